"""HDF5 files and Zarr stores as other programs write them, written with h5py and zarr."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import zarr
from zarr.storage import LocalStore, ZipStore

START_NS = 1_700_000_000_000_000_000
RATE_HZ = 20
JPEG = b"\xff\xd8\xff\xe0"


def values(*shape: int, seed: int = 0) -> Any:
    """Return random numbers of this shape."""
    return np.random.default_rng(seed).normal(size=shape)


def robomimic(path: Path, demos: int = 3, rate_hz: int | None = RATE_HZ) -> None:
    """Write demonstrations as robomimic does; demo_N has 10 + N rows."""
    environment = {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": rate_hz} if rate_hz else {}}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(environment)
        file["mask/train"] = np.array([f"demo_{number}" for number in range(0, demos, 2)], dtype="S")
        for number in range(demos):
            rows, demo = 10 + number, data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = rows
            demo.attrs["model_file"] = "<mujoco>" * 100
            demo["actions"] = values(rows, 7, seed=number)
            demo["dones"] = np.zeros(rows, np.int64)
            for group in ("obs", "next_obs"):
                demo[f"{group}/robot0_eef_pos"] = values(rows, 3, seed=number)
                demo[f"{group}/robot0_gripper_qpos"] = values(rows, 2, seed=number)
                pixels = np.zeros((rows, 84, 84, 3), np.uint8)
                demo.create_dataset(f"{group}/agentview_image", data=pixels, compression="gzip")
            demo["obs/tactile"] = np.arange(rows * 12, dtype=np.uint16).reshape(rows, 4, 3)


def pictures(rows: int) -> list[bytes]:
    """Return as many encoded pictures, by their first and last bytes; each has another length."""
    return [JPEG + bytes([1 + row % 250]) * (5 + row) + b"\x00\xff\xd9" for row in range(rows)]


def aloha(path: Path, rows: int = 8, compressed: bool = True) -> None:
    """Write an episode as ALOHA does: two arms of seven, and a camera of padded JPEG frames."""
    with h5py.File(path, "w") as file:
        file.attrs["sim"] = False
        file["action"] = values(rows, 14).astype(np.float32)
        for name in ("qpos", "qvel", "effort"):
            file[f"observations/{name}"] = values(rows, 14).astype(np.float32)
        if not compressed:
            file["observations/images/cam_high"] = np.zeros((rows, 48, 64, 3), np.uint8)
            return
        frames = pictures(rows)
        padded = np.zeros((rows, max(map(len, frames))), np.uint8)
        for row, frame in enumerate(frames):
            padded[row, : len(frame)] = np.frombuffer(frame, np.uint8)
        file["observations/images/cam_high"] = padded
        file["compress_len"] = np.array([[len(frame) for frame in frames]])


def lab(path: Path) -> None:
    """Write a file of a lab's own: a group a sensor, each with its own stamps, and labels as attributes."""
    with h5py.File(path, "w") as file:
        file.attrs["material"], file.attrs["trial"] = "cork", np.int32(3)
        skin = file.create_group("skin")
        skin["t_ns"] = START_NS + np.arange(50) * 10_000_000
        skin["taxels"] = np.arange(200, dtype=np.uint16).reshape(50, 4)
        arm = file.create_group("arm")
        arm["time"] = START_NS / 1e9 + np.arange(20) / 4
        arm["load"] = values(20, 3)
        arm["load"].attrs["units"] = "N"
        kind = [("t_s", "f8"), ("width", "f4"), ("status", "S4")]
        file["gripper"] = np.array([(row / 10, row / 100, b"ok") for row in range(6)], kind)
        file["mass"] = 0.25
        file["calibration"] = np.eye(3)


def store(path: Path, zarr_format: Any = 2) -> Any:
    """Return an empty Zarr group at a path, a zip file where its name ends so."""
    place = ZipStore(path, mode="w") if path.suffix == ".zip" else LocalStore(path)
    return zarr.open_group(place, mode="w", zarr_format=zarr_format)


def replay(path: Path, ends: tuple[int, ...] = (30, 45, 80), zarr_format: Any = 2, seed: int = 0) -> dict[str, Any]:
    """Write a replay buffer as UMI does, in chunks of 20 rows, and return its arrays."""
    rows = ends[-1]
    arrays = {
        "data/robot0_eef_pos": values(rows, 3, seed=seed).astype(np.float32),
        "data/robot0_gripper_width": values(rows, 1, seed=seed + 1).astype(np.float32),
        "meta/episode_ends": np.array(ends),
    }
    group = store(path, zarr_format)
    for name, array in arrays.items():
        chunks = (20, *array.shape[1:]) if name.startswith("data") else array.shape
        group.create_array(name, data=array, chunks=chunks)
    group.store.close()
    return arrays
