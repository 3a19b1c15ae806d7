"""Infer quantity, unit and component from the names of columns and arrays.

Array names follow the conventions of robot learning: lengths in metres, angles in radians, quaternions without unit, as
in robosuite, ALOHA, UMI, DROID and LeRobot. Anything that a name does not show is left empty, for a layout file to
state.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError
from tacpipe.formats.table.layout import UNKNOWN
from tacpipe.printable import excerpt

if TYPE_CHECKING:
    from tacpipe.formats.arrays.tree import StoredAttributes

_TIME_WORDS = r"(t|time|times|time_?stamps?|stamps?|clock|unix_?time|epoch|datetime|date[_ ]?time|date|uhrzeit|zeit)"
TIME_NAME = re.compile(rf"{_TIME_WORDS}([_ ]?(s|sec|seconds|ms|us|ns))?", re.IGNORECASE)
TIME_ENDING = re.compile(rf"\w+_{_TIME_WORDS}(_(s|sec|ms|us|ns))?", re.IGNORECASE)
MAX_NAME_CHARACTERS = 1_000  # of a column; text that is longer is no name
# name endings and their quantities; the first match counts. Limits of repetition keep the time of a search proportional
# to the length of a name.
_MEANINGS = (
    (r"(txl|tax|taxel|skin|tactile|cell|electrode|pad|sensel|touch)\w{0,40}", "tactile"),
    (r"(quat|quaternion|orientation|ori|rot|q)_?[xyzw]", "orientation"),
    (
        r"(velocity|vel|speed)\w{0,40}_(joint|j)_?\d{1,9}|(joint|j|q)_?\d{1,9}_?(velocity|vel|speed)\w{0,40}|(dq|qd)_?\d{1,9}",
        "joint_velocity",
    ),
    (r"(joint_?(velocity|velocities|vel|speeds?)|qvel)_?\d{1,9}", "joint_velocity"),
    (r"(joint_?(positions?|pos|angles?|states?)|joints|qpos)_?\d{1,9}", "joint_position"),
    (r"(effort|torque|tau)\w{0,40}_?(joint|j)?_?\d{1,9}", "joint_torque"),
    (r"(joint|j|q)_?\d{1,9}(_?(pos|position))?(_?(rad|deg))?", "joint_position"),
    (r"(f|force|kraft)_?[xyz](_?m?n)?", "force"),
    (r"(t|tau|m|torque|moment)_?[xyz](_?nm)?", "torque"),
    (r"(pos|position|translation|p|ee|tcp)_?[xyz](_?m?m)?", "position"),
    (r"temp\w{0,40}", "temperature"),
    (r"(press|druck)\w{0,40}", "static_pressure"),
)
_UNITS = {"orientation": "1"}  # quantities with only one unit
_SUFFIXES = (  # endings that indicate a unit, the unit, and its quantities
    (r"_(m)", "m", ("position",)),
    (r"_(mm)", "mm", ("position",)),
    (r"_(rad)", "rad", ("joint_position",)),
    (r"_(deg)", "deg", ("joint_position",)),
    (r"_(n)", "N", ("force",)),
    (r"_(nm)", "N m", ("torque", "joint_torque")),
)


def meaning(name: str, kind: str) -> tuple[str, str]:
    """Return the quantity and unit indicated by a name.

    >>> meaning("force_x_n", "float64"), meaning("fx", "float64"), meaning("taxel3", "uint16")
    (('force', 'N'), ('force', '?'), ('tactile', 'count'))
    """
    text = identifier(name.strip())
    if is_label(text):
        return "label", "1"
    if is_clock(text):
        return "time", UNKNOWN
    for ending, quantity in _MEANINGS:
        if re.search(rf"(?:^|_)(?:{ending})$", text, re.IGNORECASE):
            if quantity == "tactile" and "int" in kind:
                return quantity, "count"
            units = (
                unit
                for suffix, unit, quantities in _SUFFIXES
                if quantity in quantities and re.search(f"{suffix}$", text, re.IGNORECASE)
            )
            return quantity, _UNITS.get(quantity) or next(units, UNKNOWN)
    return UNKNOWN, UNKNOWN


def expect_short(names: Iterable[str], path: Path) -> None:
    """Raise `TacpipeError` for a column name in ``path`` with more than `MAX_NAME_CHARACTERS`."""
    for number, name in enumerate(names, 1):
        if len(name) > MAX_NAME_CHARACTERS:
            raise TacpipeError(
                f"{path}: the name of column {number} has {len(name):,} characters, {excerpt(name)}; at most "
                f"{MAX_NAME_CHARACTERS:,} are read. Correct the header, or the separator."
            )


def is_label(name: str) -> bool:
    """Return whether a name is that of labels rather than readings; it may start with a sensor's name.

    >>> is_label("tactile_slips_label"), is_label("skin_mask"), is_label("label_free_force")
    (True, True, False)
    """
    return bool(
        re.search(
            r"(?:^|[_./ ])(?:labels?|mask|class(?:es)?|annotations?|ground_?truth|target_?class)$", name, re.IGNORECASE
        )
    )


def is_clock(name: str) -> bool:
    """Return whether a name is that of timestamps; it may start with a sensor's name.

    >>> is_clock("tactile_timestamps"), is_clock("obs/time_ns"), is_clock("contact_time_constant")
    (True, True, False)
    """
    last = re.split(r"[/.]", name)[-1]
    return bool(TIME_NAME.fullmatch(last) or (TIME_ENDING.fullmatch(last) and not re.search(r"_t$", last)))


def without_unit(name: str) -> str:
    """Return a column's name without a unit in brackets.

    >>> without_unit("Fx [N]"), without_unit("time (ms)"), without_unit("pad[3]")
    ('Fx', 'time', 'pad[3]')
    """
    base, unit = split_unit(name)
    return base if base and not unit.isdigit() else name.strip()


def split_unit(name: str) -> tuple[str, str]:
    """Return a column's name before a unit in brackets, and the unit; both are empty without brackets at the end.

    >>> split_unit("Fx [N]"), split_unit("F (x)_(N)"), split_unit("Fx")
    (('Fx', 'N'), ('F (x)', 'N'), ('', ''))
    """
    text = name.strip()
    if not text.endswith(("]", ")")):
        return "", ""
    start = max(text.rfind("]", 0, -1), text.rfind(")", 0, -1)) + 1
    openings = [at for bracket in "[(" if (at := text.find(bracket, start)) >= 0]
    return (text[: min(openings)].rstrip(" _"), text[min(openings) + 1 : -1]) if openings else ("", "")


def identifier(base: str) -> str:
    """Return a column's name as letters, digits and underscores, with its placeholders.

    >>> identifier("Taxel {taxel}"), identifier("fx"), identifier("F.x")
    ('taxel_{taxel}', 'fx', 'f_x')
    """
    if re.fullmatch(r"[\w{}]+", base):
        return base
    return re.sub(r"[^\w{}]+", "_", base.lower()).strip("_") or base


def lower_name(name: str) -> str:
    """Return a column's name in lower case, without spaces around it."""
    return name.strip().lower()


