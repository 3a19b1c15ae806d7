"""Faults, each applied to any tool in the same way; their effect is observed, never assumed."""

import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

from tests.promises.trust.lab import RECORDINGS, VICTIM, Cell, edit_bit, truncate, wait_until_finished
from tests.promises.trust.steps import NOISE, PAUSE
from tests.promises.trust.tools import TOOLS, Dvc, Tool, remove_output, up_to

CROWD = 8
SOON_S = 5.0
Fault = Callable[[Tool, Path], Cell]


# ---- damage


def edited_output(tool: Tool, folder: Path) -> Cell:
    """An output is edited in place, its size and time kept; then the next stage runs."""
    if not isinstance(tool, Dvc):
        return _edited_output(tool, folder)
    plain, linked = _edited_output(tool, folder), _edited_output(Dvc("hardlink"), folder.with_name("hardlink"))
    return Cell(f"{plain.outcome}; with cache.type hardlink: {linked.outcome}", bool(plain.good and linked.good))


def _edited_output(tool: Tool, folder: Path) -> Cell:
    lab = tool.lab(folder)
    up_to(tool, lab, "scale")
    place = tool.output_folder(lab, "scale")
    victim = tool.stored(lab, "scale") if place is None else next(place.glob(f"{VICTIM}.*"))
    edit_bit(victim)
    summed = lab.run(tool.words(lab, "total"))
    note = "it has no workspace, so its cached file was edited; " if place is None else ""
    if tool.values(lab, "total") == lab.right("total"):
        made_again = len(lab.computed("scale")) > len(RECORDINGS)
        return Cell(f"{note}the sum is right{', the edited recording was made again' if made_again else ''}", True)
    outcome = (
        f"found (exit code {summed.code}), not repaired"
        if summed.code
        else "the edited numbers are summed, exit code 0"
    )
    return Cell(f"{note}{outcome}", False)


def damage(harm: Callable[[Path], None]) -> Fault:
    """Return the fault of a cached file that is harmed, before the output is brought back and read on."""

    def fault(tool: Tool, folder: Path) -> Cell:
        lab = tool.lab(folder)
        up_to(tool, lab, "scale")
        harm(tool.stored(lab, "scale"))
        remove_output(tool, lab, "scale")
        brought_back = tool.bring_back(lab, "scale")
        served = tool.values(lab, "scale")
        summed = lab.run(tool.words(lab, "total"))
        if served == lab.right("scale") and tool.values(lab, "total") == lab.right("total"):
            recomputed = len(lab.computed("scale")) - len(RECORDINGS)
            outcomes = {0: "the output is right", 1: "found, the recording alone is made again"}
            return Cell(outcomes.get(recomputed, "found, all recordings are made again"), True)
        if brought_back.code:
            return Cell(f"found (exit code {brought_back.code}), not repaired", False)
        after = "the next stage fails on it" if summed.code else "the next stage sums it"
        return Cell(f"brought back as it is, exit code 0; {after}", False)

    return fault


# ---- ends


def killed(tool: Tool, folder: Path) -> Cell:
    """The tool is killed (SIGKILL) with a stage at work; at once it is run again, with another factor."""
    lab = tool.lab(folder)
    up_to(tool, lab, "load")
    process = lab.start_gated(tool.words(lab, "scale"), "scale")
    process.kill()
    process.wait()
    _close(process)
    goes_on = not lab.wait_until_still(SOON_S)
    next_run = lab.run(tool.words(lab, "scale", 3))
    lab.open_gate()
    lab.wait_until_still(SOON_S)
    served = tool.values(lab, "scale", 3)
    third_run = lab.run(tool.words(lab, "scale", 3))
    right, right_again = (values == lab.right("scale", 3) for values in (served, tool.values(lab, "scale", 3)))
    outcomes = [
        "what it started goes on" if goes_on else "what it started ends with it",
        f"the next run ends with {next_run.code}",
        "and is right" if right else "and what the old one writes ends up in its output",
    ]
    if not right:
        outcomes.append(f"the run after that ({third_run.code}) {'mends it' if right_again else 'leaves it so'}")
    return Cell(", ".join(outcomes), next_run.code == third_run.code == 0 and right and right_again)


