"""How a channel is placed on a grid, by its type and quantity, and what it is called there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from tacpipe.channels import components
from tacpipe.channels.absent import entry
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

TRUTH = "gt_"  # how columns with ground truth begin; they keep their names and have no masks
DEVICE, SEQUENCE = "t_device_ns", "seq"  # a device's own time and number of a sample; they stay as they are
UNCERTAIN = "t_uncertain_ns"  # by how much a sample may be stamped late; the recorder's, and no channel
AS_IT_STANDS = ("label", "time", "mask")  # quantities between whose samples there is nothing


def channel_names(schema: pa.Schema) -> list[str]:
    """Return the names of a stream's channels: of all columns but the time and its uncertainty."""
    return [name for name in schema.names if name not in ("t_ns", UNCERTAIN)]


def method(schema: pa.Schema, name: str) -> str:
    """Return how a channel is interpolated: nearest, linear, median, or slerp and the name of its quaternion."""
    import pyarrow as pa

    field = schema.field(name)
    metadata = field.metadata or {}
    quantity = metadata.get(b"quantity", b"").decode()
    number = pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
    if not number or quantity in AS_IT_STANDS or name in (DEVICE, SEQUENCE):
        return "nearest"
    if quantity == "proximity":
        return "median"
    if quantity == "orientation":
        return f"slerp {components.shared_name(field)}"
    return "linear"


def quaternion_order(stream: str, fields: Sequence[pa.Field]) -> list[int]:
    """Return where x, y, z and w are among the columns of a quaternion. Raises `TacpipeError` for other components."""
    found = [components.component(field) for field in fields]
    if sorted(found) != ["w", "x", "y", "z"]:
        raise TacpipeError(
            f"Stream {stream!r}: the orientation in {listed(field.name for field in fields)} has the components "
            f"{listed(part or 'unknown' for part in found)}; a quaternion needs x, y, z and w once each. Set component = "
            f'"x" and so on in {entry(stream)} of the layout file, or another quantity for what is not a quaternion.'
        )
    return [found.index(part) for part in "xyzw"]


def between_type(kind: pa.DataType) -> pa.DataType:
    """Return the type of interpolated values: floats as they are, integers of 16 bits or fewer float32, else float64."""
    import pyarrow as pa

    if pa.types.is_floating(kind):
        return kind
    return pa.float32() if kind.bit_width <= 16 else pa.float64()


def grid_field(stream: str, found: pa.Field, interpolation: str, kind: pa.DataType | None = None) -> pa.Field:
    """Return the field of a channel on the grid: ``<stream>_<column>``, where it came from and how."""
    import pyarrow as pa

    metadata = {**(found.metadata or {}), b"stream": stream.encode(), b"interpolation": interpolation.encode()}
    return pa.field(grid_name(stream, found.name), kind or found.type, metadata=metadata)


def grid_name(stream: str, channel: str) -> str:
    """Return the name of a stream's channel on the grid.

    >>> grid_name("xela1", "taxel01_x"), grid_name("truth", "gt_slip")
    ('xela1_taxel01_x', 'gt_slip')
    """
    return channel if channel.startswith(TRUTH) else f"{stream}_{channel}"


def listed(names: Iterable[Any]) -> str:
    """Return names with commas between them."""
    return ", ".join(map(str, names))
