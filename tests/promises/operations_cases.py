"""Every stage and every command that uses a store, with data so small that a run takes milliseconds."""

import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from tacpipe.io.hashing import bytes_digest


def _leave_as_is(lab: Path) -> None:
    """Leave the lab as it is."""


@dataclass(frozen=True)
class Case:
    """A command to be tried, and what must have happened before it."""

    name: str
    command: str
    before: tuple[str, ...] = ()
    sources: Callable[[Path], None] = _leave_as_is  # writes what the commands before it read
    spoil: Callable[[Path], None] = _leave_as_is  # happens right before it
    outputs: tuple[str, ...] = field(default=())  # Paths that it writes besides the store, by default behind -o.
    durable: bool = False  # Its input cannot be made again, so once it has ended the result outlasts a loss of power.
    sound: bool = True  # Whether the store is sound before the command.

    @property
    def output_paths(self) -> tuple[str, ...]:
        """Return the paths that the command writes besides the store."""
        words = self.command.split()
        return self.outputs or tuple(after for word, after in pairwise(words) if word == "-o")


# ---- a plug-in's stages

NUMBERS = "ingest numbers src -o data/i"
TOY = (
    "simulate toy --trials 2 --rows 4 -o data/r",
    "scale data/r -o data/s",
    "halves data/s -o data/split",
    "centre data/s --split data/split -o data/c",
    "total data/c -o data/t",
)


def _numbers(lab: Path) -> None:
    (lab / "src").mkdir()
    (lab / "src/a.txt").write_text("1 2 3")
    (lab / "src/b.txt").write_text("4 5 6")


def _add_source(lab: Path) -> None:
    _numbers(lab)
    (lab / "more").mkdir()
    (lab / "more/c.txt").write_text("7 8 9")


def _lose(lab: Path) -> None:
    """Remove the directory of an ingested dataset."""
    shutil.rmtree(lab / "data/i")


def _damage(lab: Path) -> None:
    """Damage a shard in the store and beside its manifest, and remove another one from the store."""
    first, second = sorted((lab / "data/s").glob("*.parquet"))
    for path in (first, second):
        stored = lab / ".tacpipe/objects" / bytes_digest(path.read_bytes())[:2] / bytes_digest(path.read_bytes())
        path.unlink()
        stored.chmod(0o644)
        if path == first:
            stored.write_bytes(stored.read_bytes()[:-1] + b"x")
        else:
            stored.unlink()


def _unlink(lab: Path) -> None:
    """Remove a shard beside its manifest and spoil another one."""
    first, second = sorted((lab / "data/s").glob("*.parquet"))
    for path in (first, second):
        path.unlink()
    second.write_bytes(b"something else")


def _leave(lab: Path) -> None:
    """Leave something for gc: an output whose folder is gone, and a draft of long ago."""
    for path in (lab / "data/t").iterdir():
        path.unlink()
    (lab / "data/t").rmdir()
    (lab / ".tacpipe/tmp/0123456789abcdef").write_bytes(b"left")


def _forget(lab: Path) -> None:
    """Remove the project's store and a dataset: what was pushed is all there is."""
    shutil.rmtree(lab / ".tacpipe")
    (lab / ".tacpipe").mkdir()
    shutil.rmtree(lab / "data/s")


def _spool(lab: Path) -> None:
    """Leave the spool of a recording that was killed."""
    from tests.conftest import Lab, Ran
    from tests.recording.test_recovering import spooled

    spooled(Lab(lab, lambda command: Ran(0, "", "")), unread=3, count=20)


LABEL = "label data/i a --exclude dropped"
PUSH = "store push remote data/s data/split"
TOYS = (
    Case("ingest.numbers", NUMBERS, sources=_numbers, durable=True),
    *(Case(name, TOY[n], TOY[:n]) for n, name in enumerate(("simulate.toy", "scale", "halves", "centre", "total"))),
    Case("named", "named data/r -o data/n", TOY[:1]),
    Case("label", "label data/r trial-000 --label material=foam", TOY[:1], outputs=("data/r",), durable=True),
    Case("store status", "store status", TOY[:2]),
    Case("store verify", "store verify", TOY[:2]),
    Case("store repair", "store repair", TOY[:2], spoil=_damage, sound=False),
    Case("store init", "store init"),
    Case("store list", "store list --json", TOY[:2]),
    Case(
        "store checkout",
        "store checkout data/i -o data/i",
        (NUMBERS, LABEL),
        sources=_numbers,
        spoil=_lose,
        durable=True,
    ),
    Case("ingest appends", "ingest numbers more -o data/i", (NUMBERS, LABEL), sources=_add_source, durable=True),
    Case("simulate replaces", "simulate toy -o data/i --replace", (NUMBERS, LABEL), sources=_numbers),
    Case("store gc", "store gc --grace-days 0", TOY, spoil=_leave),
    Case("store link", "store link data/s", TOY[:2], spoil=_unlink, outputs=("data/s",)),
    Case("store push", PUSH, TOY[:3], outputs=("remote",), durable=True),
    Case("store pull", "store pull remote data/s", (*TOY[:3], PUSH), spoil=_forget, outputs=("data/s",)),
    Case("acquire", "acquire --recover --json", spoil=_spool, outputs=("rec",), durable=True),
)

