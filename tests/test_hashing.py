import hashlib
import os
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.io import hashing
from tacpipe.io.hashing import bytes_digest, canonical, digest, file_digest, remembered_file_digest
from tests.conftest import FileCalls

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=5), inner, max_size=5),
    max_leaves=10,
)


@given(st.dictionaries(st.text(max_size=5), values, max_size=5))
def test_the_order_of_keys_does_not_change_a_digest(value: dict[str, object]) -> None:
    assert digest(dict(reversed(value.items()))) == digest(value)


@given(values, values)
def test_two_values_share_a_digest_only_if_they_share_their_canonical_json(first: object, right: object) -> None:
    assert (digest(first) == digest(right)) == (canonical(first) == canonical(right))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {1, 2}, b"bytes", object()])
def test_what_json_cannot_hold_is_refused(value: object) -> None:
    with pytest.raises(TacpipeError, match="cannot be made"):
        digest(value)


def test_a_file_digest_is_what_sha256sum_prints(tmp_path: Path) -> None:
    file = tmp_path / "shard.parquet"
    file.write_bytes(bytes(range(256)) * 1000)
    printed = subprocess.run(["sha256sum", file], capture_output=True, text=True, check=True).stdout.split()[0]
    assert file_digest(file) == printed == bytes_digest(file.read_bytes())


def test_the_digest_of_a_value_is_that_of_its_canonical_json() -> None:
    assert digest({"b": 1, "a": [True, None]}) == hashlib.sha256(b'{"a":[true,null],"b":1}').hexdigest()


def test_a_file_that_stays_as_it_is_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file_calls: FileCalls
) -> None:
    monkeypatch.setattr(hashing, "SETTLED_NS", -1)  # The file looks as if it had been written long ago.
    file = tmp_path / "block.npy"
    file.write_bytes(b"slides")
    assert {remembered_file_digest(path) for path in (file, str(file), file)} == {bytes_digest(b"slides")}
    assert file_calls.take("block.npy") == 1
    (tmp_path / "other.npy").write_bytes(b"others")
    assert remembered_file_digest(tmp_path / "other.npy") == bytes_digest(b"others")


def test_a_file_that_was_written_just_now_is_read_each_time(tmp_path: Path, file_calls: FileCalls) -> None:
    file = tmp_path / "block.npy"
    for content in (
        b"one",
        b"two",
    ):  # Both have the same length, and may be written within one tick of the file system's clock.
        file.write_bytes(content)
        assert remembered_file_digest(file) == remembered_file_digest(file) == bytes_digest(content)
    assert file_calls.take("block.npy") == 4


def test_a_file_that_changed_is_read_again_though_its_time_was_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file_calls: FileCalls
) -> None:
    monkeypatch.setattr(hashing, "SETTLED_NS", -1)
    file = tmp_path / "block.npy"
    file.write_bytes(b"one")
    before = file.stat()
    assert remembered_file_digest(file) == bytes_digest(b"one")
    while file.stat().st_ctime_ns == before.st_ctime_ns:
        file.write_bytes(b"two")
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert file.stat().st_mtime_ns == before.st_mtime_ns
    assert remembered_file_digest(file) == bytes_digest(b"two")
    assert file_calls.take("block.npy") == 2
