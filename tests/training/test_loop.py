import dataclasses
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.training import loop
from tacpipe.training.following import Line, Validated
from tacpipe.training.loop import Adam, Loss, Schedule, TrainingResult, WindowSet, WindowTraining, train

SCHEDULE = Schedule(epochs=6, batch=8, learning_rate=0.01, patience=3, gradient_clip=1.0, seed=4)
INPUTS = torch.randn(40, 3, generator=torch.Generator().manual_seed(1))
TARGETS = INPUTS @ torch.tensor([[1.0], [-2.0], [0.5]])


def build() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 8), nn.Dropout(0.1), nn.Linear(8, 1))


def loss(model: nn.Module, indices: Tensor) -> Tensor:
    return nn.functional.mse_loss(model(INPUTS[indices]), TARGETS[indices])


def run(folder: Path, training_loss: Loss = loss, schedule: Schedule = SCHEDULE) -> TrainingResult:
    return train(
        build, WindowTraining(WindowSet(32, training_loss), WindowSet(40, loss), schedule.batch), schedule, folder
    )


def interrupted_after(calls: int) -> Loss:
    remaining = iter(range(calls))

    def interrupt(model: nn.Module, indices: Tensor) -> Tensor:
        if next(remaining, None) is None:
            raise KeyboardInterrupt
        return loss(model, indices)

    return interrupt


def same(first: TrainingResult, second: TrainingResult) -> bool:
    return first.history == second.history and all(
        torch.equal(first.weights[k], second.weights[k]) for k in first.weights
    )


@pytest.mark.parametrize("batches", [1, 4, 5, 11, 23])
def test_a_run_that_was_killed_and_resumed_gives_the_same_bits(tmp_path: Path, batches: int) -> None:
    uninterrupted = run(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "killed", interrupted_after(batches))
    assert same(run(tmp_path / "killed"), uninterrupted)


def test_a_finished_run_is_not_trained_again(tmp_path: Path) -> None:
    uninterrupted = run(tmp_path)
    assert same(run(tmp_path, interrupted_after(0)), uninterrupted)


def test_the_same_seed_gives_the_same_bits_and_another_one_does_not(tmp_path: Path) -> None:
    first = run(tmp_path / "a")
    assert same(first, run(tmp_path / "b"))
    assert not same(first, run(tmp_path / "c", schedule=dataclasses.replace(SCHEDULE, seed=5)))


def test_training_leaves_the_random_generator_as_it_was(tmp_path: Path) -> None:
    before = torch.get_rng_state()
    run(tmp_path)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("damage", ["cut", "a weight that a disk changed"])
def test_a_damaged_checkpoint_starts_over(tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str) -> None:
    uninterrupted = run(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "damaged", interrupted_after(9))
    file = tmp_path / "damaged" / loop.FILE
    content = file.read_bytes()
    file.write_bytes(content[:-10] if damage == "cut" else content[:-10] + bytes([content[-10] ^ 1]) + content[-9:])
    assert same(run(tmp_path / "damaged"), uninterrupted)
    assert "training starts over" in caplog.text


LINE: Line = {"epoch": 1, "train_loss": 1.0, "val_loss": 0.5}


