"""Simulate slides over materials with two different sensors: a BioTac on an arm, and RoboSkin on a forearm.

Even trials use the BioTac, odd ones RoboSkin; the materials alternate. A BioTac trial, as on the published rig:

1. the finger is free, then moves down at 0.5 mm/s until its pressure exceeds 40 counts (1.4 N);
2. the arm moves it at 25 mm/s for 8 s (6 s on material 1), while the force settles at about 1 N;
3. the arm lifts it.

A RoboSkin slide has 75 frames in contact, at a speed and over triangles that are not well controlled.

Each channel of both sensors measures ``gain share [F (1 + mu d) + texture(x + xi) + offset]``: xi is the position of the
channel, ``texture`` is from `tacpipe.simulation.texture`, and the offset is a nuisance. Part of it belongs to the
session: it is common to all trials of a material in the session and drifts between trials; there is also a gain per
session. If each material has only one session, as in the published recordings, this fingerprint reveals the material
without any texture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import Counts, Floats, Times
from tacpipe.channels import schema
from tacpipe.plugins.stage import Attribute, RecordingOutput
from tacpipe.simulation import faults, fingertip, forearm, texture

SENSORS = ("biotac", "roboskin")
SHARED, INDEPENDENT = SPECTRA = ("shared", "independent")
START_NS = 1_581_000_000_000_000_000  # UTC time of the first trial
TRIAL_NS = 60_000_000_000
FORCE_SPREAD = 0.05  # relative standard deviation of the force between trials
HOVER_S = (0.2, 0.4)  # range of the time before contact
APPROACH_M_S = 0.0005
SLIDE_S, SHORT_SLIDE_S, SHORT_MATERIAL = 8.0, 6.0, 1  # one published material has shorter recordings
RAMP_S = 0.3  # time in which speed and force settle
STOP_S, LIFT_S, AFTER_S = 0.1, 0.1, 0.3
SPEED_SPREAD = 0.01  # relative standard deviation of the arm's speed between trials; half of it within a trial
WANDER, MAX_WANDER = 0.07, 0.3  # relative variation of the forearm's speed: standard deviation, and limit
WANDER_S = (0.8, 2.0)  # range of the period of this variation
SESSION_GAIN, SESSION_N = 0.08, 0.07  # standard deviations between sessions: gain, and offset of each channel in N
DRIFT_N, DRIFT_TRIALS = 0.04, 50  # drift of an offset over a number of trials of a session
TRIAL_N = 0.10  # standard deviation of each channel's offset between trials
ARM_HZ = 150.0
ARM_GAP = 0.12  # fraction of the arm's readings that are followed by a gap
ARM_GAP_S = 0.04
SPEED_NOISE_M_S, SPIKE_M_S, SPIKES = 0.0006, 0.02, 0.01
FORCE_NOISE_N, TORQUE_NOISE_NM = 0.15, 0.02
MATERIAL, SESSION, TRIAL, NOISE = 1, 2, 3, 4  # parts of the random seeds


@dataclass(frozen=True)
class SlideRig:
    """The materials and the quality of the sensors. The fields are those of the stage's params.

    Control experiments: with ``identical_materials``, classes differ only in their sessions; with ``session_scale=0``,
    only in their materials; with ``spectra="independent"``, the two sensors measure unrelated textures.
    """

    materials: int = 20
    sessions: int = 1
    identical_materials: bool = False
    spectra: str = SHARED
    session_scale: float = 1.0
    noise_scale: float = 1.0
    force_n: float = 1.0
    speed_m_s: float = 0.025
    roboskin_speed_m_s: float = 0.05
    pac: bool = True
    arm_every: int = 20
    jitter_ms: float = 0.1


@dataclass(frozen=True)
class SlideTrial:
    """Sensor, material, session and number of a trial. Materials and sessions count from 1."""

    sensor: str
    material: int
    session: int
    number: int  # index of the trial among those of its sensor and material, from 0


@dataclass(frozen=True)
class SlideScene:
    """The ground truth of a trial at the sensor's sample times. Arrays have shape (time,) by default."""

    trial: SlideTrial
    material: texture.Material
    surface: texture.Waves
    true_ns: Times  # time in ns since the start of the trial
    position_m: Floats  # position along the slide
    speed_m_s: Floats
    force_n: Floats
    contact: Floats  # 0: no contact, 1: full contact
    phase: NDArray[np.int8]  # -1 before the slide, 0 during it, 1 after it
    patch_m: Floats  # (time, axis): centre of the pressed patch along and across the skin
    pressure_count: Counts  # logged fluid pressure of the finger; empty for RoboSkin


