"""Measure all published sets: `make benchmark DATA=FOLDER`, with ``OPTIONS=--quick`` by a tiny schedule.

The script runs the commands of ``tacpipe`` that `published_sets` declares, in ``.cache/benchmark``. An interrupted run
continues where it ended, because stored results are reused. The table contains, for each method, the results with the full
schedule, else those with the quick one; each cell states its part of the full schedule. A full run writes the table to
``docs/results/published.csv``, a quick one to ``dist/benchmark``. Names of tasks or folders limit the sets.
"""

from __future__ import annotations

import argparse
import csv
import fnmatch
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from published_sets import SEEDS, SETS, Options, PublishedSet, TestedFolds, TrainedMethod

if TYPE_CHECKING:
    from tacpipe.comparison.engine import Comparison, ComparisonRow

ROOT = Path(__file__).parents[1]
WORK = ROOT / ".cache" / "benchmark"
QUICK_SEEDS = SEEDS[:2]
HEADS = (
    "set", "tested on", "question", "method", "measure", "value", "95 % interval", "spread over seeds", "best baseline",
    "compared with it", "printed in the paper",
)  # fmt: skip


@dataclass(frozen=True)
class Benchmark:
    """The commands for one published set in ``data``."""

    published: PublishedSet
    data: Path
    work: Path = WORK

    @property
    def folder(self) -> str:
        """The folder of the set below the working folder."""
        return next(iter(self.published.sources)).replace("/", "-")

    def official_test(self, source: str) -> list[Path]:
        """Return the files or folders of the official test in the folder of a source; empty without them."""
        entries = sorted((self.data / source).iterdir())
        return [path for path in entries if any(fnmatch.fnmatch(path.name, test) for test in self.published.tests)]

    @property
    def has_official_test(self) -> bool:
        """Whether any source has its official test."""
        return any(self.official_test(source) for source in self.published.sources)

    @property
    def all_folds(self) -> tuple[TestedFolds, ...]:
        """The official test where it is present, else the declared folds."""
        if self.has_official_test and not self.published.divided:
            return (TestedFolds("official", "the official test", self.published.official, 1),)
        return self.published.folds

    def tested_on(self, folds: TestedFolds) -> str:
        """Return on what a method is tested, and whether an official test is absent."""
        if not self.published.tests or folds.name == "official":
            return folds.words
        present = "with the official test" if self.has_official_test else "the official test is absent"
        return f"{folds.words}; {present}"

    def prepare(self) -> str:
        """Read and prepare the recordings, and return the path of the dataset that is learned from."""
        data, recordings = f"data/{self.folder}", []
        for source, command in self.published.sources.items():
            for role, folder in self._folders(source).items():
                output = f"{data}/{Path(source).name}{role and '-'}{role}"
                self._run(f"{command} {shlex.quote(str(folder))} -o {output} --replace")
                if role:
                    self._run(f"label {output} * --label authors_role={role}")
                recordings.append(output)
        for command in self.published.prepare:
            self._run(command.format(data=data, recordings=" ".join(recordings)))
        return f"{data}/{self.published.dataset}" if self.published.dataset else " ".join(recordings)

    def _folders(self, source: str) -> Mapping[str, Path]:
        """Return the folders of a source by the authors' role; an official test is kept apart by folders of links."""
        tests = self.official_test(source)
        if not tests or self.published.divided:
            return {"": self.data / source}
        folders = {role: self.work / "sources" / Path(source).name / role for role in ("train", "test")}
        for path in (self.data / source).iterdir():
            link = folders["test" if path in tests else "train"] / path.name
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.is_symlink():
                link.symlink_to(path.resolve())
        return folders

    def measure(self, *, quick: bool) -> None:
        """Train and evaluate every method with every seed, in all folds or in the first one."""
        dataset = self.prepare()
        for folds in self.all_folds:
            split = f"data/{self.folder}/split-{folds.name}"
            self._run(f"split {dataset} -o {split} {folds.split}")
            fold = "0" if quick or folds.count == 1 else f"0-{folds.count - 1}"
            learned = dataset
            if folds.extract:
                data = f"data/{self.folder}"
                chosen = "0" if fold == "0" else "{fold}"
                command = folds.extract.format(recordings=dataset, split=split, fold=fold, data=data)
                self._run(command.replace(f"-{fold}", f"-{chosen}"))
                learned = f"{data}/features-{chosen}"
            for method in self.published.methods:
                for seed in QUICK_SEEDS if quick else SEEDS:
                    place = self.place(folds, method, quick=quick) + f"/{seed}/" + ("0" if fold == "0" else "{fold}")
                    common = f"{learned} --split {split} --fold {fold}"
                    options = words_of(self.options(method, quick=quick))
                    self._run(f"train {self.published.task} {common} --seed {seed} -o models/{place} {options}")
                    self._run(f"evaluate models/{place} {common} -o results/{place}")

    def options(self, method: TrainedMethod, *, quick: bool) -> Options:
        """Return the options of ``tacpipe train``."""
        return {**self.published.train, **method.options, **(method.quick if quick else {})}

    def place(self, folds: TestedFolds, method: TrainedMethod, *, quick: bool) -> str:
        """Return the folder of the models and results of a method."""
        return f"{self.folder}/{folds.name}/{method.name}/{'quick' if quick else 'full'}"

    def _run(self, command: str) -> None:
        """Run a command of tacpipe in the working folder. Raises `SystemExit` if it fails."""
        print(f"tacpipe {command}", flush=True)
        begun = time.monotonic()
        environment = {**os.environ, "TACPIPE_FOLLOW_LINKS": "1"}  # the links of `_folders`
        command = command.replace("benchmarks/layouts", str(ROOT / "benchmarks" / "layouts"))
        program = [sys.executable, "-m", "tacpipe", *shlex.split(command), "--quiet"]
        if command.startswith("label"):
            program.pop()
        done = subprocess.run(program, cwd=self.work, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{done.stdout}{done.stderr}\n`tacpipe {command}` failed; what was computed is reused.")
        print(f"  {time.monotonic() - begun:.0f} s", flush=True)

    def rows(self) -> Iterator[list[str]]:
        """Return the rows of the table, from the results that exist."""
        for folds in self.all_folds:
            for method in self.published.methods:
                for quick in (False, True):
                    paths = sorted((self.work / "results" / self.place(folds, method, quick=quick)).glob("*/*"))
                    if paths:
                        yield from self._method_rows(folds, method, paths, quick=quick)
                        break

    def _method_rows(
        self, folds: TestedFolds, method: TrainedMethod, paths: Sequence[Path], *, quick: bool
    ) -> Iterator[list[str]]:
        import tacpipe
        from tacpipe.comparison import engine

        schedule = schedule_parts(method, folds, paths, quick=quick)
        for comparison in engine.compare([tacpipe.open(path) for path in paths]):
            row = comparison.best
            if row is not None:
                paper = ["paper's network"] if method.paper else []
                notes = ", ".join([*paper, *(part for part in schedule if part not in row.name)])
                name = f"{row.name} ({notes})" if notes else row.name
                cells = result_cells(name, row, comparison, self.published.paper)
                yield [self.published.name, self.tested_on(folds), *cells]


def schedule_parts(method: TrainedMethod, folds: TestedFolds, paths: Iterable[Path], *, quick: bool) -> list[str]:
    """Return how the schedule of results differs from the full one.

    >>> gru = TrainedMethod("gru", {"epochs": 16}, {"epochs": 2, "stride": 8})
    >>> schedule_parts(gru, TestedFolds("folds", "", "", 5), [Path("0/0"), Path("1/0")], quick=True)
    ['2 of 16 epochs', 'stride 8', '1 of 5 folds', '2 of 3 seeds']
    """
    parts = []
    for name, value in method.quick.items() if quick else ():
        full = method.options.get(name)
        parts.append(f"{value} of {full:,} {name}" if isinstance(full, int) else f"{name} {value}")
    counts = (
        ("folds", {path.name for path in paths}, folds.count),
        ("seeds", {path.parent.name for path in paths}, len(SEEDS)),
    )
    return [*parts, *(f"{len(run)} of {count} {name}" for name, run, count in counts if len(run) < count)]


def result_cells(name: str, row: ComparisonRow, comparison: Comparison, paper: str) -> list[str]:
    """Return the cells of a method on one question, from its question to the number in its paper."""
    from tacpipe.scores import words

    measure, baseline = comparison.measure, comparison.best_baseline
    value, low, high, spread = map(words.number, (row.score.mean, row.score.low, row.score.high, row.spread))
    compared = words.NONE
    if baseline is not None:
        noun = {"skill": " error", "area": " area", "points": ""}[measure.name]
        compared = f"{words.format_amount(row.gain.mean, measure.name)}{noun}: {words.CELLS[row.gain.verdict]}"
    interval = words.NONE if low == words.NONE else f"{low} to {high}"
    best = f"{baseline.name}: {words.number(baseline.score.mean)}" if baseline else words.NONE
    return [
        comparison.question.where, name, measure.scored, value, interval, spread, best, compared,
        printed_number(row, comparison, paper),
    ]  # fmt: skip


def printed_number(row: ComparisonRow, comparison: Comparison, paper: str) -> str:
    """Return the number that a paper prints for this method and question, with ours where the column is another one."""
    from tacpipe.report.papers import read_papers
    from tacpipe.scores import words

    for printed in read_papers()[paper].numbers if paper else ():
        question = comparison.question
        matches = question.part.startswith(printed.part) and question.target == printed.target
        if not (printed.column and matches and printed.is_of(row)):
            continue
        text = f"{printed.value:g} {printed.unit} ({printed.source})"
        columns = comparison.measure.columns
        if printed.column in columns and columns.index(printed.column) and printed.column != comparison.measure.scored:
            text += f"; ours {words.number(row.values[columns.index(printed.column)])}"
        return text
    return words.NONE


def words_of(options: Options) -> str:
    """Return options as words of a command.

    >>> words_of({"epochs": 2, "no-joint": True})
    '--epochs 2 --no-joint'
    """
    return " ".join(f"--{name}" if value is True else f"--{name} {value}" for name, value in options.items())


def main(arguments: Sequence[str]) -> None:
    """Measure the sets, and write the table. Raises `SystemExit` if a set is missing or a command fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("sets", nargs="*", help="names of tasks, or of folders in DATA")
    parser.add_argument("--quick", action="store_true", help="one fold, two seeds and a fraction of the epochs")
    parser.add_argument("--table", action="store_true", help="only write the table, from the results that exist")
    given = parser.parse_args(arguments)
    data = given.data.resolve()
    WORK.mkdir(parents=True, exist_ok=True)
    benchmarks = [Benchmark(published, data) for published in SETS]
    for published in SETS:
        if missing := [folder for folder in published.sources if not (data / folder).is_dir()]:
            raise SystemExit(
                f"{data} has no folder {', '.join(missing)}; data/README.md lists where the sets are published."
            )
    for benchmark in benchmarks:
        names = {benchmark.published.task, *benchmark.published.sources}
        if not given.table and (not given.sets or names & set(given.sets)):
            benchmark.measure(quick=given.quick)
    path = ROOT / ("dist/benchmark" if given.quick else "docs/results") / "published.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADS)
        for benchmark in benchmarks:
            writer.writerows(benchmark.rows())
    print(path)


if __name__ == "__main__":
    main(sys.argv[1:])
