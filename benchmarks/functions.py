"""Count the functions and modules of tacpipe that a command enters in its own process: `python benchmarks/functions.py`.

A reader who traces `synchronize` of 8 recordings meets this many functions. Class bodies, lambdas and comprehensions are
not counted, and neither is the rest of the process, such as libraries and worker processes.
"""

from __future__ import annotations

import collections
import contextlib
import io
import os
import sys
import tempfile
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).parents[1]
OWN = (str(ROOT / "tacpipe"), str(ROOT / "stages"))
_NEW_LOCALS = 0x2  # flag of the code of functions, which modules and class bodies lack


def trace(words: str) -> tuple[set[CodeType], int]:
    """Run a command of tacpipe in this process; return the functions that it entered, and its number of modules."""
    from tacpipe.cli import main

    entered: set[CodeType] = set()

    def record(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            entered.add(frame.f_code)

    sys.setprofile(record)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            code = main.answer(words.split())
    finally:
        sys.setprofile(None)
    assert code == 0, f"{words} ended with {code}"
    own = {
        code
        for code in entered
        if os.path.realpath(code.co_filename).startswith(OWN)
        and code.co_flags & _NEW_LOCALS
        and not code.co_name.startswith("<")
    }
    return own, len({code.co_filename for code in own})


def main() -> None:
    """Print the counts of a first `synchronize` of 8 recordings and of its hit, by package."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for case in ("simulate forward --trials 8 --duration-s 4 -o r", *["synchronize r -o s"] * 2):
            child = os.fork()  # each command begins with its modules not yet used
            if not child:
                functions, modules = trace(case)
                by_package = collections.Counter(
                    Path(os.path.realpath(code.co_filename)).relative_to(ROOT).parts[:-1][:2][-1] for code in functions
                )
                print(f"{case}: {len(functions)} functions in {modules} modules", dict(by_package.most_common()))
                sys.stdout.flush()
                os._exit(0)
            os.waitpid(child, 0)


if __name__ == "__main__":
    main()
