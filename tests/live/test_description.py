"""What a live session is asked for is compared with what its model has, before the session begins."""

from __future__ import annotations

from pathlib import Path

import pytest

from tacpipe.live.description import Described, Surfaces
from tests.conftest import Lab

RIG = Path(__file__).parents[2] / "rigs/first-paper.toml"
CALIBRATED, PLAIN = Described(("skin_taxel01_x",), 3, "count", (10, 50, 90)), Described(("skin_taxel01_x",), 3, "count")


@pytest.mark.parametrize(
    ("about", "asked", "named"),
    [
        (PLAIN, "10,90", "tacpipe calibrate MODEL"),
        (CALIBRATED, "10,25", "10,50,90, not 25"),
        (CALIBRATED, "ten", "--quantiles ten is not a list of percentages"),
        (Surfaces(("cork", "felt")), "10,90", "of the kind material; --steps, --quantiles"),
    ],
)
def test_quantiles_that_a_model_does_not_have_are_refused_before_the_session_begins(
    about: Described | Surfaces, asked: str, named: str, lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tacpipe.live.description.described", lambda model, **_: (about, "0" * 64))
    Path("rig.toml").write_text(RIG.read_text())
    ran = lab.call(f"live rig.toml --model models/f --quantiles {asked}")
    assert ran.code == 2 and named in ran.err.replace("\n", " ")
