"""Compare numbers parsed from many texts with Python's parser; unusual texts are not parsed."""

import math
import re
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.sensors import number_texts
from tacpipe.sensors.byte_framer import LineFramer, TextFramer
from tacpipe.sensors.framing import Chunks

WRITTEN = st.one_of(
    st.floats(-1e9, 1e9).map(lambda number: f"{number:.3f}"),
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.sampled_from(["", "+1", "1_0", "0x1f", "--1", "1.2.3", "1e", "nan", "inf", "-", ".", "one"]),
)
TEXT = b'<a x="%b" y="%b"><b>%b</b><c z="yes"/></a>'


def read(words: Sequence[bytes]) -> list[float] | None:
    try:
        return list(map(float, words))
    except ValueError:
        return None


@given(
    st.lists(st.lists(WRITTEN, min_size=1, max_size=4), min_size=1, max_size=5),
    st.lists(st.sampled_from([" ", "\t", "  ", " \t"]), min_size=1, max_size=3),
)
def test_numbers_of_lines_are_those_that_python_reads_in_each(rows: list[list[str]], separators: list[str]) -> None:
    lines = [separators[row % len(separators)].join(words).strip().encode() for row, words in enumerate(rows)]
    wide = max(1, len(lines[0].split()))
    expected = [read(line.split()) for line in lines]

    numbers = number_texts.parse_lines(lines, wide)

    if numbers is not None and np.isfinite(numbers).all():
        assert numbers.tolist() == expected
    elif numbers is None:
        plain = [re.fullmatch(rb"-?\d+(\.\d+)?", word) for line in lines for word in line.split()]
        assert not all(plain) or any(len(line.split()) != wide for line in lines)


@pytest.mark.parametrize("line", [b"1 2", b"1 2 3 4", b"", b"1 2\x0b3", b"1 two 3"])
def test_lines_of_which_one_has_other_numbers_are_not_read(line: bytes) -> None:
    assert number_texts.parse_lines([b"1 2 3", line, b"4 5 6"], 3) is None


@given(st.lists(st.tuples(WRITTEN, WRITTEN, WRITTEN), min_size=1, max_size=5))
def test_numbers_of_texts_are_those_that_python_reads_between_the_same_marks(rows: list[tuple[str, str, str]]) -> None:
    texts = [TEXT % tuple(word.encode() for word in row) for row in rows]
    pattern = number_texts.pattern(TEXT % (b"1", b"2.5", b"-3"))
    assert pattern is not None

    words = pattern.extract(texts)

    assert words is not None
    assert words.to_pylist() == [word for row in rows for word in row]
    numbers, expected = number_texts.floats(words), read([word.encode() for row in rows for word in row])
    assert numbers is None or not np.isfinite(numbers).all() or numbers.tolist() == expected


@pytest.mark.parametrize(
    "texts",
    [
        [TEXT.replace(b"x=", b"w=")],
        [TEXT.replace(b"yes", b"no")],
        [TEXT.replace(b"<b>", b"<d>").replace(b"</b>", b"</d>")],
        [TEXT + b" "],
        [TEXT[:-1], b">" + TEXT],
        [TEXT.replace(b'x="%b" y="%b"', b'y="%b" x="%b"')],
        [TEXT.replace(b'y="%b"', b'y="%b" t="0"')],
    ],
)
def test_texts_that_differ_in_more_than_their_numbers_are_not_read(texts: list[bytes]) -> None:
    pattern = number_texts.pattern(TEXT % (b"1", b"2", b"3"))
    assert pattern is not None
    filled = [text.replace(b"%b", b"7") for text in texts]

    assert pattern.extract([TEXT % (b"1", b"2", b"3"), *filled]) is None


def test_whole_numbers_are_told_from_others() -> None:
    pattern = number_texts.pattern(b"<n>5</n>")
    assert pattern is not None

    for text, expected in [(b"4208163634", [4208163634]), (b"1.5", None), (b"1e3", None), (b"", None)]:
        numbers = number_texts.integers(pattern.extract([b"<n>%b</n>" % text]))
        assert (numbers is None and expected is None) or (numbers is not None and numbers.tolist() == expected)


@given(st.lists(st.sampled_from([b"12", b"x"]), max_size=60))
def test_looking_at_many_texts_at_once_finds_the_frames_that_looking_at_each_does(texts: list[bytes]) -> None:
    packets = Chunks.from_pairs(list(enumerate(texts)))
    lines = Chunks.from_pairs([(0, b"\n" + b"".join(text + b"\n" for text in texts))])

    for kind, chunks in ((TextFramer, packets), (LineFramer, lines)):
        single, batched = (
            kind(bytes.isdigit),
            kind(bytes.isdigit, check_all=lambda candidates: all(map(bytes.isdigit, candidates))),
        )
        (single_runs, single_losses), (batched_runs, batched_losses) = single.feed(chunks), batched.feed(chunks)
        assert [run.frames for run in single_runs] == [run.frames for run in batched_runs]
        assert [run.frames for run in single_runs] == ([[b"12"] * texts.count(b"12")] if b"12" in texts else [])
        assert single_losses == batched_losses and math.fsum(loss.frames for loss in single_losses) == texts.count(b"x")
        assert single.account == batched.account
