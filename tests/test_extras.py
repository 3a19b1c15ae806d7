"""Commands without tacpipe's extras work or end in one sentence with the extra and how to install it."""

import json
import os
import re
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from importlib.metadata import Distribution
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.cli import commands
from tacpipe.errors import MissingModuleError
from tacpipe.plugins import extras, registry
from tacpipe.video.gel_map import GelMap
from tests import without_extras
from tests.clouds import shapes
from tests.commands import run as run_all
from tests.conftest import Lab, forget, run_python, write_plugin
from tests.formats import grasp_files, slide_files, video_files, xdf_writer, xela_files
from tests.formats.arrays import files as array_files
from tests.formats.lerobot import files as lerobot_files
from tests.promises.warm import Warm, serving
from tests.recording.live import stream

BUILT_IN = {name for name, target in registry.stages().items() if target.startswith(("tacpipe.", "tacpipe_stages."))}
GROUPS = {
    "sensors": ("list", "probe", "emulate"),
    "store": ("status", "verify", "repair", "gc", "link", "push", "pull"),
}
WORK = (  # a command for each that needs no extra; {o} is a new place
    "simulate forward --trials 9 --duration-s 4 -o {o}",
    "simulate material --trials 2 -o {o}",
    "simulate touch --trials 1 -o {o}",
    "ingest xela-flat flat -o {o}",
    "ingest xela-psc psc -o {o}",
    "ingest biotac-slide biotac -o {o}",
    "ingest roboskin roboskin -o {o}",
    "ingest vision2tactile grasps -o {o}",
    "ingest table tables --layout tables/layout.toml -o {o}",
    "ingest table tables --guess",
    "ingest lerobot sets -o {o}",
    "check data/recordings",
    "export csv data/recordings -o {o}",
    "export card data/recordings -o {o}",
    "export lerobot data/recordings --rate-hz 20 -o {o}",
    "ingest xdf sessions -o {o}",
    "version",
    "synchronize data/recordings -o {o} --rate-hz 20",
    "segment contacts data/synced -o {o} --pad-s 0.4",
    "segment slips data/even -o {o}",
    "segment losses data/dropped-even -o {o}",
    "segment slides data/touched -o {o}",
    "segment grasps data/pinched -o {o}",
    "segment blocks data/synced -o {o} --parts 2",
    "split data/segments -o {o} --scheme random",
    "label data/recordings trial-000 --set object=cup",
    "show data/synced",
    "show models/forward",
    "compare results/forward",
    "explain report.html",
    "acquire --recover",
    "sensors list",
    "store status",
    "store verify",
    "store repair",
    "store gc --dry-run",
    "store link data/recordings",
    "store push {o} data/split",
    "store pull elsewhere data/split",
)
LACK = {  # Commands that need an extra, with that extra.
    "compress pca data/segments --split data/split -o {o}": "learn",
    "compress autoencoder data/segments --split data/split -o {o}": "learn",
    "compress pca data/segments --codec data/latents -o {o}": "learn",
    "train forward data/segments --split data/split -o {o}": "learn",
    "train material data/slides --split data/slides-split -o {o}": "learn",
    "train slip data/even --split data/split -o {o}": "learn",
    "train regress data/synced --split data/split -o {o} --target gt_force_z_n": "learn",
    "train classify data/segments --split data/split -o {o} --label gt_slip": "learn",
    "track models/forward --to tensorboard:{o}": "tensorboard",
    "track models/forward --to mlflow:{o}": "mlflow",
    "track models/forward --to wandb:{o}": "wandb",
    "train forward data/segments --split data/split -o {o} --track tensorboard": "tensorboard",
    "train touch data/grasps --split data/grasps-split -o {o}": "learn",
    "evaluate models/forward data/latents --rerun -o {o}": "learn",
    "calibrate models/forward data/latents --split data/split -o {o}": "learn",
    "recentre models/force data/synced -o {o}": "learn",
    "predict models/forward data/latents -o {o}": "learn",
    "report results/forward -o {o}.html --traces 1": "learn",
    "ingest hdf5 arrays -o {o}": "hdf5",
    "ingest hdf5 arrays --guess": "hdf5",
    "ingest zarr stores --layout rate.toml -o {o}": "zarr",
    "ingest zarr stores --layout rate.toml --dry-run": "zarr",
    "candidates bottle.ply": "clouds",
    "candidates bottle.ply --picture {o}.png": "clouds",
    "ingest gelsight-slip gels --rerun -o {o}": "video",
    "simulate gel --trials 1 --duration-s 4 -o {o}": "video",
    "extract difference data/gels -o {o}": "video",
    "extract markers data/gels -o {o}": "video",
    "extract gel-map data/gels --streams gel0 --mm-per-px 0.06 --diameter-mm 6 -o {o}": "video",
    "extract depth data/gels --map gel_map.npz -o {o}": "video",
    "extract autoencoder data/gels --split data/gels-split -o {o}": "learn",
    "extract encoder data/gels --weights bottle.ply -o {o}": "learn",
    "ingest table workbooks --guess": "xlsx",
    "ingest mcap bags -o {o}": "ros",
    "ingest rosbag bags -o {o}": "ros",
    "ingest rosbag bags --guess": "ros",
    "export mcap data/recordings -o {o}": "ros",
    "export hdf5 data/recordings -o {o}": "hdf5",
    "export zarr data/recordings --rate-hz 20 -o {o}": "zarr",
    "split data/segments --scheme random --seed 7 -o {o} --executor dask": "dask",
    "store push s3://lab/store data/split": "bucket",
    "store pull gs://lab/store data/split": "bucket",
    "store verify --remote az://lab/touch/store": "bucket",
    "split data/segments --scheme random --seed 7 -o {o} --executor slurm": "slurm",
    "show data/synced trial-000 --plot {o}.png": "learn",
    "view data/synced --save {o}.rrd": "view",
    "live ws.toml --model models/forward --publish ws:127.0.0.1:1 --duration-s 1": "learn",
    "demo -o {o}": "learn",
    "try bottle.ply -o {o}": "learn",
    "demo -o {o} --rig serial.toml": "learn",
    "acquire serial.toml -o {o}": "devices",
    "acquire serial.toml --dry-run": "devices",
    "acquire hid.toml -o {o}": "devices",
    "acquire ws.toml -o {o}": "devices",
    "acquire can.toml -o {o}": "devices",
    "acquire camera.toml -o {o}": "clouds",
    "acquire lsl.toml -o {o}": "lsl",
    "sensors probe lsl:wrist": "lsl",
    "sensors probe": "devices",
    "sensors probe /dev/null": "devices",
    "sensors probe hid:16c0:0486": "devices",
    "sensors emulate replayed.toml data/recordings -o {o} --duration-s 1": "devices",
}
PATIENCE_S = 300.0  # No command takes this long unless it hangs.
HEADER = "ply\nformat ascii 1.0\nelement vertex {0}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
RIGS = {
    "serial": ("optoforce", "serial:/dev/null"),
    "hid": ("rawhid", "hid:16c0:0486"),
    "ws": ("xela", "ws:127.0.0.1:1"),
    "can": ("icub-skin", "can:virtual:none"),
    "camera": ("clouds", "camera:0"),
    "lsl": ("lsl", "lsl:wrist"),
}
INPUTS = (
    "simulate material --trials 2 -o data/touched",
    "segment slides data/touched -o data/slides",
    "split data/slides -o data/slides-split --scheme random",
    "simulate touch --trials 5 --families box --objects 1 -o data/pinched",
    "segment grasps data/pinched -o data/grasps",
    "split data/grasps -o data/grasps-split --scheme random",
    "train regress data/synced --split data/split --target gt_force_z_n --architecture linear --recentre sensor "
    "-o models/force",
    "store push elsewhere data/split",
)


