"""Check the calls of trackers, and that no tracker changes or ends a training."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

import tacpipe
from tacpipe.errors import StorageError, TacpipeError, UsageError
from tacpipe.plugins import registry
from tacpipe.scores import headline
from tacpipe.trackers import tracking
from tacpipe.trackers.tracking import Tracking
from tacpipe.training import following, loop
from tacpipe.training.following import Line, history_bytes
from tacpipe.training.loop import TrainingResult
from tests.chain import TRAIN
from tests.conftest import Lab
from tests.test_headline import ONE
from tests.training.test_loop import SCHEDULE, interrupted_after, loss, run, same

CONFIG = {"params": {"learning_rate": 0.5, "epochs": 4, "cycle": False}, "validation": {"loss": 0.25, "epoch": 2}}


class Kept:
    """A tracker that keeps its calls, and fails in one of them."""

    def __init__(self, failing: str = "") -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.failing = failing

    def _keep(self, *call: Any) -> None:
        self.calls.append(call)
        if call[0] == self.failing:
            torch.manual_seed(13)
            raise SystemExit(3) if self.failing == "end" else ConnectionError("no answer")

    def start(self, name: str, params: Mapping[str, Any]) -> str:
        self._keep("start", name, dict(params))
        return "here"

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        self._keep("line", epoch, dict(metrics))

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        self._keep("end", path, dict(figures))


def training(folder: Path, *trackers: Kept, loss_of: Any = loss) -> tuple[TrainingResult, Tracking]:
    tracked = Tracking({f"kept{number}": tracker for number, tracker in enumerate(trackers)}, "m-1", {"a": 1})
    with following.track_with([tracked]), following.in_workspace(folder):
        return run(folder, loss_of), tracked


def test_a_tracker_gets_params_then_every_epoch_then_the_figures_and_the_path(tmp_path: Path) -> None:
    tracker = Kept()
    trained, tracked = training(tmp_path, tracker)
    files = {"config.json": json.dumps(CONFIG).encode(), "history.jsonl": history_bytes(trained.history)}
    tracked.finish(Path("models/m"), files)  # no epoch of the history is given again

    assert tracker.calls[0] == ("start", "m-1", {"a": 1})
    for call, line in zip(tracker.calls[1:-1], trained.history, strict=True):
        losses = {"train_loss": line["train_loss"], "val_loss": line["val_loss"]}
        assert call == ("line", line["epoch"], {**losses, "learning_rate": SCHEDULE.learning_rate})
    assert tracker.calls[-1] == ("end", Path("models/m"), {"best/loss": 0.25, "best/epoch": 2.0})


def test_epochs_whose_messages_did_not_come_are_given_at_the_end() -> None:
    tracker = Kept()
    tracked = Tracking({"kept": tracker}, "m-1", {})
    lines: list[Line] = [{"epoch": epoch, "train_loss": 0.5, "val_loss": 0.25} for epoch in (1, 2, 3)]
    tracked.begin(following.TrainedNetwork(3), [])
    tracked.line(lines[0], 0.5)
    tracked.finish(
        Path("models/m"), {"config.json": json.dumps(CONFIG).encode(), "history.jsonl": history_bytes(lines)}
    )

    assert [call[1] for call in tracker.calls if call[0] == "line"] == [1, 2, 3]


@pytest.mark.parametrize("method", ["start", "line", "end"])
def test_a_tracker_that_fails_is_reported_once_and_changes_no_bit(
    tmp_path: Path, method: str, capsys: pytest.CaptureFixture[str]
) -> None:
    untracked = run(tmp_path / "alone")
    failing, working = Kept(method), Kept()
    trained, tracked = training(tmp_path / "tracked", failing, working)
    tracked.finish(Path("m"), {})

    assert same(trained, untracked)
    assert capsys.readouterr().err.count("kept0 failed") == 1 == len(tracked.failures)
    assert [call[0] for call in failing.calls].count(method) == 1 and failing.calls[-1][0] == method
    assert [call[0] for call in working.calls] == ["start", *["line"] * len(untracked.history), "end"]


def test_a_resumed_training_gives_the_epochs_before_the_interruption_too(tmp_path: Path) -> None:
    first, second = Kept(), Kept()
    with pytest.raises(KeyboardInterrupt):
        training(tmp_path, first, loss_of=interrupted_after(9))
    trained, _ = training(tmp_path, second)

    assert [call[1] for call in first.calls[1:]] == [1, 2]
    assert [call[1] for call in second.calls[1:]] == [line["epoch"] for line in trained.history]


def test_a_stored_history_gives_the_lines_that_its_training_gave(tmp_path: Path) -> None:
    live, replayed = Kept(), Kept()
    trained, tracked = training(tmp_path, live)
    tracked.finish(Path("m"), {})
    params = {"learning_rate": SCHEDULE.learning_rate, "epochs": SCHEDULE.epochs, "cycle": SCHEDULE.cycle}
    files = {"config.json": json.dumps({"params": params}).encode(), "history.jsonl": history_bytes(trained.history)}
    Tracking({"kept": replayed}, "m-1", {}).finish(Path("m"), files)

    assert replayed.calls[1:-1] == live.calls[1:-1]
    assert replayed.calls[0][2]["learning_rate"] == SCHEDULE.learning_rate  # params are the model's


def test_lines_of_several_networks_are_told_apart_and_nested_figures_named_by_their_path() -> None:
    line: Line = {"epoch": 1, "train_loss": 1.0, "val_loss": 0.5, "val": {"biotac": {"accuracy": 0.25}}, "best": True}
    lines: list[Line] = [{**line, "target": name, "network": 0} for name in ("pdc_th", "e_th")]
    figures = {"train_loss": 1.0, "val_loss": 0.5, "val/biotac/accuracy": 0.25}
    tracker = Kept()
    Tracking({"kept": tracker}, "m", {}).finish(Path("m"), {"history.jsonl": history_bytes(lines)})

    assert [call[2] for call in tracker.calls[1:-1]] == [
        {f"{name}/0/{metric}": value for metric, value in figures.items()} for name in ("pdc_th", "e_th")
    ]


def test_a_result_gives_its_summary_or_that_of_its_headlines_where_it_has_none() -> None:
    for files in (
        {"headline.json": headline.write([ONE])},
        {"headline.json": headline.write([ONE]), "summary.json": b'{"gain": 0.1, "mae_t_1": 7.5}'},
    ):
        tracker = Kept()
        Tracking({"kept": tracker}, "r", {}).finish(Path("r"), files)
        (_, _, figures) = tracker.calls[-1]
        assert figures["gain"] == 0.1 and figures["mae_t_1"] == 7.5


def test_a_run_is_named_by_its_output_and_its_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert tracking.name_of(Path("models/forward"), "ab" * 32) == "models/forward-abababab"
    assert tracking.name_of(tmp_path / "models" / "forward", "ab" * 32) == "models/forward-abababab"
    assert tracking.name_of(tmp_path.parent / "elsewhere", "ab" * 32) == "elsewhere-abababab"


def test_an_unknown_tracker_is_a_usage_error_before_anything_is_trained(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    failed = lab.call("track data/r --to nobody")
    assert failed.code == 2
    with pytest.raises(TacpipeError, match="tensorboard"):
        registry.load_tracker("nobody")


def test_stages_that_train_or_evaluate_can_be_tracked_and_no_others() -> None:
    tracked_stages = {name for name in registry.stages() if registry.load(name).tracked}
    built_in = {
        name for name, target in registry.stages().items() if target.startswith(("tacpipe.", "tacpipe_stages."))
    }
    assert tracked_stages & built_in == {
        *(
            "train.classify",
            "train.forward",
            "train.material",
            "train.regress",
            "train.slip",
            "train.touch",
            "compress.autoencoder",
            "extract.autoencoder",
        ),
        "evaluate",
    }


@pytest.mark.long
def test_tracked_or_not_a_model_has_the_same_bytes_and_key(tracked: Lab) -> None:
    plain = json.loads(tracked.run(f"{TRAIN} --epochs 3 -o models/plain --json").out)
    (tracked.folder / "elsewhere").mkdir()
    options = "--track keeping --track failing:line --rerun --json"
    ran = tracked.run(f"{TRAIN} --epochs 3 -o models/tracked {options}")

    assert json.loads(ran.out)["key"] == plain["key"]  # standard output holds nothing else
    assert tracked.manifest("models/tracked").content == tracked.manifest("models/plain").content
    assert ran.err.count("failing:line failed") == 1
    calls = [json.loads(line) for line in (tracked.folder / "kept.jsonl").read_text().splitlines()]
    assert [call[0] for call in calls] == ["start", "line", "line", "line", "end"]
    assert calls[0][1] == f"models/tracked-{plain['key'][:8]}" and calls[0][2]["hidden"] == 16
    assert calls[-1][1] == "models/tracked" and calls[-1][2]["best/loss"] > 0


@pytest.mark.long
def test_a_hit_gives_the_stored_history_and_a_result_its_figures(tracked: Lab) -> None:
    repeated = tracked.run(f"{TRAIN} --epochs 2 -o models/forward --track keeping")
    tracked.run("track models/forward --to keeping:stored.jsonl")
    tracked.run(
        "evaluate models/forward data/latents --split data/split -o results/forward --track keeping:figures.jsonl"
    )
    model_calls, result_calls, figures = (
        [json.loads(line) for line in (tracked.folder / f"{name}.jsonl").read_text().splitlines()]
        for name in ("kept", "stored", "figures")
    )

    assert "0 ran, 1 reused" in repeated.err
    assert [call[0] for call in model_calls] == ["start", "line", "line", "end"]
    assert [call[:2] for call in result_calls] == [call[:2] for call in model_calls]  # the same run, by its name
    assert {"gain", "n"} <= set(figures[-1][2]) and figures[0][2]["hidden"] == 16


@pytest.mark.long
def test_a_training_that_fails_ends_its_run_without_a_model(tracked: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise StorageError("no space is left")

    monkeypatch.setattr(loop, "write_checkpoint", full)
    failed = tracked.call(f"{TRAIN} --epochs 3 -o models/x --track keeping")
    calls = [json.loads(line) for line in (tracked.folder / "kept.jsonl").read_text().splitlines()]

    assert failed.code == 1
    assert calls[0][0] == "start" and calls[-1] == ["end", None, {}]


def test_python_tracks_with_an_argument_and_refuses_a_stage_that_trains_nothing(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    with pytest.raises(UsageError, match="track"):
        tacpipe.run("scale", "data/r", output="data/s", track=["tensorboard"])
    with pytest.raises(UsageError, match="nobody"):
        tacpipe.run("evaluate", "data/r", output="x", model="data/r", track=["nobody"])


def test_tracking_goes_with_no_run_that_stores_nothing(lab: Lab) -> None:
    (lab.folder / "m").mkdir()
    for option in ("--check", "--recompute-and-compare"):
        assert lab.call(f"evaluate m r -o x --track tensorboard {option}").code == 2


@pytest.mark.parametrize(
    "place", ["http://lee:hidden@lab:5000", "postgresql://lee:hidden@lab/runs", "http://lab/?token=hidden"]
)
def test_a_place_with_credentials_is_refused_without_printing_them(place: str) -> None:
    with pytest.raises(UsageError, match="--track has an address") as error:
        tracking.open_trackers([f"mlflow:{place}"])
    assert "hidden" not in str(error.value)
