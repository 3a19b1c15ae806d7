from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from sklearn.metrics import log_loss
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models.recurrent_autoencoder import RecurrentAutoencoder, RecurrentClassifier, Shape
from tacpipe.tasks.material.losses import NONE, JointWork, Pairs, ScaledSlides, Weights

CLASSES = torch.tensor([0, 1, 2, 0, 1, 2, 0, 1])
SHAPES = {"a": Shape(4, 3, hidden=6, latents=5), "b": Shape(7, 3, hidden=6, latents=5)}


def touched(sensor: str, classes: Tensor = CLASSES) -> ScaledSlides:
    generator = torch.Generator().manual_seed(len(sensor) + SHAPES[sensor].channels)
    return ScaledSlides(torch.randn(len(classes), 9, SHAPES[sensor].channels, generator=generator), classes)


def networks(architecture: str = "raec") -> nn.ModuleDict:
    torch.manual_seed(5)
    made = {"raec": RecurrentAutoencoder, "x-lstm": RecurrentClassifier}[architecture]
    return nn.ModuleDict({name: made(shape) for name, shape in SHAPES.items()})


def work(weights: Weights, frozen: str = "", **classes: Tensor) -> JointWork:
    given = {name: touched(name, classes.get(name, CLASSES)) for name in SHAPES}
    pairs = Pairs({name: one.classes for name, one in given.items()}, 16)
    return JointWork(given, given, pairs, weights, frozen)


def batch(job: JointWork) -> dict[str, Tensor]:
    torch.manual_seed(1)
    (found,) = job.batches(0)
    return found


def parts(model: nn.ModuleDict, job: JointWork, rows: dict[str, Tensor]) -> dict[str, Any]:
    """The losses of a batch, one by one, told by numpy and scikit-learn."""
    found: dict[str, Any] = {}
    with torch.no_grad():
        told = {name: model[name](job.training[name].batch(rows[name])) for name in SHAPES}
    for name, one in told.items():
        scores = one.scores.numpy().astype(np.float64)
        chances = np.exp(scores) / np.exp(scores).sum(axis=1, keepdims=True)
        found[f"{name} classes"] = log_loss(job.training[name].classes[rows[name]], chances, labels=[0, 1, 2])
        frames = job.training[name].batch(rows[name]).numpy()
        found[f"{name} frames"] = np.mean((one.frames.numpy() - frames) ** 2)
    found["latents"] = np.mean((told["a"].latents.numpy() - told["b"].latents.numpy()) ** 2)
    return found


def test_the_loss_is_the_weighted_sum_of_its_parts_and_latents_count_from_their_epoch_on() -> None:
    weights = Weights(reconstruction=0.3, classification=2.0, alignment=0.7, align_from=20)
    job, model = work(weights), networks()
    rows = batch(job)
    found = parts(model, job, rows)
    own = sum(2.0 * found[f"{name} classes"] + 0.3 * found[f"{name} frames"] for name in SHAPES)
    early, late = (float(job.loss(model, rows, epoch)[0].detach()) for epoch in (19, 20))
    assert early == pytest.approx(own, rel=1e-5)
    assert late == pytest.approx(own + 0.7 * found["latents"], rel=1e-5)


def test_before_its_epoch_the_alignment_moves_no_weight() -> None:
    def gradients(weights: Weights, epoch: int) -> list[Tensor]:
        job, model = work(weights), networks()
        job.loss(model, batch(job), epoch)[0].backward()  # type: ignore[no-untyped-call]
        return [torch.zeros_like(one) if one.grad is None else one.grad for one in model.parameters()]

    alone, joint = Weights(alignment=0.0), Weights(alignment=1.0)
    for one, other in zip(gradients(alone, 19), gradients(joint, 19), strict=True):
        assert torch.equal(one, other)
    assert any(not torch.equal(a, b) for a, b in zip(gradients(alone, 20), gradients(joint, 20), strict=True))