def prepare(folder: Path) -> None:
    """Fill a project with what all commands read, made where every extra is installed."""
    run_all(folder, INPUTS)
    xela_files.write_flat(folder / "flat" / "trial_1")
    xela_files.write_psc(folder / "psc" / "trial_1")
    slide_files.write_biotac(folder / "biotac")
    slide_files.write_roboskin(folder / "roboskin", slide_files.touched())
    grasp_files.write_grasp(folder / "grasps")
    video_files.write_gelsight(folder / "gels")
    untouched, weights = np.ones((120, 160, 3)), np.zeros((9, 10, 2))
    gel_map = GelMap(320, 240, 0.06, untouched, weights, np.ones((120, 160), bool), 0.5, 0.4)
    (folder / "gel_map.npz").write_bytes(gel_map.to_bytes())
    run_all(
        folder,
        (
            "ingest gelsight-slip gels -o data/gels",
            "split data/gels -o data/gels-split --scheme random --val 0 --test 0.5",
        ),
    )
    points_m = shapes.visible_half(shapes.cylinder(0.035, 0.2)).points_m.tolist()
    lines = [" ".join(map(str, point)) for point in points_m]
    split = "tacpipe split data/segments -o data/split-again"
    (folder / "dvc.yaml").write_text(f"stages: {{split: {{cmd: {split}, outs: [data/split-again]}}}}\n")
    (folder / "bottle.ply").write_text(HEADER.format(len(lines)) + "\n".join(lines) + "\n")
    (folder / "tables").mkdir()
    (folder / "tables" / "a.csv").write_text("time,x\n0,1\n1,2\n")
    layout = '[streams.skin]\nfiles = "{trial}.csv"\ntime = { column = "time" }\ncolumns = [{ match = "x" }]\n'
    (folder / "tables" / "layout.toml").write_text(layout)
    (folder / "workbooks").mkdir()
    (folder / "workbooks" / "a.xlsx").write_bytes(b"")
    for name in ("arrays", "stores"):
        (folder / name).mkdir()
    array_files.lab(folder / "arrays" / "run.h5")
    array_files.replay(folder / "stores" / "replay.zarr")
    (folder / "rate.toml").write_text('[streams.data]\nsource = "data"\ntime = { rate_hz = 60 }\n')
    lerobot_files.write_v2(folder / "sets" / "pick", episodes=1)
    (folder / "sessions").mkdir()
    session = xdf_writer.Writer()
    session.stream(1, "force")
    session.numbers(1, "float32", [1.0, 1.01], [[0.5], [0.75]])
    session.write(folder / "sessions" / "a.xdf")
    (folder / "bags").mkdir()
    (folder / "bags" / "a.mcap").write_bytes(b"")
    for name, (sensor, transport) in RIGS.items():
        (folder / f"{name}.toml").write_text(stream("s", sensor, transport))
    (folder / "replayed.toml").write_text(stream("xela1", "xela", "ws:127.0.0.1:1"))
    run_all(
        folder,
        (
            "synchronize data/recordings -o data/even --rate-hz 50",
            "simulate forward --trials 1 --duration-s 4 -o data/dropped",
            "label data/dropped trial-000 --label slip=true",
            "synchronize data/dropped -o data/dropped-even --rate-hz 50",
        ),
    )


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory, chained: Path) -> Iterator[Callable[[str], tuple[int, str]]]:
    """A function that runs a command where no extra is installed: its exit code, and all that it printed."""
    folder = tmp_path_factory.mktemp("bare")
    project = shutil.copytree(chained, folder / "project", symlinks=True)
    prepare(project)
    hiding = without_extras.hide(folder / "hiding")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(hiding))
        with serving() as warm:
            yield lambda command: run_warm(warm, project, command)


