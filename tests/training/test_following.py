"""Follow a training: the growing file, the lines and the bar, and the sentence of an interrupt."""

import dataclasses
import errno
import json
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tacpipe.errors import TacpipeError
from tacpipe.io import terminal, termination
from tacpipe.training import display, following
from tacpipe.training.following import Line, TrainedNetwork
from tacpipe.training.loop import Loss, TrainingResult, WindowSet, WindowTraining, train
from tests.training.followers import Seen
from tests.training.test_loop import SCHEDULE, build, interrupted_after, loss, run, same


def followed(folder: Path, *followers: following.Follower, training: Loss = loss) -> TrainingResult:
    with following.in_workspace(folder, *followers):
        return run(folder, training)


def lines(folder: Path) -> list[Line]:
    return [json.loads(line) for line in (folder / following.HISTORY).read_text().splitlines()]


def test_a_follower_is_called_at_every_batch_and_every_epoch(tmp_path: Path) -> None:
    follower = Seen()
    trained = followed(tmp_path, follower)

    epochs = len(trained.history)
    assert follower.passed == [0.25, 0.5, 0.75, 1.0] * epochs  # four batches of 8 windows
    assert follower.losses[3] == pytest.approx(trained.history[0]["train_loss"])
    assert [line for line, _ in follower.lines] == trained.history
    assert {rate for _, rate in follower.lines} == {SCHEDULE.learning_rate}
    assert follower.ends == [True]


def test_the_learning_rate_of_a_line_is_that_of_its_first_batch(tmp_path: Path) -> None:
    follower, schedule = Seen(), dataclasses.replace(SCHEDULE, cycle=True, patience=9)
    with following.in_workspace(tmp_path, follower):
        train(build, WindowTraining(WindowSet(32, loss), WindowSet(40, loss), schedule.batch), schedule, tmp_path)

    assert [rate for _, rate in follower.lines] == [schedule.rate(epoch / 6) for epoch in range(6)]


def test_the_history_file_grows_with_every_epoch_and_ends_as_the_history(tmp_path: Path) -> None:
    counts: list[int] = []
    follower = Seen(act=lambda: counts.append(len(lines(tmp_path))))
    trained = followed(tmp_path, follower)

    assert counts == list(range(1, len(trained.history) + 1))
    assert (tmp_path / following.HISTORY).read_bytes() == following.history_bytes(trained.history)


def test_a_resumed_training_states_its_epoch_and_the_file_is_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(KeyboardInterrupt), display.followers_on_stderr("train", tmp_path) as displays:
        followed(tmp_path, *displays, training=interrupted_after(9))  # the third epoch has four batches
    before = capsys.readouterr().err
    epochs = len(lines(tmp_path))
    with display.followers_on_stderr("train", tmp_path) as displays:
        trained = followed(tmp_path, *displays)
    after = capsys.readouterr().err

    assert epochs == 2
    assert "epoch 2/6" in before and "epoch 3/6" not in before and "trained" not in before
    assert "resumes from epoch 3 of 6" in after and "epoch 2/6" not in after and "epoch 3/6" in after
    assert lines(tmp_path) == trained.history


def test_an_interrupt_is_stated_with_the_epoch_that_is_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        followed(tmp_path, training=interrupted_after(9))
    termination.report()
    assert "epoch 3 of 6" in capsys.readouterr().err

    with pytest.raises(KeyboardInterrupt):
        followed(tmp_path / "another", training=interrupted_after(2))
    termination.report()
    assert "epoch" not in capsys.readouterr().err  # nothing is kept of the first


def test_the_lines_of_several_networks_are_in_one_file_with_their_labels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work = WindowTraining(WindowSet(32, loss), WindowSet(40, loss), SCHEDULE.batch)
    with display.followers_on_stderr("train", tmp_path) as displays, following.in_workspace(tmp_path, *displays):
        trainings = [
            train(build, work, SCHEDULE, tmp_path / name, number=number, count=2, labels={"target": name})
            for number, name in enumerate(("a", "b"), 1)
        ]

    assert lines(tmp_path) == [
        {**line, "target": name} for name, trained in zip("ab", trainings, strict=True) for line in trained.history
    ]
    err = capsys.readouterr().err
    assert err.count(following.HISTORY) == 1
    assert "network 1 of 2: epoch 1/6" in err and "network 2 of 2: epoch 1/6" in err


