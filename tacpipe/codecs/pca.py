"""Fit and apply principal components of standardised tactile channels.

The equations are standard (Pearson 1901): with the mean and standard deviation s of each channel on training rows,
latent = W ((counts - mean) / s) with orthonormal rows in W, and counts = mean + s (latent W). For increments, the mean
is 0.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from safetensors.numpy import save as save_tensors

from tacpipe.arrays import AnyFloats, Bools
from tacpipe.codecs import codec as codecs
from tacpipe.codecs import measures
from tacpipe.codecs.codec import (
    DESCRIPTION,
    TENSORS,
    check_channels,
    description,
    encode_finite,
    latent_names,
)
from tacpipe.codecs.measures import Moments
from tacpipe.codecs.training_rows import CodecRows, held_out, warn_of_constant_channels
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError


@dataclass(frozen=True)
class PCA:
    """A fitted PCA. Arrays are float64: mean and scale in counts, ``components`` without unit."""

    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    mean_count: AnyFloats  # (channel,)
    scale_count: AnyFloats  # (channel,)
    components: AnyFloats  # (latent, channel)
    explained_ratio: AnyFloats  # (component,), for all components, including dropped ones
    representation: str = codecs.LEVELS
    measured: measures.CodecMeasures = field(default_factory=measures.CodecMeasures)
    kind: str = "pca"

    @property
    def latents(self) -> tuple[str, ...]:
        """The names of the latents; ``z00`` has the most variance."""
        return latent_names(len(self.components))

    @property
    def reads(self) -> int:
        """The number of rows that the latents of a row depend on."""
        return 2 if self.representation == codecs.INCREMENTS else 1

    def encode(self, values: AnyFloats, channels: Sequence[str], begins: Bools | None = None) -> AnyFloats:
        """Return the latents (time, latent), float32, of counts above rest (time, channel).

        Raises `TacpipeError` unless ``channels`` are those of the fit, in the same order.
        """
        check_channels(self.channels, channels)
        return encode_finite(
            self.project, codecs.codec_inputs(values, begins, self.representation, 1), len(self.components)
        )

    def project(self, inputs: AnyFloats) -> AnyFloats:
        """Return the latents (row, latent) of finite rows (row, channel) of the codec's ``representation``."""
        return ((inputs - self.mean_count) / self.scale_count) @ self.components.T

    def decode(self, latents: AnyFloats) -> AnyFloats:
        """Decode latents (…, latent) to counts (…, channel), float64."""
        return (latents @ self.components) * self.scale_count + self.mean_count

    def to_files(self) -> dict[str, bytes]:
        """Return the content of ``codec.safetensors`` and ``codec.json``."""
        content = {
            **self.measured,
            "kind": self.kind,
            "of": self.representation,
            "channels": list(self.channels),
            "layout": [dict(channel) for channel in self.layout],
            "latents": len(self.components),
            "explained_ratio": [round(float(ratio), 9) for ratio in self.explained_ratio],
        }
        tensors = {
            "mean_count": self.mean_count,
            "scale_count": self.scale_count,
            "components": np.ascontiguousarray(self.components),
            "explained_ratio": self.explained_ratio,
        }
        return {TENSORS: save_tensors(tensors), DESCRIPTION: description(content)}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> PCA:
        """Return the codec that `to_files` stored."""
        content, tensors = json.loads(files[DESCRIPTION]), model_files.arrays(files[TENSORS], TENSORS)
        return cls(
            tuple(content["channels"]),
            tuple(content["layout"]),
            tensors["mean_count"],
            tensors["scale_count"],
            tensors["components"],
            tensors["explained_ratio"],
            content["of"],
            measures.measures_from(content),
        )


def fit(
    rows: Moments,
    channels: Sequence[str],
    layout: Sequence[Mapping[str, str]],
    *,
    components: int = 20,
    variance: float = 0.0,
    representation: str = codecs.LEVELS,
) -> PCA:
    """Fit the codec on training rows, which are counts above rest or their increments (``representation``).

    It has ``components`` latents or, if ``variance`` is above 0, enough for this fraction of the variance. A constant
    channel gets the scale 1. The sign of each component is chosen so that its largest weight is positive. Raises
    `TacpipeError` if the count or fraction is out of range, or all channels are constant.
    """
    width = len(channels)
    limit = min(rows.count - 1, width)
    if limit < 1:
        raise TacpipeError(f"A codec cannot be fitted on {rows.count} rows. Give it training recordings with contact.")
    if not 0 <= variance < 1:
        raise TacpipeError(
            f"variance is {variance}; it must be a fraction between 0 and 1. Use 0 to count components instead."
        )
    if variance == 0 and not 1 <= components <= limit:
        raise TacpipeError(f"components is {components}; {rows.count} rows of {width} channels give 1 to {limit}.")
    mean, scale = rows.mean_and_scale(representation)
    # scikit-learn's PCA always subtracts the mean, which increments must keep. The triangular factor of a QR
    # decomposition has the same singular values and right vectors as all rows, and only as many rows as there are
    # channels.
    _, singular, all_weights = np.linalg.svd(rows.standardised_triangle(representation))
    power = singular**2
    ratio = power / power.sum()
    count = int(np.searchsorted(ratio.cumsum(), variance, side="right")) + 1 if variance else components
    count = min(count, limit)
    weights = all_weights[:count]  # (latent, channel)
    largest = np.take_along_axis(weights, np.abs(weights).argmax(axis=1)[:, None], axis=1)
    return PCA(
        tuple(channels),
        tuple(layout),
        mean,
        scale,
        weights * np.where(largest < 0, -1.0, 1.0),
        ratio[:limit],
        representation,
    )


def fit_and_measure(
    rows: CodecRows, *, components: int = 20, variance: float = 0.0, representation: str = codecs.LEVELS
) -> PCA:
    """Return the codec fitted on ``rows`` of all recordings, with its measures; the rows are read twice, in chunks.

    The errors are those of a PCA with as many components, fitted without the held-out recordings, so that they compare
    with those of an autoencoder. If no recordings are held out, ``val`` is omitted. Warns of constant channels, unless
    all are. Raises the errors of `fit`.
    """
    validation = held_out(rows.names)
    parts: dict[str, Collection[str]] = {"train": set(rows.names) - validation, "val": validation}
    width = len(rows.channels)
    train, val = (Moments.from_pieces(rows.pieces(names), width) for names in parts.values())
    all_rows = train.merge(val)
    if all_rows.count > 1:
        constant = [name for name, moves in zip(rows.channels, all_rows.varies, strict=True) if not moves]
        warn_of_constant_channels(constant, width)
    fit_rows = functools.partial(fit, channels=rows.channels, layout=rows.layout, representation=representation)
    codec = fit_rows(all_rows, components=components, variance=variance)
    evaluated = codec
    if val.count and train.count > len(codec.components):
        evaluated = fit_rows(train, components=len(codec.components))
    else:
        parts = {"train": rows.names}
    measured: measures.CodecMeasures = {
        "reconstruction": measures.reconstructions(
            evaluated, {part: rows.pieces(names) for part, names in parts.items()}
        ),
        "latent_covariance": _covariance(codec, all_rows),
    }
    return replace(codec, measured=measured)


def _covariance(codec: PCA, rows: Moments) -> list[list[float]]:
    """Return the covariance (latent, latent) of the latents of all rows."""
    spread = rows.centred_triangle / codec.scale_count @ codec.components.T
    return measures.rounded_matrix(spread.T @ spread / (rows.count - 1))