def run_warm(warm: Warm, project: Path, command: str) -> tuple[int, str]:
    out = project.parent / "printed"
    out.unlink(missing_ok=True)
    pid = warm.start(project, command.format(o=f"new/{len(list((project.parent).rglob('*')))}"), out, {})
    until_s = time.monotonic() + PATIENCE_S
    while (code := warm.poll(pid)) is None:
        if time.monotonic() > until_s:
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.005)
    return code, out.read_text()


def words(commands_of: Iterator[str] | tuple[str, ...] | dict[str, str]) -> set[str]:
    """Return the commands among command lines: one word, or two where the first is a group."""
    groups = {name.partition(".")[0] for name in BUILT_IN if "." in name} | set(GROUPS)
    split = [line.split() for line in commands_of]
    return {" ".join(line[: 2 if line[0] in groups else 1]) for line in split}


def test_every_command_is_walked() -> None:
    expected_commands = {name.replace(".", " ") for name in BUILT_IN}
    expected_commands |= {name for name in commands.NAMES if name not in GROUPS}
    expected_commands |= {f"{group} {name}" for group, names in GROUPS.items() for name in names}

    assert words(WORK) | words(LACK) == expected_commands


@pytest.mark.long
def test_what_needs_no_extra_works_without_any(bare: Callable[[str], tuple[int, str]]) -> None:
    failed = {command: output for command in WORK for code, output in [bare(command)] if code}

    assert failed == {}