def component(name: str) -> str:
    """Return the component in the name of a quaternion or position column, such as x for qx, or ""."""
    match = re.fullmatch(r"(?:(?:quat|quaternion|orientation|ori|rot|q)_?)?([xyzw])", lower_name(name))
    return match[1] if match else ""


def taxel_pattern(match: str, quantity: str, kind: str) -> str:
    """Return the pattern of numbered columns, with {taxel} for the number if they may be taxels.

    >>> taxel_pattern("pad{pad}", "tactile", "float64"), taxel_pattern("q{number}", "joint_position", "float64")
    ('pad{taxel}', 'q{number}')
    """
    taxels = quantity == "tactile" or (quantity == UNKNOWN and "int" in kind)
    if not taxels or match.replace("{axis}", "").count("{") != 1:
        return match
    return re.sub(r"\{(?!axis\})\w+\}", "{taxel}", match)


def numbered_pattern(name: str) -> str:
    """Return a name with its numbers as placeholders, which are named after the preceding word.

    >>> numbered_pattern("taxel3_x"), numbered_pattern("t12"), numbered_pattern("r1c2")
    ('taxel{taxel}_x', 't{number}', 'r{r}c{c}')
    """
    counter = itertools.count(2)
    labels: set[str] = set()
    has_several = len(re.findall(r"\d+", name)) > 1

    def placeholder(number: re.Match[str]) -> str:
        word = number[1].strip("_ .").lower()
        is_label = len(word) > 1 or (name.count(word) and has_several)
        label = word if is_label and word.isidentifier() else "number"
        while label in labels:
            label = f"{label}{next(counter)}"
        labels.add(label)
        return f"{number[1]}{{{label}}}"

    return re.sub(r"([A-Za-z_]{0,64}[ .]?)\d+", placeholder, name)


