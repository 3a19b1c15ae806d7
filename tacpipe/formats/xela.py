"""Read the files that the published XELA trials share: uSkin counts, markers, and the line about the trial."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Counts, Floats, Times
from tacpipe.channels import schema
from tacpipe.errors import TacpipeError
from tacpipe.formats.csv_table import place, read_csv, read_record
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt

T = TypeVar("T")
SENSORS = {"xela1": "xela_sensor1.csv", "xela2": "xela_sensor2.csv"}
META = "meta_data.csv"
UNSEEN = 10.0  # value of all seven columns of a marker that the camera did not see
UNIT_TOLERANCE = 1e-3  # tolerance of a quaternion's norm; recordings have less than 1e-6


def read_uskin(path: Path) -> list[Counts]:
    """Return the 48 columns of a uSkin, each (time,), uint16 counts, ordered by taxel."""
    names = [f"txl{taxel}_{axis}" for taxel in range(1, schema.TAXELS + 1) for axis in schema.AXES]
    table = read_csv(path, names, integers=pa.uint16())
    return [table.column(name).to_numpy() for name in names]


def read_floats(path: Path, names: Sequence[str]) -> Floats:
    """Return the columns ``names`` as an array (time, channel)."""
    table = read_csv(path, names)
    return np.column_stack([table.column(name).to_numpy() for name in names])


def read_marker(path: Path, name: str) -> tuple[Floats, float]:
    """Return the pose of a marker (time, 7), with NaN in rows in which the camera did not see it, and their fraction.

    Raises `TacpipeError` with file and row if a quaternion is not of unit length.
    """
    columns = [f"{name}_position_{axis}" for axis in schema.AXES]
    pose = read_floats(path, columns + [f"{name}_quaternion_{part}" for part in schema.COMPONENTS])
    unseen = (pose == UNSEEN).all(axis=1)
    pose[unseen] = np.nan
    require_unit(path, pose[:, 3:], f"{name}_quaternion")
    return pose, float(unseen.mean())


def require_unit(path: Path, quaternions: Floats, name: str) -> None:
    """Raise `TacpipeError` with file and row if a quaternion (time, 4) is not of unit length; NaN is accepted."""
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.abs(length - 1) > UNIT_TOLERANCE
    if bad.any():
        row = int(bad.argmax())
        raise TacpipeError(
            f"{path}, {place(path, row)}: {name} has length {length[row]:.4g}, a rotation has 1. "
            f"Check that its columns are in the order x, y, z, w."
        )


def check_rows(trial: str, rows: Mapping[str, int], tactile: str, missing_allowed: int) -> None:
    """Raise `TacpipeError` if a file has more rows than the tactile file, or more than ``missing_allowed`` fewer."""
    for name, count in rows.items():
        difference = count - rows[tactile]
        if difference > 0 or difference < -missing_allowed:
            raise TacpipeError(
                f"Trial {trial}: {name} has {count} rows and {tactile} {rows[tactile]}. They are written together, so "
                f"at most {missing_allowed} row may be missing at the end. Copy the trial again or leave it out."
            )


class TrialMeta:
    """The one-row CSV file that describes a trial; each cell is checked when it is read."""

    def __init__(self, path: Path) -> None:
        """Read the file. Raises `TacpipeError` unless it has one row below its header."""
        self.path = path
        self.cells = read_record(path)

    def text(self, name: str) -> str:
        """Return a cell. Raises `TacpipeError` if it is missing or empty."""
        return self._read(name, str, "text")

    def number(self, name: str) -> float:
        """Return a cell as a positive number. Raises `TacpipeError` if it is not one."""

        def positive(cell: str) -> float:
            value = float(cell)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(cell)
            return value

        return self._read(name, positive, "a positive number")

    def flag(self, name: str) -> bool:
        """Return a cell that is 0 or 1 as a boolean. Raises `TacpipeError` for other values."""
        return self._read(name, {"0": False, "1": True, "0.0": False, "1.0": True}.__getitem__, "0 or 1")

    def utc_ns(self, name: str) -> int:
        """Return the value of a field such as ``2021-11-24 15:20:42.172409``, in UTC, in nanoseconds since 1970."""

        def parse_time(cell: str) -> int:
            elapsed = datetime.fromisoformat(cell).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
            return (elapsed.days * 86_400 + elapsed.seconds) * 1_000_000_000 + elapsed.microseconds * 1_000

        return self._read(name, parse_time, "a date and time as 2021-11-24 15:20:42.172409")

    def _read(self, name: str, read: Callable[[str], T], expected: str) -> T:
        """Return ``read`` of a cell. Raises `TacpipeError` if the cell is missing or ``read`` fails."""
        cell = self.cells.get(name, "")
        try:
            if cell:
                return read(cell)
        except (ValueError, KeyError):
            pass
        problem = f"holds {excerpt(cell)}" if cell else "is missing or empty"
        raise TacpipeError(
            f"{self.path}, column {name} {problem}; it must be {expected}. Correct the file and try again."
        )


def tactile_streams(
    columns: Mapping[str, Sequence[Counts]], t_ns: Times, stamp_source: str | None
) -> dict[str, pa.Table]:
    """Return the tables of the sensors by stream name."""
    fields = schema.uskin_fields()
    return {
        name: schema.stream(t_ns[: len(channels[0])], channels, fields, stamp_source)
        for name, channels in columns.items()
    }


def authors_role(role: str) -> dict[str, Attribute]:
    """Return the attribute with the authors' role of a folder, or an empty dictionary if ``role`` is empty."""
    return {"authors_role": role} if role else {}