def test_a_known_sensor_gets_no_gradient_and_the_others_learn_no_class() -> None:
    job, model = work(Weights(0.05, 1.0, 1.0, 0), frozen="a"), networks()
    model["a"].requires_grad_(False)
    rows = batch(job)
    loss, _ = job.loss(model, rows, 0)
    found = parts(model, job, rows)
    assert float(loss.detach()) == pytest.approx(0.05 * found["b frames"] + found["latents"], rel=1e-5)
    loss.backward()  # type: ignore[no-untyped-call]
    assert all(weight.grad is None for weight in model["a"].parameters())
    assert all(weight.grad is None for weight in model["b"].classifier.parameters())  # type: ignore[union-attr]
    assert model["b"].encoder.weight_ih_l0.grad.abs().sum() > 0  # type: ignore[union-attr, operator]


def test_slides_without_label_are_made_again_and_neither_named_nor_aligned() -> None:
    held = torch.where(CLASSES == 2, NONE, CLASSES)
    job, model = work(Weights(align_from=0), b=held), networks()
    rows = batch(job)

    total = float(job.loss(model, rows, 0)[0].detach())
    known = (rows["b"] != NONE) & (rows["a"] != NONE)
    with torch.no_grad():
        a, b = (model[name](job.training[name].batch(rows[name][known])) for name in SHAPES)
        every = {name: model[name](job.training[name].batch(rows[name][rows[name] != NONE])) for name in SHAPES}
    wanted = float(nn.functional.mse_loss(a.latents, b.latents))
    for name in SHAPES:
        classes = job.training[name].classes[rows[name][rows[name] != NONE]]
        named = classes != NONE
        wanted += float(nn.functional.cross_entropy(every[name].scores[named], classes[named]))
        frames = job.training[name].batch(rows[name][rows[name] != NONE])
        wanted += 0.01 * float(nn.functional.mse_loss(every[name].frames, frames))
    assert total == pytest.approx(wanted, rel=1e-5)


def test_an_epochs_line_tells_accuracy_as_a_share_of_all_validation_slides() -> None:
    job, model = work(Weights()), networks()
    batch(job)
    line = job.watch(model)
    for name in SHAPES:
        named = model[name](job.validation[name].batch(torch.arange(8))).scores.argmax(dim=1)
        assert line["val"][name]["accuracy"] == int((named == CLASSES).sum()) / 8


def test_joint_networks_are_chosen_together_and_others_each_for_itself() -> None:
    line = {"epoch": 7, "val": {"a": {"accuracy": 0.5}, "b": {"accuracy": 1.0}}}
    assert work(Weights()).ranks(line) == {"": (0.25, -7)}
    assert work(Weights(alignment=0.0)).ranks(line) == {"a.": (0.5, -7), "b.": (0.0, -7)}


def test_a_network_without_decoder_learns_from_classes_alone() -> None:
    job, model = work(Weights(alignment=0.0)), networks("x-lstm")
    rows = batch(job)
    with torch.no_grad():
        wanted = sum(
            nn.functional.cross_entropy(model[name](job.training[name].batch(rows[name])).scores, CLASSES[rows[name]])
            for name in SHAPES
        )
    assert float(job.loss(model, rows, 30)[0].detach()) == pytest.approx(float(wanted), rel=1e-6)
    assert "reconstruction" not in job.watch(model)["val"]["a"]


def test_contrast_is_the_supervised_contrastive_loss_between_sensors() -> None:
    job, model = work(Weights(0.0, 0.0, 1.0, 0, "contrast")), networks()
    rows = batch(job)
    with torch.no_grad():
        latents = {name: model[name](job.training[name].batch(rows[name])).latents.numpy() for name in SHAPES}
    units = {name: one / np.linalg.norm(one, axis=1, keepdims=True) for name, one in latents.items()}
    classes, terms = CLASSES[rows["a"]].numpy(), []
    for one, other in (("a", "b"), ("b", "a")):
        for i, unit in enumerate(units[one]):
            chances = np.exp(units[other] @ unit / 0.1)
            same = classes == classes[i]
            terms.append(-np.log(chances[same] / chances.sum()).mean())
    assert float(job.loss(model, rows, 0)[0].detach()) == pytest.approx(np.mean(terms), rel=1e-4)


def test_an_unknown_alignment_loss_is_refused() -> None:
    with pytest.raises(TacpipeError, match="alignment_loss is 'love'"):
        Weights(alignment_loss="love")
