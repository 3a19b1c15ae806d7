"""Read quantity, unit and component from the names of columns."""

from __future__ import annotations

import itertools
import re

from tacpipe.formats.table.layout import UNKNOWN

_TIME_WORDS = r"(t|time|times|time_?stamps?|stamps?|clock|unix_?time|epoch|datetime|date[_ ]?time|date|uhrzeit|zeit)"
TIME_NAME = re.compile(rf"{_TIME_WORDS}([_ ]?(s|sec|seconds|ms|us|ns))?", re.IGNORECASE)
TIME_ENDING = re.compile(rf"\w+_{_TIME_WORDS}(_(s|sec|ms|us|ns))?", re.IGNORECASE)
UNIT_IN_NAME = re.compile(r"(?P<base>.*?)[ _]*[\[(](?P<unit>[^\])]*)[\])]\s*")
_MEANINGS = (  # endings of names and their quantities; the first match counts
    (r"(txl|tax|taxel|skin|tactile|cell|electrode|pad|sensel|touch)\w*", "tactile"),
    (r"(quat|quaternion|orientation|ori|rot|q)_?[xyzw]", "orientation"),
    (
        r"(velocity|vel|speed)\w*_(joint|j)_?\d+|(joint|j|q)_?\d+_?(velocity|vel|speed)\w*|(dq|qd)_?\d+",
        "joint_velocity",
    ),
    (r"(joint_?(velocity|velocities|vel|speeds?)|qvel)_?\d+", "joint_velocity"),
    (r"(joint_?(positions?|pos|angles?|states?)|joints|qpos)_?\d+", "joint_position"),
    (r"(effort|torque|tau)\w*_?(joint|j)?_?\d+", "joint_torque"),
    (r"(joint|j|q)_?\d+(_?(pos|position))?(_?(rad|deg))?", "joint_position"),
    (r"(f|force|kraft)_?[xyz](_?m?n)?", "force"),
    (r"(t|tau|m|torque|moment)_?[xyz](_?nm)?", "torque"),
    (r"(pos|position|translation|p|ee|tcp)_?[xyz](_?m?m)?", "position"),
    (r"temp\w*", "temperature"),
    (r"(press|druck)\w*", "static_pressure"),
)
_UNITS = {"orientation": "1"}  # quantities that have one unit only
_SUFFIXES = (  # endings that state a unit, the unit, and its quantities
    (r"_(m)", "m", ("position",)),
    (r"_(mm)", "mm", ("position",)),
    (r"_(rad)", "rad", ("joint_position",)),
    (r"_(deg)", "deg", ("joint_position",)),
    (r"_(n)", "N", ("force",)),
    (r"_(nm)", "N m", ("torque", "joint_torque")),
)


def meaning(name: str, kind: str) -> tuple[str, str]:
    """Return the quantity and the unit that a name shows.

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


def is_label(name: str) -> bool:
    """Return whether a name is that of labels rather than readings; the name may begin with a sensor.

    >>> is_label("tactile_slips_label"), is_label("skin_mask"), is_label("label_free_force")
    (True, True, False)
    """
    return bool(
        re.search(
            r"(?:^|[_./ ])(?:labels?|mask|class(?:es)?|annotations?|ground_?truth|target_?class)$", name, re.IGNORECASE
        )
    )


def is_clock(name: str) -> bool:
    """Return whether a name is that of stamps; the name may begin with a sensor.

    >>> is_clock("tactile_timestamps"), is_clock("obs/time_ns"), is_clock("contact_time_constant")
    (True, True, False)
    """
    last = re.split(r"[/.]", name)[-1]
    return bool(TIME_NAME.fullmatch(last) or (TIME_ENDING.fullmatch(last) and not re.search(r"_t$", last)))


def without_unit(name: str) -> str:
    """Return a column's name without the unit that it states in brackets.

    >>> without_unit("Fx [N]"), without_unit("time (ms)"), without_unit("pad[3]")
    ('Fx', 'time', 'pad[3]')
    """
    match = UNIT_IN_NAME.fullmatch(name.strip())
    return match["base"] if match and match["base"] and not match["unit"].isdigit() else name.strip()


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
    """Return the component that the name of a quaternion or position column states, as x for qx, or ""."""
    match = re.fullmatch(r"(?:(?:quat|quaternion|orientation|ori|rot|q)_?)?([xyzw])", lower_name(name))
    return match[1] if match else ""


def taxel_pattern(match: str, quantity: str, kind: str) -> str:
    """Return the pattern of numbered columns, with {taxel} for the number where they may be taxels.

    >>> taxel_pattern("pad{pad}", "tactile", "float64"), taxel_pattern("q{number}", "joint_position", "float64")
    ('pad{taxel}', 'q{number}')
    """
    taxels = quantity == "tactile" or (quantity == UNKNOWN and "int" in kind)
    if not taxels or match.replace("{axis}", "").count("{") != 1:
        return match
    return re.sub(r"\{(?!axis\})\w+\}", "{taxel}", match)


def numbered_pattern(name: str) -> str:
    """Return a name with its numbers as placeholders.

    >>> numbered_pattern("taxel3_x"), numbered_pattern("t12"), numbered_pattern("r1c2")
    ('taxel{taxel}_x', 't{number}', 'r{r}c{c}')
    """
    counter = itertools.count(2)
    labels: set[str] = set()

    def placeholder(number: re.Match[str]) -> str:
        word = number[1].strip("_ .").lower()
        label = (
            word
            if (word.isidentifier() and len(word) > 1) or (name.count(word) and len(re.findall(r"\d+", name)) > 1)
            else "number"
        )
        label = label if label.isidentifier() else "number"
        while label in labels:
            label = f"{label}{next(counter)}"
        labels.add(label)
        return f"{number[1]}{{{label}}}"

    return re.sub(r"([A-Za-z_]*[ .]?)\d+", placeholder, name)
