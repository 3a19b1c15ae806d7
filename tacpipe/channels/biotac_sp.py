"""The BioTac SP: where its electrodes lie, what a reading of two of them holds, and the ranges touch is scaled by.

A grasp is measured by the thumb (``th``) and the middle finger (``mf``). Of each finger the pressure of the fluid (``pdc``)
and 24 impedances (``e``) are predicted: four targets, 50 values.
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
RANGES = {  # device counts, the fixed ranges by which the letter scales (RA-L 2020, section on training)
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
    """Return where the electrodes lie on the core, metres (electrode, xyz).

    x runs along the finger towards its tip, y away from the pad (electrodes lie at negative y), z sideways. Electrodes 1
    to 10 lie at positive z, 11 to 20 mirror them, 21 to 24 lie on and about the midline. Source: the positions published
    with tactile-gcn (Garcia-Garcia et al., TactileGCN, IJCNN 2019), in inches there.
    """
    right = np.column_stack([_X, _Y, _Z])
    return np.concatenate([right, right * (1, 1, -1), _MIDDLE]) * INCH_M


def unrolled_m() -> Floats:
    """Return where electrodes lie on the core rolled out flat, metres (electrode, axis): along the finger, and around it.

    Along it is x of `electrode_positions_m`; around it is the arc about the finger's axis from the midline of the pad,
    at the electrode's own distance from that axis, positive where z is.
    """
    along, depth, across = electrode_positions_m().T
    return np.column_stack([along, np.hypot(depth, across) * np.arctan2(across, -depth)])


def width(target: str) -> int:
    """Return how many values a target has: 1 for a pressure, 24 for electrodes."""
    return ELECTRODES if target.startswith("e_") else 1


def columns(target: str) -> list[str]:
    """Return the columns that hold a target in a table of readings.

    >>> columns("pdc_th"), columns("e_mf")[:2]
    (['th_pdc'], ['mf_electrode01', 'mf_electrode02'])
    """
    kind, finger = target.split("_")
    return [f"{finger}_pdc"] if kind == "pdc" else [f"{finger}_electrode{n:02d}" for n in range(1, ELECTRODES + 1)]


def value_columns(target: str) -> list[str]:
    """Return the columns that hold a target where values are listed by target: in predictions, and the truth beside them.

    >>> value_columns("pdc_th"), value_columns("e_mf")[:2]
    (['pdc_th'], ['e_mf_01', 'e_mf_02'])
    """
    count = width(target)
    return [target] if count == 1 else [f"{target}_{n:02d}" for n in range(1, count + 1)]


def normalised(target: str, counts: Floats) -> Floats:
    """Return counts of a target as fractions of its range (`RANGES`): 0 at its low end, 1 at its high one."""
    low, high = RANGES[target]
    return (np.asarray(counts, np.float64) - low) / (high - low)


def counts(target: str, shares: Floats) -> Floats:
    """Return device counts of fractions of a target's range: what `normalised` undoes."""
    low, high = RANGES[target]
    return np.asarray(shares, np.float64) * (high - low) + low


def fields() -> list[pa.Field]:
    """Return the 58 fields of a reading, uint16 device counts, in the order of the published files.

    Of each finger 24 electrodes, two quick readings of the fluid's pressure (``pac0``, ``pac1``), its pressure (``pdc``),
    and temperature, its quick part before it (``tac``, ``tdc``).
    """
    import pyarrow as pa

    quantities = {f"electrode{n:02d}": "tactile" for n in range(1, ELECTRODES + 1)}
    quantities |= {"pac0": "vibration", "pac1": "vibration", "pdc": "static_pressure"}
    quantities |= {"tac": "temperature_change", "tdc": "temperature"}
    return [
        pa.field(
            f"{finger}_{name}",
            pa.uint16(),
            metadata={"unit": "count", "quantity": quantity, "finger": finger}
            | ({"electrode": str(int(name.removeprefix("electrode")))} if quantity == "tactile" else {}),
        )
        for finger in FINGERS
        for name, quantity in quantities.items()
    ]