def test_what_follows_changes_no_bit(tmp_path: Path) -> None:
    unfollowed = run(tmp_path / "alone")

    def draw() -> None:
        torch.manual_seed(99)

    drawing = Seen(act=draw)
    assert same(followed(tmp_path / "followed", drawing), unfollowed)


def test_a_file_that_cannot_be_written_is_reported_once_and_ends_no_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    unfollowed = run(tmp_path / "alone")
    (tmp_path / "followed").mkdir()
    (tmp_path / "followed" / following.HISTORY).symlink_to(tmp_path / "elsewhere")  # none is followed in a store
    assert same(followed(tmp_path / "followed"), unfollowed)
    assert not (tmp_path / "elsewhere").exists()
    assert capsys.readouterr().err.count(following.HISTORY) == 1

    def full(handle: int, content: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "full").mkdir()
    with monkeypatch.context() as patch, following.in_workspace(tmp_path / "full"):
        patch.setattr(os, "write", full)
        with following.follow_network(TrainedNetwork(2), []) as followers:
            for epoch in (1, 2):
                followers.line({"epoch": epoch, "train_loss": 1.0, "val_loss": 0.5}, 0.1)
    assert capsys.readouterr().err.count("No space left") == 1


def test_nothing_is_left_of_a_training_that_failed_in_its_first_epoch(tmp_path: Path) -> None:
    def diverging(model: torch.nn.Module, indices: torch.Tensor) -> torch.Tensor:
        return loss(model, indices) * float("nan")

    with pytest.raises(TacpipeError, match="diverged"):
        followed(tmp_path, training=diverging)
    assert list(tmp_path.iterdir()) == []


def test_without_a_terminal_a_line_an_epoch_holds_losses_best_and_seconds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with display.followers_on_stderr("train", tmp_path) as displays:
        trained = followed(tmp_path, *displays)
    printed = re.findall(
        r"epoch (\d)/6  train ([\d.e-]+) +val ([\d.e-]+) +best ([\d.e-]+) \(epoch (\d)\)  \d+\.\d s  [\d:]+ left",
        capsys.readouterr().err,
    )

    assert [int(fields[0]) for fields in printed] == [line["epoch"] for line in trained.history]
    for fields, line in zip(printed, trained.history, strict=True):
        assert float(fields[1]) == pytest.approx(line["train_loss"], rel=1e-3)
        assert float(fields[2]) == pytest.approx(line["val_loss"], rel=1e-3)
    best = min(trained.history, key=lambda line: line["val_loss"])
    assert int(printed[-1][4]) == best["epoch"] and float(printed[-1][3]) == pytest.approx(best["val_loss"], rel=1e-3)


def test_quiet_prints_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with terminal.showing_progress(False), display.followers_on_stderr("train", tmp_path) as displays:
        followed(tmp_path, *displays)
    assert capsys.readouterr().err == ""


def test_on_a_terminal_the_bar_counts_batches_and_shows_loss_best_rate_and_remaining_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr(display, "REDRAW_S", 0.0)
    drawn: list[tuple[str, float, str]] = []
    with display.followers_on_stderr("train", tmp_path) as displays:
        assert isinstance(displays[0], display.Bar)
        tasks = displays[0].progress.tasks
        pulsing = [tasks[0].total]

        class Look(Seen):
            def batch(self, passed: float, mean: Callable[[], float]) -> None:
                (task,) = displays[0].progress.tasks  # type: ignore[attr-defined]
                drawn.append((task.description, task.completed, task.fields["note"]))

        trained = followed(tmp_path, *displays, Look())
        pulsing.append(displays[0].progress.tasks[0].total)

    assert pulsing == [None, None]  # it moves before the first epoch and after the last too
    assert [completed for _, completed, _ in drawn] == [n / 4 for n in range(1, 4 * len(trained.history) + 1)]
    assert drawn[4][0] == "epoch 2/6"
    best = f"{trained.history[0]['val_loss']:#.4g}"
    assert re.fullmatch(rf"loss [\d.]+  best {best} \(epoch 1\)  [\d.]+ batches/s  [\d:]+ left", drawn[4][2])