def interrupted(tool: Tool, folder: Path) -> Cell:
    """Ctrl-C, to all that the terminal runs, with a stage at work."""
    lab = tool.lab(folder)
    up_to(tool, lab, "load")
    process = lab.start_gated(tool.words(lab, "scale"), "scale")
    interrupted_s = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    completed = wait_until_finished(process)
    soon = time.monotonic() - interrupted_s < SOON_S
    all_ended = lab.wait_until_still(SOON_S)
    place = tool.output_folder(lab, "scale")
    partial = place is not None and any(place.glob("rec-*"))
    lab.must(tool.words(lab, "scale"))
    right = tool.values(lab, "scale") == lab.right("scale")
    outcomes = [
        f"exit code {completed.code} {'at once' if soon else 'late'}",
        "a traceback" if "Traceback" in completed.printed else "no traceback",
        "a partial output stays in the workspace" if partial else "no partial output",
        "the rerun is right" if right else "the rerun is wrong",
    ]
    if not all_ended:
        outcomes.append("processes stay")
    return Cell(", ".join(outcomes), completed.code != 0 and soon and all_ended and right and not partial)


# ---- company


def crowd(tool: Tool, folder: Path) -> Cell:
    """Eight runs of the same stage at once."""
    lab = tool.lab(folder)
    up_to(tool, lab, "load")
    words = tool.words(lab, "scale")
    processes = [lab.start(words, **{PAUSE: "0.1"}) for _ in range(CROWD)]
    codes = Counter(wait_until_finished(process).code for process in processes)
    times = Counter(lab.computed("scale")).values()
    right = tool.values(lab, "scale") == lab.right("scale")
    failed = CROWD - codes[0]
    outcomes = [
        f"some fail (exit code {', '.join(str(code) for code in sorted(codes) if code)})" if failed else "all succeed",
        "each recording is computed once" if max(times) == 1 else "recordings are computed several times",
        "the result is right" if right else "the result is wrong",
    ]
    return Cell(", ".join(outcomes), not failed and max(times) == 1 and right)


def collected(tool: Tool, folder: Path) -> Cell:
    """Unneeded results are removed while a stage runs; then the outputs are brought back and read on."""
    lab = tool.lab(folder)
    up_to(tool, lab, "load")
    process = lab.start_gated(tool.words(lab, "scale"), "scale")
    cleaned = lab.run(tool.cleaning())
    lab.open_gate()
    completed = wait_until_finished(process)
    before = len(lab.computed("scale"))
    for step in ("load", "scale"):
        remove_output(tool, lab, step)
        tool.bring_back(lab, step)
    summed = lab.run(tool.words(lab, "total"))
    right = tool.values(lab, "scale") == lab.right("scale") and tool.values(lab, "total") == lab.right("total")
    lost = len(lab.computed("scale")) - before
    # Some tools know what is needed; the others free what they are told to, here all.
    knows = tool.output_folder(lab, "scale") is not None
    outcomes = [
        f"the collection ends with {cleaned.code}, the run with {completed.code}",
        "results of the run were removed and are made again" if lost else "nothing needed is removed",
        "all is right" if right else f"what comes next is wrong (exit code {summed.code})",
    ]
    return Cell(", ".join(outcomes), completed.code == 0 and right and not (lost and knows))


def changed_input(tool: Tool, folder: Path) -> Cell:
    """An input is written anew while a stage works on it, before and after it was read."""
    cells = [_changed_input(tool, folder.with_name(f"{folder.name}-{when}"), when) for when in ("before", "after")]
    if cells[0] == cells[1]:
        return cells[0]
    return Cell(
        "; ".join(f"{when} it was read: {cell.outcome}" for when, cell in zip(("before", "after"), cells, strict=True)),
        all(cell.good for cell in cells),
    )


