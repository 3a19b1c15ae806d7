"""A dataset from an untrusted source: whatever its manifest names, nothing outside of it is read, changed or removed."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tacpipe.datasets.manifest import parse
from tacpipe.errors import TacpipeError
from tacpipe.io.hashing import bytes_digest, digest
from tests.conftest import Lab
from tests.promises.counts import count
from tests.promises.limits import GIB, bound_memory, is_sentence

Tree = dict[str, Any]
SHARD = {"digest": bytes_digest(b"precious\n"), "rows": 3, "bytes": 9}
NAMES = {
    "the folder above": "../victim",
    "a file above": "../victim/x",
    "two above": "../../victim",
    "an absolute path": "/tmp/victim-of-tacpipe/x",
    "above within": "a/../../victim/x",
    "only dots": "..",
    "a dot": ".",
    "nothing": "",
    "NUL": "a\0b",
    "a line's end": "a\nb",
    "a terminal's command": "a\x1b[2J",
    "a backslash": "..\\victim",
    "five thousand letters": "a" * 5000,
    "half a character": "a\ud800",
    "a hidden folder": ".git/hooks/x",
    "the manifest": "manifest.json",
    "slashes": "a//b",
    "a command": "$(touch opened)/../../x",
}


def manifest_tree(**changed: Any) -> Tree:
    """A manifest with a recording and a file, its digest right whatever is in it."""
    tree: Tree = {
        "format": 1,
        "stage": "scale",
        "version": 1,
        "params": {},
        "inputs": {},
        "chain": [],
        "recordings": {"r": {"attributes": {}, "shards": {"a": dict(SHARD), "b": dict(SHARD)}}},
        "files": {"f.json": {key: SHARD[key] for key in ("digest", "bytes")}},
        "skipped": {},
        "sources": {},
        "labels": {},
        **changed,
    }
    return sign(tree)


def sign(tree: Tree) -> Tree:
    """Return a manifest whose digest is that of what it names, as far as one can be made."""
    try:
        recordings = {
            name: {
                "attributes": entry["attributes"],
                "shards": {key: shard["digest"] for key, shard in entry["shards"].items()},
            }
            for name, entry in tree["recordings"].items()
        }
        tree["digest"] = digest(
            {"recordings": recordings, "files": {name: file["digest"] for name, file in tree["files"].items()}}
        )
    except (TacpipeError, KeyError, TypeError, AttributeError):
        tree["digest"] = "0" * 64
    return tree


def with_recording(name: str, stream: str = "a", shard: Any = None) -> Tree:
    return manifest_tree(recordings={name: {"attributes": {}, "shards": {stream: SHARD if shard is None else shard}}})


def content(tree: Any) -> bytes:
    return json.dumps(tree).encode()


DIGESTS: tuple[Any, ...] = ("../../victim", "", "A" * 64, "0" * 63, "../" * 21 + "a", 5, None, [], "0" * 64 + "\n")
NUMBERS: tuple[Any, ...] = (-1, 1.5, "3", None, True, [], -(10**30), float("nan"))
HOSTILE: dict[str, bytes] = {
    **{
        f"a recording: {reason}": content(with_recording(name))
        for reason, name in NAMES.items()
        if name != "manifest.json"
    },
    **{
        f"a stream: {reason}": content(with_recording("r", name))
        for reason, name in NAMES.items()
        if name not in ("", "manifest.json")
    },
    **{f"a file: {reason}": content(manifest_tree(files={name: SHARD})) for reason, name in NAMES.items()},
    **{f"a digest: {name!r:.20}": content(with_recording("r", "a", {**SHARD, "digest": name})) for name in DIGESTS},
    **{
        f"{key} {number!r:.20}": content(with_recording("r", "a", {**SHARD, key: number}))
        for key in ("rows", "bytes")
        for number in NUMBERS
    },
    "brackets": b"[" * 10_000,
    "brackets within": content(manifest_tree()).replace(b'"params": {}', b'"params": ' + b"[" * 10_000 + b"]" * 10_000),
    "a format to come": content(manifest_tree(format=99)),
    "a format that is a text": content(manifest_tree(format="x" * 100_000)),
    "two paths that are one": content(manifest_tree(files={"r/a.parquet": SHARD})),
    "no digest": content({key: value for key, value in manifest_tree().items() if key != "digest"}),
    "a digest that is a list": content({**manifest_tree(), "digest": [1]}),
    "an unknown key": content({**manifest_tree(), "x" * 100_000: 1}),
    "nothing": b"",
    "a number": b"5",
    "no text": b"\xff\xfe{}",
    "NUL": b"\0" * 100,
}
WRONG: tuple[Any, ...] = (None, 5, "x", [], [1], {"x": 1}, {"x": []}, True, 1.5)


def test_the_manifest_that_these_are_made_of_is_one() -> None:
    assert parse(content(manifest_tree()), "given").rows == 6


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_manifest_is_refused_with_a_sentence(case: str) -> None:
    with bound_memory(GIB), pytest.raises(TacpipeError) as error:
        parse(HOSTILE[case], "given")
    assert is_sentence(str(error.value)), repr(str(error.value))
    count("hostile inputs refused")


@pytest.mark.parametrize("key", [key for key in manifest_tree() if key != "digest"])
def test_another_type_in_a_manifest_gives_a_sentence_or_a_manifest(key: str) -> None:
    for value in WRONG:
        try:
            parsed = parse(content(manifest_tree(**{key: value})), "given")
            assert isinstance(parsed.rows, int) and list(parsed.objects()) is not None and parsed.content
        except TacpipeError as error:
            assert is_sentence(str(error)), str(error)
    count("hostile inputs refused", len(WRONG))


def test_of_two_keys_that_are_the_same_nothing_is_taken_unseen() -> None:
    text = json.dumps(with_recording("../victim"))
    doubled = text.replace('"recordings": ', '"recordings": {}, "recordings": ')
    with pytest.raises(TacpipeError):
        parse(doubled.encode(), "given")


@pytest.mark.faults
def test_very_many_recordings_are_read_or_refused_within_bounds() -> None:
    entry = {"attributes": {}, "shards": {"": SHARD}}
    with bound_memory(6 * GIB):
        parsed = parse(content(manifest_tree(recordings={f"r{number}": entry for number in range(200_000)})), "given")
        assert parsed.rows == 600_000


# ---- as commands


class Place:
    """A project with an untrusted dataset in it, and a victim outside of both."""

    def __init__(self, lab: Lab) -> None:
        self.lab, self.victim = lab, lab.folder / "victim"
        self.project = lab.folder
        self.victim.mkdir()
        for name in ("x", "x.parquet", "a.parquet", "f.json", "manifest"):
            (self.victim / name).write_text("precious\n")
        self.dataset = lab.folder / "given"
        self.dataset.mkdir()

    def outside(self) -> dict[str, tuple[bytes, int]]:
        """Return all that is no store and not the dataset."""
        files = [path for path in self.project.rglob("*") if path.is_file() and not path.is_symlink()]
        outside_dataset = [
            path for path in files if not {".tacpipe", "given"} & set(path.relative_to(self.project).parts)
        ]
        return {str(path): (path.read_bytes(), path.stat().st_mtime_ns) for path in outside_dataset}


@pytest.fixture
def place(lab: Lab) -> Place:
    lab.run("simulate toy -o made")
    return Place(lab)


COMMANDS = (
    "show given",
    "show given --full",
    "explain given",
    "scale given -o given2",
    "scale made -o given",
    "store link given",
    "label given r --set material=cork",
    "store push remote given",
    "store pull remote given",
    "store status",
    "store gc",
)
QUICK = (
    "a recording: the folder above",
    "a file: an absolute path",
    "a stream: above within",
    "a digest: '../../victim'",
)


def kept_out(place: Place, content: bytes) -> None:
    """Run all commands on a directory with this manifest: they say a sentence, and the victim stays as it was."""
    (place.lab.folder / "remote").mkdir(exist_ok=True)
    before = place.outside()
    for command in COMMANDS:
        (place.dataset / "manifest.json").write_bytes(content)
        with bound_memory(4 * GIB):
            ran = place.lab.call(command)
        assert "Traceback" not in ran.err
        assert ran.code in (0, 1, 2, 4), f"{command}: {ran.err}"
        after = {path: state for path, state in place.outside().items() if path in before or "victim" in path}
        assert after == before, command
        assert not Path("/tmp/victim-of-tacpipe").exists() and not (place.project / "opened").exists()
    count("hostile inputs refused", len(COMMANDS))


@pytest.mark.parametrize("case", QUICK)
def test_no_command_follows_a_hostile_manifest_out_of_its_directory(place: Place, case: str) -> None:
    kept_out(place, HOSTILE[case])


@pytest.mark.faults
@pytest.mark.parametrize("case", [case for case in HOSTILE if case not in QUICK])
def test_no_command_follows_any_hostile_manifest_out_of_its_directory(place: Place, case: str) -> None:
    kept_out(place, HOSTILE[case])


LINKS: dict[str, Callable[[Place], None]] = {
    "the folder of a recording": lambda place: (place.dataset / "r").symlink_to(place.victim),
    "a shard": lambda place: _shard(place, "x"),
    "a shard that is not there": lambda place: _shard(place, "new"),
    "the manifest": lambda place: (place.dataset / "manifest.json").symlink_to(place.victim / "manifest"),
    "a draft": lambda place: (place.dataset / ".manifest.json.draft").symlink_to(place.victim / "new"),
}


def _shard(place: Place, name: str) -> None:
    (place.dataset / "r").mkdir()
    (place.dataset / "r" / "a.parquet").symlink_to(place.victim / name)


@pytest.mark.parametrize("case", LINKS)
@pytest.mark.parametrize("command", ["scale made -o given", "store link given", "show given"])
def test_nothing_is_written_or_removed_through_a_link_out_of_the_dataset(place: Place, case: str, command: str) -> None:
    (place.dataset / "manifest.json").write_bytes(content(manifest_tree()))
    if case == "the manifest":
        (place.dataset / "manifest.json").unlink()
    LINKS[case](place)
    before = place.outside()
    ran = place.lab.call(command)
    assert "Traceback" not in ran.err
    assert {path: state for path, state in place.outside().items() if path in before or "victim" in path} == before
    count("hostile inputs refused")


def test_a_remote_store_cannot_name_a_file_that_lies_elsewhere(place: Place) -> None:
    place.lab.run("store push remote made")
    before = place.outside()
    for path in (place.project / "remote").rglob("*"):
        if path.is_file() and path.read_bytes()[:1] == b"{":
            path.chmod(0o644)
            path.write_bytes(HOSTILE["a recording: the folder above"])
    ran = place.lab.call("store pull remote made --ancestors")
    assert "Traceback" not in ran.err
    after = {path: state for path, state in place.outside().items() if "/remote/" not in path}
    assert after == {path: state for path, state in before.items() if "/remote/" not in path}
    count("hostile inputs refused")