def longer_axis(shape: Sequence[int]) -> int:
    """Return the longest axis of an array if the first is so much shorter that it belongs to the sensor, else 0.

    >>> longer_axis((18, 3, 400)), longer_axis((400, 18)), longer_axis((100, 500))
    (2, 0, 0)
    """
    longest = shape.index(max(shape))
    return longest if shape[0] < 100 and shape[longest] >= 4 * shape[0] else 0


XYZ, QUATERNION = ("x", "y", "z"), ("x", "y", "z", "w")


@dataclass(frozen=True)
class ColumnMeaning:
    """Quantity, unit and component of a column; empty if its name does not show them."""

    quantity: str = ""
    unit: str = ""
    component: str = ""


NO_MEANING = ColumnMeaning()
_HAND = r"(?:.*[_./])?(?:eef?|ee|tcp|end_effector|hand|wrist|tool|robot|arm)[_./]?"
_ANY = r"(?:.*[_./])?"


def _vector(quantity: str, unit: str, components: Sequence[str] = XYZ) -> list[ColumnMeaning]:
    return [ColumnMeaning(quantity, unit, component) for component in components]


_UNNAMED_QUATERNION = _vector("orientation", "1", [""] * 4)  # of which parts may be in any order
_VECTORS: Sequence[tuple[str, Sequence[ColumnMeaning]]] = (  # name, and the meaning of each column
    (rf"{_HAND}(?:pos|position|translation|xyz|trans)", _vector("position", "m")),
    (rf"{_ANY}robot\d+_eef_quat", _vector("orientation", "1", QUATERNION)),
    (rf"{_ANY}(?:quat|quaternion|orientation|ori)", _UNNAMED_QUATERNION),
    (rf"{_HAND}(?:vel_lin|lin_vel|linear_velocity)", _vector("velocity", "m/s")),
    (rf"{_HAND}(?:vel_ang|ang_vel|angular_velocity)", _vector("angular_velocity", "rad/s")),
    (rf"{_ANY}(?:rot_axis_angle|axis_angle|rotation_vector|rotvec)", _vector("angle", "rad")),
    (rf"{_HAND}pose|{_ANY}demo_(?:start|end)_pose", _vector("position", "m") + _vector("angle", "rad")),
    (rf"{_HAND}pose", _vector("position", "m") + _UNNAMED_QUATERNION),
    (rf"{_ANY}(?:force|forces)", _vector("force", "N")),
    (rf"{_ANY}(?:torque|torques|moment)", _vector("torque", "N m")),
    (rf"{_ANY}(?:wrench|force_?torque|ft|ft_sensor)", _vector("force", "N") + _vector("torque", "N m")),
)
_ANY_WIDTH: Sequence[tuple[str, ColumnMeaning]] = (  # name, and the meaning for any width
    (rf"{_ANY}gripper[_./](?:qpos|qvel|pos|position|state|command|action)s?", ColumnMeaning("state")),
    (rf"{_ANY}(?:joint_pos|joint_positions?|joint_angles?|joint_states?|qpos)", ColumnMeaning("joint_position", "rad")),
    (rf"{_ANY}(?:joint_vel|joint_velocit(?:y|ies)|qvel)", ColumnMeaning("joint_velocity", "rad/s")),
    (rf"{_ANY}(?:joint_torques?|tau)", ColumnMeaning("joint_torque", "N m")),
    (rf"{_ANY}(?:gripper|finger)s?[_./](?:width|opening)", ColumnMeaning("finger_width", "m")),
    (rf"{_ANY}(?:tactile|taxels?|skin|touch|uskin|xela|digit|reskin|anyskin)\w{{0,40}}", ColumnMeaning("tactile")),
    (rf"{_ANY}(?:dones?|terminals?|terminated|truncated|success|timeouts?)", ColumnMeaning("label", "1")),
    (rf"{_ANY}(?:rewards?)", ColumnMeaning("score", "1")),
)
_UNREAL = ("sin", "cos")  # sine and cosine of an angle are not angles