def test_a_checkpoint_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loop.write_checkpoint(tmp_path, {"a": torch.zeros(2)}, [LINE])

    def dies(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", dies)
    with pytest.raises(KeyboardInterrupt):
        loop.write_checkpoint(tmp_path, {"a": torch.ones(2)}, [LINE, LINE])
    checkpoint = loop.read_checkpoint(tmp_path)
    assert checkpoint is not None
    assert checkpoint[1] == [LINE]
    assert torch.equal(checkpoint[0]["a"], torch.zeros(2))


def test_training_stops_when_validation_no_longer_improves_and_keeps_the_best(tmp_path: Path) -> None:
    validation = iter([1.0, 0.5, 0.7, 0.6, 0.8, 0.1])
    states: list[dict[str, Tensor]] = []

    def scripted(model: nn.Module, indices: Tensor) -> Tensor:
        states.append({name: value.clone() for name, value in model.state_dict().items()})
        return torch.tensor(next(validation))

    schedule = dataclasses.replace(SCHEDULE, epochs=50, batch=100)
    trained = train(
        build, WindowTraining(WindowSet(32, loss), WindowSet(40, scripted), schedule.batch), schedule, tmp_path
    )
    assert [line["best"] for line in trained.history] == [True, True, False, False, False]
    assert all(torch.equal(trained.weights[name], states[1][name]) for name in states[1])


def test_the_loss_of_an_epoch_is_the_mean_over_windows_and_not_over_batches(tmp_path: Path) -> None:
    def by_size(model: nn.Module, indices: Tensor) -> Tensor:
        return loss(model, indices) * 0 + len(indices)

    schedule = dataclasses.replace(SCHEDULE, epochs=1, batch=20)
    trained = train(
        build, WindowTraining(WindowSet(32, by_size), WindowSet(32, by_size), schedule.batch), schedule, tmp_path
    )
    assert trained.history[0]["val_loss"] == trained.history[0]["train_loss"] == (20 * 20 + 12 * 12) / 32


def test_gradients_are_clipped(tmp_path: Path) -> None:
    norms: list[float] = []

    def steep(model: nn.Module, indices: Tensor) -> Tensor:
        grads = [weight.grad for weight in model.parameters() if weight.grad is not None]
        norms.extend([float(torch.cat([grad.flatten() for grad in grads]).norm())] if grads else [])
        return 1e4 * loss(model, indices)

    run(tmp_path, steep)
    assert norms
    assert max(norms) <= 1.0 + 1e-4


def test_the_rate_of_a_cycle_rises_and_falls_and_ends_at_nothing() -> None:
    schedule = dataclasses.replace(SCHEDULE, cycle=True)
    rates = [schedule.rate(progress / 100) for progress in range(101)]
    assert rates[0] == pytest.approx(SCHEDULE.learning_rate / 25)
    assert rates[30] == pytest.approx(SCHEDULE.learning_rate) == max(rates)
    assert all(rate < next_rate for rate, next_rate in pairwise(rates[:31]))
    assert all(rate > next_rate for rate, next_rate in pairwise(rates[30:]))
    assert rates[-1] == pytest.approx(0, abs=1e-12)
    assert max(abs(rate - next_rate) for rate, next_rate in pairwise(rates)) < 0.06 * SCHEDULE.learning_rate  # no jump


def test_the_rate_is_the_same_throughout_without_a_cycle() -> None:
    assert {SCHEDULE.rate(progress / 10) for progress in range(11)} == {SCHEDULE.learning_rate}


def test_the_optimiser_steps_at_the_rate_of_all_epochs_passed(tmp_path: Path) -> None:
    positions: list[float] = []

    class StillSchedule(Schedule):
        def rate(self, progress: float) -> float:
            positions.append(progress)
            return 0.0

    fields = {**dataclasses.asdict(SCHEDULE), "epochs": 3, "batch": 20, "cycle": True}
    trained = run(tmp_path, schedule=StillSchedule(**fields))
    assert positions == pytest.approx([0, 1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6])
    assert len({line["val_loss"] for line in trained.history}) == 1  # nothing is learned at a rate of 0


@pytest.mark.parametrize("batches", [3, 9])
def test_a_cycle_goes_on_where_it_was_killed(tmp_path: Path, batches: int) -> None:
    schedule = dataclasses.replace(SCHEDULE, cycle=True)
    uninterrupted = run(tmp_path / "whole", schedule=schedule)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "killed", interrupted_after(batches), schedule)
    assert same(run(tmp_path / "killed", schedule=schedule), uninterrupted)


def test_a_loss_that_is_not_finite_ends_training_with_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="Lower the learning rate"):
        run(tmp_path, lambda model, indices: loss(model, indices) * torch.inf)


class TwoHalves:
    """Two numbers that go down and up again, each with its own best epoch."""

    def batches(self, epoch: int) -> list[int]:
        return [epoch]

    def loss(self, model: nn.Module, batch: int, epoch: int) -> tuple[Tensor, int]:
        return sum(((weight - epoch) ** 2).sum() for weight in model.parameters()), 1  # type: ignore[return-value]

    def validate(self, model: nn.Module) -> Validated:
        return {"val_loss": 1.0}

    def ranks(self, line: Line) -> dict[str, tuple[float, ...]]:
        return {"a.": (abs(line["epoch"] - 2),), "b.": (abs(line["epoch"] - 4),)}


