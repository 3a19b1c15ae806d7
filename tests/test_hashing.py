import hashlib
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.hashing import bytes_digest, canonical, digest, file_digest

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@given(st.dictionaries(st.text(), values))
def test_the_order_of_keys_does_not_change_a_digest(value: dict[str, object]) -> None:
    assert digest(dict(reversed(value.items()))) == digest(value)


@given(values, values)
def test_two_values_share_a_digest_only_if_they_share_their_canonical_json(left: object, right: object) -> None:
    assert (digest(left) == digest(right)) == (canonical(left) == canonical(right))


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