def _changed_input(tool: Tool, folder: Path, when: str) -> Cell:
    lab = tool.lab(folder)
    process = lab.start_gated(tool.words(lab, "load"), "load", when)
    old = lab.raw[VICTIM]
    lab.write_raw(VICTIM, old + 7)
    lab.open_gate()
    completed = wait_until_finished(process)
    lab.run(tool.words(lab, "load"))
    under_new = tool.values(lab, "load") == lab.right("load")
    lab.write_raw(VICTIM, old)
    lab.run(tool.words(lab, "load"))
    under_old = tool.values(lab, "load") == lab.right("load")
    if under_new and under_old:
        return Cell("the run is refused, the next is right" if completed.code else "each content has its result", True)
    version = "new" if not under_new else "old"
    return Cell(f"a wrong result is kept under the {version} content, exit code {completed.code}", False)


def undetermined(tool: Tool, folder: Path) -> Cell:
    """A stage gives something else each time; the tool is asked. Asked of a stage that gives the same, it must be calm."""
    lab = tool.lab(folder)
    up_to(tool, lab, "scale")
    false_alarm, _ = tool.comparing(lab, "scale")
    lab.environment[NOISE] = "1"
    lab.must(tool.words(lab, "scale", 3))
    tells, answer = tool.comparing(lab, "scale", 3)
    return Cell(f"{answer}{', and so it is of a good stage' if false_alarm else ''}", tells and not false_alarm)


# ---- room


def full(tool: Tool, folder: Path) -> Cell:
    """The disk is full before a stage has written all; later there is room again. Needs a place that can be mounted on."""
    folder.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=48m", "tmpfs", str(folder)], check=True)
    lab = tool.lab(folder / "project", rows=20_000)
    up_to(tool, lab, "load")
    size = sum(values.nbytes for values in lab.raw.values())
    ballast, before = folder / "ballast", lab.files()
    disk = os.statvfs(folder)
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, int(disk.f_bavail * disk.f_frsize - tool.room * size))
    completed = lab.run(tool.words(lab, "scale"))
    drafts = [path for path in lab.files() - before if "tmp" in path.parts or path.suffix in (".tmp", ".draft")]
    ballast.unlink()
    lab.run(tool.words(lab, "scale"))
    right = tool.values(lab, "scale") == lab.right("scale")
    outcomes = [
        f"exit code {completed.code}",
        "a traceback"
        if "Traceback" in completed.printed
        else "a warning"
        if "Warning" in completed.printed
        else "a sentence",
        "drafts stay in its cache" if drafts else "no draft stays",
        "with room again the rerun is right" if right else "with room again the rerun is wrong",
    ]
    delivered = completed.code == 0 and "rec-" in completed.out
    return Cell(", ".join(outcomes), (completed.code != 0 or delivered) and right and not drafts)


FAULTS: Mapping[str, tuple[str, Fault]] = {
    "edited": ("output edited, size and mtime kept; next stage run", edited_output),
    "flipped": ("a bit flipped in the cache; output brought back", damage(edit_bit)),
    "truncated": ("cached file cut in half; output brought back", damage(truncate)),
    "deleted": ("cached file deleted; output brought back", damage(Path.unlink)),
    "killed": ("`kill -9` at work; run again at once with another factor", killed),
    "interrupted": ("Ctrl-C at work", interrupted),
    "crowd": (f"{CROWD} runs of the same stage at once", crowd),
    "full": ("disk full while a stage writes", full),
    "changed": ("input written anew while a stage reads it", changed_input),
    "undetermined": ("a stage that gives something else each time: can the tool tell?", undetermined),
    "collected": ("garbage collected while a stage runs", collected),
}


def _close(process: subprocess.Popen[str]) -> None:
    """Let go of a killed command's pipes, which what it started may hold."""
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()


def met(fault: str, tool: str, folder: Path) -> Cell:
    """Do a fault to a tool in a new folder, and remove that."""
    place = folder / f"{fault}-{tool.split()[0].split('.')[0]}"
    place.mkdir(parents=True)
    try:
        return FAULTS[fault][1](TOOLS[tool], place / "project")
    finally:
        shutil.rmtree(place, ignore_errors=True)
