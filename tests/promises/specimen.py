"""A project with all kinds of content of a store, its sound content, and methods to inspect it later."""

import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

import tacpipe
from tacpipe.datasets.manifest import NAME, Found, Manifest
from tacpipe.datasets.pages import PAGE
from tacpipe.errors import DAMAGED, TacpipeError, UsageError
from tacpipe.io.hashing import bytes_digest
from tacpipe.io.parquet import owned
from tests.any_table import bits
from tests.conftest import Lab, Ran, write_source

CHAIN = (
    "ingest numbers src -o data/recordings --jobs 1",
    "simulate toy --trials 2 --rows 6 -o data/simulated --jobs 1",
    "scale data/recordings -o data/scaled --jobs 1",
    "named data/simulated -o data/named --jobs 1",
    "halves data/scaled -o data/split --jobs 1",
    "centre data/scaled --split data/split -o data/centred --jobs 1",
    "total data/scaled -o data/total --jobs 1",
)
LABEL = "label data/recordings a --set material=foam"  # The label is set by hand: no rerun would compute it.
Contents = dict[str, Any]  # path within a dataset to bits of a table, or to bytes of a file


def make(lab: Lab) -> None:
    """Run the chain in an empty project."""
    texts = {name: " ".join(str(value + 5 * number) for value in range(10)) for number, name in enumerate("abc")}
    write_source(lab.folder / "src", **texts)
    lab.run(CHAIN[0])
    lab.run(LABEL)
    for command in CHAIN[1:]:
        lab.run(command)


@dataclass
class Specimen:
    """A copy of the project, which is to be harmed, beside what it held before."""

    lab: Lab
    sound: Mapping[str, bytes]  # every file beneath data/
    manifests: Mapping[str, Manifest]

    @property
    def folder(self) -> Path:
        """The project."""
        return self.lab.folder

    @property
    def store(self) -> Path:
        """The folder of its store."""
        return self.lab.folder / ".tacpipe"

    def object(self, dataset: str, path: str) -> Path:
        """Return the object that a dataset names at a path; its own manifest's if the path is empty."""
        names_by_path = dict(self.manifests[dataset].objects())
        name = names_by_path[path] if path else bytes_digest(self.sound[f"{dataset}/{NAME}"])
        return self.store / "objects" / name[:2] / name

    def needed(self) -> set[str]:
        """Return the digests of all that the datasets are made of, their manifests included."""
        names = {name for manifest in self.manifests.values() for _, name in manifest.objects()}
        return names | {bytes_digest(manifest.content) for manifest in self.manifests.values()}

    def records(self, stage: str, identity_key: str = "stage") -> list[Path]:
        """Return the records of what a stage made (of its runs: ``of="run"``), by name."""
        paths = [
            self.store / "records" / key[:2] / f"{key}.json"
            for key, record in self.lab.store.records()
            if record["identity"].get(identity_key) == stage
        ]
        assert paths, stage
        return paths

    def expected(self, dataset: str) -> Contents:
        """Return what a dataset held."""
        paths = [path for path, _ in self.manifests[dataset].objects() if not path.startswith(PAGE)]
        return {path: parse_content(self.sound[f"{dataset}/{path}"], path) for path in paths}

    def rerun(self) -> list[Ran]:
        """Run the chain again, whatever its commands say."""
        return [self.lab.call(command) for command in CHAIN]

    def data_files(self) -> dict[str, bytes]:
        """Return every file beneath data/ as it is now."""
        return files(self.folder / "data")

    def served(self) -> dict[str, bool]:
        """Return of each dataset whether it was read right; otherwise it was refused with the documented code.

        Anything else, above all anything that was not put in, fails.
        """
        return {dataset: self._served(dataset) for dataset in self.manifests}

    def _served(self, dataset: str) -> bool:
        try:
            content = read_content(self.folder / "data" / dataset)
        except TacpipeError as error:
            sentence = str(error)
            usage = isinstance(error, UsageError) and ("no manifest.json" in sentence or "manifest format" in sentence)
            assert error.exit_code == DAMAGED or usage
            assert sentence.endswith(".") and "\n" not in sentence, sentence
            return False
        assert content == self.expected(dataset), f"{dataset} holds what nobody put there"
        return True


def read_content(path: Path) -> Contents:
    """Return all that a dataset gives to whoever opens it."""
    dataset = tacpipe.open(path)
    contents: Contents = {}
    for name, shard in dataset.recordings.items():
        for stream in shard.streams:
            contents[f"{name}/{stream}.parquet" if stream else f"{name}.parquet"] = bits(shard.table(stream))
    return {**contents, **dict(dataset.files)}


def parse_content(content: bytes, path: str) -> Any:
    """Return what a file of a dataset says, read by other means."""
    return bits(pq.read_table(pa.BufferReader(owned(content)))) if path.endswith(".parquet") else content


def copy(original: Path, lab: Lab) -> Specimen:
    """Return a copy of a project that was made, its hard links kept, in place of what is in the folder of ``lab``."""
    for path in lab.folder.iterdir():
        shutil.rmtree(path)
    clone(original, lab.folder)
    sound = files(original / "data")
    manifests = {
        name.parent.name: Found(original / "data" / name.parent, sound[str(name)]).manifest
        for name in map(Path, sound)
        if name.name == NAME
    }
    return Specimen(lab, sound, manifests)


def clone(original: Path, folder: Path) -> None:
    """Copy a project with times, modes and hard links."""
    subprocess.run(["cp", "-a", f"{original}/.", str(folder)], check=True)


def files(folder: Path) -> dict[str, bytes]:
    """Return the content of every file beneath a folder by its path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in beneath(folder)}


def beneath(folder: Path) -> Iterator[Path]:
    """Yield every file beneath a folder, sorted."""
    for place, folders, names in os.walk(folder):
        folders.sort()
        yield from (Path(place) / name for name in sorted(names))


def age(folder: Path, days: float = 30.0) -> None:
    """Make every file beneath a folder look old."""
    then_s = time.time() - days * 86400
    for path in beneath(folder):
        os.utime(path, (then_s, then_s))
