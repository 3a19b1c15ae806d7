"""The sentence for a recording that lacks a channel which a stage needs: what there is, and where it is declared."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import pyarrow as pa

_NO_CHANNELS = ("time", "mask", "label", "latent", "prediction")  # quantities of columns that no sensor gave
_SHOWN = 6  # quantities


def entry(stream: str) -> str:
    """Return where a layout file declares the columns of a stream.

    >>> entry("skin"), entry("")
    ('[streams.skin] columns', '[streams.…] columns')
    """
    return f"[streams.{plain(stream) if stream else '…'}] columns"


def absent(
    recording: str, quantity: str, fields: Iterable[pa.Field] | Mapping[str, Iterable[pa.Field]], *, unit: str = ""
) -> TacpipeError:
    """Return the error of a recording without a channel of ``quantity``; ``fields`` are those of all its columns, or of each
    stream.

    It names the quantities that are there, the columns without one, and the line of a layout file that sets it.
    """
    undeclared: list[str] = []
    known: dict[str, int] = {}
    streams: set[str] = set()
    owned: list[tuple[str, pa.Field]]
    if isinstance(fields, Mapping):
        owned = [(stream, field) for stream, some in fields.items() for field in some]
    else:
        owned = [("", field) for field in fields]
    for stream, field in owned:
        metadata = field.metadata or {}
        found = metadata.get(b"quantity", b"").decode()
        if found in _NO_CHANNELS or field.name in ("t_ns", "seq", "t_device_ns"):
            continue
        if found:
            known[found] = known.get(found, 0) + 1
        else:
            undeclared.append(field.name)
            streams.add(stream or metadata.get(b"stream", b"").decode())
    there = [f"{count} of {plain(name)}" for name, count in known.items()]
    there += [f"{len(undeclared)} without a quantity ({listed(undeclared, 3)})"] if undeclared else []
    where = entry(streams.pop() if len(streams) == 1 else "")
    wanted = f'quantity = "{quantity}"' + (f' and unit = "{unit}"' if unit else "")
    shown = ", ".join(there[-_SHOWN:]) or "none"
    return TacpipeError(
        f"Recording {recording} has no channel of the quantity {quantity}; its columns are {shown}. Set "
        f"{wanted} in {where} of the layout file, and ingest again."
    )
