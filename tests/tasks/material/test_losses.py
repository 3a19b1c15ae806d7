from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import log_loss
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models.recurrent_autoencoder import AutoencoderShape, RecurrentAutoencoder, RecurrentClassifier
from tacpipe.tasks.material.losses import NONE, BatchPairs, JointWork, ScaledSlides, Weights, permuted_classes
from tacpipe.training.following import Line

CLASSES = torch.tensor([0, 1, 2, 0, 1, 2, 0, 1])
SHAPES = {"a": AutoencoderShape(4, 3, hidden=6, latents=5), "b": AutoencoderShape(7, 3, hidden=6, latents=5)}


def touch(sensor: str, classes: Tensor = CLASSES) -> ScaledSlides:
    generator = torch.Generator().manual_seed(len(sensor) + SHAPES[sensor].channels)
    return ScaledSlides(torch.randn(len(classes), 9, SHAPES[sensor].channels, generator=generator), classes)


def networks(architecture: str = "raec") -> nn.ModuleDict:
    torch.manual_seed(5)
    network_class = {"raec": RecurrentAutoencoder, "x-lstm": RecurrentClassifier}[architecture]
    return nn.ModuleDict({name: network_class(shape) for name, shape in SHAPES.items()})


def work(weights: Weights, frozen: str = "", **classes: Tensor) -> JointWork:
    slides_by_sensor = {name: touch(name, classes.get(name, CLASSES)) for name in SHAPES}
    pairs = BatchPairs({name: sensor_slides.classes for name, sensor_slides in slides_by_sensor.items()}, 16)
    return JointWork(slides_by_sensor, slides_by_sensor, pairs, weights, frozen)


def batch(job: JointWork) -> dict[str, Tensor]:
    torch.manual_seed(1)
    (only_batch,) = job.batches(0)
    return only_batch


def parts(model: nn.ModuleDict, job: JointWork, rows: dict[str, Tensor]) -> dict[str, Any]:
    """The losses of a batch, one by one, told by numpy and scikit-learn."""
    losses: dict[str, Any] = {}
    with torch.no_grad():
        outputs = {name: model[name](job.training[name].batch(rows[name])) for name in SHAPES}
    for name, output in outputs.items():
        scores = output.scores.numpy().astype(np.float64)
        chances = np.exp(scores) / np.exp(scores).sum(axis=1, keepdims=True)
        losses[f"{name} classes"] = log_loss(job.training[name].classes[rows[name]], chances, labels=[0, 1, 2])
        frames = job.training[name].batch(rows[name]).numpy()
        losses[f"{name} frames"] = np.mean((output.frames.numpy() - frames) ** 2)
    losses["latents"] = np.mean((outputs["a"].latents.numpy() - outputs["b"].latents.numpy()) ** 2)
    return losses


def test_the_loss_is_the_weighted_sum_of_its_parts_and_latents_count_from_their_epoch_on() -> None:
    weights = Weights(reconstruction=0.3, classification=2.0, alignment=0.7, align_from=20)
    job, model = work(weights), networks()
    rows = batch(job)
    losses = parts(model, job, rows)
    expected = sum(2.0 * losses[f"{name} classes"] + 0.3 * losses[f"{name} frames"] for name in SHAPES)
    early, late = (float(job.loss(model, rows, epoch)[0].detach()) for epoch in (19, 20))
    assert early == pytest.approx(expected, rel=1e-5)
    assert late == pytest.approx(expected + 0.7 * losses["latents"], rel=1e-5)


def test_before_its_epoch_the_alignment_moves_no_weight() -> None:
    def gradients(weights: Weights, epoch: int) -> list[Tensor]:
        job, model = work(weights), networks()
        job.loss(model, batch(job), epoch)[0].backward()  # type: ignore[no-untyped-call]
        return [torch.zeros_like(weight) if weight.grad is None else weight.grad for weight in model.parameters()]

    independent, joint = Weights(alignment=0.0), Weights(alignment=1.0)
    for unaligned, aligned in zip(gradients(independent, 19), gradients(joint, 19), strict=True):
        assert torch.equal(unaligned, aligned)
    assert any(not torch.equal(a, b) for a, b in zip(gradients(independent, 20), gradients(joint, 20), strict=True))


def test_a_known_sensor_gets_no_gradient_and_the_others_learn_no_class() -> None:
    job, model = work(Weights(0.05, 1.0, 1.0, 0), frozen="a"), networks()
    model["a"].requires_grad_(False)
    rows = batch(job)
    loss, _ = job.loss(model, rows, 0)
    losses = parts(model, job, rows)
    assert float(loss.detach()) == pytest.approx(0.05 * losses["b frames"] + losses["latents"], rel=1e-5)
    loss.backward()  # type: ignore[no-untyped-call]
    assert all(weight.grad is None for weight in model["a"].parameters())
    assert all(weight.grad is None for weight in model["b"].classifier.parameters())  # type: ignore[union-attr]
    assert model["b"].encoder.weight_ih_l0.grad.abs().sum() > 0  # type: ignore[union-attr, operator]


