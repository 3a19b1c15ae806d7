"""Grasps in the layout of vision2tactile, small and made up."""

import struct
from pathlib import Path

import numpy as np

BEGAN_S = 1_561_629_162  # unix time of the first grasp, 2019-06-27
PADDING = 3916  # bytes of zeros behind the published points


def points_m(seed: int = 0, count: int = 50) -> np.ndarray:
    """Return points (point, xyz) of a patch of 0.1 m, 1.1 m before the camera."""
    return np.asarray(
        np.random.default_rng(seed).uniform((-0.05, -0.05, 1.05), (0.05, 0.05, 1.15), (count, 3)), dtype=np.float32
    )


def colours(seed: int = 0, count: int = 50) -> np.ndarray:
    """Return colours (point, rgb), 0 to 255."""
    return np.random.default_rng(seed).integers(0, 256, (count, 3)).astype(np.uint8)


def counts(seed: int = 0) -> list[int]:
    """Return a reading of 58 counts."""
    return [int(value) for value in np.random.default_rng(seed).integers(0, 4096, 58)]


def header(count: int, data: str = "binary", **replaced: str) -> str:
    """Return the header of the published clouds, with other values where they are given."""
    lines = {
        "VERSION": "0.7",
        "FIELDS": "x y z rgb",
        "SIZE": "4 4 4 4",
        "TYPE": "F F F F",
        "COUNT": "1 1 1 1",
        "WIDTH": str(count),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(count),
        "DATA": data,
    } | replaced
    text = "".join(f"{name} {value}\n" for name, value in lines.items() if value)
    return "# .PCD v0.7 - Point Cloud Data file format\n" + text


def packed(points: np.ndarray, rgb: np.ndarray) -> bytes:
    """Return points and colours as the published files hold them, written value by value."""
    return b"".join(
        struct.pack("<fffI", *map(float, xyz), int(red) << 16 | int(green) << 8 | int(blue))
        for xyz, (red, green, blue) in zip(points, rgb, strict=True)
    )


def write_grasp(
    source: Path, label: str = "bleach", after_s: int = 0, seed: int = 0, reading: int | None = None
) -> Path:
    """Write a grasp on the first two points of its cloud; ``reading`` chooses what is felt. Returns its folder."""
    folder = source / label / str(BEGAN_S + after_s)
    folder.mkdir(parents=True)
    points, rgb = points_m(seed), colours(seed)
    content = header(len(points)).encode() + packed(points, rgb) + bytes(PADDING)
    (folder / "cloud-object.pcd").write_bytes(content)
    (folder / "best-grasp.txt").write_text(",".join(f"{value:.8g}" for value in points[:2].ravel()))
    values = counts(seed if reading is None else reading)
    (folder / "tactile.tac").write_text("," + ",".join(map(str, values)))
    return folder
