"""Two clients of one export of a kernel's NFS server, in User-mode Linux: `TACPIPE_TEST_NFS=1 pytest tests/nfs`, minutes."""

import os
import re
import sys
from pathlib import Path

import pytest

from tests.power import machine

TOOLS = {  # Programs that are needed, each with its package.
    "linux.uml": "user-mode-linux",
    "rpc.nfsd": "nfs-kernel-server",
    "rpc.mountd": "nfs-kernel-server",
    "ip": "iproute2",
    "insmod": "kmod",
    "mkfs.ext4": "e2fsprogs",
}
ROUNDS = 3
WORK = """
mkdir -p /mnt/a/lab/a /mnt/a/lab/b
on() {  # client, command
    nsenter --net=/run/netns/$1 sh -c "cd /mnt/$1/lab/$1 && TACPIPE_STORE=/mnt/$1/lab/store $PYTHON -B -m tacpipe $2"
}
for round in $(seq ROUNDS); do
    command="simulate toy -o data/r$round --trials 12 --rows $((20 + round)) --jobs 1 --quiet"
    on a "$command" & first=$!
    on b "$command" & second=$!
    on b "store gc" & third=$!
    for process in $first $second $third; do wait $process; echo "CODE $?"; done
    diff -r /mnt/a/lab/a/data /mnt/b/lab/b/data && echo "SAME $round"
done
for client in a b; do on $client "store verify"; echo "CODE $?"; done
"""


@pytest.mark.skipif("TACPIPE_TEST_NFS" not in os.environ, reason="it takes minutes: TACPIPE_TEST_NFS=1 runs it")
@pytest.mark.skipif(bool(machine.lacking(TOOLS)), reason=f"{machine.lacking(TOOLS)} is not installed")
def test_two_clients_of_one_export_that_do_the_same_beside_collections_end_with_the_same_bytes(
    plugin: Path, tmp_path: Path
) -> None:
    disk = machine.format_disk(tmp_path / "disk", "ext4", size_mb=512)
    (tmp_path / "work").write_text(WORK.replace("ROUNDS", str(ROUNDS)))
    variables = {
        "PATH": machine.PATH,
        "LD_LIBRARY_PATH": os.environ.get("LD_LIBRARY_PATH", ""),
        "SCRATCH": str(tmp_path),
        "PYTHON": sys.executable,
        "PYTHONPATH": str(plugin),
        "OMP_NUM_THREADS": "1",
        "HOME": "/run",
    }
    ran = machine.boot([disk], f"exec bash {Path(__file__).with_name('guest.sh')}\n", tmp_path, variables)
    printed = ran.stdout
    assert "CLIENTS 2" in printed, printed[-3000:] + ran.stderr[-1000:]
    assert re.findall(r"CODE (\d+)", printed) == ["0"] * (3 * ROUNDS + 2), printed[-3000:]
    assert re.findall(r"SAME (\d+)", printed) == [str(number) for number in range(1, ROUNDS + 1)]
    assert printed.count("all sound") == 2
