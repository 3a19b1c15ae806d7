"""Measure a fitted codec for ``codec.json``.

==================  ==============================================================================================
reconstruction      errors on ``train`` rows and on ``val``, held-out training recordings: mean squared error of
                    encoding and decoding in units of each channel's scale, which is 1 for a codec without latents,
                    and mean absolute error in counts
latent_covariance   covariance (latent, latent) of the training rows' latents
search              the candidate networks; see `tacpipe.codecs.autoencoder_fit`
==================  ==============================================================================================

Errors are those of the newest frame, or of its increments.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NotRequired, Protocol, TypedDict

import numpy as np

from tacpipe.arrays import AnyFloats, Bools
from tacpipe.codecs.codec import LEVELS
from tacpipe.errors import TacpipeError

DIGITS = 6  # stored digits; further digits depend on the order of additions, so on the number of threads


class Reconstruction(TypedDict):
    """Errors of encoding and decoding rows."""

    rows: int
    mse_standardised: float
    mae_counts: float


class SearchedNetwork(TypedDict):
    """A candidate network of a search."""

    hidden: list[int]
    learning_rate: float
    weight_decay: float
    parameters: int
    epochs: int
    val_loss: float
    kept: bool


class CodecMeasures(TypedDict, total=False):
    """The measures of a fitted codec."""

    reconstruction: dict[str, Reconstruction]  # keyed by ``train`` and ``val``
    latent_covariance: list[list[float]]
    search: list[SearchedNetwork]


class StoredCodec(CodecMeasures):
    """``codec.json`` of tacpipe's own codecs."""

    kind: str
    of: str  # levels or increments
    channels: list[str]
    layout: list[dict[str, str]]
    latents: int
    frames: NotRequired[int]
    explained_ratio: NotRequired[list[float]]
    layers: NotRequired[dict[str, int]]


class RowCodec(Protocol):
    """A codec that reads rows of `tacpipe.codecs.codec.codec_inputs`."""

    @property
    def scale_count(self) -> AnyFloats:
        """The spread of each channel (channel,) on training rows, in counts."""

    def project(self, inputs: AnyFloats) -> AnyFloats:
        """Return the latents (row, latent) of finite rows (row, frames * channel)."""

    def decode(self, latents: AnyFloats) -> AnyFloats:
        """Decode latents (row, latent) to counts (row, channel)."""


def reconstructions(codec: RowCodec, parts: Mapping[str, Iterable[AnyFloats]]) -> dict[str, Reconstruction]:
    """Return the errors on each part, given as chunks of rows (row, frames * channel). Parts without rows are omitted."""
    errors_by_part = {name: reconstruction(codec, pieces) for name, pieces in parts.items()}
    return {name: errors for name, errors in errors_by_part.items() if errors}


def reconstruction(codec: RowCodec, pieces: Iterable[AnyFloats]) -> Reconstruction | None:
    """Return the errors of encoding and decoding rows (row, frames * channel), and their number; None without rows."""
    rows, squares, deviations, width = 0, 0.0, 0.0, len(codec.scale_count)
    for inputs in pieces:
        newest = inputs[:, -width:]
        error = codec.decode(codec.project(inputs).astype(np.float32)) - newest
        rows += len(inputs)
        squares += float(np.square(error / codec.scale_count).sum())
        deviations += float(np.abs(error).sum())
    if not rows:
        return None
    return {
        "rows": rows,
        "mse_standardised": rounded(squares / (rows * width)),
        "mae_counts": rounded(deviations / (rows * width)),
    }


def covariance(latents: AnyFloats) -> list[list[float]]:
    """Return the covariance (latent, latent) of latents (row, latent)."""
    return rounded_matrix(np.atleast_2d(np.cov(latents.astype(np.float64), rowvar=False)))


def rounded_matrix(matrix: AnyFloats) -> list[list[float]]:
    """Round a matrix to the stored digits of its largest entry."""
    digits = DIGITS - 1 - int(np.floor(np.log10(max(float(np.abs(matrix).max()), 1e-30))))
    return (matrix.round(digits) + 0.0).tolist()  # type: ignore[no-any-return]  # + 0.0: no -0


def rounded(value: float) -> float:
    """Round ``value`` to the stored digits."""
    return float(f"{value:.{DIGITS}g}")


def measures_from(content: StoredCodec) -> CodecMeasures:
    """Return the measures in ``codec.json``."""
    measures: CodecMeasures = {}
    if "reconstruction" in content:
        measures["reconstruction"] = content["reconstruction"]
    if "latent_covariance" in content:
        measures["latent_covariance"] = content["latent_covariance"]
    if "search" in content:
        measures["search"] = content["search"]
    return measures


def constant_channels(values: AnyFloats, channels: Sequence[str]) -> list[str]:
    """Return the names of the channels that are constant in ``values`` (time, channel)."""
    return [name for name, moves in zip(channels, _varies(values), strict=True) if not moves]


