"""The sentence for a recording that lacks a channel which a stage needs: what there is, and where it is declared."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import pyarrow as pa

_NO_CHANNELS = ("time", "mask", "label", "latent", "prediction")  # quantities of columns that no sensor gave
_SHOWN = 6


def entry(stream: str) -> str:
    """Return where a layout file declares the columns of a stream.

    >>> entry("skin"), entry("")
    ('[streams.skin] columns', '[streams.…] columns')
    """
    return f"[streams.{plain(stream) if stream else '…'}] columns"


def absent(
    recording: str, quantity: str, fields: Iterable[pa.Field], *, unit: str = "", stream: str = ""
) -> TacpipeError:
    """Return the error of a recording without a channel of ``quantity``; ``fields`` are those of all its columns.

    It names the quantities that are there, columns without one first, and the line of a layout file that sets it.
    """
    undeclared: list[str] = []
    known: dict[str, int] = {}
    streams = {stream} if stream else set()
    for field in fields:
        metadata = field.metadata or {}
        found = metadata.get(b"quantity", b"").decode()
        if found in _NO_CHANNELS or field.name in ("t_ns", "seq", "t_device_ns"):
            continue
        if found:
            known[found] = known.get(found, 0) + 1
        else:
            undeclared.append(field.name)
            streams.add(metadata.get(b"stream", b"").decode())
    there = [f"{count} of {plain(name)}" for name, count in known.items()]
    there += [f"{len(undeclared)} without a quantity ({listed(undeclared, 3)})"] if undeclared else []
    where = entry(streams.pop() if len(streams) == 1 else "")
    wanted = f'quantity = "{quantity}"' + (f' and unit = "{unit}"' if unit else "")
    return TacpipeError(
        f"Recording {recording} has no channel of the quantity {quantity}; its columns are {listed(there, _SHOWN)}. Set "
        f"{wanted} in {where} of the layout file, and ingest again."
    )
