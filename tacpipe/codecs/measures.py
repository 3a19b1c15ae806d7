"""Measure a fitted codec, as ``codec.json`` holds it.

==================  ==============================================================================================
reconstruction      of ``train`` rows and of ``val``, training recordings that were held out: mean squared error of
                    encoding and decoding in units of each channel's scale, where 1 is what a codec without latents
                    gives, and mean absolute error in counts
latent_covariance   of the latents of the training rows, (latent, latent)
search              the networks that were tried; see `tacpipe.codecs.autoencoder_fit`
==================  ==============================================================================================

Errors are those of the newest frame and, of a codec of increments, those of the increments.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    Floats = np.ndarray[Any, np.dtype[np.floating[Any]]]

NAMES = ("reconstruction", "latent_covariance", "search")
DIGITS = 6  # stored digits; beyond them the order of additions matters, which the number of threads changes


class Fitted(Protocol):
    """A codec that reads rows as `tacpipe.codecs.frame_stacking.inputs` makes them."""

    @property
    def scale_count(self) -> Floats:
        """The spread of each channel on training rows, in counts."""

    def project(self, inputs: Floats) -> Floats:
        """Return the latents (row, latent) of finite rows (row, frames * channel)."""

    def decode(self, latents: Floats) -> Floats:
        """Return the counts that latents decode to."""


def reconstructions(codec: Fitted, parts: Mapping[str, Iterable[Floats]]) -> dict[str, dict[str, float]]:
    """Return the errors on each part, of rows (row, frames * channel) in pieces; a part without rows is left out."""
    errors_by_part = {name: reconstruction(codec, pieces) for name, pieces in parts.items()}
    return {name: errors for name, errors in errors_by_part.items() if errors}


def reconstruction(codec: Fitted, pieces: Iterable[Floats]) -> dict[str, float]:
    """Return the errors of encoding and decoding rows (row, frames * channel), and their number; nothing of no rows."""
    rows, squares, deviations, width = 0, 0.0, 0.0, len(codec.scale_count)
    for inputs in pieces:
        newest = inputs[:, -width:]
        error = codec.decode(codec.project(inputs).astype(np.float32)) - newest
        rows += len(inputs)
        squares += float(np.square(error / codec.scale_count).sum())
        deviations += float(np.abs(error).sum())
    if not rows:
        return {}
    return {
        "rows": rows,
        "mse_standardised": rounded(squares / (rows * width)),
        "mae_counts": rounded(deviations / (rows * width)),
    }


def covariance(latents: Floats) -> list[list[float]]:
    """Return the covariance of latents (row, latent), (latent, latent)."""
    return rounded_matrix(np.atleast_2d(np.cov(latents.astype(np.float64), rowvar=False)))


def rounded_matrix(matrix: Floats) -> list[list[float]]:
    """Return a matrix rounded to the stored digits of its largest entry."""
    digits = DIGITS - 1 - int(np.floor(np.log10(max(float(np.abs(matrix).max()), 1e-30))))
    return (matrix.round(digits) + 0.0).tolist()  # type: ignore[no-any-return]  # + 0.0: no minus before a 0


def rounded(value: float) -> float:
    """Return ``value`` rounded to the stored digits.

    >>> rounded(0.123456789)
    0.123457
    """
    return float(f"{value:.{DIGITS}g}")


def stored(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return what ``codec.json`` holds of measures."""
    return {name: content[name] for name in NAMES if name in content}