# ---- the stages of this project

FORWARD = (
    "simulate forward --trials 4 --duration-s 4 --robot-rate-hz 200 -o data/r",
    "synchronize data/r -o data/synced",
    "segment contacts data/synced -o data/c",
    "split data/c -o data/split --scheme random --val 0.25 --calibration 0.25 --test 0.25",
    "train forward data/c --split data/split -o models/f --architecture gru --hidden 4 --epochs 2 --batch 64 "
    "--context 3 --horizon 2",
    "evaluate models/f data/c --split data/split -o results/f",
)
MATERIAL = (
    "simulate material --jobs 1 --trials 16 --materials 2 --arm-every 2 -o data/r",
    "segment slides --jobs 1 data/r -o data/s --frames 60",
    "split data/s -o data/split --scheme random --stratify sensor,material --val 0.25 --test 0.25",
    "train material data/s --split data/split -o models/m --architecture raec --hidden 4 --latents 3 --epochs 2",
)
TOUCH = (
    "simulate touch --trials 6 --objects 1 --raw --families box,sphere -o data/r",
    "segment grasps data/r -o data/g",
    "split data/g -o data/split --scheme random --val 0.2 --test 0.2",
    "train touch data/g --split data/split -o models/t --architecture patches --networks 1 --epochs 2 --points 16 "
    "--hidden 8",
)


CHAINS = {
    "forward": FORWARD,
    "material": MATERIAL,
    "touch": TOUCH,
    **{  # A stage that works recording by recording needs no more than two to show all that it does with files.
        f"two {name}": (re.sub(r"--trials \d+", "--trials 2", first), *later_commands)
        for name, (first, *later_commands) in {"forward": FORWARD, "material": MATERIAL, "touch": TOUCH}.items()
    },
}


def _cases_of_chain(chain: str, names: dict[int, str]) -> list[Case]:
    """Return cases of a chain's commands, by their numbers."""
    return [Case(name, CHAINS[chain][number], CHAINS[chain][:number]) for number, name in names.items()]


EVEN = (CHAINS["two forward"][0], "synchronize data/r -o data/even --rate-hz 50")


def _export(names: Sequence[str], dataset: str, chain: tuple[str, ...]) -> list[Case]:
    """Return cases that export a dataset, which the commands of the chain write."""
    return [
        Case(f"export.{name}", f"export {name} {dataset} -o data/out{' --license mit' * (name == 'card')}", chain)
        for name in names
    ]


CONTAINERS = ("hdf5", "lerobot", "mcap", "rosbag", "xdf", "zarr")


def _ingest(name: str) -> Case:
    options = {"table": " --layout src/layout.toml", "zarr": " --layout rate.toml"}.get(name, "")
    command = f"ingest {name} src -o data/r{options}"
    return Case(f"ingest.{name}", command, sources=lambda lab: _publish(name, lab / "src"), durable=True)


def _publish_balls(lab: Path) -> None:
    """Write presses of balls into a gel, and one press of its own."""
    from tests.video import balls

    balls.write_presses(lab / "src", count=4)
    balls.write_presses(lab / "one", count=1)


def _publish(name: str, place: Path) -> None:
    """Write recordings in a published format."""
    from tests.formats import grasp_files, slide_files, video_files, xela_files
    from tests.formats.arrays import files as array_files
    from tests.formats.lerobot import files as lerobot_files
    from tests.promises import targets

    if name == "biotac-slide":
        slide_files.write_biotac(place, arm=False)
    elif name == "roboskin":
        slide_files.write_roboskin(place, slide_files.touched(2))
    elif name == "vision2tactile":
        grasp_files.write_grasp(place)
    elif name == "gelsight-slip":
        video_files.write_gelsight(place)
    elif name == "markers":
        video_files.write_gelsight(place, markers=True)
    elif name == "table":
        place.mkdir()
        for trial in "ab":
            (place / f"{trial}.csv").write_text("time,x\n0,1.5\n0.01,2\n")
        (place / "layout.toml").write_text(
            '[streams.skin]\nfiles = "{trial}.csv"\ntime = { column = "time" }\ncolumns = [{ match = "x" }]\n'
        )
    elif name == "xela-flat":
        xela_files.write_flat(place / "data_sample_2021-11-24-15-19-34")
    elif name == "lerobot":
        lerobot_files.write_v3(place / "three")
    elif name == "zarr":
        array_files.replay(place / "a.zarr")
        (place.parent / "rate.toml").write_text(targets.RATE)
    elif name in CONTAINERS:
        place.mkdir()
        targets.TREES[name](place)
    else:
        xela_files.write_psc(place / "data_sample_2022-02-21-09-58-49")