def test_each_part_of_a_model_keeps_the_weights_of_its_own_best_epoch(tmp_path: Path) -> None:
    def halves() -> nn.Module:
        return nn.ModuleDict({"a": nn.Linear(1, 1), "b": nn.Linear(1, 1)})

    def trained_for(epochs: int) -> TrainingResult:
        schedule = dataclasses.replace(SCHEDULE, epochs=epochs, patience=9, gradient_clip=float("inf"))
        return train(halves, TwoHalves(), schedule, tmp_path / str(epochs))

    six_epochs, second, fourth = trained_for(6), trained_for(2), trained_for(4)
    assert torch.equal(six_epochs.weights["a.weight"], second.last["a.weight"])
    assert torch.equal(six_epochs.weights["b.weight"], fourth.last["b.weight"])
    assert not torch.equal(six_epochs.last["b.weight"], fourth.last["b.weight"])
    assert [line["best"] for line in six_epochs.history] == [True, True, True, True, False, False]


def test_weights_that_need_no_gradient_stay_as_they_were(tmp_path: Path) -> None:
    def frozen() -> nn.Module:
        model = build()
        model[2].requires_grad_(False)  # type: ignore[index]
        return model

    torch.manual_seed(SCHEDULE.seed)
    before = {name: value.clone() for name, value in frozen().state_dict().items()}
    after = train(frozen, WindowTraining(WindowSet(32, loss), WindowSet(40, loss), 8), SCHEDULE, tmp_path).last
    assert torch.equal(after["2.weight"], before["2.weight"])
    assert not torch.equal(after["0.weight"], before["0.weight"])


def test_parts_without_windows_and_schedules_without_steps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="The validation recordings contain no window"):
        train(build, WindowTraining(WindowSet(3, loss), WindowSet(0, loss), 8), SCHEDULE, tmp_path)
    with pytest.raises(TacpipeError, match="epochs is 0"):
        dataclasses.replace(SCHEDULE, epochs=0)


def _network() -> nn.Sequential:
    torch.manual_seed(3)
    return nn.Sequential(nn.Linear(5, 7), nn.Tanh(), nn.Linear(7, 2), nn.Linear(2, 1))


def _gradients(network: nn.Sequential, step: int) -> None:
    """Compute gradients of a batch; in every third step the last layer is not reached."""
    rows = torch.randn(11, 5, generator=torch.Generator().manual_seed(step))
    outputs = network[:3](rows) if step % 3 == 2 else network(rows)
    outputs.square().mean().backward()


@pytest.mark.parametrize("weight_decay", [0.0, 0.01])
def test_each_step_gives_the_bits_of_torch_optim_adam_also_where_some_weights_have_no_gradient(
    weight_decay: float,
) -> None:
    ours, theirs = _network(), _network()
    optimiser = Adam(ours.parameters(), 0.01, weight_decay)
    torchs = torch.optim.Adam(theirs.parameters(), lr=0.01, weight_decay=weight_decay, fused=True)

    for step in range(12):
        optimiser.learning_rate = torchs.param_groups[0]["lr"] = 0.01 / (step + 1)
        optimiser.zero_grad()
        torchs.zero_grad(set_to_none=True)
        _gradients(ours, step)
        _gradients(theirs, step)
        optimiser.step()
        torchs.step()

    for our_weight, torch_weight in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.equal(our_weight, torch_weight)
    for number, torch_state in torchs.state_dict()["state"].items():
        assert {name: value.tolist() for name, value in torch_state.items()} == {
            name: value.tolist() for name, value in optimiser.state()[number].items()
        }


def test_an_optimiser_that_takes_over_the_state_of_another_continues_with_the_same_bits() -> None:
    uninterrupted, parts = _network(), _network()
    single, first = Adam(uninterrupted.parameters(), 0.01), Adam(parts.parameters(), 0.01)
    second = Adam(parts.parameters(), 0.01)

    for step in range(8):
        if step == 4:
            second.load({number: {**moments} for number, moments in first.state().items()})
        for network, optimiser in ((uninterrupted, single), (parts, first if step < 4 else second)):
            optimiser.zero_grad()
            _gradients(network, step)
            optimiser.step()

    assert all(torch.equal(a, b) for a, b in zip(uninterrupted.parameters(), parts.parameters(), strict=True))


def test_a_training_imports_no_compiler() -> None:
    program = (
        "import sys, torch\nfrom tacpipe.training.loop import Adam\nweight = torch.ones(3, "
        "requires_grad=True)\nweight.square().sum().backward()\nAdam([weight], 0.1).step()\nprint([name for name in "
        "('torch._dynamo', 'torch._inductor') if name in sys.modules])\n"
    )

    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert process.stdout == "[]\n"
