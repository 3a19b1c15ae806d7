"""What arrays of known names hold: quantity, unit and component of each column, by the conventions of robot learning.

Lengths are metres, angles radians, quaternions without unit, as robosuite, ALOHA, UMI, DROID and LeRobot write them. What
a name does not show is left empty: a layout file states it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tacpipe.formats.table import column_names
from tacpipe.formats.table.layout import UNKNOWN

XYZ, QUATERNION = ("x", "y", "z"), ("x", "y", "z", "w")


@dataclass(frozen=True)
class Meaning:
    """What one column holds; texts are empty where that is not known."""

    quantity: str = ""
    unit: str = ""
    component: str = ""


NOTHING = Meaning()
_HAND = r"(?:.*[_./])?(?:eef?|ee|tcp|end_effector|hand|wrist|tool|robot|arm)[_./]?"
_ANY = r"(?:.*[_./])?"
_VECTORS: Sequence[tuple[str, int, Sequence[Meaning]]] = (  # a name, a width, and what each column is
    (rf"{_HAND}(?:pos|position|translation|xyz|trans)", 3, [Meaning("position", "m", axis) for axis in XYZ]),
    (rf"{_ANY}robot\d+_eef_quat", 4, [Meaning("orientation", "1", part) for part in QUATERNION]),
    (rf"{_ANY}(?:quat|quaternion|orientation|ori)", 4, [Meaning("orientation", "1")] * 4),
    (rf"{_HAND}(?:vel_lin|lin_vel|linear_velocity)", 3, [Meaning("velocity", "m/s", axis) for axis in XYZ]),
    (rf"{_HAND}(?:vel_ang|ang_vel|angular_velocity)", 3, [Meaning("angular_velocity", "rad/s", axis) for axis in XYZ]),
    (
        rf"{_ANY}(?:rot_axis_angle|axis_angle|rotation_vector|rotvec)",
        3,
        [Meaning("angle", "rad", axis) for axis in XYZ],
    ),
    (
        rf"{_HAND}pose|{_ANY}demo_(?:start|end)_pose",
        6,
        [Meaning("position", "m", axis) for axis in XYZ] + [Meaning("angle", "rad", axis) for axis in XYZ],
    ),
    (rf"{_HAND}pose", 7, [Meaning("position", "m", axis) for axis in XYZ] + [Meaning("orientation", "1")] * 4),
    (rf"{_ANY}(?:force|forces)", 3, [Meaning("force", "N", axis) for axis in XYZ]),
    (rf"{_ANY}(?:torque|torques|moment)", 3, [Meaning("torque", "N m", axis) for axis in XYZ]),
    (
        rf"{_ANY}(?:wrench|force_?torque|ft|ft_sensor)",
        6,
        [Meaning("force", "N", axis) for axis in XYZ] + [Meaning("torque", "N m", axis) for axis in XYZ],
    ),
)
_ANY_WIDTH: Sequence[tuple[str, Meaning]] = (  # a name, whatever its width
    (rf"{_ANY}gripper[_./](?:qpos|qvel|pos|position|state|command|action)s?", Meaning("state")),
    (rf"{_ANY}(?:joint_pos|joint_positions?|joint_angles?|joint_states?|qpos)", Meaning("joint_position", "rad")),
    (rf"{_ANY}(?:joint_vel|joint_velocit(?:y|ies)|qvel)", Meaning("joint_velocity", "rad/s")),
    (rf"{_ANY}(?:joint_torques?|tau)", Meaning("joint_torque", "N m")),
    (rf"{_ANY}(?:gripper|finger)s?[_./](?:width|opening)", Meaning("finger_width", "m")),
    (rf"{_ANY}(?:tactile|taxels?|skin|touch|uskin|xela|digit|reskin|anyskin)\w*", Meaning("tactile")),
    (rf"{_ANY}(?:dones?|terminals?|terminated|truncated|success|timeouts?)", Meaning("label", "1")),
    (rf"{_ANY}(?:rewards?)", Meaning("score", "1")),
)
_UNREAL = ("sin", "cos")  # of an angle: no angle


def meanings(name: str, width: int, whole: bool = False) -> list[Meaning]:
    """Return what each of ``width`` columns of an array called ``name`` holds; ``whole``: its values are whole numbers.

    >>> meanings("robot0_eef_pos", 3)[0], meanings("obs/joint_pos", 7)[6].unit
    (Meaning(quantity='position', unit='m', component='x'), 'rad')
    >>> meanings("tactile_left", 48, whole=True)[0]
    Meaning(quantity='tactile', unit='count', component='')
    >>> meanings("tactile_slips_label", 1)[0].quantity, meanings("tactile_timestamps", 1)[0].quantity
    ('label', '')
    >>> meanings("object", 14)[0], meanings("robot0_joint_pos_cos", 7)[0]
    (Meaning(quantity='', unit='', component=''), Meaning(quantity='', unit='', component=''))
    """
    text = name.strip().lower()
    if column_names.is_clock(text):
        return [NOTHING] * width
    if column_names.is_label(text):
        return [Meaning("label", "1")] * width
    for pattern, wanted, found in _VECTORS:
        if wanted == width and re.fullmatch(pattern, text):
            return list(found)
    if text.endswith(_UNREAL):
        return [NOTHING] * width
    for pattern, one in _ANY_WIDTH:
        if re.fullmatch(pattern, text):
            counted = one.quantity == "tactile" and whole
            return [Meaning("tactile", "count") if counted else one] * width
    return [NOTHING] * width


def of_name(name: str, kind: str) -> Meaning:
    """Return what a column of one value holds where its name states both quantity and unit.

    >>> of_name("joint1_rad", "float32"), of_name("fx", "float64")
    (Meaning(quantity='joint_position', unit='rad', component=''), Meaning(quantity='', unit='', component=''))
    """
    quantity, unit = column_names.meaning(name, kind)
    return NOTHING if UNKNOWN in (quantity, unit) else Meaning(quantity, unit)


def aloha(name: str, width: int) -> list[Meaning] | None:
    """Return what the columns of an array of ALOHA are: arms of six joints and a gripper that is open at 1; else None.

    ``effort`` is the current of the motors in a unit of theirs.

    >>> [one.quantity for one in aloha("observations/qpos", 14)][5:8]
    ['joint_position', 'state', 'joint_position']
    """
    last = name.rpartition("/")[2]
    quantities = {"qpos": ("joint_position", "rad"), "qvel": ("joint_velocity", "rad/s"), "effort": ("current", "")}
    quantities["action"] = ("target_joint_position", "rad")
    if last not in quantities or width % 7:
        return None
    joint = Meaning(*quantities[last])
    gripper = joint if last == "effort" else Meaning("state", "1" if last != "qvel" else "1/s")
    return ([joint] * 6 + [gripper]) * (width // 7)


def declared(attributes: Mapping[str, object]) -> dict[str, str]:
    """Return what attributes of an array state of its columns, as metadata of fields.

    Where a quantity is among them all texts count, as in files that tacpipe writes.

    >>> declared({"units": "N", "comment": "x"}), declared({"unit": "count", "quantity": "tactile", "taxel": "7"})
    ({'unit': 'N'}, {'unit': 'count', 'quantity': 'tactile', 'taxel': '7'})
    """
    texts = {key: value for key, value in attributes.items() if isinstance(value, str) and value}
    if "quantity" in texts:
        return texts
    found = texts.get("unit") or texts.get("units")
    return {"unit": found} if found else {}


def listed(attributes: Mapping[str, object], key: str, count: int) -> list[str]:
    """Return the text that an attribute states for each of ``count`` columns, nothing where it states another number.

    >>> listed({"columns": ["a", "b"]}, "columns", 2), listed({"columns": ["a"]}, "columns", 2)
    (['a', 'b'], [])
    """
    value = attributes.get(key)
    if value is None or isinstance(value, str | bytes) or not hasattr(value, "__iter__"):
        return []
    found = [one.decode(errors="replace") if isinstance(one, bytes) else str(one) for one in value]
    return found if len(found) == count else []