NETWORK = TrainedNetwork(4, number=2, count=3, labels={"network": 1})


def epoch_line(epoch: int) -> following.Line:
    return {"epoch": epoch, "train_loss": 1.0, "val_loss": 0.5}


def line(epoch: int) -> following.TrainingMessage:
    return {"line": epoch_line(epoch), "learning_rate": 0.25}


def end(*, trained: bool) -> following.TrainingMessage:
    return {"end": trained}


def begin(*epochs: int, network: TrainedNetwork = NETWORK) -> following.TrainingMessage:
    messages: list[following.TrainingMessage] = []
    following.Sender(messages.append).begin(network, [epoch_line(epoch) for epoch in epochs])
    return json.loads(json.dumps(messages[0]))  # type: ignore[no-any-return]


def test_followers_elsewhere_see_what_followers_in_the_process_see(tmp_path: Path) -> None:
    local, remote = Seen(), Seen()
    receiver = following.Receiver([remote])
    followed(tmp_path, local, following.Sender(lambda message: receiver.take(json.loads(json.dumps(message)))))

    assert remote.networks == local.networks
    assert remote.lines == local.lines
    assert remote.ends == local.ends == [True]
    assert set(remote.passed) <= set(local.passed)


def test_messages_about_batches_are_at_least_half_a_second_apart() -> None:
    sent: list[following.TrainingMessage] = []
    sender = following.Sender(sent.append)
    for number in range(1000):
        sender.batch(number / 1000, lambda: 1.0)
    assert len(sent) <= 1

    sender._sent_s -= following.BATCH_S
    sender.batch(0.5, lambda: 0.125)
    assert sent[-1] == {"batch": 0.5, "loss": 0.125}


def test_epochs_that_another_worker_repeats_or_takes_over_are_given_once() -> None:
    follower = Seen()
    receiver = following.Receiver([follower])
    for message in (begin(), line(1), line(2), end(trained=False)):
        receiver.take(message)
    for message in (begin(1, 2, 3), line(4), end(trained=True)):  # one epoch's message was lost with the worker
        receiver.take(message)

    assert follower.networks == [(NETWORK, [])]
    assert [line_received["epoch"] for line_received, _ in follower.lines] == [1, 2, 3, 4]
    assert follower.ends == [True]


def test_a_network_that_is_trained_from_its_beginning_by_another_worker_gives_no_epoch_twice() -> None:
    follower = Seen()
    receiver = following.Receiver([follower])
    for message in (begin(), line(1), line(2), begin(), line(1), line(2), line(3)):
        receiver.take(message)

    assert [line_received["epoch"] for line_received, _ in follower.lines] == [1, 2, 3]


def test_a_network_whose_worker_never_came_back_ends_untrained() -> None:
    follower = Seen()
    receiver = following.Receiver([follower])
    receiver.take(begin())
    receiver.take(line(1))
    receiver.close()
    receiver.close()

    assert follower.ends == [False]


def test_the_next_network_is_begun_once_the_one_before_has_ended() -> None:
    follower = Seen()
    receiver = following.Receiver([follower])
    next_network = TrainedNetwork(4, number=3, count=3, labels={"network": 2})
    for message in (begin(), line(1), end(trained=True), begin(network=next_network), line(1), end(trained=True)):
        receiver.take(message)

    assert [network for network, _ in follower.networks] == [NETWORK, next_network]
    assert len(follower.lines) == 2
    assert follower.ends == [True, True]
