"""Rig files and params from anywhere: text is text, and no name leads out of its place."""

import os
from pathlib import Path

import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import config_text
from tacpipe.links import opening
from tacpipe.plugins import given_params, registry
from tacpipe.recording import rig
from tests.conftest import Lab, without_created_store
from tests.promises.counts import count
from tests.promises.limits import GIB, bound_memory, is_sentence, sample_cases

SMALL = GIB // 2
COMMANDS = (
    "$(touch opened)",
    "`touch opened`",
    "; touch opened",
    "| touch opened",
    "&& touch opened",
    "\n touch opened",
)
PATHS = ("../x", "../../x", "/tmp/x", "a/b", "a\\b", ".", "..", "", "a\0b", "x" * 5000, "a b", "A", "~/x", "con:")


def check_refusal(lab: Lab, command: str) -> None:
    """A command ends with a sentence and the code for usage, and has done nothing."""
    before = {path: path.stat().st_mtime_ns for path in lab.folder.rglob("*") if ".tacpipe" not in path.parts}
    with bound_memory(GIB):
        ran = lab.call(command)
    assert ran.code in (1, 2, 5), ran.err
    assert is_sentence(without_created_store(ran.err).removeprefix("tacpipe: ").rstrip("\n")), ran.err
    assert not (lab.folder / "opened").exists()
    assert {path: path.stat().st_mtime_ns for path in lab.folder.rglob("*") if ".tacpipe" not in path.parts} == before
    count("hostile inputs refused")


def quote(text: str) -> str:
    """Return a text as TOML has it."""
    if text.isprintable() and not set(text) & set('"\\'):
        return f'"{text}"'
    return '"' + "".join(c if c.isprintable() and c not in '"\\' else f"\\u{ord(c):04x}" for c in text) + '"'


def a_rig(name: str = "xela1", sensor: str = "xela", transport: str = "ws:127.0.0.1:1", further_lines: str = "") -> str:
    values = {"name": name, "sensor": sensor, "transport": transport}
    return "[[stream]]\n" + "".join(f"{key} = {quote(value)}\n" for key, value in values.items()) + further_lines


@pytest.mark.parametrize("command", sample_cases(COMMANDS, 1))
@pytest.mark.parametrize(
    "scheme", sample_cases(["", "exec:", "shell:", "sh:", "file:", "http:", "socket:", "spy:", "loop:"], 2)
)
def test_an_address_that_is_a_command_or_of_no_known_kind_is_refused(lab: Lab, command: str, scheme: str) -> None:
    (lab.folder / "rig.toml").write_text(a_rig(transport=f"{scheme}{command}"))
    check_refusal(lab, "acquire rig.toml -o data --duration-s 1")


@pytest.mark.parametrize("command", sample_cases(COMMANDS[:-1], 0))
@pytest.mark.parametrize(
    ("scheme", "sensor", "options"),
    [
        ("serial", "optoforce", ""),
        ("folder", "clouds", ""),
        ("camera", "clouds", ""),
        ("tcp", "ur-rtde", ""),
        ("udp", "tap", ""),
        ("ws", "xela", "options = { sensor = 1 }\n"),
        ("hid", "rawhid", ""),
        ("can", "paxini", ""),
    ],
)
def test_a_command_behind_a_known_scheme_is_a_place_that_is_not_there(
    lab: Lab, command: str, scheme: str, sensor: str, options: str
) -> None:
    (lab.folder / "rig.toml").write_text(a_rig("one", sensor, f"{scheme}:{command}", options))
    check_refusal(lab, "acquire rig.toml -o data --duration-s 1")


@pytest.mark.parametrize("name", sample_cases([*PATHS, *COMMANDS], 3))
def test_a_stream_cannot_be_named_so_that_it_lies_elsewhere(lab: Lab, name: str) -> None:
    if name == "A":
        name = "Xela"
    (lab.folder / "rig.toml").write_text(a_rig(name, further_lines="options = { sensor = 1 }\n"))
    check_refusal(lab, "acquire rig.toml -o data --duration-s 1")


