"""The streams of a recording: those of a synchronized table are those that were recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.channels.streams import columns_with_quantity, signal
from tacpipe.datasets.overview import streams_of


@dataclass
class Recording:
    """A recording without a store."""

    tables: Mapping[str, pa.Table]
    name: str = "trial"

    @property
    def streams(self) -> tuple[str, ...]:
        return tuple(sorted(self.tables))

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        return self.tables[stream]


def table(**columns: tuple[list[Any], dict[str, str]]) -> pa.Table:
    fields = [pa.field(name, pa.array(values).type, metadata=kind) for name, (values, kind) in columns.items()]
    return pa.table([pa.array(values) for values, _ in columns.values()], schema=pa.schema(fields))


def streams(tables: Mapping[str, pa.Table]) -> dict[str, pa.Table]:
    return streams_of(Recording(tables))  # type: ignore[arg-type]


TIME = ([10, 20], {"quantity": "time"})


def test_streams_that_lie_apart_are_given_without_truth_and_events() -> None:
    left, right = table(t_ns=TIME, a=([1, 2], {})), table(t_ns=TIME, b=([3, 4], {}))
    assert streams({"one": left, "events": right, "truth": right, "two": right}) == {"one": left, "two": right}


def test_a_synchronized_table_falls_apart_under_the_names_that_were_recorded() -> None:
    parts = streams(
        {
            "": table(
                t_ns=TIME,
                xela_x=([1, 2], {"stream": "xela", "quantity": "tactile"}),
                xela_held=([True, False], {"stream": "xela", "quantity": "mask"}),
                robot_xela_x=([3, 4], {"stream": "robot"}),
                gt_force_n=([5, 6], {"stream": "truth"}),
            )
        }
    )
    assert {name: part.to_pydict() for name, part in parts.items()} == {
        "xela": {"t_ns": [10, 20], "x": [1, 2]},
        "robot": {"t_ns": [10, 20], "xela_x": [3, 4]},
    }
    assert columns_with_quantity(parts["xela"], "tactile") == ["x"]
    assert columns_with_quantity(parts["robot"], "tactile") == []


def test_a_table_that_was_one_from_the_start_is_one_stream_without_name() -> None:
    assert list(streams({"": table(t_ns=TIME, a=([1, 2], {}))})) == [""]


def test_a_signal_is_that_of_the_first_stream_with_its_quantity() -> None:
    force = {"quantity": "force"}
    tables = {
        "pose": table(t_ns=TIME, a=([1, 2], {})),
        "wrench": table(t_ns=TIME, x=([1.0, 2.0], force), other=([0.0, 0.0], {}), y=([3.0, 4.0], force)),
    }
    values = signal(tables, "force")
    assert values is not None
    np.testing.assert_array_equal(values[0], [10, 20])
    np.testing.assert_array_equal(values[1], [[1.0, 3.0], [2.0, 4.0]])
    assert signal(tables, "velocity") is None
