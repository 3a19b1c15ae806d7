"""Run several tacpipe commands in one new process, which imports everything only once."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def run(folder: Path, commands: Sequence[str]) -> None:
    """Run commands that must succeed in ``folder``, as ``tacpipe`` with these words would.

    Each in a process of its own would spend most of its time on imports.
    """
    process = subprocess.run(
        [sys.executable, __file__], cwd=folder, input=json.dumps(commands), capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, f"{process.stdout}\n{process.stderr}"


def main() -> None:
    """Run the commands that standard input lists."""
    import shlex

    sys.path.pop(0)  # this file's folder, whose modules are not to be found by their bare names
    from tacpipe.cli import main as cli

    for words in json.loads(sys.stdin.read()):
        sys.argv = ["tacpipe", *shlex.split(words)]
        print(words, flush=True)
        try:
            cli.main()
        except SystemExit as ended:
            if ended.code:
                raise


if __name__ == "__main__":
    main()
