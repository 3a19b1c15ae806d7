"""The learning of a network of touch: batches, losses by hand, and draws that repeat."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.tasks.touch import training
from tacpipe.tasks.touch.inputs import Arrays
from tacpipe.tasks.touch.members import ScaledGrasps, TouchWork, predictions


class Numbers:
    """Draws of one point: the grasp's number, and a random one beside it."""

    def draw(self, indices: Sequence[int], rng: np.random.Generator) -> Arrays:
        return self._of(indices, rng.random(len(indices)))

    def fixed(self, indices: Sequence[int], visit: int) -> Arrays:
        return self._of(indices, np.full(len(indices), 10.0 * visit))

    def _of(self, indices: Sequence[int], values: np.ndarray) -> Arrays:
        return np.array(indices, np.float32)[:, None], values.astype(np.float32)[:, None]


class Sum(nn.Module):
    """Tells number + what is beside it, twice."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(2))

    def forward(self, points: Tensor, numbers: Tensor) -> Tensor:
        return (points + numbers) * self.weight


def work(count: int = 7, batch: int = 3, loss: str = "rmse", weights: tuple[float, float] = (1.0, 1.0)) -> TouchWork:
    felt = ScaledGrasps(Numbers(), torch.zeros(count, 2))
    return TouchWork(felt, felt, batch, loss, torch.tensor(weights))


@pytest.mark.parametrize(
    ("count", "batch", "sizes"),
    [(7, 3, [3, 4]), (6, 3, [3, 3]), (8, 3, [3, 3, 2]), (3, 2, [3]), (2, 10, [2]), (5, 10, [5]), (21, 10, [10, 11])],
)
def test_a_single_grasp_that_is_left_over_joins_the_batch_before_it(count: int, batch: int, sizes: list[int]) -> None:
    batches = work(count, batch).batches(0)
    assert [len(batch_rows) for batch_rows in batches] == sizes
    assert sorted(torch.cat(batches).tolist()) == list(range(count))


def test_batches_are_others_every_epoch() -> None:
    torch.manual_seed(0)
    touch_work = work(50, 10)
    assert not torch.equal(torch.cat(touch_work.batches(0)), torch.cat(touch_work.batches(1)))


def test_the_papers_loss_is_the_root_of_the_mean_square_over_grasps_and_values() -> None:
    predicted = torch.tensor([[1.0, 2.0], [0.0, 4.0]])
    loss = work()._loss(predicted, torch.zeros(2, 2))
    assert loss.item() == pytest.approx(np.sqrt((1 + 4 + 16) / 4 + 1e-6), rel=1e-7)
    exact = torch.zeros(2, 2, requires_grad=True)
    loss = work()._loss(exact, torch.zeros(2, 2))
    loss.backward()  # type: ignore[no-untyped-call]
    assert loss.item() == pytest.approx(1e-3)
    assert exact.grad is not None and torch.isfinite(exact.grad).all()


def test_the_balanced_loss_counts_every_target_alike() -> None:
    group = ("pdc_th", "e_th")
    weights = training._loss_weights(group)
    assert weights.shape == (25,)
    assert weights.mean().item() == pytest.approx(1)
    assert weights[0].item() == pytest.approx(weights[1:].sum().item())
    felt = ScaledGrasps(Numbers(), torch.zeros(4, 25))
    touch_work = TouchWork(felt, felt, 2, "balanced", weights)
    off = [torch.zeros(3, 25), torch.zeros(3, 25)]
    off[0][:, 0] = 0.5  # all of the pressure
    off[1][:, 1:] = 0.5  # all electrodes
    losses = [touch_work._loss(predicted, torch.zeros(3, 25)).item() for predicted in off]
    assert losses[0] == pytest.approx(losses[1])
    assert sum(losses) == pytest.approx(0.25)


def test_the_loss_of_a_batch_draws_points_anew_and_what_is_watched_stays() -> None:
    torch.manual_seed(1)
    touch_work, model, batch = work(), Sum(), torch.tensor([4, 0])
    (first, count), (second, _) = touch_work.loss(model, batch, 0), touch_work.loss(model, batch, 0)
    assert count == 2
    assert first.item() != second.item()
    expected = np.sqrt(np.mean(np.arange(7.0) ** 2) + 1e-6)
    assert [touch_work.validate(model)["val_loss"] for _ in range(2)] == pytest.approx([expected] * 2)
    assert touch_work.ranks({"epoch": 1, "train_loss": 1.0, "val_loss": 0.25}) == {"": (0.25,)}


def test_the_same_generator_draws_the_same_points() -> None:
    losses = []
    for _ in range(2):
        torch.manual_seed(3)
        losses.append(work().loss(Sum(), torch.tensor([1, 2]), 0)[0].item())
    assert losses[0] == losses[1]


@pytest.mark.parametrize("count", [3, 64, 130])
def test_what_is_predicted_is_the_mean_over_visits_of_every_grasp(count: int) -> None:
    predicted = predictions(Sum(), Numbers(), count, draws=3)
    np.testing.assert_allclose(predicted, np.repeat(np.arange(count)[:, None] + 10.0, 2, axis=1))


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"loss": "cubed"}, "loss is 'cubed'; it must be rmse or balanced"),
        ({"batch": 1}, "batch is 1; it must be 2 or more"),
        ({"count": 1}, "There are 1 grasps to learn from; there must be 2 or more"),
    ],
)
def test_what_cannot_be_learned_is_refused(given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        work(**given)
