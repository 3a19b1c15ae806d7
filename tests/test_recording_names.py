"""A format's stage that takes the name of its recording: it is given, and part of the key, of that stage alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from tacpipe.engine import keys
from tacpipe.plugins.stage import Discovery, RecordingOutput, Source, stage
from tacpipe.store.store import Store
from tests.conftest import Lab, write_plugin

if TYPE_CHECKING:
    from tacpipe.plugins.stage import Files, RecordingName

PLUGIN = '''
"""Read text files, one number a line."""
from __future__ import annotations
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from tacpipe import RecordingOutput, TacpipeError, stage
from tacpipe.plugins.stage import Discovery
if TYPE_CHECKING:
    from tacpipe.plugins.stage import Files, RecordingName

@dataclass(frozen=True)
class Params:
    """None."""

def discover(params: Params, source: Path) -> dict[str, dict[str, Path]]:
    """Find one recording a folder."""
    return {path.parent.name: {"numbers.txt": path} for path in sorted(source.glob("*/numbers.txt"))}

@stage(version=1, source=Discovery(discover))
def read(params: Params, files: Files, called: RecordingName) -> RecordingOutput:
    """Read the numbers of a folder."""
    import pyarrow as pa
    (path,) = files.values()
    text = path.read_text()
    if not text:
        raise TacpipeError(f"{called} has no number.")
    return RecordingOutput({"left": pa.table({"x": [int(one) for one in text.split()]})}, {"called": called})
'''


@dataclass(frozen=True)
class Params:
    """None."""


def discover(params: Params, source: Path) -> Mapping[str, Source]:
    """Find nothing: the stages are never run."""
    return {}


@stage(version=1, source=Discovery(discover))
def nameless(params: Params, files: Files) -> RecordingOutput:
    """Read no name."""
    return RecordingOutput(pa.table({"x": [1]}))


@stage(version=1, source=Discovery(discover))
def read_name(params: Params, files: Files, name: RecordingName) -> RecordingOutput:
    """Read the name."""
    return RecordingOutput(pa.table({"x": [1]}), {"name": name})


def test_the_name_is_part_of_the_key_of_a_stage_that_takes_it_and_of_no_other(tmp_path: Path) -> None:
    sources = {name: Source({"a.txt": tmp_path / "a.txt"}) for name in ("one", "two")}
    digests = {name: {"a.txt": "0"} for name in sources}
    for format_stage, inputs in (
        (nameless, {"files": {"a.txt": "0"}}),
        (read_name, {"files": {"a.txt": "0"}, "name": "one"}),
    ):
        first, second = keys.source_tasks(Store(tmp_path / "s"), "ingest.x", format_stage, Params(), sources, digests)
        assert first.identity["inputs"] == inputs
        assert (first.identity == second.identity) == (format_stage is nameless)


def test_a_format_of_a_plug_in_is_given_the_name_and_a_renamed_recording_is_read_again(lab: Lab) -> None:
    points = "[tacpipe.formats]\nnamed-numbers = named_format:read\n"
    write_plugin(lab.folder, "named", points, named_format=PLUGIN)
    import sys

    from tests.conftest import forget

    sys.path.insert(0, str(lab.folder))
    forget()
    try:
        for name in ("cup", "can"):
            Path("in", name).mkdir(parents=True)
            Path("in", name, "numbers.txt").write_text("1 2 3")
        lab.run("ingest named-numbers in -o data/r --jobs 1")
        attributes = {name: entry["attributes"] for name, entry in lab.manifest("data/r").recordings.items()}
        assert attributes == {"cup": {"called": "cup"}, "can": {"called": "can"}}
        Path("in/cup").rename("in/mug")
        result = lab.run_json("ingest named-numbers in -o data/r --replace --jobs 1")
        assert (result["ran"], result["reused"]) == (1, 1)
        Path("in/mug/numbers.txt").write_text("")
        ran = lab.call("ingest named-numbers in -o data/r --replace --jobs 1")
        assert ran.code == 1 and "mug has no number" in ran.err
    finally:
        sys.path.remove(str(lab.folder))
        sys.modules.pop("named_format", None)
        forget()
