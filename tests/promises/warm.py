"""Processes of tacpipe that start at once: forked from one that has imported everything, each in a session of its own.

Half a second of imports would be what most random kills meet. Run as ``python -m tests.promises.warm``, it reads requests
from standard input, a line of JSON each, and answers each with a line.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

IMPORTED = ("pyarrow.parquet", "pyarrow.compute", "tacpipe.engine.pipeline", "tacpipe.cli.stages", "tacpipe.cli.store")


class Warm:
    """The server of forks, from the side of those who ask."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def start(self, folder: Path, words: str, out: Path, environment: Mapping[str, str]) -> int:
        """Return the id of a new process, and of its session, that runs ``tacpipe words`` and prints to ``out``."""
        request = {"folder": str(folder), "words": words, "out": str(out), "environment": dict(environment)}
        return int(self._ask(request))

    def poll(self, pid: int) -> int | None:
        """Return how a process ended, as `subprocess` gives it, or None while it runs."""
        exit_code: int | None = self._ask({"pid": pid})
        return exit_code

    def _ask(self, request: Mapping[str, Any]) -> Any:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


@contextlib.contextmanager
def serving(*modules: str) -> Iterator[Warm]:
    """Yield a server of forks that has imported these modules too."""
    command = [sys.executable, "-m", "tests.promises.warm", *IMPORTED, *modules]
    with subprocess.Popen(
        command, cwd=Path(__file__).parents[2], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield Warm(process)
        assert process.stdin is not None
        process.stdin.close()


def main() -> None:
    """Serve requests; return in a process that is to be a command, having run it."""
    import importlib

    for module in sys.argv[1:]:
        importlib.import_module(module)
    for line in sys.stdin:
        request = json.loads(line)
        if "pid" in request:
            pid, status = os.waitpid(request["pid"], os.WNOHANG)
            answer = os.waitstatus_to_exitcode(status) if pid else None
        else:
            answer = os.fork()
            if answer == 0:
                return _become(**request)
        print(json.dumps(answer), flush=True)
    return None


def _become(folder: str, words: str, out: str, environment: Mapping[str, str]) -> None:
    import shlex

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # until the command heeds it
    os.setsid()
    os.chdir(folder)
    os.environ.update(environment)
    printed = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    for handle, source in ((0, os.open(os.devnull, os.O_RDONLY)), (1, printed), (2, printed)):
        os.dup2(source, handle)
    sys.path[:0] = [path for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path]
    if "TEST_USER" in environment:  # Users of a group share what they write.
        os.setgroups([])
        os.setgid(int(environment["TEST_GROUP"]))
        os.setuid(int(environment["TEST_USER"]))
        os.umask(int(environment.get("TEST_UMASK", "002"), 8))
        sys.path = [path for path in sys.path if os.access(path, os.R_OK)]  # the interpreter may be root's alone
    sys.argv = ["tacpipe", *shlex.split(words)]
    from tacpipe.cli import main as cli

    cli.main()


if __name__ == "__main__":
    main()