HELD = (
    "simulate forward --trials 3 --duration-s 5 --seed 7 --effort 1.15 --tactile-rate-hz 12 --robot-rate-hz 50 "
    "-o data/r",
    "label data/r trial-* --label slip=true",
    "split data/r -o data/split --scheme random --val 0.34 --test 0",
)
GELS = (
    "simulate gel --trials 3 --duration-s 4 -o data/g",
    "split data/g -o data/gs --scheme random --val 0 --test 0.34",
    "extract autoencoder data/g --split data/gs -o data/f --streams gel1 --images 40 --components 4 --epochs 2",
    "extract encoder data/g --streams gel1 --weights data/f/encoder.safetensors -o data/e",
)
BALLS = "ingest table src/presses --layout src/layout.toml -o data/presses"
GEL_MAP = "extract gel-map data/presses --background src/background.png --mm-per-px 0.25 -o data/gel"
STAGES = (
    *_cases_of_chain("two forward", {0: "simulate.forward", 1: "synchronize", 2: "segment.contacts"}),
    *_cases_of_chain("forward", {3: "split", 4: "train.forward", 5: "evaluate"}),
    *_cases_of_chain("two material", {0: "simulate.material", 1: "segment.slides"}),
    *_cases_of_chain("material", {3: "train.material"}),
    *_cases_of_chain("two touch", {0: "simulate.touch", 1: "segment.grasps"}),
    *_cases_of_chain("touch", {3: "train.touch"}),
    *(
        Case(name, GELS[n], GELS[:n])
        for n, name in ((0, "simulate.gel"), (2, "extract.autoencoder"), (3, "extract.encoder"))
    ),
    Case(
        "extract.markers",
        "extract markers data/gels -o data/m --rows 2 --columns 3",
        ("ingest gelsight-slip src -o data/gels",),
        sources=lambda lab: _publish("markers", lab / "src"),
    ),
    Case(
        "extract.gel-map",
        GEL_MAP,
        (BALLS,),
        sources=_publish_balls,
    ),
    Case(
        "extract.depth",
        "extract depth data/one --map data/gel --reference-frames 0 -o data/depth",
        (BALLS, GEL_MAP, BALLS.replace("src/presses", "one/presses").replace("data/presses", "data/one")),
        sources=_publish_balls,
    ),
    Case(
        "extract.difference",
        "extract difference data/gels -o data/d",
        ("ingest gelsight-slip src -o data/gels",),
        sources=lambda lab: _publish("gelsight-slip", lab / "src"),
    ),
    Case("segment.slips", "segment slips data/even -o data/slips", EVEN),
    Case("segment.blocks", "segment blocks data/r -o data/blocks --parts 2", HELD[:2]),
    Case("segment.losses", "segment losses data/r -o data/losses --streams xela*", HELD[:2]),
    Case(
        "train.slip",
        "train slip data/r --split data/split --streams xela* -o models/s --architecture boosting --trees 2 --leaf 5 "
        "--no-match-time",
        HELD,
    ),
    Case(
        "train.regress",
        "train regress data/c --split data/split -o models/n --target gt_force_z_n --architecture linear",
        FORWARD[:4],
    ),
    Case(
        "train.classify",
        "train classify data/c --split data/split -o models/n --label contact --architecture linear",
        FORWARD[:4],
    ),
    Case("compress.pca", "compress pca data/c --split data/split -o data/z --components 2", FORWARD[:4]),
    Case(
        "compress.autoencoder",
        "compress autoencoder data/c --split data/split -o data/z --epochs 1 --components 2 --hidden 4",
        (*FORWARD[:3], "split data/c -o data/split --scheme random --val 0.25 --test 0.25"),
    ),
    Case("calibrate", "calibrate models/f data/c --split data/split -o models/g", FORWARD[:5]),
    Case(
        "recentre",
        "recentre models/n data/c -o models/g",
        (
            *FORWARD[:4],
            "train classify data/c --split data/split -o models/n --label contact --architecture linear "
            "--recentre sensor",
        ),
    ),
    Case("predict", "predict models/f data/c --split data/split -o data/p --role test --steps 1,2", FORWARD[:5]),
    Case("report", "report results/f -o report.html", FORWARD),
    *_export(("card", "csv", "hdf5", "mcap"), "data/r", EVEN[:1]),
    *_export(("lerobot", "zarr"), "data/even", EVEN),
    *(
        _ingest(name)
        for name in ("biotac-slide", "gelsight-slip", "roboskin", "table", "vision2tactile", "xela-flat", "xela-psc")
    ),
    *(_ingest(name) for name in CONTAINERS),
)
CASES = {case.name: case for case in (*TOYS, *STAGES)}
# So many of a stage's calls are skipped for each that is tried; 1 tries all of each stage.
PART = int(os.environ.get("TACPIPE_TEST_CALLS", "3"))
assert len(CASES) == len(TOYS) + len(STAGES)