@pytest.mark.parametrize(
    "name", sample_cases([path for path in (*PATHS, *COMMANDS) if "\0" not in path and path not in ("A", "")], 3)
)
def test_a_recording_cannot_be_named_so_that_it_lies_elsewhere(lab: Lab, name: str) -> None:
    import shlex

    (lab.folder / "rig.toml").write_text(a_rig(further_lines="options = { sensor = 1 }\n"))
    check_refusal(lab, f"acquire rig.toml -o data --duration-s 1 --name {shlex.quote(name)}")


RIGS = {
    "brackets": "a = " + "[" * 100_000,
    "a number of many digits": "master = " + "9" * 5000,
    "a long name": a_rig("x" * 1_000_000),
    "no text": "\udcff",
    "an option that is a command": a_rig(further_lines='options = { sensor = "$(touch opened)" }\n'),
    "an option that is none": a_rig(further_lines='options = { "$(touch opened)" = 1 }\n'),
    "options within options": a_rig(further_lines="options = { sensor = " + "{ a = " * 400 + "1" + " }" * 400 + " }\n"),
    "a label that is a list": a_rig() + "[labels]\nx = [1, 2]\n",
    "a sensor that is a module": a_rig(sensor="os:system"),
    "a terminal's commands": a_rig(sensor="\x1b[2J\x1b]0;x\x07"),
    "absurd sizes": a_rig(
        sensor="justfloat", transport="serial:/dev/null", further_lines="options = { channels = 100000000000 }\n"
    ),
}


@pytest.mark.parametrize("case", RIGS)
def test_a_rig_file_that_no_person_wrote_is_refused_with_a_sentence(lab: Lab, case: str) -> None:
    (lab.folder / "rig.toml").write_bytes(RIGS[case].encode("utf-8", "surrogateescape"))
    check_refusal(lab, "acquire rig.toml -o data --duration-s 1")


@pytest.mark.parametrize("kind", ["folder", "pipe", "endless", "empty"])
@pytest.mark.parametrize("name", ["rig.toml", "params.yaml"])
def test_what_is_no_file_is_no_rig_and_no_params(lab: Lab, kind: str, name: str) -> None:
    path = lab.folder / name
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "endless":
        path.symlink_to("/dev/zero")
    else:
        path.touch()
    words = (
        "acquire rig.toml -o data" if name == "rig.toml" else "simulate toy -o data --params params.yaml --block toy"
    )
    check_refusal(lab, words)


def test_labels_of_a_rig_are_text_and_nothing_else() -> None:
    parsed = rig.parse(
        a_rig(further_lines="options = { sensor = 1 }\n") + f"[labels]\nnote = {quote('$(touch opened)')}\n"
    )
    assert parsed.labels == {"note": "$(touch opened)"}


def test_an_address_is_no_expression_of_another_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for scheme, place in (("serial", "spy:///dev/null?file=opened"), ("serial", "socket://127.0.0.1:1")):
        stream = rig.parse(a_rig("one", "optoforce", f"{scheme}:{place}")).streams["one"]
        with pytest.raises(TacpipeError, match="no port"):
            opening.open_link(stream.address, stream.sensor, "one")
    assert not (tmp_path / "opened").exists()


# ---- params.yaml

