"""Measure how strong waves of each length are in a slide, which unlike sensors share.

A wave of the surface with k periods a metre shakes a sensor that slides at v metres a second with f = k v hertz. Over
spatial frequency k, the spectra of one material are therefore alike whatever sensor recorded it, at whatever speed and rate,
up to what the sensor itself does to each k: its gain, and its aperture, which passes the fraction exp(-2 (pi sigma k)^2) of
an amplitude. Both are offsets of the logarithm. All sensors are read over the same way and in the same bands, so that
they separate waves equally well, and only where all of them take samples densely enough.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyFloats
from tacpipe.errors import TacpipeError

BANDS = 16
PERIODS = (
    3.0  # fewest periods of the longest wave in the way; a slower one cannot be separated from a change of pressure
)
HIGHEST = 0.6  # fraction of the spatial frequency above which a sensor would take a wave for a longer one
LINES = 4  # spatial frequencies at which a band is read
LEADING = 0.3  # fraction of the channels that are read, those pressed most; the others may not touch at all
HOP = 0.25  # distance of windows, as a fraction of their length
ROUNDING = 1 / 12  # counts^2, power of whole counts' rounding: no spectrum lies below
READ = 256  # slides that are read at once


@dataclass(frozen=True)
class Sampling:
    """How a sensor's slides come about."""

    frames: int
    rate_hz: float
    speed_m_s: float

    @property
    def way_m(self) -> float:
        """How far a slide goes."""
        return self.frames * self.speed_m_s / self.rate_hz

    @property
    def highest_per_m(self) -> float:
        """The spatial frequency of which there are two samples a period."""
        return self.rate_hz / (2 * self.speed_m_s)


@dataclass(frozen=True)
class Bands:
    """The way over which spectra are taken and the bands of spatial frequency."""

    way_m: float
    edges_per_m: AnyFloats  # (band + 1,)

    @classmethod
    def common(cls, sensors: Sequence[Sampling], number: int = BANDS) -> Bands:
        """Return ``number`` bands, alike on a logarithmic scale, that all sensors can be read in.

        They begin at `PERIODS` in the shortest slide's way and end at the fraction `HIGHEST` of the lowest frequency that
        a sensor could separate from others. Raises `TacpipeError` where nothing lies between.

        >>> Bands.common([Sampling(400, 100.0, 0.025), Sampling(75, 50.0, 0.05)]).edges_per_m[[0, -1]].round(3).tolist()
        [40.0, 300.0]
        """
        way_m = min(sampling.way_m for sampling in sensors)
        lowest, highest = PERIODS / way_m, HIGHEST * min(sampling.highest_per_m for sampling in sensors)
        if not lowest < highest:
            raise TacpipeError(
                f"The shortest slide goes {way_m:.3g} m and shows waves of more than {lowest:.3g} periods a metre, but a "
                f"sensor shows but those of less than {highest:.3g}. Give longer slides, or the speeds that were meant."
            )
        return cls(way_m, np.geomspace(lowest, highest, number + 1))

    def log_power(self, slides: AnyFloats, rate_hz: float, speed_m_s: float) -> AnyFloats:
        """Return the features of slides (slide, time, channel): (slide, band + 1), natural logarithms of power.

        The first are the power in each band less the mean of all bands; the last is that mean, as a density over spatial
        frequency (m), less the power of the pressure itself, so that neither gain nor force counts. Each is the median
        over the channels that are pressed most, so that a channel out of order does not count either. Raises
        `TacpipeError` for slides shorter than the way and for values that are not finite.
        """
        window = round(self.way_m / speed_m_s * rate_hz)
        if slides.ndim != 3 or window > slides.shape[1]:
            raise TacpipeError(
                f"Slides of {slides.shape} do not go {self.way_m:.3g} m; (slide, time, channel) of {window} frames or "
                f"more would."
            )
        if not np.isfinite(slides).all():
            raise TacpipeError("Some slides hold values that are not finite. Segment them again, or leave these out.")
        step_m = speed_m_s / rate_hz
        waves = self._waves(window, step_m)
        parts = [self._read(slides[first : first + READ], waves) for first in range(0, len(slides), READ)]
        features = np.concatenate(parts) if parts else np.empty((0, len(self.edges_per_m)))
        features[:, -1] += np.log(step_m)
        return features

    def _read(self, slides: AnyFloats, waves: NDArray[np.complex64]) -> AnyFloats:
        """Return the features of a few slides."""
        level = np.maximum(slides.mean(axis=1, dtype=np.float64), 0)  # (slide, channel)
        leading = np.argsort(-level, axis=1, kind="stable")[:, : max(1, round(LEADING * level.shape[1]))]
        chosen = np.take_along_axis(slides, leading[:, None], axis=2).astype(np.float32)
        level = np.take_along_axis(level, leading, axis=1)
        spectra = [self._power(part, waves) for part in _windows(chosen, len(waves))]
        power = np.log(np.mean(spectra, axis=0) + ROUNDING)  # (slide, channel, band)
        mean = power.mean(axis=2)
        shape = np.median(power - mean[:, :, None], axis=1)
        strength = np.median(mean - 2 * np.log(level + 1), axis=1)
        return np.column_stack([shape - shape.mean(axis=1, keepdims=True), strength])

    def _power(self, part: AnyFloats, waves: NDArray[np.complex64]) -> AnyFloats:
        """Return the power of a window of slides (slide, time, channel) in each band: (slide, channel, band), counts^2."""
        moved = part - part.mean(axis=1, keepdims=True)
        lines = np.square(np.abs(np.tensordot(moved, waves, axes=(1, 0))))  # (slide, channel, line)
        power: AnyFloats = lines.reshape(*lines.shape[:2], -1, LINES).mean(axis=3)
        return power

    def _waves(self, window: int, step_m: float) -> NDArray[np.complex64]:
        """Return the waves (time, line) that windows are compared with, tapered; white noise has its variance as power."""
        width = np.diff(np.log(self.edges_per_m))[:, None]
        lines = np.log(self.edges_per_m[:-1, None]) + width * (np.arange(LINES) + 0.5) / LINES
        taper = np.hanning(window + 2)[1:-1]
        angle = 2 * np.pi * step_m * np.outer(np.arange(window), np.exp(lines).ravel())
        waves = (taper / np.sqrt(np.square(taper).sum()))[:, None] * np.exp(-1j * angle)
        return np.asarray(waves, np.complex64)


def _windows(slides: AnyFloats, window: int) -> Iterator[AnyFloats]:
    """Yield overlapping windows of slides (slide, time, channel)."""
    for first in range(0, slides.shape[1] - window + 1, max(1, round(HOP * window))):
        yield slides[:, first : first + window]
