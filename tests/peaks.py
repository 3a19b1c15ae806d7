"""Measure the peak resident memory of a command in a separate process."""

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

# the kernel counts a process' peak from its `exec` on; `ru_maxrss` would hold that of the process which started it
PROGRAM = """
import atexit, importlib, json, re, sys
from tacpipe.cli.main import main
for name, value in json.loads(sys.argv.pop(1)).items():
    module, _, constant = name.rpartition(".")
    setattr(importlib.import_module(module), constant, value)
def state():
    print("peak", re.search("VmHWM:\\\\s+([0-9]+)", open("/proc/self/status").read())[1])
atexit.register(state)
sys.argv[0] = "tacpipe"
sys.exit(main())
"""


def bytes_of(folder: Path, command: str, constants: Mapping[str, int] = MappingProxyType({})) -> int:
    """Return how many bytes of memory ``tacpipe COMMAND`` had at most, in ``folder``; it must succeed.

    The command is run in one process, with temporary files that lie on ``folder``'s disk. ``constants`` of tacpipe's
    modules, by their whole names, have these values there: what may stay in memory is less than a test's recordings.
    """
    words = [sys.executable, "-c", PROGRAM, json.dumps(dict(constants)), *shlex.split(command)]
    environment = {name: value for name, value in os.environ.items() if name != "TACPIPE_STORE"}
    environment |= {"OMP_NUM_THREADS": "1", "TMPDIR": str(folder), "COLUMNS": "120"}
    process = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    name, kilobytes = process.stdout.splitlines()[-1].split()
    assert name == "peak"
    return int(kilobytes) << 10
