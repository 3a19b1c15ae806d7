"""Spans: labels of rows, gaps and events."""

import numpy as np
import pyarrow as pa
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.channels import schema
from tacpipe.traces import spans
from tacpipe.traces.spans import Span
from tests.viewer import hand

S = 1_000_000_000


def seconds(span_list: list[Span]) -> list[tuple[str, str, float, float]]:
    start_ns = hand.START_NS
    return [(span.lane, span.text, (span.start_ns - start_ns) / S, (span.stop_ns - start_ns) / S) for span in span_list]


def test_contacts_have_their_number_and_slips_their_name() -> None:
    assert seconds(spans.label_spans(hand.labels())) == [("contact", "contact 0", 1.0, 3.0), ("slip", "slip", 2.5, 3.0)]


def test_a_span_up_to_the_last_row_ends_a_step_behind_it() -> None:
    table = schema.stream(np.arange(4) * 10, [[0, 0, 1, 1]], [schema.label_field("slip")])

    assert spans.label_spans(table) == [Span("slip", "slip", 20, 40)]


def test_of_the_phases_of_a_slide_the_slide_is_a_span() -> None:
    table = schema.stream(np.arange(5), [[-1, 0, 0, 1, 1]], [schema.label_field("phase")])

    assert spans.label_spans(table) == [Span("phase", "slide", 1, 3)]


def test_texts_are_spans_by_themselves_and_null_is_none() -> None:
    field = pa.field("surface", pa.string(), metadata={"quantity": "label"})
    values = pa.array(["", "cork", "cork", None, "foam"])
    table = pa.table([pa.array(range(5)), values], schema=pa.schema([pa.field("t_ns", pa.int64()), field]))

    assert [span[1:] for span in spans.label_spans(table)] == [("cork", 1, 3), ("foam", 4, 5)]


@given(st.lists(st.integers(-1, 3), min_size=2, max_size=60))
def test_spans_are_the_rows_that_hold_their_value(values: list[int]) -> None:
    table = schema.stream(np.arange(len(values)), [values], [schema.label_field("contact")])
    found_spans = spans.label_spans(table)

    texts_by_row = {row: span.text for span in found_spans for row in range(span.start_ns, span.stop_ns)}
    if set(values) <= {0, 1}:  # a switch
        assert texts_by_row == {row: "contact" for row, value in enumerate(values) if value}
    else:
        assert texts_by_row == {row: f"contact {value}" for row, value in enumerate(values) if value >= 0}


def test_gaps_are_those_of_the_counter_where_the_device_counts() -> None:
    late = pa.table({"t_ns": [0, 10, 20, 90, 100], "seq": [1, 2, 3, 4, 5]})
    lost = pa.table({"t_ns": [0, 10, 20, 30, 40], "seq": [1, 2, 3, 5, 6]})

    assert spans.gaps("a", late) == [] and spans.gaps("a", lost) == [Span("a", "gap", 20, 30)]
    assert spans.gaps("a", late.drop_columns("seq")) == [Span("a", "gap", 20, 90)]


def test_masks_of_a_synchronized_table_give_the_gaps_of_its_streams() -> None:
    table = pa.table({"t_ns": [0, 10, 20, 30], "arm_gap": [False, True, True, False], "arm_x": [0.0] * 4})

    assert spans.masked_gaps(table) == [Span("arm", "gap", 10, 30)]


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 30), st.integers(1, 10)), max_size=12))
def test_merged_spans_name_at_each_moment_all_lanes_that_are_there(intervals: list[tuple[str, int, int]]) -> None:
    given_spans = [Span(lane, "gap", start, start + length) for lane, start, length in intervals]
    merged = spans.merge_lanes(given_spans)

    for at in range(41):
        expected = sorted({span.lane for span in given_spans if span.start_ns <= at < span.stop_ns})
        lanes = [span.text.split(", ") for span in merged if span.start_ns <= at < span.stop_ns]
        assert lanes == ([expected] if expected else [])


def test_an_event_has_its_moment_stream_and_what_was_lost() -> None:
    (event,) = spans.events(hand.events())

    assert (event.t_ns, event.stream, event.cause) == (hand.START_NS + 2 * S, "xela1", "cut")
    assert "1 frames" in event.text and "7 bytes" in event.text
