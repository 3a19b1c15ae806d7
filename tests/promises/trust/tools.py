"""The three tools, each set up as its documentation recommends, with the same few operations."""

import json
import shutil
import sys
from pathlib import Path
from typing import Protocol

import joblib
import yaml

from tests.promises.trust.lab import RECORDINGS, VICTIM, Done, Lab, parse_mapping, python
from tests.promises.trust.steps import STEPS

JOBLIB_CACHE = Path("cache/joblib/tests/promises/trust/steps")  # joblib names folders after the module
ENTRY_POINTS = """
[tacpipe.stages]
scale = tests.promises.trust.stages:scale
total = tests.promises.trust.stages:total
[tacpipe.formats]
numbers = tests.promises.trust.stages:load
"""


class Tool(Protocol):
    """A way to run the chain."""

    name: str
    room: float  # disk to leave before a full disk strikes, as a share of what a step writes once

    def lab(self, folder: Path, rows: int = 300) -> Lab:
        """Return a new lab that is set up for the tool."""

    def words(self, lab: Lab, step: str, factor: int = 2) -> list[str]:
        """Return the command that makes a step anew, or all that is not up to date up to it."""

    def values(self, lab: Lab, step: str, factor: int = 2) -> dict[str, object]:
        """Return what the tool serves of a step to whoever asks; nothing if it fails."""

    def stored(self, lab: Lab, step: str) -> Path:
        """Return the cached file of the victim's output."""

    def output_folder(self, lab: Lab, step: str) -> Path | None:
        """Return where the output of a step lies in the workspace, if the tool has one."""

    def bring_back(self, lab: Lab, step: str) -> Done:
        """Bring back the output of a step that was removed from the workspace, as the tool's manual says."""

    def cleaning(self) -> list[str]:
        """Return the command that frees what is not needed."""

    def comparing(self, lab: Lab, step: str, factor: int = 2) -> tuple[bool, str]:
        """Ask whether a step gives the same again: whether the tool tells, and how."""


def up_to(tool: Tool, lab: Lab, step: str, factor: int = 2) -> None:
    """Run the chain up to a step."""
    for chain_step in STEPS[: STEPS.index(step) + 1]:
        lab.must(tool.words(lab, chain_step, factor))


class Tacpipe:
    """tacpipe, with its store in the project."""

    name, room = "tacpipe", 0.3

    def lab(self, folder: Path, rows: int = 300) -> Lab:
        plugin = folder.with_name(f"{folder.name}-plugin")
        (plugin / "trust.egg-info").mkdir(parents=True)
        (plugin / "trust.egg-info" / "entry_points.txt").write_text(ENTRY_POINTS)
        lab = Lab(folder, {"PYTHONPATH": str(plugin)}, rows)
        (folder / ".tacpipe").mkdir()
        return lab

    def words(self, lab: Lab, step: str, factor: int = 2) -> list[str]:
        common = ["-o", f"data/{step}", "--jobs", "2"]
        if step == "load":
            return ["tacpipe", "ingest", "numbers", "raw", "--replace", *common]  # else a file written anew is refused
        if step == "scale":
            return ["tacpipe", "scale", "data/load", "--factor", str(factor), *common]
        return ["tacpipe", "total", "data/scale", *common]

    def values(self, lab: Lab, step: str, factor: int = 2) -> dict[str, object]:
        if step == "total":
            path = lab.folder / "data" / "total" / "total.json"
            return parse_mapping(path.read_text()) if path.exists() else {}
        return parse_mapping(lab.run(python("stages", f"data/{step}")).out)

    def stored(self, lab: Lab, step: str) -> Path:
        manifest = json.loads((lab.folder / "data" / step / "manifest.json").read_text())
        digest: str = manifest["recordings"][VICTIM]["shards"][""]["digest"]
        return lab.folder / ".tacpipe" / "objects" / digest[:2] / digest

    def output_folder(self, lab: Lab, step: str) -> Path | None:
        return lab.folder / "data" / step

    def bring_back(self, lab: Lab, step: str) -> Done:
        return lab.run(self.words(lab, step))

    def cleaning(self) -> list[str]:
        return ["tacpipe", "store", "gc"]

    def comparing(self, lab: Lab, step: str, factor: int = 2) -> tuple[bool, str]:
        compared = lab.run([*self.words(lab, step, factor), "--recompute-and-compare"])
        named_count = sum(name in compared.printed for name in RECORDINGS)
        return (
            compared.code == 1 and named_count > 0,
            f"--recompute-and-compare ends with {compared.code} and names {named_count} recordings",
        )