@pytest.mark.long
def test_what_needs_an_extra_ends_in_one_sentence_that_names_it(bare: Callable[[str], tuple[int, str]]) -> None:
    unexpected = {}
    for command, extra in LACK.items():
        code, output = bare(command)
        sentence = (
            r"tacpipe: [^\n]+ needs [\w-]+, which is not installed: install it with the extra "
            rf"{extra}, by `[^`\n]+ install [^`\n]*\[{extra}\]'?`\.\n"
        )
        if code != 1 or not re.fullmatch(sentence, output):
            unexpected[command] = (code, output)

    assert unexpected == {}


LIBRARY = """
import sys, tacpipe
try:
    {0}
except ImportError as error:
    print(type(error).__name__, error)
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("call", "needed_by"),
    [('tacpipe.load("models/forward")', "A model"), ('tacpipe.open("data/split").to_torch()', "to_torch")],
)
def test_python_gets_the_same_sentence(chained: Path, tmp_path: Path, call: str, needed_by: str) -> None:
    environment = {"PYTHONPATH": str(without_extras.hide(tmp_path / "hiding"))}
    process = run_python(chained, "-c", LIBRARY.format(call), environment=environment, check=True)

    start = f"MissingModuleError {needed_by} needs torch, which is not installed: install it with the extra learn, by `"
    assert process.stdout.startswith(start) and process.stdout.count("\n") == 1


def install_from_url(folder: Path, monkeypatch: pytest.MonkeyPatch, url: Any) -> None:
    """Make tacpipe look installed from a URL, by pip."""
    about = folder / "tacpipe-9.9.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        "Metadata-Version: 2.4\nName: tacpipe\nVersion: 9.9\nRequires-Dist: numpy>=1\n"
        'Requires-Dist: scipy>=1; extra == "dev"\n'
        'Requires-Dist: scikit-learn>=1.4; extra == "learn"\nRequires-Dist: torch>=2.4; extra == "learn"\n'
        "Requires-Dist: tacpipe[learn]; extra == 'all'\n"
    )
    (about / "INSTALLER").write_text("pip\n")
    if url is not None:
        (about / "direct_url.json").write_text(json.dumps(url))
    distribution = Distribution.at(about)
    monkeypatch.setattr("importlib.metadata.distributions", lambda **_: [distribution])
    monkeypatch.setattr(extras, "_pip", lambda: "pip")


def test_the_command_installs_from_where_tacpipe_came_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clone, wheel = tmp_path / "a clone", tmp_path / "tacpipe-9.9-py3-none-any.whl"
    clone.mkdir()
    wheel.touch()
    git = {"url": "https://host/tacpipe.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}}
    cases: dict[str, Any] = {
        f"pip install -e '{clone}[learn]'": {"url": clone.as_uri(), "dir_info": {"editable": True}},
        f"pip install '{clone}[learn]'": {"url": clone.as_uri(), "dir_info": {}},
        f"pip install '{wheel}[learn]'": {"url": wheel.as_uri(), "archive_info": {}},
        "pip install 'tacpipe[learn] @ git+https://host/tacpipe.git@abc'": git,
        "pip install 'tacpipe[learn]'": None,  # The source is an index.
        "pip install 'scikit-learn>=1.4' 'torch>=2.4'": {"url": "file:///gone/tacpipe.whl", "archive_info": {}},
    }
    for number, (command, url) in enumerate(cases.items()):
        (tmp_path / str(number)).mkdir()
        with monkeypatch.context() as patch:
            install_from_url(tmp_path / str(number), patch, url)
            assert extras.command("learn") == command
            patch.chdir(clone)
            assert extras.command("learn") == command.replace(f"-e '{clone}[", "-e '.[").replace(f" '{clone}[", " '.[")


def test_modules_belong_to_the_extra_whose_package_brings_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    extra_by_module = {
        "torch": "learn",
        "sklearn": "learn",
        "scipy": "learn",
        "safetensors": "learn",
        "matplotlib": "learn",
    }
    extra_by_module |= {
        "open3d": "clouds",
        "serial": "devices",
        "hid": "devices",
        "hidraw": "devices",
        "can": "devices",
    }
    extra_by_module |= {"obstore": "bucket", "websockets": "devices", "rerun": "view", "rerun_cli": "view"}

    assert {module: extras.extra_for(module) for module in extra_by_module} == extra_by_module
    assert extras.extra_for("numpy") is None and extras.extra_for("nobody") is None
    install_from_url(tmp_path, monkeypatch, None)
    assert (extras.extra_for("sklearn"), extras.extra_for("scipy")) == ("learn", "dev")


def test_a_mistake_of_our_own_is_no_missing_extra() -> None:
    for statement in ("import tacpipe.nothing", "from torch import nothing_of_this_name", "import numpy.nothing"):
        with pytest.raises(ImportError) as raised, extras.explain_missing("This"):
            exec(statement)
        assert not isinstance(raised.value, MissingModuleError)


def test_a_module_that_a_plug_in_needs_is_named_with_its_package(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = lab.folder / "other"
    points = "[tacpipe.stages]\nlate = late_stages:late\nearly = early_stages:early\n"
    write_plugin(folder, "other_stages-1", points)
    about = "Metadata-Version: 2.1\nName: other-stages\nVersion: 1\n"
    (folder / "other_stages-1.egg-info" / "PKG-INFO").write_text(about)
    stage = "from __future__ import annotations\nfrom dataclasses import dataclass\nfrom tacpipe import stage\n"
    stage += "@dataclass(frozen=True)\nclass Params:\n    pass\n@stage(version=1)\n"
    (folder / "late_stages.py").write_text(
        f"{stage}def late(params: Params, recording: Recording) -> Table:\n    import rarely_there\n"
    )
    (folder / "early_stages.py").write_text("import rarely_there\n")
    monkeypatch.syspath_prepend(folder)
    forget()
    lab.run("simulate toy -o data/r")
    late, early = lab.call("late data/r -o x"), lab.call("early data/r -o y")

    end = "needs the module rarely_there, which is not installed: install the package that brings it.\n"
    assert (late.code, late.err) == (1, f"tacpipe: Stage late, of the package other-stages, {end}")
    assert (early.code, early.err) == (1, f"tacpipe: early, of the package other-stages, {end}")