def test_slides_without_label_are_made_again_and_neither_named_nor_aligned() -> None:
    hidden = torch.where(CLASSES == 2, NONE, CLASSES)
    job, model = work(Weights(align_from=0), b=hidden), networks()
    rows = batch(job)

    total = float(job.loss(model, rows, 0)[0].detach())
    labelled = (rows["b"] != NONE) & (rows["a"] != NONE)
    with torch.no_grad():
        a, b = (model[name](job.training[name].batch(rows[name][labelled])) for name in SHAPES)
        outputs = {name: model[name](job.training[name].batch(rows[name][rows[name] != NONE])) for name in SHAPES}
    expected = float(nn.functional.mse_loss(a.latents, b.latents))
    for name in SHAPES:
        classes = job.training[name].classes[rows[name][rows[name] != NONE]]
        has_label = classes != NONE
        expected += float(nn.functional.cross_entropy(outputs[name].scores[has_label], classes[has_label]))
        frames = job.training[name].batch(rows[name][rows[name] != NONE])
        expected += 0.01 * float(nn.functional.mse_loss(outputs[name].frames, frames))
    assert total == pytest.approx(expected, rel=1e-5)


def test_an_epochs_line_tells_accuracy_as_a_share_of_all_validation_slides() -> None:
    job, model = work(Weights()), networks()
    batch(job)
    line = job.validate(model)
    for name in SHAPES:
        predicted = model[name](job.validation[name].batch(torch.arange(8))).scores.argmax(dim=1)
        assert line["val"][name]["accuracy"] == int((predicted == CLASSES).sum()) / 8


def test_joint_networks_are_chosen_together_and_others_each_for_itself() -> None:
    accuracies = {"a": {"accuracy": 0.5}, "b": {"accuracy": 1.0}}
    line: Line = {"epoch": 7, "train_loss": 1.0, "val_loss": 0.5, "val": accuracies}
    assert work(Weights()).ranks(line) == {"": (0.25, -7)}
    assert work(Weights(alignment=0.0)).ranks(line) == {"a.": (0.5, -7), "b.": (0.0, -7)}


def test_a_network_without_decoder_learns_from_classes_alone() -> None:
    job, model = work(Weights(alignment=0.0)), networks("x-lstm")
    rows = batch(job)
    with torch.no_grad():
        expected = sum(
            nn.functional.cross_entropy(model[name](job.training[name].batch(rows[name])).scores, CLASSES[rows[name]])
            for name in SHAPES
        )
    assert float(job.loss(model, rows, 30)[0].detach()) == pytest.approx(float(expected), rel=1e-6)
    assert "reconstruction" not in job.validate(model)["val"]["a"]


def test_contrast_is_the_supervised_contrastive_loss_between_sensors() -> None:
    job, model = work(Weights(0.0, 0.0, 1.0, 0, "contrast")), networks()
    rows = batch(job)
    with torch.no_grad():
        latents = {name: model[name](job.training[name].batch(rows[name])).latents.numpy() for name in SHAPES}
    units = {name: vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for name, vectors in latents.items()}
    classes, terms = CLASSES[rows["a"]].numpy(), []
    for sensor, partner in (("a", "b"), ("b", "a")):
        for i, unit in enumerate(units[sensor]):
            chances = np.exp(units[partner] @ unit / 0.1)
            same = classes == classes[i]
            terms.append(-np.log(chances[same] / chances.sum()).mean())
    assert float(job.loss(model, rows, 0)[0].detach()) == pytest.approx(np.mean(terms), rel=1e-4)


def test_an_unknown_alignment_loss_is_refused() -> None:
    with pytest.raises(TacpipeError, match="alignment_loss is 'love'"):
        Weights(alignment_loss="love")


LABELS = torch.arange(600) % 20


def two(**changed: Any) -> BatchPairs:
    return BatchPairs({"a": LABELS, "b": LABELS.flip(0)}, 32, **changed)


def visited(pairs: BatchPairs, sensor: str) -> list[int]:
    return [int(row) for batch in pairs.epoch() for row in batch[sensor] if row != NONE]


