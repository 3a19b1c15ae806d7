"""The BioTac SP: positions of its electrodes, columns of a reading of two fingers, and ranges for scaling.

A grasp is measured with thumb (``th``) and middle finger (``mf``). The targets of prediction are the fluid pressure
(``pdc``) and 24 impedances (``e``) of each finger: four targets with 50 values.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Floats

if TYPE_CHECKING:
    import pyarrow as pa


ELECTRODES = 24
FINGERS = ("mf", "th")  # middle finger and thumb, in the order of the published files
TARGETS = ("pdc_th", "pdc_mf", "e_th", "e_mf")
RANGES = {  # in counts; the fixed ranges of the publication (RA-L 2020, section on training)
    "pdc_th": (2500.0, 3400.0),
    "pdc_mf": (1600.0, 2300.0),
    "e_th": (100.0, 3600.0),
    "e_mf": (500.0, 3800.0),
}
INCH_M = 0.0254
_X = (0.3864, 0.3189, 0.0874, 0.0839, -0.0186, -0.0919, -0.1367, -0.2235, -0.3208, -0.3969)
_Y = (-0.1090, -0.2050, -0.1286, -0.2359, -0.3001, -0.1204, -0.2375, -0.2707, -0.1995, -0.1000)
_Z = (0.1569, 0.1207, 0.2820, 0.2016, 0.0949, 0.2850, 0.1871, 0.0715, 0.1278, 0.1516)
_MIDDLE = ((0.2588, -0.2523, 0.0), (0.1702, -0.2744, 0.0729), (0.1702, -0.2744, -0.0729), (0.0753, -0.2981, 0.0))


def electrode_positions_m() -> Floats:
    """Return the positions of the electrodes on the core in metres (electrode, xyz).

    x points to the fingertip, y away from the pad (electrodes have negative y), z sideways. Electrodes 1 to 10 have
    positive z, 11 to 20 mirror them, and 21 to 24 are close to the midline. Source: the positions, in inches, published
    with tactile-gcn (Garcia-Garcia et al., TactileGCN, IJCNN 2019).
    """
    right = np.column_stack([_X, _Y, _Z])
    return np.concatenate([right, right * (1, 1, -1), _MIDDLE]) * INCH_M


def unrolled_positions_m() -> Floats:
    """Return the positions of electrodes on the unrolled core in metres (electrode, axis): along and around the finger.

    The first is x of `electrode_positions_m`, the second the arc length from the midline of the pad at the electrode's
    distance from the finger's axis, with the sign of z.
    """
    along, depth, across = electrode_positions_m().T
    return np.column_stack([along, np.hypot(depth, across) * np.arctan2(across, -depth)])


def width(target: str) -> int:
    """Return the number of values of a target: 1 for pressure, 24 for electrodes."""
    return ELECTRODES if target.startswith("e_") else 1


def columns(target: str) -> list[str]:
    """Return the columns of a target in a table of readings.

    >>> columns("pdc_th"), columns("e_mf")[:2]
    (['th_pdc'], ['mf_electrode01', 'mf_electrode02'])
    """
    kind, finger = target.split("_")
    return [f"{finger}_pdc"] if kind == "pdc" else [f"{finger}_electrode{n:02d}" for n in range(1, ELECTRODES + 1)]


def value_columns(target: str) -> list[str]:
    """Return the names of a target's columns in tables of predicted and true values.

    >>> value_columns("pdc_th"), value_columns("e_mf")[:2]
    (['pdc_th'], ['e_mf_01', 'e_mf_02'])
    """
    count = width(target)
    return [target] if count == 1 else [f"{target}_{n:02d}" for n in range(1, count + 1)]


def normalise(target: str, counts: Floats) -> Floats:
    """Scale counts of a target to fractions of its range in `RANGES`, 0 to 1, with the same shape."""
    low, high = RANGES[target]
    return (np.asarray(counts, np.float64) - low) / (high - low)


def to_counts(target: str, shares: Floats) -> Floats:
    """Convert fractions of a target's range to counts, the inverse of `normalise`."""
    low, high = RANGES[target]
    return np.asarray(shares, np.float64) * (high - low) + low


def fields() -> list[pa.Field]:
    """Return the 58 fields of a reading, uint16 counts, in the order of the published files.

    For each finger there are 24 electrodes, two readings of dynamic pressure (``pac0``, ``pac1``), static pressure
    (``pdc``), and dynamic and static temperature (``tac``, ``tdc``).
    """
    import pyarrow as pa

    quantities = {f"electrode{n:02d}": "tactile" for n in range(1, ELECTRODES + 1)}
    quantities |= {"pac0": "vibration", "pac1": "vibration", "pdc": "static_pressure"}
    quantities |= {"tac": "temperature_change", "tdc": "temperature"}
    finger_fields = []
    for finger in FINGERS:
        for name, quantity in quantities.items():
            metadata = {"unit": "count", "quantity": quantity, "finger": finger}
            if quantity == "tactile":
                metadata["electrode"] = str(int(name.removeprefix("electrode")))
            finger_fields.append(pa.field(f"{finger}_{name}", pa.uint16(), metadata=metadata))
    return finger_fields
