"""Classify the material of a simulated slide with known spectra, as a reference for classifiers that have to learn.

Known are the spectra of all materials, where the sensor was on its way, how sensitive each channel is and how hard it was
pressed; not known are phases, backgrounds, wear, the session's gain and offsets, and noise. All channels measure one
surface, each displaced by where it lies, so they are put together again as a track: at each place the mean of what all
channels measured there, weighted by the squares of their gains. The track's periodogram P is compared with the one expected
of each material, E, by Whittle's likelihood (P. Whittle, Arkiv för Matematik 2, 1953): minus the sum of log E + P / E
over wave numbers. Of a few gains common to all channels the best counts.

Levels are taken off: only texture counts. The likelihood is meant for Gaussian surfaces; a grating of random phase is none,
so this is close to the best classifier of texture, but no strict bound; and one that also reads the offsets of a session
can beat it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tacpipe.arrays import Floats, Int32s
from tacpipe.simulation import fingertip, forearm, slide, texture

FRAMES = 400  # frames from the middle of a BioTac's slide, as classifiers read them
STEP_M = 0.0005  # distance between two places of a track
# wavelength that is compared; shorter ones do not pass the aperture
MIN_WAVELENGTH_M = {"biotac": 0.002, "roboskin": 0.0035}
MAX_WAVELENGTH_M = 0.020  # longer ones went with the levels
MIN_WEIGHT = 0.02  # fraction of the largest weight of a place; places with less do not count
GAINS = (0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.4)
MISFIT = 0.003  # fraction of a texture's power at other wave numbers than expected, of stretch, wear and levels
FINE = 16  # wave numbers at which a taper's spectrum is known, between two of the periodogram


@dataclass(frozen=True)
class SlideTrack:
    """Measurements along the way; arrays are (place,)."""

    texture_n: Floats
    noise_n2: Floats  # variance
    taper: Floats  # its squares add up to one, or 0 if nothing was measured


def likelihood_accuracy(seed: int, indices: Sequence[int], rig: slide.SlideRig) -> float:
    """Return the fraction of trials ``indices`` of the rig whose material is classified correctly."""
    materials = [slide.slide_trial(index, rig).material for index in indices]
    return float(np.mean(likelihood_materials(seed, indices, rig) == np.array(materials)))


def likelihood_materials(seed: int, indices: Sequence[int], rig: slide.SlideRig) -> Int32s:
    """Return the material that each of trials ``indices`` of the rig most likely is of (trial,), 1 to ``rig.materials``."""
    return np.array([log_likelihoods(seed, index, rig).argmax() + 1 for index in indices], np.int32)


def log_likelihoods(seed: int, index: int, rig: slide.SlideRig) -> Floats:
    """Return Whittle's log-likelihood of each material for trial ``index`` (material,), but for a constant."""
    sensor = slide.slide_trial(index, rig).sensor
    track = _slide_track(seed, index, rig)
    size = 2 * len(track.taper)
    number = np.fft.rfftfreq(size, STEP_M)
    compared = (number >= 1 / MAX_WAVELENGTH_M) & (number <= 1 / MIN_WAVELENGTH_M[sensor])
    observed = np.abs(np.fft.rfft(track.taper * track.texture_n, size)[compared]) ** 2
    floor = float((track.taper**2 * track.noise_n2).sum())
    window = np.abs(np.fft.fft(track.taper, FINE * size)) ** 2
    aperture_m = fingertip.APERTURE_M if sensor == "biotac" else forearm.APERTURE_M
    likelihoods = []
    for material in range(1, rig.materials + 1):
        wave, power = texture.spectrum(slide.material(seed, sensor, material, rig), aperture_m)
        offsets = np.rint((number[compared, None] - wave) * FINE * size * STEP_M).astype(int) % len(window)
        passed = window[offsets] @ power / 2 + MISFIT * power.sum()
        expected = np.outer(np.square(GAINS), passed) + floor  # (gain, wave number)
        likelihoods.append(-(np.log(expected) + observed / expected).sum(axis=1).min() / 2)
    return np.array(likelihoods)


def _slide_track(seed: int, index: int, rig: slide.SlideRig) -> SlideTrack:
    """Return the track of trial ``index``: what each channel measured, less its mean, put together where it was measured."""
    scene = slide.perform(seed, index, rig)
    sensor = scene.trial.sensor
    table = slide.simulate_trial(seed, index, replace(rig, pac=False, arm_every=0)).streams[sensor]
    names = [name for name in table.column_names if name.startswith(("electrode", "triangle"))]
    gain, lean, along_m, _ = slide.sensitivity(scene)
    rows = np.flatnonzero(scene.phase == 0)
    if sensor == "biotac":
        rows = rows[(len(rows) - FRAMES) // 2 :][:FRAMES]
    counts = np.column_stack([table.column(name).to_numpy()[rows] for name in names]).astype(float)
    gain, pressed_n = gain[rows], scene.force_n[rows, None] * (1 + np.mean(texture.FRICTION) * lean[rows])
    if sensor == "biotac":
        weight, noise, rounding = gain**2, fingertip.NOISE_COUNT, 1 / 12
    else:
        weight, noise, rounding = gain**2 * (counts > 0), forearm.NOISE_COUNT, 0.0
        counts += forearm.DEAD_COUNT  # the sensor subtracts it from each reading
    texture_n = counts / gain - pressed_n
    texture_n -= (weight * texture_n).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12)
    at_m = scene.position_m[rows, None] + along_m
    place = ((at_m - at_m.min()) / STEP_M).astype(int).ravel()
    total = np.bincount(place, weight.ravel())
    summed = np.bincount(place, (weight * texture_n).ravel())
    enough = total > MIN_WEIGHT * total.max()
    span = slice(enough.argmax(), len(enough) - enough[::-1].argmax())
    total, summed, enough = total[span], summed[span], enough[span]
    divisor = np.where(enough, total, 1.0)
    taper = np.hanning(len(divisor) + 2)[1:-1] * enough
    contact_n = np.where(enough, summed / divisor, 0.0)
    contact_n -= (taper * contact_n).sum() / taper.sum()
    noise_n2 = ((rig.noise_scale * noise) ** 2 + rounding) / divisor
    return SlideTrack(contact_n, noise_n2, taper / np.sqrt((taper**2).sum()))