def meanings(name: str, width: int, are_integers: bool = False) -> list[ColumnMeaning]:
    """Return the meaning of each of ``width`` columns of the array ``name``.

    ``are_integers``: whether its values are integers.

    >>> meanings("robot0_eef_pos", 3)[0], meanings("obs/joint_pos", 7)[6].unit
    (ColumnMeaning(quantity='position', unit='m', component='x'), 'rad')
    >>> meanings("tactile_left", 48, are_integers=True)[0]
    ColumnMeaning(quantity='tactile', unit='count', component='')
    >>> meanings("tactile_slips_label", 1)[0].quantity, meanings("tactile_timestamps", 1)[0].quantity
    ('label', '')
    >>> meanings("object", 14)[0], meanings("robot0_joint_pos_cos", 7)[0]
    (ColumnMeaning(quantity='', unit='', component=''), ColumnMeaning(quantity='', unit='', component=''))
    """
    text = name.strip().lower()
    if is_clock(text):
        return [NO_MEANING] * width
    if is_label(text):
        return [ColumnMeaning("label", "1")] * width
    for pattern, column_meanings in _VECTORS:
        if len(column_meanings) == width and re.fullmatch(pattern, text):
            return list(column_meanings)
    if text.endswith(_UNREAL):
        return [NO_MEANING] * width
    for pattern, meaning in _ANY_WIDTH:
        if re.fullmatch(pattern, text):
            is_count = meaning.quantity == "tactile" and are_integers
            return [ColumnMeaning("tactile", "count") if is_count else meaning] * width
    return [NO_MEANING] * width


def meaning_from_name(name: str, kind: str) -> ColumnMeaning:
    """Return the meaning of a scalar column whose name shows both quantity and unit.

    >>> meaning_from_name("joint1_rad", "float32"), meaning_from_name("fx", "float64")
    (ColumnMeaning(quantity='joint_position', unit='rad', component=''), ColumnMeaning(quantity='', unit='', component=''))
    """
    quantity, unit = meaning(name, kind)
    return NO_MEANING if UNKNOWN in (quantity, unit) else ColumnMeaning(quantity, unit)


def aloha_meanings(name: str, width: int) -> list[ColumnMeaning] | None:
    """Return the column meanings of an ALOHA array, or None for another array.

    Each arm has six joints and a gripper, which is open at 1. ``effort`` is the motor current in ALOHA's own unit.

    >>> [meaning.quantity for meaning in aloha_meanings("observations/qpos", 14)][5:8]
    ['joint_position', 'state', 'joint_position']
    """
    array_name = name.rpartition("/")[2]
    quantities = {"qpos": ("joint_position", "rad"), "qvel": ("joint_velocity", "rad/s"), "effort": ("current", "")}
    quantities["action"] = ("target_joint_position", "rad")
    if array_name not in quantities or width % 7:
        return None
    joint = ColumnMeaning(*quantities[array_name])
    gripper = joint if array_name == "effort" else ColumnMeaning("state", "1" if array_name != "qvel" else "1/s")
    return ([joint] * 6 + [gripper]) * (width // 7)


def declared_metadata(attributes: StoredAttributes) -> dict[str, str]:
    """Return the field metadata declared by an array's attributes.

    If a quantity is among them, all texts are included, as in files that tacpipe writes.

    >>> declared_metadata({"units": "N", "comment": "x"})
    {'unit': 'N'}
    >>> declared_metadata({"unit": "count", "quantity": "tactile", "taxel": "7"})
    {'unit': 'count', 'quantity': 'tactile', 'taxel': '7'}
    """
    texts = {key: value for key, value in attributes.items() if isinstance(value, str) and value}
    if "quantity" in texts:
        return texts
    unit = texts.get("unit") or texts.get("units")
    return {"unit": unit} if unit else {}


def declared_texts(attributes: StoredAttributes, key: str, count: int) -> list[str]:
    """Return the texts in the attribute ``key``, one for each of ``count`` columns, or an empty list if its length differs.

    >>> declared_texts({"columns": ["a", "b"]}, "columns", 2), declared_texts({"columns": ["a"]}, "columns", 2)
    (['a', 'b'], [])
    """
    value = attributes.get(key)
    if value is None or isinstance(value, str | bytes) or not hasattr(value, "__iter__"):
        return []
    texts = [text.decode(errors="replace") if isinstance(text, bytes) else str(text) for text in value]
    return texts if len(texts) == count else []