DEEP = "&a0 [1, 2, 3, 4, 5, 6, 7, 8, 9]"
BOMB = f"a0: {DEEP}\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12))
MERGES = "a0: &a0 {x: 1, y: 2}\n" + "".join(
    f"a{n}: &a{n}\n  <<: [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12)
)
YAMLS = {
    "a call": "synchronize: !!python/object/apply:os.system ['touch opened']",
    "an object": "synchronize: !!python/object/new:os.system ['touch opened']",
    "a module": "synchronize: !!python/module:os",
    "a name": "synchronize: !!python/name:os.system",
    "aliases of aliases": BOMB + "synchronize: *a11\n",
    "aliases of aliases as a value": BOMB + "synchronize: {rate_hz: *a11}\n",
    "merges of merges": MERGES + "synchronize: *a11\n",
    "a list in itself": "synchronize: &a [*a]",
    "a mapping in itself": "synchronize: &a {rate_hz: *a}",
    "many brackets": "synchronize: " + "[" * 100_000 + "]" * 100_000,
    "many braces": "synchronize: " + "{a: " * 100_000,
    "many dashes": "synchronize:\n" + "- " * 100_000,
    "a date that is none": "synchronize: {rate_hz: 2001-99-99}",
    "a time that is none": "synchronize: {rate_hz: !!timestamp x}",
    "a number of many digits": f"synchronize: {{rate_hz: {'9' * 5000}}}",
    "a number that is none": "synchronize: {rate_hz: !!int x}",
    "a float that is none": "synchronize: {rate_hz: !!float x}",
    "more than a float holds": f"synchronize: {{rate_hz: {'9' * 400}}}",
    "zeros": "synchronize: \0",
    "no text": "synchronize: \udcff\udcfe",
    "two documents": "a: 1\n---\nsynchronize: 2\n",
    "a long name": "synchronize: {" + "x" * 1_000_000 + ": 1}",
    "many names": "synchronize: {" + ", ".join(f"x{n}: 1" for n in range(20_000)) + "}",
    "a key that is a list": "synchronize: {[1, 2]: 3}",
    "a terminal's commands": 'synchronize: "\\e[2J"',
    "only an anchor": "synchronize: *nobody",
}


@pytest.mark.parametrize("case", YAMLS)
def test_params_that_no_person_wrote_are_refused_with_a_sentence(
    tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "params.yaml").write_bytes(YAMLS[case].encode("utf-8", "surrogateescape"))
    stage = registry.load("synchronize")
    with bound_memory(SMALL), pytest.raises(UsageError) as error:
        given_params.build("synchronize", stage, file=Path("params.yaml"), block="synchronize")
    assert is_sentence(str(error.value)), str(error.value)
    assert not (tmp_path / "opened").exists()
    count("hostile inputs refused")


@pytest.mark.parametrize("case", [case for case in YAMLS if case not in ("no text", "zeros", "two documents")])
def test_a_value_of_set_is_read_as_carefully(tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    stage = registry.load("synchronize")
    value = YAMLS[case].partition("synchronize:")[2]
    with bound_memory(SMALL), pytest.raises(UsageError) as error:
        given_params.build("synchronize", stage, sets=[f"rate_hz={value}"])
    assert not (tmp_path / "opened").exists()
    assert len(str(error.value)) < 500 or "--set" in str(error.value)
    count("hostile inputs refused")


def test_anchors_that_a_person_writes_are_read() -> None:
    text = "base: &base {rate_hz: 50, axes: [x, y]}\nother:\n  <<: *base\n  rate_hz: 100\nlist: [*base, *base]\n"
    base = {"rate_hz": 50, "axes": ["x", "y"]}
    assert config_text.load_yaml(text) == {"base": base, "other": {**base, "rate_hz": 100}, "list": [base, base]}


def test_what_aliases_stand_for_is_counted_by_what_they_name() -> None:
    thousand = "a: &a [" + ", ".join("1" * 1 for _ in range(999)) + "]\n"
    assert len(config_text.load_yaml(thousand + "b: [" + ", ".join(["*a"] * 90) + "]")["b"]) == 90  # 90,000 values
    with pytest.raises(ValueError, match="100000"):
        config_text.load_yaml(thousand + "b: [" + ", ".join(["*a"] * 110) + "]")


def test_a_sentence_stays_one_line_whatever_untrusted_text_is_in_it() -> None:
    assert str(UsageError("There is no sensor xela; there are a, b.")) == "There is no sensor xela; there are a, b."
    sentence = str(UsageError(f"The sensor {'x' * 10_000} says \x1b[2J and \udcff."))
    assert is_sentence(sentence) and sentence.endswith(r"says \x1b[2J and \udcff.") and len(sentence) < 300
