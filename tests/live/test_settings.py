"""Settings of a live session come from the rig file and, over it, from the command; errors name the place."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tacpipe.cli import live as command
from tacpipe.errors import UsageError
from tacpipe.live import plans, preparation
from tacpipe.live.preparation import LiveModel
from tacpipe.live.settings import SessionOptions, Settings, keys, task_settings
from tacpipe.recording import rig as rigs
from tacpipe.tasks.forward.live.task import ForwardSettings
from tests.conftest import Lab
from tests.live.persistent import model_of
from tests.live.sessions import TRAINED
from tests.test_docs import fenced_blocks

ROOT = Path(__file__).parents[2]
STREAM = '[[stream]]\nname = "skin"\nsensor = "xela"\ntransport = "ws:127.0.0.1:5000"\n'
FULL = {
    "model": "models/f",
    "plan": "rig:robot",
    "publish": ["ws:127.0.0.1:8765", "udp:10.0.0.2:9000"],
    "steps": [1, 5],
    "settle_ms": 3,
    "realtime": True,
    "quantiles": [10, 90],
}


def settings(file_settings: dict[str, Any], **options: Any) -> Settings:
    return Settings.from_sources(ForwardSettings, file_settings, "rig.toml", options)


def forward_settings(file_settings: dict[str, Any], **options: Any) -> ForwardSettings:
    task_settings = settings(file_settings, **options).task
    assert isinstance(task_settings, ForwardSettings)
    return task_settings


def test_what_the_file_states_counts_and_options_of_the_command_win() -> None:
    merged = settings(FULL, plan=None, realtime=False, publish=("lsl:touch",), settle_ms=1.5)
    expected = ForwardSettings("rig:robot", "", (1, 5), (10, 90))
    assert merged == Settings("models/f", ("lsl:touch",), 1.5, realtime=False, task=expected)
    assert settings({}, model="models/g") == Settings("models/g", task=ForwardSettings())


@pytest.mark.parametrize(
    ("stated", "given", "sentence"),
    [
        ({"modle": "x"}, {}, "rig.toml, live: there is no key modle; there are model, publish,"),
        ({**FULL, "settle_ms": 5000}, {}, "rig.toml, live: settle_ms is 5000; it must be a number from 0 to 1000."),
        ({**FULL, "publish": "ws:a:1"}, {}, "rig.toml, live: publish is 'ws:a:1'; it must be a list"),
        ({**FULL, "realtime": "yes"}, {}, "rig.toml, live: realtime is 'yes'; it must be true or false"),
        ({**FULL, "places": {}}, {}, "there is no key places"),
        (FULL, {"settle_ms": 5000.0}, "--settle-ms is 5000; it must be a number from 0 to 1000."),
        ({"model": "m", "rank": "contact"}, {}, "rig.toml, live: there is no key rank; there are model,"),
        ({"model": "m", "steps": [0]}, {}, "rig.toml, live: steps"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(stated: dict[str, Any], given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError) as raised:
        settings(stated, **given)
    assert sentence in str(raised.value)


def test_steps_beyond_the_horizon_are_refused_and_none_are_all() -> None:
    assert forward_settings({"model": "m"}).steps_up_to(3) == (1, 2, 3)
    assert forward_settings({"model": "m", "steps": [5, 1, 5]}).steps_up_to(10) == (1, 5)
    with pytest.raises(UsageError, match="1 to 4 steps ahead"):
        forward_settings({"model": "m", "steps": [5]}).steps_up_to(4)


def planned(plan: str, sender: str = "") -> str:
    """Return the address at which a session with this plan awaits plans."""
    return str(plans.with_plan(rigs.parse(STREAM), plan, sender).streams["plan"].address)


@pytest.mark.parametrize(
    ("plan", "sender", "address"),
    [
        ("udp::9100", "", "udp:127.0.0.1:9100"),
        ("udp:[::1]:9100", "", "udp:[::1]:9100"),
        ("udp:localhost:9100", "", "udp:localhost:9100"),
        ("udp::9100", "127.0.0.2", "udp:127.0.0.1:9100?sender=127.0.0.2"),
        ("udp:0.0.0.0:9100", "192.168.1.20", "udp:0.0.0.0:9100?sender=192.168.1.20"),
        ("udp:0.0.0.0:9100?sender=first", "", "udp:0.0.0.0:9100?sender=first"),
        ("ws:planner:9100", "", "ws:planner:9100"),
    ],
)
def test_plans_are_awaited_on_this_computer_unless_an_address_is_given(plan: str, sender: str, address: str) -> None:
    assert planned(plan, sender) == address


@pytest.mark.parametrize(
    ("plan", "sender", "sentence"),
    [
        ("udp:0.0.0.0:9100", "", "give the address of the controller with --plan-from"),
        ("udp:lab-pc:9100", "", "give the address of the controller with --plan-from"),
        ("udp::9100", "controller", "--plan-from 'controller' is not an IP address"),
        ("udp::9100?sender=first", "127.0.0.1", "leave ?sender=first of --plan out"),
        ("ws:planner:9100", "127.0.0.1", "no effect without --plan udp"),
        ("measured", "127.0.0.1", "no effect without --plan udp"),
    ],
)
def test_plans_that_anybody_could_send_are_refused(plan: str, sender: str, sentence: str) -> None:
    with pytest.raises(UsageError, match=re.escape(sentence)):
        planned(plan, sender)


def test_the_table_stays_in_the_text_of_a_rig_and_recorders_do_not_look_at_it() -> None:
    text = STREAM + '[live]\nmodel = "models/f"\npublish = ["udp:127.0.0.1:9000"]\nsettle_ms = 3\n'
    rig = rigs.parse(text)
    assert rig.live == {"model": "models/f", "publish": ["udp:127.0.0.1:9000"], "settle_ms": 3}
    assert rigs.parse(rigs.to_toml(rig)).live == rig.live
    assert rigs.parse(STREAM + '[live]\nanything = "else"\n').live  # `tacpipe acquire` records such a rig
    with pytest.raises(UsageError, match="live is 3; it must be a table"):
        rigs.parse("live = 3\n" + STREAM)


@pytest.mark.parametrize("page", ["docs/rig.md", "docs/howto/live.md"])
def test_the_examples_of_the_pages_are_read(page: str) -> None:
    texts = [block.text for block in fenced_blocks((ROOT / page).read_text()) if block.language == "toml"]
    examples = [text for text in texts if "[live]" in text]
    assert examples
    for text in examples:
        file_settings = tomllib.loads(text)["live"]
        assert settings(file_settings).model == file_settings["model"]
        if "[[stream]]" in text:
            assert rigs.parse(text).live == file_settings


def test_the_page_of_the_rig_file_names_every_key() -> None:
    table = (ROOT / "docs" / "rig.md").read_text().split("| key of `[live]` |")[1].split("\n\n")[0]
    kinds: list[Any] = [Settings, *task_settings().values()]
    assert all(f"`{name}`" in table for kind in kinds for name in keys(kind))


@pytest.mark.long
def test_a_session_is_what_the_file_states_but_for_the_options_given(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    for training_command in TRAINED:
        lab.run(training_command)
    table = 'model = "models/f"\nplan = "udp::9100"\nsteps = [2]\nsettle_ms = 3\n'
    Path("rig.toml").write_text(f"{STREAM}[live]\n{table}")
    prepared_sessions: list[Any] = []
    monkeypatch.setattr(command, "_run", lambda prepared, *arguments, **keywords: prepared_sessions.append(prepared))
    lab.run("live rig.toml --settle-ms 1 --publish udp:127.0.0.1:9000")
    (prepared,) = prepared_sessions
    common, task_settings = prepared.options.settings, prepared.options.settings.task
    assert common.model == str(Path("models/f").absolute()) and task_settings.steps == (2,) and common.settle_ms == 1.0
    assert common.publish == ("udp:127.0.0.1:9000",) and "plan" in prepared.options.streams
    assert prepared.attributes["live_plan"] == "udp::9100"
    assert SessionOptions.from_json(prepared.options.to_json()) == prepared.options


@pytest.mark.long
def test_a_value_of_the_file_that_the_session_refuses_is_named_with_the_file(lab: Lab) -> None:
    for training_command in TRAINED:
        lab.run(training_command)
    for line, sentence in (
        ('plan = "carrier pigeon"', "rig.toml, live: plan 'carrier pigeon' is not a source of plans"),
        ('plan = "rig:arm"', "rig.toml, live: plan 'rig:arm': the rig has no stream"),
        ('publish = ["ftp:a"]', "rig.toml, live: publish"),
        ("steps = [9]", "rig.toml, live: The steps 9"),
    ):
        Path("rig.toml").write_text(f'{STREAM}[live]\nmodel = "models/f"\n{line}\n')
        ran = lab.call("live rig.toml")
        assert ran.code == 2 and sentence in ran.err, ran.err
    Path("rig.toml").write_text(STREAM)
    ran = lab.call("live rig.toml")
    assert ran.code == 2 and 'state model = "models/forward" in the table [live] of rig.toml' in " ".join(
        ran.err.split()
    )
    Path("rig.toml").write_text(f'{STREAM}[live]\nmodel = "models/none"\n')
    ran = lab.call("live rig.toml")
    assert ran.code == 2 and "rig.toml, live: " in ran.err and "models/none" in ran.err, ran.err


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