def mean_and_scale(values: AnyFloats, representation: str) -> tuple[AnyFloats, AnyFloats]:
    """Return mean and scale of each channel in counts, both (channel,), of training rows ``values`` (time, channel).

    The scale is the standard deviation, or 1 for a constant channel. The mean of increments is set to 0, so that rows
    without change have latents 0. Raises `TacpipeError` if all channels are constant.
    """
    moves = _varies(values)
    if not moves.any():
        raise no_moving_channel_error(values.shape[1], len(values))
    mean = values.mean(axis=0) if representation == LEVELS else np.zeros(values.shape[1])
    return mean, np.where(moves, values.std(axis=0), 1.0)


def no_moving_channel_error(channels: int, rows: int) -> TacpipeError:
    """Return the error for training rows in which all channels are constant."""
    return TacpipeError(
        f"None of the {channels} tactile channels changes in {rows} training rows, so there is nothing to compress. Give "
        "training recordings with contact."
    )


def _varies(values: AnyFloats) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return whether each channel has more than one value; exact, in contrast to a standard deviation."""
    if not len(values):
        return np.zeros(values.shape[1], dtype=bool)
    moves: np.ndarray[Any, np.dtype[np.bool_]] = values.max(axis=0) > values.min(axis=0)
    return moves


class Moments:
    """The number, range and triangular factor of rows (row, channel).

    Covariances are stored as the triangular factor R of a QR decomposition of all rows, [1 | x] = Q R, which has as
    many rows as columns. Adding rows updates it to the factor of R with the new rows below (Golub, Van Loan, Matrix
    Computations, 4th ed., 6.5), so products of rows are never summed, and the means cost no precision.
    """

    def __init__(self, width: int) -> None:
        self.count = 0  # number of rows
        self._low, self._high = np.full(width, np.inf), np.full(width, -np.inf)
        self._triangle: AnyFloats = np.zeros((width + 1, width + 1))

    @classmethod
    def from_pieces(cls, pieces: Iterable[AnyFloats], width: int) -> Moments:
        """Return the moments of chunks of rows (row, channel), given the number of channels."""
        moments = cls(width)
        for piece in pieces:
            moments.add(piece)
        return moments

    def add(self, rows: AnyFloats) -> None:
        """Add rows (row, channel) to the moments."""
        if len(rows):
            self.count += len(rows)
            self._low, self._high = np.minimum(self._low, rows.min(axis=0)), np.maximum(self._high, rows.max(axis=0))
            self._extend(np.column_stack([np.ones(len(rows)), rows]))

    def merge(self, further: Moments) -> Moments:
        """Return the moments of both sets of rows, without changing either."""
        merged = Moments(len(self._low))
        merged.count = self.count + further.count
        merged._low, merged._high = np.minimum(self._low, further._low), np.maximum(self._high, further._high)
        merged._triangle = self._triangle
        merged._extend(further._triangle)
        return merged

    @property
    def varies(self) -> Bools:
        """Whether each channel (channel,) has more than one value; exact, in contrast to a standard deviation."""
        return self._high > self._low

    @property
    def centred_triangle(self) -> AnyFloats:
        """The triangular factor (channel, channel) of the centred rows."""
        return self._triangle[1:, 1:] * self.varies

    def mean_and_scale(self, representation: str) -> tuple[AnyFloats, AnyFloats]:
        """Return mean and scale of each channel, both (channel,), as `tacpipe.codecs.measures.mean_and_scale`.

        The mean is 0 unless ``representation`` is levels. The scale is the standard deviation, or 1 for a constant channel.

        Raises `TacpipeError` if all channels are constant.
        """
        if not self.varies.any():
            raise no_moving_channel_error(len(self._low), self.count)
        spread = np.sqrt(np.square(self.centred_triangle).sum(axis=0) / self.count)
        # The first row of the triangle is the count and the sums of channels, over the root of the count.
        mean = self._triangle[0, 1:] / self._triangle[0, 0] if representation == LEVELS else np.zeros(len(spread))
        return mean, np.where(self.varies, spread, 1.0)

    def standardised_triangle(self, representation: str) -> AnyFloats:
        """Return the triangular factor (channel, channel) of the standardised rows.

        Raises the errors of `mean_and_scale`.
        """
        _, scale = self.mean_and_scale(representation)
        if representation == LEVELS:
            return self.centred_triangle / scale
        return _triangle(self._triangle[:, 1:] / scale)

    def _extend(self, rows: AnyFloats) -> None:
        self._triangle = _triangle(np.concatenate([self._triangle, rows]))


def _triangle(rows: AnyFloats) -> AnyFloats:
    """Return the triangular factor R (column, column) of a QR decomposition of rows (row, column)."""
    return np.asarray(np.linalg.qr(rows, mode="r"))
