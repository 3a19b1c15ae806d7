"""Test that `tacpipe acquire` records each sample that a rig sent, with the attributes of the command line."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tacpipe.recording import rig as rig_of
from tests.conftest import Lab, tacpipe
from tests.emulation.emulator import Emulator
from tests.recording import killing, live
from tests.test_imports import imported

LABELLED = '[labels]\ngripper = "left"\nmaterial = "from the rig"\n'


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulator]:
    folder = tmp_path_factory.mktemp("served")
    with live.served(folder, live.FORCE, live.RANGE, live.WRENCH, live.SKIN, head=LABELLED) as emulator:
        yield emulator


@pytest.fixture
def rig(lab: Lab, served: Emulator) -> Emulator:
    """A rig of four streams, its rig file in the lab."""
    text = (served.folder.parent / "rig.toml").read_text()
    (lab.folder / "rig.toml").write_text(text)
    return served


@pytest.mark.rig
def test_the_rig_of_the_first_paper_is_recorded_sample_by_sample(lab: Lab) -> None:
    with live.served(lab.folder, killing.RIG.read_text()) as emulator:
        lab.run("acquire rig.toml -o rec --duration-s 1")
        shard = live.only(lab.folder)

        assert sorted(shard.streams) == ["proximity", "robot", "xela1", "xela2"]  # there are no events
        for name in shard.streams:
            live.place(live.recorded(shard, name), live.sent(emulator, name))
            counts = shard.table(name).column("seq").to_numpy()
            assert (np.diff(counts) == 1).all() and shard.attributes[f"{name}_lost"] == 0


def test_no_sample_arrives_before_it_was_sent_or_out_of_order(lab: Lab, rig: Emulator) -> None:
    lab.run("acquire rig.toml -o rec --duration-s 1")
    shard = live.only(lab.folder)
    to_utc_ns = time.time_ns() - time.monotonic_ns()
    for name, ledger in rig.ledger.items():
        rows = live.recorded(shard, name)
        start = live.place(rows, live.sent(rig, name))
        arrived_ns = shard.table(name).column("t_ns").to_numpy()
        sent_ns = ledger.column("sent_ns")[ledger.intact_rows][start : start + len(rows)] + to_utc_ns

        assert (np.diff(arrived_ns) >= 0).all()
        assert (arrived_ns - sent_ns > -20_000_000).all()  # two clocks are compared


def test_trials_are_numbered_tared_and_labelled(lab: Lab, rig: Emulator) -> None:
    heard = len(rig.ledger["force"].events)
    lab.run("acquire rig.toml -o rec --duration-s 0.4 --trials 3 --name press --label material=cork --note 'worn pad'")
    shards = live.shards(lab.folder)

    assert list(shards) == ["press-001", "press-002", "press-003"]
    for number, shard in enumerate(shards.values(), start=1):
        attributes = {name: shard.attributes[name] for name in ("trial", "material", "note", "gripper", "sensor")}
        labels = {"material": "cork", "note": "worn pad", "gripper": "left", "sensor": "optoforce"}
        assert attributes == {"trial": number, **labels}
        live.place(live.recorded(shard, "force"), live.sent(rig, "force"))
    commands = [payload for _, kind, payload in rig.ledger["force"].events[heard:] if kind == "heard"]
    tare = "aa003203" + "030" + "4ff"  # 333 Hz, 15 Hz low-pass, zero; the sum follows
    assert sum(command.startswith(tare) for command in commands) == 3


def test_devices_are_not_tared_where_the_operator_says_no(lab: Lab, rig: Emulator) -> None:
    heard = len(rig.ledger["force"].events)
    lab.run("acquire rig.toml -o rec --duration-s 0.3 --trials 2 --no-tare")

    assert not [
        payload for _, kind, payload in rig.ledger["force"].events[heard:] if kind == "heard" and payload[12:14] == "ff"
    ]


def test_a_name_that_a_recording_has_already_is_refused_before_anything_is_recorded(lab: Lab, rig: Emulator) -> None:
    lab.run("acquire rig.toml -o rec --duration-s 0.3 --name same")
    lab.run("acquire rig.toml -o rec --duration-s 0.3 --name press --trials 2")
    before = lab.manifest("rec")
    single = lab.call("acquire rig.toml -o rec --duration-s 0.3 --name same")
    trials = lab.call("acquire rig.toml -o rec --duration-s 0.3 --name press --trials 3")
    folded = lab.call("acquire rig.toml -o rec --duration-s 0.3 --name Same")  # one to a file system without case

    assert (single.code, trials.code, folded.code) == (2, 2, 2)
    assert "with these names: same." in folded.err
    assert "with these names: same." in single.err and "with these names: press-001, press-002." in trials.err
    assert lab.manifest("rec") == before and not live.spools(lab.folder)


def test_a_name_that_was_taken_while_it_was_recorded_gets_a_number_and_loses_nothing(
    lab: Lab, rig: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tacpipe.recording.appending.refuse_existing_names", lambda output, names: None)
    for name in ("same", "Same"):
        lab.run(f"acquire rig.toml -o rec --duration-s 0.3 --name {name}")

    assert sorted(live.shards(lab.folder)) == ["Same-2", "same"]


def test_the_rig_file_goes_along(lab: Lab, rig: Emulator) -> None:
    lab.run("acquire rig.toml -o rec --duration-s 0.3 --name one")
    source = lab.manifest("rec").sources["one"]["rig.toml"]

    assert lab.store.read(source).decode() == (lab.folder / "rig.toml").read_text()
    assert rig_of.parse(lab.store.read(source).decode()).master == "force"


def test_quiet_prints_where_it_is_and_no_more(lab: Lab, rig: Emulator) -> None:
    ran = lab.run("acquire rig.toml -o rec --duration-s 0.3 --quiet")

    assert (ran.out, ran.err) == ("rec\n", "")


def test_json_tells_what_was_recorded(lab: Lab, rig: Emulator) -> None:
    report = json.loads(lab.run("acquire rig.toml -o rec --duration-s 0.5 --name one --json").out)
    rows = {name: live.only(lab.folder).table(name).num_rows for name in rig.rig.streams}

    assert report["schema_version"] == 1 and report["output"] == "rec" and report["rows"] == sum(rows.values())
    (recording,) = report["recordings"]
    assert recording["name"] == "one" and recording["rows"] == rows
    assert set(recording["lost"]) == set(rows) and recording["lost"]["force"] == 0


def test_a_dry_run_opens_every_stream_and_writes_nothing(
    lab: Lab, rig: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tacpipe_stages.acquire.DRY_RUN_S", 0.2)
    before = sorted(lab.folder.rglob("*"))
    report = json.loads(lab.run("acquire rig.toml --dry-run --json").out)

    assert {name: figures["samples"] > 0 for name, figures in report["streams"].items()} == dict.fromkeys(
        rig.rig.streams, True
    )
    assert sorted(lab.folder.rglob("*")) == before


def test_a_dataset_of_another_stage_is_refused_before_a_device_is_opened(lab: Lab) -> None:
    lab.run("simulate toy -o made")
    (lab.folder / "rig.toml").write_text(live.stream("force", "optoforce", "serial:/dev/there-is-none"))
    refused = lab.call("acquire rig.toml -o made --duration-s 1")

    assert (
        refused.code == 2 and "made was written by simulate.toy" in refused.err and "there-is-none" not in refused.err
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("", "Missing option -o. Give the dataset of recordings to append to, as -o data/recordings."),
        ("-o rec --start bell", "There is no --start bell; it must be one of now, key, contact, tap."),
        ("-o rec --stop bell", "There is no --stop bell; it must be one of duration, key, contact, tap."),
        ("-o rec --trials 0", "--trials and --duration-s must be above 0."),
        ("-o rec --trials 2", "--trials needs --duration-s or --stop, because otherwise the first trial never ends."),
        (
            "-o rec --name ../out",
            "--name '../out' is not a valid file name. Use letters, digits, _, - and dots, without a dot in front.",
        ),
        ("-o rec --label cork", "--label cork should read name=value, as in --label material=foam."),
    ],
)
def test_what_cannot_be_meant_is_refused_before_a_device_is_opened(lab: Lab, options: str, message: str) -> None:
    (lab.folder / "rig.toml").write_text(live.stream("force", "optoforce", "serial:/dev/there-is-none"))
    refused = lab.call(f"acquire rig.toml {options}")

    assert (refused.code, refused.err) == (2, f"tacpipe: {message}\n")
    assert not (lab.folder / "rec").exists()


def test_without_a_rig_file_an_example_is_told(lab: Lab) -> None:
    refused = lab.call("acquire")

    assert refused.code == 2 and "tacpipe acquire rig.toml -o data/recordings" in refused.err


def test_two_recordings_at_once_are_both_appended(lab: Lab, rig: Emulator) -> None:
    for name in ("force", "range"):
        stream = rig.rig.streams[name]
        options = "{ axes = 3, rate_hz = 333 }" if name == "force" else "{}"
        (lab.folder / f"{name}.toml").write_text(live.stream(name, stream.kind, str(stream.address), options))
    processes = [
        live.started(lab.folder, f"--duration-s 1 --name {name} --quiet", f"{name}.toml") for name in ("force", "range")
    ]
    errors = [process.communicate()[1] for process in processes]

    assert [process.returncode for process in processes] == [0, 0], errors
    shards = live.shards(lab.folder)
    assert {name: shard.streams[-1:] for name, shard in shards.items()} == {"force": ("force",), "range": ("range",)}
    for name, shard in shards.items():
        live.place(live.recorded(shard, name), live.sent(rig, name))


def test_help_ends_with_an_example(tmp_path: Path) -> None:
    help_text = " ".join(tacpipe(tmp_path, "acquire --help").stdout.split("Arguments:")[0].split())

    assert help_text.endswith(
        "Example: tacpipe acquire rig.toml -o data/recordings --duration-s 30 --label material=cork"
    )


def test_recording_imports_no_torch(lab: Lab, rig: Emulator) -> None:
    modules = imported(lab.folder, "acquire rig.toml -o rec --duration-s 0.3 --quiet")

    assert "numpy" in modules and modules & {"torch", "sklearn", "open3d", "scipy", "matplotlib"} == set()
