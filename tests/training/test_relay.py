"""A training in another process: what its followers here are called with, and what they are not called with twice."""

from __future__ import annotations

import json
from pathlib import Path

from tacpipe.training import following
from tacpipe.training.following import TrainedNetwork
from tests.training.test_following import Seen, followed

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
