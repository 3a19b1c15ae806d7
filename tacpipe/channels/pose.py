"""Which columns of a synchronized table hold the pose of an arm: found by quantity, unit and component, not by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.channels import components
from tacpipe.channels.absent import absent, entry
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import pyarrow as pa

POSITION, ORIENTATION, WIDTH = "position", "orientation", "finger_width"  # quantities
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}  # by unit of a length
USUAL = "robot"  # stream that is the arm where several hold a position
TRUTH = "gt_"  # how columns with ground truth begin


@dataclass(frozen=True)
class Pose:
    """The columns of an arm's position x, y, z and of its quaternion x, y, z, w; empty where it has none."""

    position: tuple[str, ...] = ()
    orientation: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """All of them, the position first."""
        return self.position + self.orientation


WITHOUT_ARM = "Without an arm, give --actions none."

# the columns of recordings that do not declare quantities, as the first versions wrote them
NAMED = Pose(
    tuple(f"{USUAL}_position_{axis}_m" for axis in "xyz"), tuple(f"{USUAL}_orientation_{part}" for part in "xyzw")
)


def pose(schema: pa.Schema, arm: str = "", *, needed: bool = True) -> Pose:
    """Return the columns of the arm's pose; of no arm where no column's quantity is position.

    ``arm`` names the stream of the arm; without it that is the only one with a position, or else the one named robot.
    An arm without a quaternion has no orientation. Where none is ``needed`` nor named, several streams with a position, as
    markers have, and a position that is not x, y and z are not an arm. Else raises `TacpipeError` for these, and
    `UsageError` where ``arm`` has no position.
    """
    found = _vectors(schema, POSITION)
    if not found and set(NAMED.columns) <= set(schema.names):
        return NAMED
    streams = list(dict.fromkeys(stream for stream, _ in found))
    if arm and arm not in streams:
        raise UsageError(f"arm is {arm!r}, and a position is in {listed(streams)}; name one of these streams.")
    if not found:
        return Pose()
    stream = arm or (streams[0] if len(streams) == 1 else USUAL)
    here = [fields for (owner, _), fields in found.items() if owner == stream]
    if not here and not needed:
        return Pose()
    if len(here) != 1:
        several = listed(field.name for fields in found.values() for field in fields)
        raise TacpipeError(
            f"There are {len(found)} positions ({several}), and the motion of one arm is read. Name its stream with "
            f"--arm, or give what is not an arm another quantity in {entry(stream if here else '')} of the layout file."
        )
    if not needed and not arm and sorted(map(components.component, here[0])) != list("xyz"):
        return Pose()
    try:
        position = _ordered(here[0], "xyz", POSITION, stream)
    except TacpipeError as error:
        raise TacpipeError(f"{error} {WITHOUT_ARM}") from error
    turned = [fields for (owner, _), fields in _vectors(schema, ORIENTATION).items() if owner == stream]
    if len(turned) > 1:
        several = listed(field.name for fields in turned for field in fields)
        raise TacpipeError(
            f"The stream {stream} has {len(turned)} orientations ({several}), and one is read. Give the others another "
            f"quantity in {entry(stream)} of the layout file."
        )
    return Pose(position, _ordered(turned[0], "xyzw", ORIENTATION, stream) if turned else ())


def metres(field: pa.Field) -> float:
    """Return how many metres the unit of a length is. Raises `TacpipeError` for one that is not known.

    A column without metadata is in metres, as its name then ends in _m.
    """
    metadata = field.metadata or {}
    unit = metadata.get(b"unit", b"").decode()
    if not unit and b"quantity" not in metadata:
        return 1.0
    if unit not in METRES:
        stream = metadata.get(b"stream", b"").decode()
        raise TacpipeError(
            f"{field.name} has the unit {unit!r}; a position is in {', '.join(METRES)}. Set unit in {entry(stream)} of the "
            f"layout file, with scale where the file has another unit, and ingest again."
        )
    return METRES[unit]


def no_arm(recording: str, schema: pa.Schema) -> TacpipeError:
    """Return the error of a recording whose arm is not found although its motion is to be read."""
    missing = absent(recording, POSITION, schema, unit="m")
    return TacpipeError(f"{missing} {WITHOUT_ARM}")


def _vectors(schema: pa.Schema, quantity: str) -> dict[tuple[str, str], list[pa.Field]]:
    """Return the columns of a quantity by stream and by what their names share."""
    found: dict[tuple[str, str], list[pa.Field]] = {}
    for field in schema:
        metadata = field.metadata or {}
        if metadata.get(b"quantity") == quantity.encode() and not field.name.startswith(TRUTH):
            key = metadata.get(b"stream", b"").decode(), components.shared_name(field)
            found.setdefault(key, []).append(field)
    return found


def _ordered(fields: list[pa.Field], parts: str, quantity: str, stream: str) -> tuple[str, ...]:
    """Return the names of columns in the order of ``parts``, each of which must be there once."""
    by_part = {components.component(field): field.name for field in fields}
    if sorted(by_part) != sorted(parts) or len(fields) != len(parts):
        raise TacpipeError(
            f"The {quantity} in {listed(field.name for field in fields)} has the components "
            f"{listed(plain(components.component(field)) or 'unknown' for field in fields)}; it needs {', '.join(parts)} "
            f'once each. Set component = "{parts[0]}" and so on in {entry(stream)} of the layout file, and ingest again.'
        )
    return tuple(by_part[part] for part in parts)
