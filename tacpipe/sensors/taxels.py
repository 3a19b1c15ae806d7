"""The channels of a tactile array as arrow fields: numbered from 1, taxel by taxel, with their axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa


def numbered(name: str, count: int) -> list[str]:
    """Return ``name`` with numbers from 1, of two digits at least.

    >>> numbered("taxel", 2)
    ['taxel01', 'taxel02']
    """
    digits = max(2, len(str(count)))
    return [f"{name}{number:0{digits}d}" for number in range(1, count + 1)]


def fields(count: int, kind: pa.DataType, unit: str, axes: str = "", prefix: str = "", **layout: str) -> list[pa.Field]:
    """Return the fields ``taxel01`` to the last, or ``taxel01_x``, … where a taxel has ``axes``, each of this type.

    ``prefix`` goes before each name, and ``layout`` into the metadata of each, next to ``taxel`` and ``axis``.
    """
    import pyarrow as pa

    fields_of_taxels = []
    for number, name in enumerate(numbered("taxel", count), start=1):
        metadata = {"unit": unit, "quantity": "tactile", **layout, "taxel": str(number)}
        fields_of_taxels += [
            pa.field(f"{prefix}{name}_{axis}", kind, metadata={**metadata, "axis": axis}) for axis in axes
        ]
        fields_of_taxels += [] if axes else [pa.field(f"{prefix}{name}", kind, metadata=metadata)]
    return fields_of_taxels


def grid(rows: int, columns: int, kind: pa.DataType, unit: str, prefix: str = "", **layout: str) -> list[pa.Field]:
    """Return the fields of taxels that stand in rows, row by row, with ``row`` and ``column`` from 1 in the metadata."""
    return [
        field.with_metadata(
            {**field.metadata, b"row": b"%d" % (place // columns + 1), b"column": b"%d" % (place % columns + 1)}
        )
        for place, field in enumerate(fields(rows * columns, kind, unit, prefix=prefix, **layout))
    ]
