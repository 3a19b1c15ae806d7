"""Commands that end after reading Parquet, run until a rare end shows: a process that aborts when its work is done.

    python -m tests.promises.exits [--shows 2000] [--others 300] [--jobs 2]

prints a table of exit codes by command and ends with 1 if one differs from 0. Threads of Arrow's pool run on while the
interpreter ends, so the fault depends on time: it cannot be tried once, only counted.
"""

import argparse
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests import chain
from tests.conftest import tacpipe
from tests.promises.counts import count

SHOW = "show data/recordings"
_EVERY = 50  # commands between two lines of progress
OTHERS = (
    "show data/latents",
    "show data/split",
    "show models/forward",
    "show results/forward",
    "explain data/latents",
    "synchronize data/recordings -o data/synced --recompute-and-compare --jobs 1",
    "split data/segments -o data/split --scheme random --val 0.25 --test 0.25 --recompute-and-compare",
    "evaluate models/forward data/latents --split data/split -o results/forward --check",
    "evaluate models/forward data/latents --split data/split -o results/forward --recompute-and-compare --jobs 1",
    "report results/forward -o report.html --recompute-and-compare",
)


def main() -> int:
    """Run the commands and print their exit codes; return 1 if one was not 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shows", type=int, default=2000, help="Runs of `tacpipe show`.")
    parser.add_argument("--others", type=int, default=300, help="Runs of other commands, in turns.")
    parser.add_argument("--jobs", type=int, default=2, help="Commands at a time.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        chain.run(Path(place))
        counts = count_exit_codes(Path(place), [SHOW] * options.shows, options.jobs)
        counts += count_exit_codes(
            Path(place), [OTHERS[number % len(OTHERS)] for number in range(options.others)], options.jobs
        )
    for (command, code), times in sorted(counts.items()):
        print(f"{times:6} x exit code {code:4}  tacpipe {command}")
    count("commands that ended as they should", sum(times for (_, code), times in counts.items() if code == 0))
    return int(any(code for _, code in counts))


def count_exit_codes(folder: Path, commands: list[str], jobs: int) -> Counter[tuple[str, int]]:
    """Return how often each command ended with each exit code; what a failed one wrote to stderr is printed."""

    def run(command: str) -> tuple[str, int]:
        process = tacpipe(folder, command)
        if process.returncode:
            print(
                f"tacpipe {command}: exit code {process.returncode}: {process.stderr[-300:]}",
                file=sys.stderr,
                flush=True,
            )
        return command, process.returncode

    counts: Counter[tuple[str, int]] = Counter()
    with ThreadPoolExecutor(jobs) as pool:
        for number, command_and_code in enumerate(pool.map(run, commands), 1):
            counts[command_and_code] += 1
            if number % _EVERY == 0:
                failed = sum(times for (_, code), times in counts.items() if code)
                print(f"{number} of {len(commands)} ended, {failed} with another exit code than 0", file=sys.stderr)
    return counts


if __name__ == "__main__":
    sys.exit(main())
