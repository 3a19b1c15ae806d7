import errno
import os
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Lab


def test_a_full_disk_is_no_reason_to_leave_recordings_out(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate toy -o data/r")
    write = os.write

    def full(handle: int, content: Any) -> int:
        place = str(Path(f"/proc/self/fd/{handle}").readlink())
        if "/.tacpipe/tmp/" in place and bytes(content[:4]) == b"PAR1":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(handle, content)

    monkeypatch.setattr(os, "write", full)
    ran = lab.call("scale data/r -o data/s --skip-bad --jobs 1")
    assert ran.code == 1
    assert "is full" in ran.err
    assert not Path("data/s/manifest.json").exists()
    monkeypatch.setattr(os, "write", write)
    lab.run("scale data/r -o data/s --skip-bad --jobs 1")
    assert len(lab.manifest("data/s").recordings) == 4
