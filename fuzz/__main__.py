"""Let atheris look for bytes that a reader or decoder stumbles over; each target in a process of its own.

python -m fuzz [--seconds 60] [TARGET...], a target being one of tests/promises/targets.py or a part of its name. What it
finds lies in .cache/fuzz/TARGET, with the inputs that reach new code, from which the next run goes on.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

PLACE = Path(__file__).parents[1] / ".cache" / "fuzz"
MEMORY_MB, TRY_S, LONGEST = 3000, 60, 1 << 16  # Limits of one input: memory, time, bytes.
DONE = re.compile(r"Done (\d+) runs|stat::number_of_executed_units:\s+(\d+)")


def fuzz(name: str, seconds: int) -> tuple[int, str]:
    """Return how many inputs a target was tried on, and what it stumbled over; empty: nothing."""
    from tests.promises.targets import targets

    corpus, artifacts = PLACE / name / "corpus", PLACE / name
    corpus.mkdir(parents=True, exist_ok=True)
    for number, example in enumerate(targets()[name].examples()):
        (corpus / f"example-{number}").write_bytes(example)
    limits = [f"-rss_limit_mb={MEMORY_MB}", f"-timeout={TRY_S}", f"-max_len={LONGEST}", f"-max_total_time={seconds}"]
    command = [sys.executable, "-m", "fuzz", "--within", name, str(corpus), *limits, f"-artifact_prefix={artifacts}/"]
    process = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    counts = [int(libfuzzer_count or atheris_count) for libfuzzer_count, atheris_count in DONE.findall(process.stderr)]
    failed = "" if process.returncode == 0 else f"{process.stdout[-2000:]}\n{process.stderr[-1000:]}"
    return max(counts, default=0), failed


def fuzz_in_process(name: str, arguments: list[str]) -> None:
    """Try a target on inputs until the time is over, in this process, which libFuzzer then ends."""
    import atheris

    with atheris.instrument_imports(include=["tacpipe"]):
        from tacpipe.errors import TacpipeError
        from tests.promises.limits import is_sentence
        from tests.promises.targets import targets

        target = targets()[name]
        for example in target.examples():  # The examples import what is imported late.
            target.run(example)

    def attempt(data: bytes) -> None:
        try:
            target.run(data)
        except TacpipeError as error:
            assert is_sentence(str(error)), f"no sentence: {str(error)!r:.500}"

    atheris.Setup([name, *arguments], attempt)
    atheris.Fuzz()


def main() -> int:
    """Fuzz the targets that were named, or all; return 1 where one stumbled."""
    if sys.argv[1:2] == ["--within"]:
        fuzz_in_process(sys.argv[2], sys.argv[3:])
    from tests.promises.targets import targets

    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("targets", nargs="*")
    options = parser.parse_args()
    failures = 0
    for name in targets():
        if options.targets and not any(part in name for part in options.targets):
            continue
        count, failed = fuzz(name, options.seconds)
        print(f"{name}: {count} inputs{', and it stumbled' if failed else ''}", flush=True)
        if failed:
            failures += 1
            print(failed, file=sys.stderr)
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
