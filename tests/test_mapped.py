"""Arrays that lie in mapped files hold what was put into them, and take memory only while they are read."""

import errno
import os
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.arrays import AnyArray
from tacpipe.errors import StorageError
from tacpipe.io import spill
from tacpipe.io.spill import MappedArrays


def test_arrays_of_all_shapes_and_types_come_back_also_after_they_were_let_go_of(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(spill, "SEGMENT_BYTES", 1 << 16)
    rng, mapped_arrays = np.random.default_rng(0), MappedArrays(100)
    arrays: list[AnyArray] = [
        rng.normal(size=(7, 3)).astype(np.float32),
        rng.integers(0, 9, 5000),
        rng.random(11) < 0.5,
        np.zeros((0, 4)),
        rng.normal(size=(900, 12)),
        np.asfortranarray(rng.normal(size=(20, 30))),
    ]
    copies = [mapped_arrays.keep(array) for array in arrays]
    filled = mapped_arrays.empty((50, 2), np.float32)
    filled[:] = 3
    mapped_arrays.release()
    assert copies[0] is arrays[0]  # the first bytes stay in memory
    for copy, array in zip(copies, arrays, strict=True):
        assert copy.dtype == array.dtype and np.array_equal(copy, array)
    assert (filled == 3).all()


def resident_bytes() -> int:
    """Return how many bytes of this process are in memory."""
    match = re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())
    assert match
    return int(match[1]) << 10


def test_what_was_read_takes_no_memory_once_it_is_let_go_of() -> None:
    mapped_arrays, size = MappedArrays(0), 200 << 20
    array = mapped_arrays.empty((size // 8,), np.float64)
    before = resident_bytes()
    array[:] = 1.0
    assert resident_bytes() > before + size // 2
    mapped_arrays.read(spill.MAX_READ_BYTES + 1)
    assert resident_bytes() < before + size // 8
    assert array.sum() == len(array)


def test_a_full_disk_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(StorageError, match=f"The disk under {tempfile.gettempdir()} is full"):
        MappedArrays(0).keep(np.zeros(10))