def slide_trial(index: int, rig: SlideRig) -> SlideTrial:
    """Return sensor, material, session and number of trial ``index``."""
    number, position = divmod(index, len(SENSORS) * rig.materials)
    session = number % rig.sessions + 1
    return SlideTrial(SENSORS[position % len(SENSORS)], position // len(SENSORS) + 1, session, number)


def material(seed: int, sensor: str, number: int, rig: SlideRig = SlideRig()) -> texture.Material:
    """Return material ``number`` for ``sensor``. It is the same for both sensors if they share their spectra."""
    source = SENSORS.index(sensor) if rig.spectra == INDEPENDENT else 0
    index = 0 if rig.identical_materials else number
    return texture.draw_material(np.random.default_rng([seed, MATERIAL, source, index]))


def simulate_trial(seed: int, index: int, rig: SlideRig = SlideRig()) -> RecordingOutput:
    """Simulate trial ``index`` of the rig: the stream biotac or roboskin, truth, and for some BioTac trials the arm.

    The same seed, index and rig give the same values. Columns of ``truth``, at the true times of the tactile samples,
    are ground truth.
    """
    scene = perform(seed, index, rig)
    start_ns = START_NS + index * TRIAL_NS
    rng = np.random.default_rng([seed, NOISE, index])
    signal = response(seed, index, scene, rig)
    streams = {}
    if scene.trial.sensor == "biotac":
        arrived_ns = start_ns + faults.arrivals(scene.true_ns, rig.jitter_ms * 1e6, rng)
        streams["biotac"] = schema.stream(arrived_ns, _finger(scene, signal, rig, rng), schema.biotac_fields())
        if rig.arm_every and scene.trial.number % rig.arm_every == 0:
            streams |= _arm(scene, start_ns, rig, rng)
    else:
        taxels = forearm.simulate_taxels(signal, rig.noise_scale, rng)
        note = f"from a nominal rate of {forearm.RATE_HZ:g} Hz"
        streams["roboskin"] = schema.stream(start_ns + scene.true_ns, taxels.T, schema.roboskin_fields(), note)
    streams["truth"] = _truth(scene, start_ns)
    return RecordingOutput(streams, _attributes(scene.trial))


def perform(seed: int, index: int, rig: SlideRig = SlideRig()) -> SlideScene:
    """Simulate the scene of trial ``index``."""
    trial = slide_trial(index, rig)
    rng = np.random.default_rng([seed, TRIAL, index])
    surface_material = material(seed, trial.sensor, trial.material, rig)
    surface = texture.draw_surface(surface_material, rng)
    force_n = rig.force_n * (1 + FORCE_SPREAD * float(rng.normal()))
    simulate_course = _biotac_course if trial.sensor == "biotac" else _roboskin_course
    return SlideScene(trial, surface_material, surface, *simulate_course(trial, surface_material, force_n, rig, rng))


def response(seed: int, index: int, scene: SlideScene, rig: SlideRig = SlideRig()) -> Floats:
    """Return the noise-free counts of each channel in a trial (time, channel)."""
    gain, lean, along_m, aperture_m = sensitivity(scene)
    contact_n = texture.contact_force(scene.surface, scene.position_m[:, None] + along_m, aperture_m)
    factor, offset_n = nuisance(seed, index, gain.shape[1], rig)
    pressed_n = scene.force_n[:, None] * (1 + scene.material.friction * lean)
    return factor * gain * (pressed_n + scene.contact[:, None] * (contact_n + offset_n))


def sensitivity(scene: SlideScene) -> tuple[Floats, Floats, Floats, float]:
    """Return each channel's counts per newton (time, channel), d (time, channel) and xi (channel,) in m, and sigma in m.

    These are the symbols of the module's description; sigma is the width of the aperture.
    """
    if scene.trial.sensor == "biotac":
        shape = (len(scene.true_ns), schema.ELECTRODES)
        gain, lean = (np.broadcast_to(values, shape) for values in (fingertip.gains(), fingertip.leans()))
        return gain, lean, fingertip.ALONG_M, fingertip.APERTURE_M
    gain = forearm.GAIN_COUNT_N * forearm.fractions(scene.patch_m)
    return gain, forearm.leans(scene.patch_m), forearm.ALONG_M, forearm.APERTURE_M


def nuisance(seed: int, index: int, number: int, rig: SlideRig = SlideRig()) -> tuple[float, Floats]:
    """Return the gain of a trial's session, and the offsets (channel,) in N of ``number`` channels in the trial."""
    trial = slide_trial(index, rig)
    rng = np.random.default_rng([seed, SESSION, SENSORS.index(trial.sensor), trial.material, trial.session])
    factor = float(np.exp(rig.session_scale * SESSION_GAIN * rng.normal()))
    offset, drift = rng.normal(0, 1, (2, number))
    late = trial.number // rig.sessions / DRIFT_TRIALS
    noise = np.random.default_rng([seed, SESSION, index]).normal(0, 1, number)
    return factor, rig.session_scale * (SESSION_N * offset + DRIFT_N * late * drift) + rig.noise_scale * TRIAL_N * noise


def _biotac_course(
    trial: SlideTrial, surface_material: texture.Material, force_n: float, rig: SlideRig, rng: np.random.Generator
) -> tuple[Any, ...]:
    """Return the arrays of a BioTac slide, which starts with the first sample whose pressure exceeds the trigger."""
    rate_hz = fingertip.RATE_HZ
    touch_s, phase_s = rng.uniform(*HOVER_S), rng.random() / rate_hz
    loading_n_s = surface_material.stiffness_n_m * APPROACH_M_S
    short = trial.material == SHORT_MATERIAL and not rig.identical_materials
    duration_s = SHORT_SLIDE_S if short else SLIDE_S
    longest_s = touch_s + 2 * fingertip.TRIGGER_COUNT / fingertip.PRESSURE_COUNT_N / loading_n_s
    at_s = phase_s + np.arange(round((longest_s + duration_s + AFTER_S) * rate_hz)) / rate_hz
    noise = rig.noise_scale * rng.normal(0, fingertip.PRESSURE_NOISE_COUNT, len(at_s))
    coming_n = loading_n_s * np.maximum(at_s - touch_s, 0)
    first = int((fingertip.pressure(coming_n, noise) > fingertip.TRIGGER_COUNT).argmax())
    rows = first + round((duration_s + AFTER_S) * rate_hz)
    at_s, since_s = at_s[:rows], at_s[:rows] - at_s[first]
    position_m, speed_m_s = _arm_motion(since_s, duration_s, rig.speed_m_s, rng)
    settling = np.clip(since_s / RAMP_S, 0, 1)
    lifting = 1 - np.clip((since_s - duration_s) / LIFT_S, 0, 1)
    sliding_n = (1 - settling) * coming_n[first] + settling * force_n
    pressed_n = np.where(since_s < 0, coming_n[:rows], sliding_n * lifting)
    phase = np.where(since_s < 0, -1, np.where(np.arange(rows) < first + round(duration_s * rate_hz), 0, 1))
    return (
        np.rint(at_s * 1e9).astype(np.int64),
        position_m,
        speed_m_s,
        pressed_n,
        np.clip(pressed_n / force_n, 0, 1),
        phase.astype(np.int8),
        np.tile(fingertip.CENTRE_M[:2], (rows, 1)),
        fingertip.pressure(pressed_n, noise[:rows]),
    )


def _roboskin_course(
    trial: SlideTrial, surface_material: texture.Material, force_n: float, rig: SlideRig, rng: np.random.Generator
) -> tuple[Any, ...]:
    """Return the arrays of a RoboSkin slide, which is in contact in all frames, with a varying speed."""
    at_s = np.arange(forearm.FRAMES) / forearm.RATE_HZ
    variation = float(np.clip(WANDER * rng.normal(), -MAX_WANDER, MAX_WANDER))
    period_s, phase = rng.uniform(*WANDER_S), rng.uniform(0, 2 * np.pi)
    turn = 2 * np.pi / period_s
    speed = rig.roboskin_speed_m_s * (1 + variation * np.sin(turn * at_s + phase))
    way = rig.roboskin_speed_m_s * (at_s - variation / turn * (np.cos(turn * at_s + phase) - np.cos(phase)))
    start_m, roll_m = (np.array([rng.uniform(*axis) for axis in axes]) for axes in (forearm.START_M, forearm.ROLL_M))
    return (
        np.rint(at_s * 1e9).astype(np.int64),
        way,
        speed,
        np.full(len(at_s), force_n),
        np.ones(len(at_s)),
        np.zeros(len(at_s), np.int8),
        start_m + np.outer(at_s / at_s[-1], roll_m),
        np.empty(0, np.uint16),
    )


def _arm_motion(
    since_s: Floats, duration_s: float, limit_m_s: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return position and speed of the arm (time,) at ``since_s`` after its start."""
    grid = np.arange(0, duration_s, 0.001)
    swing, period_s, phase = rng.normal(0, SPEED_SPREAD / 2), rng.uniform(1, 4), rng.uniform(0, 2 * np.pi)
    speed = limit_m_s * (1 + SPEED_SPREAD * rng.normal() + swing * np.sin(2 * np.pi * grid / period_s + phase))
    speed *= np.clip(grid / RAMP_S, 0, 1) * np.clip((duration_s - grid) / STOP_S, 0, 1)
    position = np.append(0, np.cumsum(speed[:-1] + np.diff(speed) / 2) * 0.001)
    return np.interp(since_s, grid, position), np.interp(since_s, grid, speed, left=0.0, right=0.0)


def _finger(scene: SlideScene, signal: Floats, rig: SlideRig, rng: np.random.Generator) -> list[Any]:
    """Return the 44 columns (time,) of the stream biotac."""
    electrodes = fingertip.simulate_counts(signal, rig.noise_scale, rng)
    touched = scene.true_ns[int((scene.force_n > 0).argmax())]
    tdc, tac = fingertip.warmth((scene.true_ns - touched) / 1e9, rig.noise_scale, rng)
    pac = np.zeros((len(signal), schema.VIBRATIONS), np.uint16)
    if rig.pac:
        rows = np.arange(pac.size) / schema.VIBRATIONS
        at, contact = (np.interp(rows, np.arange(len(signal)), values) for values in (scene.position_m, scene.contact))
        pac = fingertip.vibration(
            contact * texture.contact_force(scene.surface, at, fingertip.APERTURE_M), rig.noise_scale, rng
        )
    return [tdc, tac, scene.pressure_count, *pac.T, *electrodes.T]


def _arm(scene: SlideScene, start_ns: int, rig: SlideRig, rng: np.random.Generator) -> dict[str, pa.Table]:
    """Return the streams twist and wrench of the arm, on its own clock and with gaps.

    The arm slides along -x, and z is up. Angular velocity is NaN, as in the published recordings.
    """
    sample_ns = faults.samples(int(scene.true_ns[-1]), ARM_HZ, 0.0, rng).true_ns
    silent = rng.random(len(sample_ns)) < ARM_GAP
    gap_end_ns = np.maximum.accumulate(
        np.where(silent, sample_ns + rng.exponential(ARM_GAP_S * 1e9, len(sample_ns)), 0)
    )
    sample_ns = sample_ns[np.append(True, sample_ns[1:] > gap_end_ns[:-1])]
    arrived_ns = start_ns + faults.arrivals(sample_ns, rig.jitter_ms * 1e6, rng)
    speed, force = (np.interp(sample_ns, scene.true_ns, values) for values in (scene.speed_m_s, scene.force_n))
    phase = np.interp(sample_ns, scene.true_ns, scene.phase)
    zeros = np.zeros(len(sample_ns))
    down = np.where(phase < 0, APPROACH_M_S, 0.0)
    twist = np.column_stack([-speed, zeros, -down]) + rig.noise_scale * rng.normal(
        0, SPEED_NOISE_M_S, (len(sample_ns), 3)
    )
    spikes = np.flatnonzero(rng.random(len(sample_ns)) < SPIKES * (rig.noise_scale > 0))
    twist[spikes, 0] += rng.choice([-SPIKE_M_S, SPIKE_M_S], len(spikes))
    load = np.column_stack([scene.material.friction * force * (speed > 0), zeros, force])
    load += rig.noise_scale * rng.normal(0, FORCE_NOISE_N, load.shape)
    turned = rig.noise_scale * rng.normal(0, TORQUE_NOISE_NM, load.shape)
    unknown = np.full((3, len(sample_ns)), np.nan)
    return {
        "twist": schema.stream(arrived_ns, [*twist.T, *unknown], schema.twist_fields()),
        "wrench": schema.stream(arrived_ns, [*load.T, *turned.T], schema.wrench_fields()),
    }


def _truth(scene: SlideScene, start_ns: int) -> pa.Table:
    """Return the stream ``truth``, at the true times of the tactile samples."""
    fields = [
        schema.float_field("gt_position_m", "m", "position"),
        schema.float_field("gt_speed_m_s", "m/s", "speed"),
        schema.float_field("gt_force_n", "N", "force"),
        schema.float_field("gt_patch_along_m", "m", "position"),
        schema.float_field("gt_patch_across_m", "m", "position"),
        pa.field("gt_phase", pa.int8(), metadata={"unit": "1", "quantity": "label"}),
    ]
    columns = [scene.position_m, scene.speed_m_s, scene.force_n, *scene.patch_m.T, scene.phase]
    return schema.stream(start_ns + scene.true_ns, columns, fields)


def _attributes(trial: SlideTrial) -> dict[str, Attribute]:
    return {
        "sensor": trial.sensor,
        "simulated": True,
        "material": trial.material,
        "trial": trial.number + 1,
        "session": f"{trial.sensor}-m{trial.material:02d}-s{trial.session}",
        "rate_hz": fingertip.RATE_HZ if trial.sensor == "biotac" else forearm.RATE_HZ,
        **({"layout": "time"} if trial.sensor == "roboskin" else {}),
    }
