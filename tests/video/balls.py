"""Render a gel into which balls are pressed, with colours that are a linear function of its slopes."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from tacpipe.arrays import Bytes, Floats

HEIGHT, WIDTH, MM_PER_PX = 60, 80, 0.25
# relative change of red, green and blue per sine of the slope along x and y
COLOURS = np.array([[0.9, 0.2], [-0.5, 0.8], [-0.3, -0.9]])
DECAY = 4  # power with which the sine of the slope falls outside of the contact
LAYOUT = """
[recordings]
name = "ball{diameter_mm}-{trial}"

[streams.gel]
files = "{diameter_mm}mm/{trial}"
format = "images"
time = { rate_hz = 25 }
"""
PLACES = [(x, y, diameter) for x in (18.0, 40.0, 61.0) for y in (16.0, 43.0) for diameter in (6.0, 9.5)]


def background() -> Floats:
    """The untouched gel (row, column, rgb), brighter in the middle."""
    y, x = np.meshgrid(np.linspace(-1, 1, HEIGHT), np.linspace(-1, 1, WIDTH), indexing="ij")
    return np.stack([150 - 30 * x**2, 140 - 20 * y**2, 160 - 20 * x * y], axis=-1)


def contact_mm(diameter_mm: float) -> float:
    """The radius of the contact of a ball that is pressed in by a third of a millimetre below its rim."""
    return float(np.sqrt(diameter_mm / 2 * 0.7))


def sine(distance_mm: Floats, diameter_mm: float) -> Floats:
    """The sine of the slope of the gel by distance from the centre of a ball."""
    contact = contact_mm(diameter_mm)
    ratio = np.maximum(distance_mm / contact, 1e-9)
    return contact / (diameter_mm / 2) * np.where(ratio < 1, ratio, ratio**-DECAY)


def depth_mm(distance_mm: Floats, diameter_mm: float) -> Floats:
    """The depth of the gel by distance from the centre of a ball, integrated along the radius; 0 far away."""
    radius = np.linspace(0, 40, 40_001)
    slope = sine(radius, diameter_mm) / np.sqrt(1 - sine(radius, diameter_mm) ** 2)
    steps = (slope[1:] + slope[:-1]) / 2 * np.diff(radius)
    depth = np.append(np.cumsum(steps[::-1])[::-1], 0)
    depths: Floats = np.interp(distance_mm, radius, depth)
    return depths


def distances_mm(x: float, y: float) -> Floats:
    """The distance of each pixel (row, column) from a place in pixels."""
    row, column = np.indices((HEIGHT, WIDTH))
    distances: Floats = np.hypot(column - x, row - y) * MM_PER_PX
    return distances


def image(x: float, y: float, diameter_mm: float, *, share: float = 1.0, seed: int = 0) -> Bytes:
    """A frame of a gel with a ball at a place in pixels; ``share`` of its slopes, with noise."""
    row, column = np.indices((HEIGHT, WIDTH))
    distance = distances_mm(x, y)
    unit = np.stack([column - x, row - y], axis=-1) * MM_PER_PX / np.maximum(distance, 1e-9)[..., None]
    normals = share * sine(distance, diameter_mm)[..., None] * unit
    noise = np.random.default_rng(seed).normal(0, 0.5, (HEIGHT, WIDTH, 3))
    pixels: Bytes = np.clip(background() * (1 + normals @ COLOURS.T) + noise, 0, 255).round().astype(np.uint8)
    return pixels


def write_png(path: Path, pixels: Bytes) -> None:
    """Write an image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    encoder: Any = av.CodecContext.create("png", "w")
    encoder.width, encoder.height, encoder.pix_fmt = pixels.shape[1], pixels.shape[0], "rgb24"
    encoder.time_base = Fraction(1)
    packets = [*encoder.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")), *encoder.encode(None)]
    path.write_bytes(b"".join(bytes(packet) for packet in packets))


def write_presses(folder: Path, count: int = len(PLACES)) -> None:
    """Write presses at the first ``count`` of `PLACES`, the background, and the layout file."""
    for trial, (x, y, diameter_mm) in enumerate(PLACES[:count]):
        write_png(folder / f"presses/{diameter_mm}mm/{trial:02d}/gel.png", image(x, y, diameter_mm, seed=trial))
    write_png(folder / "background.png", background().round().astype(np.uint8))
    (folder / "layout.toml").write_text(LAYOUT)
