"""Count the trials and their outcomes in tests of any process, and sum them up for a page.

python -m tests.promises.counts COUNTS [--write docs/benchmarks/faults.md]
"""

import argparse
import json
import os
from collections import Counter
from pathlib import Path

PLACE = "TACPIPE_COUNTS"  # names the file that counts go to; without it they are not kept
BEGIN, END = "<!-- counts -->", "<!-- end of counts -->"


def count(event: str, number: int = 1) -> None:
    """Note that ``number`` more of an event happened, as in ``count("kills survived")``."""
    place = os.environ.get(PLACE)
    if place and number:
        with open(place, "a") as file:  # a line is appended whole, whichever process writes
            file.write(json.dumps([event, number]) + "\n")


def total(place: Path) -> dict[str, int]:
    """Return all counts of a file, by name."""
    sums: Counter[str] = Counter()
    for line in place.read_text().splitlines():
        event, number = json.loads(line)
        sums[event] += number
    return dict(sorted(sums.items()))


def table(sums: dict[str, int]) -> str:
    """Return the counts as a Markdown table."""
    return "\n".join(["| what | how many |", "| --- | ---: |", *(f"| {name} | {sums[name]:,} |" for name in sums)])


def main() -> None:
    """Print the table of a file of counts; with ``--write`` put it into a page, between its marks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("counts", type=Path)
    parser.add_argument("--write", type=Path, default=None)
    options = parser.parse_args()
    text = table(total(options.counts))
    print(text)
    if options.write is not None:
        before, _, after_begin = options.write.read_text().partition(BEGIN)
        _, _, after = after_begin.partition(END)
        options.write.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}")


if __name__ == "__main__":
    main()
