"""Requested quantiles are compared with those of the model before the session begins."""

from __future__ import annotations

from pathlib import Path

import pytest

from tacpipe.live import preparation
from tacpipe.live.preparation import LiveModel
from tests.conftest import Lab
from tests.live.persistent import model_of

RIG = Path(__file__).parents[2] / "rigs/first-paper.toml"
INPUTS = {"tactile": ["skin_taxel01_x"]}
PLAIN = model_of("forward", horizon=3, inputs=INPUTS)
CALIBRATED = model_of("forward", horizon=3, inputs=INPUTS, quantiles={"levels": [10, 50, 90]})
MATERIAL = model_of("material", classes=[0, 1])


@pytest.mark.parametrize(
    ("about", "levels", "sentence"),
    [
        (PLAIN, "10,90", "tacpipe calibrate MODEL"),
        (CALIBRATED, "10,25", "10,50,90, not 25"),
        (CALIBRATED, "ten", "--quantiles is ('ten',); it must be a list"),
        (MATERIAL, "10,90", "This model has no setting --quantiles"),
    ],
)
def test_quantiles_that_a_model_does_not_have_are_refused_before_the_session_begins(
    about: LiveModel, levels: str, sentence: str, lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preparation, "open_model", lambda path: about)
    Path("rig.toml").write_text(RIG.read_text())
    ran = lab.call(f"live rig.toml --model models/f --quantiles {levels}")
    assert ran.code == 2 and sentence in ran.err.replace("\n", " ")
