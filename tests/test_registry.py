from importlib.metadata import entry_points
from pathlib import Path

import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins import registry
from tests.conftest import Lab, forget


def test_the_names_are_those_that_importlib_finds() -> None:
    forget()
    for group in (registry.STAGES, registry.FORMATS, registry.TASKS):
        expected = {point.name: point.value for point in entry_points(group=group)}
        assert {**expected} == {name: registry.entry_points()[group].get(name) for name in expected}
        assert expected


@pytest.mark.parametrize("name", sorted(registry.stages()))
def test_every_built_in_stage_loads_and_has_a_summary_and_help_for_each_param(name: str) -> None:
    from tacpipe.plugins import params

    found = registry.load(name)
    assert found.version >= 1
    assert registry.summary(name).endswith(".")
    assert set(params.comments(found)) >= set(params.fields(found))


def test_a_third_party_s_stage_stands_beside_the_built_in_ones(lab: Lab) -> None:
    assert "scale" in lab.run("--help").out
    assert "times" not in lab.run("--help").out
    assert "that every value is multiplied by" in lab.run("scale --help").out


def test_a_broken_plug_in_spoils_its_own_name_alone(lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "broken"
    (broken / "b.egg-info").mkdir(parents=True)
    (broken / "b.egg-info/entry_points.txt").write_text(
        "[tacpipe.stages]\nlost = nowhere:f\nwrong = syntax_of:f\nplain = plain_of:f\nsegment.lost = nowhere:g\n"
    )
    (broken / "syntax_of.py").write_text("def f(:\n")
    (broken / "plain_of.py").write_text('"""Say nothing."""\n\nf = 3\n')
    monkeypatch.syspath_prepend(broken)
    forget()
    assert lab.call("--help").code == 0
    assert lab.call("segment contacts --help").code == 0
    lab.run("simulate toy -o data/r")
    failed = lab.call("lost data/r -o data/x")
    assert failed.code == 1 and "nowhere" in failed.err
    assert "no stage" in lab.call("plain data/r -o data/x").err


def test_an_unknown_stage_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="there are"):
        registry.load("polish")
    with pytest.raises(TacpipeError, match="no task"):
        registry.load_task("polish")