@pytest.mark.parametrize("percent, count", [(100, 576), (90, 512), (50, 288), (25, 160), (17, 96), (11, 64)])
def test_a_reduced_sensor_learns_from_the_same_few_slides_in_every_epoch(percent: int, count: int) -> None:
    whole = two(pairing="fixed", shuffle=False, drop_last=True)
    reduced = two(pairing="fixed", shuffle=False, subsample_sensor="b", subsample_percent=percent)
    order = visited(whole, "b")
    every = {100: 1, 50: 2, 25: 4, 17: 6, 11: 9}.get(percent)
    kept = [n for n in range(18) if (n % every == 0 if every else n % 10)]
    assert visited(reduced, "b") == [row for n in kept for row in order[32 * n : 32 * n + 32]]
    assert len(visited(reduced, "b")) == count
    assert visited(reduced, "b") == visited(reduced, "b")
    assert visited(reduced, "a") == visited(whole, "a")
    assert len(visited(reduced, "a")) == 576


def test_every_slide_is_seen_once_an_epoch_and_the_last_batch_is_not_dropped() -> None:
    pairs = two()
    assert [len(batch["a"]) for batch in pairs.epoch()] == [32] * 18 + [24]
    for sensor in "ab":
        assert sorted(visited(pairs, sensor)) == list(range(600))


def test_dropping_the_last_batch_leaves_whole_ones() -> None:
    assert [len(batch["a"]) for batch in two(drop_last=True).epoch()] == [32] * 18


@given(st.lists(st.integers(0, 3), min_size=1, max_size=30), st.lists(st.integers(-1, 3), min_size=1, max_size=30))
def test_the_slides_of_a_row_are_of_the_same_class(first_classes: list[int], second_classes: list[int]) -> None:
    pairs = BatchPairs({"a": torch.tensor(first_classes), "b": torch.tensor(second_classes)}, 4)
    rows = [row for batch in pairs.epoch() for row in zip(batch["a"].tolist(), batch["b"].tolist(), strict=True)]
    for first, second in rows:
        if NONE not in (first, second):
            assert first_classes[first] == second_classes[second]
    assert sorted(first for first, _ in rows if first != NONE) == list(range(len(first_classes)))
    assert sorted(second for _, second in rows if second != NONE) == list(range(len(second_classes)))
    assert (NONE, NONE) not in rows
    both = sum(NONE not in row for row in rows)
    assert both == sum(min(first_classes.count(kind), second_classes.count(kind)) for kind in range(4))


def test_permuted_pairs_are_of_the_partner_class_and_of_no_class_with_itself() -> None:
    partners = permuted_classes(range(20), seed=3)
    assert sorted(partners) == sorted(partners.values()) == list(range(20))
    assert all(row != partner for row, partner in partners.items())
    pairs = two(pairing="permuted", partners=partners)
    for batch in pairs.epoch():
        for first, second in zip(batch["a"].tolist(), batch["b"].tolist(), strict=True):
            assert partners[first % 20] == (599 - second) % 20


def test_random_pairs_differ_from_epoch_to_epoch_and_fixed_ones_do_not() -> None:
    def matched(pairs: BatchPairs) -> set[tuple[int, int]]:
        return {row for batch in pairs.epoch() for row in zip(batch["a"].tolist(), batch["b"].tolist(), strict=True)}

    fixed, random, unshuffled = two(pairing="fixed"), two(), two(shuffle=False)
    assert matched(fixed) == matched(fixed)
    assert matched(unshuffled) == matched(unshuffled)
    assert matched(random) != matched(random)
    assert visited(fixed, "a") != visited(fixed, "a")
    assert visited(unshuffled, "a") == visited(unshuffled, "a")


def test_the_same_state_of_the_generator_gives_the_same_epoch() -> None:
    pairs = two()
    torch.manual_seed(7)
    first = visited(pairs, "b")
    torch.manual_seed(7)
    assert visited(pairs, "b") == first


def test_three_sensors_are_dealt_side_by_side() -> None:
    pairs = BatchPairs({"a": LABELS[:40], "b": LABELS[:60], "c": LABELS[:20]}, 16)
    rows = [row for batch in pairs.epoch() for row in zip(*(batch[name].tolist() for name in "abc"), strict=True)]
    assert len(rows) == 60
    for row in rows:
        assert len({number % 20 for number in row if number != NONE}) == 1


@pytest.mark.parametrize(
    "changed, sentence",
    [
        ({"pairing": "none"}, "pairing is 'none'"),
        ({"subsample_percent": 30, "subsample_sensor": "a", "shuffle": False}, "subsample_percent is 30"),
        ({"subsample_sensor": "c", "shuffle": False}, "subsample_sensor is c"),
        ({"subsample_sensor": "a", "subsample_percent": 50}, "give --no-shuffle"),
    ],
)
def test_what_cannot_be_dealt_is_refused(changed: dict[str, object], sentence: str) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        two(**changed)


def test_one_material_has_no_other_to_be_paired_with() -> None:
    with pytest.raises(TacpipeError, match="1 material cannot be paired"):
        permuted_classes([4], seed=0)