class Dvc:
    """DVC, with its cache in the project."""

    name, room = "dvc repro", 1.5  # a stage of DVC writes its output itself, before DVC copies it

    def __init__(self, cache_type: str = "") -> None:
        self.cache_type = cache_type

    def lab(self, folder: Path, rows: int = 300) -> Lab:
        places = {f"DVC_{kind}_DIR": str(folder.with_name(f"{folder.name}-dvc") / kind) for kind in _DVC_PLACES}
        lab = Lab(folder, {**places, "DVC_NO_ANALYTICS": "1"}, rows)
        lab.must(["dvc", "init", "--quiet", "--no-scm"])
        lab.must(["dvc", "config", "core.check_update", "false"])
        if self.cache_type:
            lab.must(["dvc", "config", "cache.type", self.cache_type])
        script = " ".join(python("steps", "dvc"))
        stages = {
            "load": {"cmd": f"{script} load", "deps": ["raw"], "outs": ["load"]},
            "scale": {"cmd": f"{script} scale ${{factor}}", "deps": ["load"], "params": ["factor"], "outs": ["scale"]},
            "total": {"cmd": f"{script} total", "deps": ["scale"], "outs": ["total.json"]},
        }
        (folder / "dvc.yaml").write_text(yaml.safe_dump({"stages": stages}))
        return lab

    def words(self, lab: Lab, step: str, factor: int = 2) -> list[str]:
        params = lab.folder / "params.yaml"
        text = f"factor: {factor}\n"
        if not params.exists() or params.read_text() != text:
            params.write_text(text)
        return ["dvc", "repro", step]

    def values(self, lab: Lab, step: str, factor: int = 2) -> dict[str, object]:
        if step == "total":
            path = lab.folder / "total.json"
            return parse_mapping(path.read_text()) if path.exists() else {}
        read = "import json, numpy, pathlib, sys; print(json.dumps({path.stem: numpy.load(path).tolist() "
        read += "for path in pathlib.Path(sys.argv[1]).glob('*.npy')}))"
        return parse_mapping(lab.run([sys.executable, "-c", read, step]).out)

    def stored(self, lab: Lab, step: str) -> Path:
        lock = yaml.safe_load((lab.folder / "dvc.lock").read_text())
        cache = lab.folder / ".dvc" / "cache" / "files" / "md5"
        folder = lock["stages"][step]["outs"][0]["md5"]
        listed = json.loads((cache / folder[:2] / folder[2:]).read_text())
        md5: str = next(entry["md5"] for entry in listed if entry["relpath"] == f"{VICTIM}.npy")
        return cache / md5[:2] / md5[2:]

    def output_folder(self, lab: Lab, step: str) -> Path | None:
        return lab.folder / step

    def bring_back(self, lab: Lab, step: str) -> Done:
        checked_out = lab.run(["dvc", "checkout", step])
        return lab.run(self.words(lab, step)) if checked_out.code else checked_out

    def cleaning(self) -> list[str]:
        return ["dvc", "gc", "--workspace", "--force"]

    def comparing(self, lab: Lab, step: str, factor: int = 2) -> tuple[bool, str]:
        before = (lab.folder / "dvc.lock").read_text()
        repeated = lab.run(["dvc", "repro", "--force", "--single-item", step])
        changed = (lab.folder / "dvc.lock").read_text() != before
        effect = "has replaced the result" if changed else "has changed nothing"
        return (
            repeated.code != 0,
            f"repro --force ends with {repeated.code} and {effect}; only a diff of dvc.lock tells",
        )


_DVC_PLACES = ("GLOBAL_CONFIG", "SYSTEM_CONFIG", "SITE_CACHE")


class Joblib:
    """joblib.Memory, its functions called by two workers."""

    name, room = "joblib.Memory", 0.5

    def lab(self, folder: Path, rows: int = 300) -> Lab:
        return Lab(folder, {}, rows)

    def words(self, lab: Lab, step: str, factor: int = 2) -> list[str]:
        return python("steps", "joblib", step, str(factor))

    def values(self, lab: Lab, step: str, factor: int = 2) -> dict[str, object]:
        return parse_mapping(lab.run(self.words(lab, step, factor)).out)

    def stored(self, lab: Lab, step: str) -> Path:
        right = lab.right(step)[VICTIM]
        for path in (lab.folder / JOBLIB_CACHE / f"{step}_one").glob("*/output.pkl"):
            if joblib.load(path).tolist() == right:
                return path
        raise RuntimeError(f"joblib has no output of {step}.")

    def output_folder(self, lab: Lab, step: str) -> Path | None:
        return None

    def bring_back(self, lab: Lab, step: str) -> Done:
        return lab.run(self.words(lab, step))

    def cleaning(self) -> list[str]:
        return python("steps", "clean")

    def comparing(self, lab: Lab, step: str, factor: int = 2) -> tuple[bool, str]:
        return False, "it has no way to compare; a hit is served as it is"


def remove_output(tool: Tool, lab: Lab, step: str) -> None:
    """Remove the output of a step from the workspace."""
    place = tool.output_folder(lab, step)
    if place is not None:
        shutil.rmtree(place)


TOOLS: dict[str, Tool] = {tool.name: tool for tool in (Tacpipe(), Dvc(), Joblib())}
