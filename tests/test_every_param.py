"""Every param of every stage says what it may be, and what it may not be is refused before anything is read."""

import ast
import dataclasses
import inspect
import json
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest

from tacpipe.clouds.geometry import NORMALISATIONS
from tacpipe.codecs.autoencoder_fit import FRAMES, MAX_SEARCH
from tacpipe.datasets.splits import SCHEMES
from tacpipe.errors import UsageError
from tacpipe.models.point_networks import BACKBONES, HEADS
from tacpipe.models.recurrent_autoencoder import DECODERS
from tacpipe.plugins import fields, given_params, registry
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import CommaList, Range, Unit
from tacpipe.simulation.grasp_scene import FAMILIES, MODULI_PA
from tacpipe.simulation.slide import SPECTRA
from tacpipe.simulation.trajectory import PROTOCOLS
from tacpipe.tasks.forward.networks import ACTIONS
from tacpipe.tasks.material.losses import BATCH_STEPS, PAIRINGS
from tacpipe.tasks.touch.inputs import MODES, WRISTS
from tacpipe.tasks.touch.members import LOSSES
from tacpipe.training.scaling import KINDS
from tests.conftest import Ran, forget, write_plugin

Call = Callable[[str], Ran]
STAGES = [name for name in registry.stages() if registry.load(name).function.__module__.startswith("tacpipe")]
FREE = {  # params that are any text, and why
    "synchronize.master": "the name of a stream",
    "synchronize.truth": "patterns of columns of recordings",
    "segment.slips.channel": "the name of a column",
    "split.stratify": "attributes of recordings, which are the lab's own",
    "split.few_by": "an attribute of recordings",
    "split.few_of": "an attribute and its value; `check` looks at the form",
    "split.apart": "an attribute of recordings",
    "split.group": "attributes of recordings, which are the lab's own",
    "split.by": "an attribute of recordings",
    "train.forward.arm": "a stream of recordings",
    "train.material.label": "a label of recordings, which are the lab's own",
    "train.material.sensors": "sensors of recordings, which plug-ins may add",
    "train.material.quantities": "quantities of columns, which plug-ins may add",
    "train.material.subsample_sensor": "a sensor of recordings",
    "train.material.frozen_sensor": "a sensor of recordings",
    "train.material.run_label": "words for a report",
    "train.regress.target": "patterns of columns of recordings",
    "train.classify.label": "a label, a column or a kind of intervals, which are the lab's own",
    **{
        f"train.{task}.{param}": reason
        for task in ("regress", "classify")
        for param, reason in (
            ("inputs", "patterns of columns of recordings"),
            ("recentre", "a label of recordings"),
            ("group", "labels of recordings, which are the lab's own"),
        )
    },
    "train.slip.streams": "patterns of streams of recordings",
    "train.touch.run_label": "words for a report",
    "report.title": "words for a report",
    "extract.depth.map": "the path of a file",
    "extract.depth.map_sha256": "the digest of a file",
    "extract.gel-map.background": "the path of a file",
    "extract.gel-map.background_sha256": "the digest of a file",
    "extract.encoder.encoder": "an encoder, which plug-ins may add",
    "extract.encoder.weights": "the path of a file",
    "extract.encoder.weights_sha256": "the digest of a file",
    "export.card.title": "words for a page",
    "export.card.description": "words for a page",
    "export.card.license": "the identifier of any licence",
    "export.card.creators": "names",
    "export.card.url": "an address",
    "export.card.published": "a date, which is printed as it is given",
    "export.card.cite_as": "words for a page",
    "export.hdf5.actions": "the name of a stream",
    "export.hdf5.master": "the name of a stream",
    "export.lerobot.actions": "the name of a stream",
    "export.lerobot.master": "the name of a stream",
    "export.lerobot.robot_type": "the name of a robot",
    "export.lerobot.state": "names of streams",
    "export.lerobot.task": "words, with labels of recordings",
    "export.zarr.actions": "the name of a stream",
    "export.zarr.master": "the name of a stream",
}

SELECTING = [name for name in STAGES if name.startswith(("extract.", "ingest.", "segment.", "synchronize"))]
FREE |= {f"{name}.{field}": "names of streams" for name in SELECTING for field in ("streams", "without")}


def every_param() -> Iterator[tuple[str, Any, str, Any]]:
    """Yield stage, kind of params, name and annotation of every field."""
    for name in STAGES:
        for kind in params_of.kinds(registry.load(name)):
            for field, annotation in fields.hints(kind).items():
                yield name, kind, field, annotation


def tag_option(name: str, kind: Any) -> dict[str, Any]:
    """Return the option that chooses a kind of params, if there are several."""
    tag = params_of.tag(registry.load(name))
    return {tag: get_args(fields.bare(fields.hints(kind)[tag]))[0]} if tag else {}


def values_outside(annotation: Any) -> Iterator[Any]:
    """Yield values just outside of each end of a range."""
    is_integer = fields.bare(annotation) is int
    for constraint in fields.constraints(annotation):
        if isinstance(constraint, Range):
            yield from () if constraint.minimum is None else (constraint.minimum - (1 if is_integer else 0.001),)
            yield from () if constraint.maximum is None else (constraint.maximum + (1 if is_integer else 0.001),)
            yield from () if constraint.above is None else (constraint.above,)
            yield from () if constraint.below is None else (constraint.below,)
            yield from () if is_integer else (math.nan, math.inf)


def command(name: str, options: dict[str, Any]) -> str:
    """Return a command line whose inputs do not exist, which would be found out next."""
    words = [f"--{key.replace('_', '-')}={value}" for key, value in options.items()]
    split = "--split nowhere" if registry.load(name).needs_split else ""
    inputs = {"simulate": "", **dict.fromkeys(("calibrate", "evaluate", "predict", "recentre"), "nowhere nowhere")}
    return f"{name.replace('.', ' ')} {inputs.get(name.partition('.')[0], 'nowhere')} {split} -o out {' '.join(words)}"


RANGED = {
    (name, kind, field): annotation
    for name, kind, field, annotation in every_param()
    if any(True for _ in values_outside(annotation))
}
CHOICES = {
    (name, kind, field): annotation
    for name, kind, field, annotation in every_param()
    if get_origin(fields.bare(annotation)) is Literal
}


def test_every_param_is_a_choice_a_range_a_list_a_truth_or_free_for_a_reason() -> None:
    free = {
        f"{name}.{field}"
        for name, _, field, annotation in every_param()
        if fields.bare(annotation) is not bool
        and get_origin(fields.bare(annotation)) is not Literal
        and not any(
            not (isinstance(constraint, CommaList) and constraint.item_type is str)
            for constraint in fields.constraints(annotation)
        )
    }
    assert free == set(FREE)
    assert len(RANGED) > 100 and len(CHOICES) > 40


@pytest.mark.parametrize("name", SELECTING)
def test_streams_are_selected_by_the_same_options_which_are_in_keys_only_where_they_are_given(name: str) -> None:
    kind = params_of.kinds(registry.load(name))[0]
    required = {"layout": json.dumps({"streams": {}})} if name == "ingest.table" else {}
    assert not {"streams", "without"} & set(params_of.to_json(kind(**required)))
    assert params_of.to_json(kind(**required, without="a"))["without"] == "a"


@pytest.mark.parametrize("key", RANGED, ids=lambda key: f"{key[0]}.{key[1].__name__}.{key[2]}")
def test_a_number_out_of_its_range_ends_with_code_2_before_anything_is_read(
    key: tuple[str, Any, str], tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, kind, field = key
    monkeypatch.chdir(tmp_path)
    stage = registry.load(name)
    for value in values_outside(RANGED[key]):
        ran = call(command(name, {**tag_option(name, kind), field: value}))
        assert (ran.code, ran.out) == (2, ""), ran
        flag = f"--{field.replace('_', '-')}"
        assert (
            ran.err == f"tacpipe: {flag} is {fields.format_value(value)}; it must be {fields.describe(RANGED[key])}.\n"
        )
        with pytest.raises(UsageError, match=f"{field} is "):
            given_params.build(
                name, stage, sets=[*(f"{k}={v}" for k, v in tag_option(name, kind).items()), f"{field}={value}"]
            )
        with pytest.raises(UsageError, match=f"preset odd of {name}: {field} is "), monkeypatch.context() as patched:
            patched.setattr(kind, "PRESETS", {"odd": {field: value}}, raising=False)
            given_params.build(name, stage, preset="odd", options=tag_option(name, kind))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("key", RANGED, ids=lambda key: f"{key[0]}.{key[1].__name__}.{key[2]}")
def test_the_ends_of_a_range_belong_to_it_or_not_as_it_says(key: tuple[str, Any, str]) -> None:
    for constraint in fields.constraints(RANGED[key]):
        if isinstance(constraint, Range):
            assert all(
                fields.fits(end, RANGED[key]) for end in (constraint.minimum, constraint.maximum) if end is not None
            )
            assert not any(
                fields.fits(end, RANGED[key]) for end in (constraint.above, constraint.below) if end is not None
            )
            default = key[1].__dataclass_fields__[key[2]].default
            assert fields.fits(default, RANGED[key])


@pytest.mark.parametrize("key", CHOICES, ids=lambda key: f"{key[0]}.{key[1].__name__}.{key[2]}")
def test_a_word_that_is_no_choice_ends_with_code_2_before_anything_is_read(
    key: tuple[str, Any, str], tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, kind, field = key
    monkeypatch.chdir(tmp_path)
    ran = call(command(name, {**tag_option(name, kind), field: "zzz"}))
    assert (ran.code, ran.out, ran.err.count("\n")) == (2, "", 1), ran
    assert ran.err.startswith(f"tacpipe: --{field.replace('_', '-')} is 'zzz'; it must be one of ")


@pytest.mark.parametrize("name", [name for name in STAGES if params_of.tag(registry.load(name))])
def test_an_option_of_another_kind_of_params_is_refused_and_is_in_no_key(
    name: str, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = registry.load(name)
    monkeypatch.chdir(tmp_path)
    for kind in params_of.kinds(stage):
        params = given_params.build(name, stage, options=tag_option(name, kind))
        assert set(params_of.to_input(params)) == set(fields.hints(kind))
        for other_kind in params_of.kinds(stage):
            for field in set(fields.hints(other_kind)) - set(fields.hints(kind)):
                default = other_kind.__dataclass_fields__[field].default
                with pytest.raises(UsageError, match=f"--{field.replace('_', '-')} belongs to the "):
                    given_params.build(name, stage, options={**tag_option(name, kind), field: default})
                (tmp_path / "params.yaml").write_text(json.dumps({"own": {**tag_option(name, kind), field: default}}))
                ran = call(f"{command(name, {})} --block own")
                assert ran.code == 2
                assert f"params.yaml, block own: {field} belongs to the {params_of.tag(stage)} " in ran.err
                assert get_args(fields.bare(fields.hints(other_kind)[params_of.tag(stage) or ""]))[0] in ran.err


@pytest.mark.parametrize("name", STAGES)
def test_a_preset_that_a_stage_does_not_have_is_refused_and_those_it_has_can_be_built(name: str, call: Call) -> None:
    stage = registry.load(name)
    presets = params_of.presets(stage)
    ran = call(f"{command(name, {})} --preset glossy")
    assert ran.code == 2
    assert ran.err == f"tacpipe: There is no preset glossy for {name}; it has {', '.join(presets) or 'none'}.\n"
    for preset in presets:
        assert given_params.build(name, stage, preset=preset)


@pytest.mark.parametrize("name", STAGES)
def test_help_shows_choices_ranges_and_whose_an_option_is(name: str, call: Call) -> None:
    stage = registry.load(name)
    tag = params_of.tag(stage)
    choices = [f"--{tag} {params_of.choices(kind, tag)[0]} " for kind in params_of.kinds(stage)] if tag else [""]
    texts = [call(f"{name.replace('.', ' ')} {words}--help").out for words in choices]
    printed = " ".join(" ".join(texts).split())
    for field, annotation in params_of.fields(stage).items():
        assert f"--{field.replace('_', '-')}" in printed
        if get_origin(fields.bare(annotation)) is Literal:
            assert f"[{'|'.join(map(str, get_args(fields.bare(annotation))))}]" in printed
        assert not params_of.choices_with(stage, field) or f"only with {params_of.tag(stage)}" in printed


@pytest.mark.parametrize("name", STAGES)
def test_every_param_has_a_help_text(name: str) -> None:
    stage = registry.load(name)
    comments = params_of.comments(stage)
    assert [field for field in params_of.fields(stage) if not comments.get(field)] == []


@pytest.mark.parametrize(
    ("name", "field", "choices"),
    [
        ("train.forward", "architecture", {"auto", *registry.architectures("forward")}),
        ("train.forward", "actions", ACTIONS),
        ("train.material", "decoder", DECODERS),
        ("train.material", "pairing", PAIRINGS),
        ("train.material", "subsample_percent", (100, 90, *BATCH_STEPS)),
        ("train.material", "scaling", KINDS),
        ("train.touch", "inputs", MODES),
        ("train.touch", "normalisation", NORMALISATIONS),
        ("train.touch", "wrist", WRISTS),
        ("train.touch", "head", HEADS),
        ("train.touch", "backbone", BACKBONES),
        ("train.touch", "loss", LOSSES),
        ("split", "scheme", SCHEMES),
        ("compress.autoencoder", "frames", FRAMES),
        ("simulate.forward", "protocol", {"mixed", *PROTOCOLS}),
        ("simulate.material", "spectra", SPECTRA),
        ("simulate.touch", "stiffness", {"mixed", *MODULI_PA}),
    ],
)
def test_choices_are_those_that_the_code_behind_them_knows(name: str, field: str, choices: Any) -> None:
    assert set(get_args(fields.bare(params_of.fields(registry.load(name))[field]))) == set(choices)


def test_lists_and_limits_are_those_that_the_code_behind_them_knows() -> None:
    families = fields.constraints(params_of.fields(registry.load("simulate.touch"))["families"])[0]
    assert isinstance(families, CommaList) and set(get_args(families.item_type)) == {"all", *FAMILIES}
    search = fields.constraints(params_of.fields(registry.load("compress.autoencoder"))["search"])[0]
    assert isinstance(search, Range) and search.maximum == MAX_SEARCH


UNITS = {  # the end of a name and the unit that help must show
    **{"_s": "s", "_ms": "ms", "_mm": "mm", "_m": "m", "_hz": "Hz", "_n": "N", "_deg": "degrees", "_ppm": "ppm"},
    **{"_count": "count", "_m_s": "m/s", "_count_day": "count/day", "_per_mm": "count/mm"},
}


def test_a_number_whose_name_ends_in_a_unit_shows_that_unit() -> None:
    numbers = {
        (name, field): annotation
        for name, _, field, annotation in every_param()
        if fields.bare(annotation) in (int, float)
    }
    ends = {key: max((end for end in UNITS if key[1].endswith(end)), key=len, default="") for key in numbers}
    units = {
        key: [constraint.name for constraint in fields.constraints(numbers[key]) if isinstance(constraint, Unit)]
        for key in numbers
    }
    wrong = {key: units[key] for key, end in ends.items() if end and units[key] != [UNITS[end]]}
    assert not wrong
    assert sum(map(bool, ends.values())) > 30
    assert fields.describe(numbers["synchronize", "gap_ms"]).endswith("(ms)")


def test_each_param_of_a_model_is_in_one_panel_of_the_help() -> None:
    for name in STAGES:
        kinds, panels = params_of.kinds(registry.load(name)), params_of.panels(registry.load(name))
        if not set(panels) - {"streams", "without"}:  # Many stages share these.
            assert not name.startswith(("train.", "compress."))
            continue
        assert set(panels) == set(params_of.fields(registry.load(name))), name
        assert set(panels.values()) <= {"Model", "Training", "Data"}
        for kind in kinds:
            declared = [
                field for owner in kind.__mro__ for names in vars(owner).get("PANELS", {}).values() for field in names
            ]
            assert len(declared) == len(set(declared)), kind
            assert kind.PANELS["Model"][0] == dataclasses.fields(kind)[0].name or name.startswith("compress.")


@pytest.mark.parametrize("name", ["train.touch", "compress.autoencoder"])
def test_the_options_of_a_command_know_their_panels(name: str) -> None:
    import typer

    from tacpipe.cli import stages

    program = typer.Typer()
    stages.add(program, name, "stage", [])
    panel_of_option = {
        param.name: getattr(param, "rich_help_panel", None) for param in typer.main.get_command(program).params
    }
    panels = params_of.panels(registry.load(name))
    assert {field: panel_of_option[field] for field in panels} == panels


def test_models_and_tasks_read_params_as_attributes_of_their_dataclasses() -> None:
    root = Path(params_of.__file__).parents[1]
    files = [file for part in ("tasks", "models", "codecs", "training") for file in (root / part).rglob("*.py")]
    lookups = re.compile(r"\bparams(?:\[[\"']|\.get\()|\bparams: (?:Mapping|dict)\b|\bParams = (?:Mapping|dict)\b")
    found_lookups = {file.name: lookups.findall(file.read_text(encoding="utf-8")) for file in files}
    assert {name: texts for name, texts in found_lookups.items() if texts} == {}
    assert len(files) > 50


# ---- what help says of a stage


@pytest.mark.parametrize("name", STAGES)
def test_the_summary_of_a_stage_is_one_short_sentence_in_the_imperative(name: str) -> None:
    summary = registry.summary(name)
    assert len(summary) < 60 and summary.endswith(".") and "  " not in summary
    verb = summary.split()[0]
    assert (verb.endswith("ss") or not verb.endswith("s")) and verb not in ("Return", "The")


@pytest.mark.parametrize("name", STAGES)
def test_the_help_of_a_stage_ends_in_one_example_of_that_stage(name: str) -> None:
    from tacpipe.cli import stage_options

    _, *examples = stage_options.summary(name, registry.load(name)).split(stage_options.EXAMPLE)
    assert len(examples) == 1 and examples[0].startswith(f"tacpipe {name.replace('.', ' ')} ")


def test_the_command_line_names_no_stage() -> None:
    from tacpipe.cli import stage_options, stages

    texts = {
        node.value
        for module in (stages, stage_options)
        for node in ast.walk(ast.parse(inspect.getsource(module)))
        if isinstance(node, ast.Constant)
    }
    # split is an option too, and train a role
    groups = {name.partition(".")[0] for name in STAGES} | {name.rpartition(".")[2] for name in STAGES}
    assert not {name for name in groups - {"split", "train"} if name in texts or f"data/{name}" in texts}


# ---- what a lab typed


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("train material nowhere --split s --decoder nonsense", "--decoder belongs to the architecture raec, and the"),
        ("train material nowhere --split s --unpool rubbish", "--unpool belongs to the architecture raec"),
        ("train material nowhere --split s --hidden 77", "--hidden belongs to the architecture raec or x-lstm"),
        (
            "train material nowhere --split s --architecture raec --alignment-loss zzz",
            "--alignment-loss is 'zzz'; it must be one",
        ),
        (
            "train material nowhere --split s --architecture raec --subsample-percent 30",
            "--subsample-percent is '30'; it must be one of 100",
        ),
        (
            "train material nowhere --split s --architecture raec --subsample-percent 25",
            "subsample_percent is 25 and no sensor",
        ),
        (
            "train material nowhere --split s --architecture raec --subsample-sensor biotac",
            "give --no-shuffle with --subsample-sensor",
        ),
        ("train material nowhere --split s --preset paper --no-joint --pairing permuted", "pairing is permuted and"),
        ("train material nowhere --split s --architecture spectra --speeds biotac", "list of NAME=VALUE, each value a"),
        (
            "train material nowhere --split s --architecture raec --headers biotac=rnn",
            "each value one of none, mlp, cnn",
        ),
        ("train forward nowhere --split s --loss zzz", "--loss is 'zzz'; it must be one of auto, absolute, huber"),
        ("train forward nowhere --split s --epochs 0", "--epochs is 0; it must be a whole number of 1 or more."),
        ("train forward nowhere --split s --epochs abc", "--epochs is 'abc'; it must be a whole number of 1 or more."),
        ("train forward nowhere --split s --preset paper --loss huber", "--loss belongs to the architecture auto, tax"),
        ("train touch nowhere --split s --targets thumb", "each item one of pdc_th, pdc_mf, e_th, e_mf"),
        (
            "train touch nowhere --split s --preset paper --architecture tree-ensemble",
            "no preset paper for the architecture",
        ),
        ("report nowhere --preset paper", "There is no preset paper for report; it has none."),
        ("report nowhere --traces -1", "--traces is -1; it must be a whole number of 0 or more."),
        ("synchronize nowhere --grid bogus --skip-bad", "--grid is 'bogus'; it must be one of logged, fresh."),
        (
            "synchronize nowhere --rate-hz -5",
            "--rate-hz is -5; it must be a number above 0 and at most 1000000000 (Hz).",
        ),
        ("synchronize nowhere --rate-hz nan", "--rate-hz is nan; it must be a number above 0 and"),
        ("synchronize nowhere --set rate_hz=-5", "--set rate_hz=-5: rate_hz is -5; it must be a number above 0 and"),
        ("synchronize nowhere --jobs -3", "--jobs is -3; it must be a whole number of 0 or more."),
        ("split nowhere --fold 1", "No such option"),
        ("split nowhere --scheme foo", "--scheme is 'foo'; it must be one of random, kfold, blocked, leave-one-out"),
        (
            "split nowhere --scheme kfold --test 0.2",
            "--test belongs to the scheme random or blocked, and the scheme is",
        ),
        ("split nowhere --folds 3", "--folds belongs to the scheme kfold, and the scheme is random. Leave it out, or"),
        (
            "split nowhere --val 0.6 --test 0.5",
            "val is 0.6, calibration is 0 and test is 0.5, which leave no recordings to train on",
        ),
        ("split nowhere --few-by sensor", "few_by is sensor and few is 0; it must be 1 or more with few_by."),
        ("split nowhere --few 3 --few-of sensor", "few_of is 'sensor'; it must be an attribute and a value"),
        ("segment contacts nowhere --on-count 5", "off_count is 80, above on_count, 5"),
        ("segment slides nowhere --spike-frames 4", "spike_frames is 4; it must be odd"),
        ("compress autoencoder nowhere --split s --hidden 64,x", "each item a whole number of 1 or more"),
        ("compress autoencoder nowhere --split s --hidden 8 --search 3", "search is 3, which chooses its own widths"),
        (
            "evaluate nowhere nowhere --split s --role best",
            "--role is 'best'; it must be one of train, val, calibration, test.",
        ),
        (
            "evaluate nowhere nowhere --split s --fold -1",
            "--fold is '-1'; it must be a fold as 2, or several as 0-4 or 0,2,5.",
        ),
        ("predict nowhere nowhere --steps 1,0", "--steps is '1,0'; it must be a comma-separated list, each item a"),
        ("simulate touch --families box,pyramid", "--families is 'box,pyramid'; it must be a comma-separated list"),
        ("simulate touch --raw --spheres", "raw and spheres are both set"),
    ],
)
def test_what_means_nothing_is_refused_with_one_sentence_and_code_2(
    words: str, sentence: str, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = call(f"{words} -o out")
    assert (ran.code, ran.out) == (2, ""), ran
    assert sentence in ran.err
    assert "No such option" in ran.err or (ran.err.startswith("tacpipe: ") and ran.err.count("\n") == 1), ran.err
    assert not any(tmp_path.iterdir())


# ---- a plug-in's own stage

PLUGIN = '''
"""Bend."""

from __future__ import annotations
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal
from tacpipe.plugins.constraints import PositiveInt, Range
from tacpipe import stage


@dataclass(frozen=True)
class Gentle:
    way: Literal["gentle"] = "gentle"  # how it is bent
    trials: PositiveInt = 1
    angle_deg: Annotated[float, Range(0, 90)] = 10.0  # degrees


@dataclass(frozen=True)
class Hard:
    way: Literal["hard"] = "hard"
    trials: PositiveInt = 1
    # newton; what it takes
    force_n: Annotated[float, Range(above=0, maximum=5)] = 1.0
    PRESETS: ClassVar[dict[str, dict[str, object]]] = {"strong": {"force_n": 5.0}}


Params = Gentle | Hard


@stage(version=1)
def bend(params: Params, trial: Trial) -> Table:
    """Bend."""
    import pyarrow as pa

    return pa.table({"x": [len(params.way)]})
'''


@pytest.fixture
def bending(tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> Iterator[Call]:
    folder = tmp_path / "plugin"
    write_plugin(folder, "bend", "[tacpipe.stages]\nbend = bend_stages:bend\n", bend_stages=PLUGIN)
    monkeypatch.syspath_prepend(folder)
    (tmp_path / "lab").mkdir()
    monkeypatch.chdir(tmp_path / "lab")
    monkeypatch.delenv("TACPIPE_STORE", raising=False)
    forget()
    yield call
    forget()


def test_a_plug_ins_stage_has_choices_ranges_and_kinds_like_a_built_in_one(bending: Call) -> None:
    for words, sentence in (
        ("--way rough", "--way is 'rough'; it must be one of gentle, hard."),
        ("--angle-deg 91", "--angle-deg is 91; it must be a number from 0 to 90."),
        ("--force-n 2", "--force-n belongs to the way hard, and the way is gentle. Leave it out, or set way to hard."),
        ("--way hard --force-n 6", "--force-n is 6; it must be a number above 0 and at most 5."),
        ("--preset paper", "There is no preset paper for bend; it has strong."),
    ):
        ran = bending(f"bend -o out {words}")
        assert (ran.code, ran.err) == (2, f"tacpipe: {sentence}\n")
    printed = bending("bend --way hard --help").out
    assert "[gentle|hard]" in printed and "only with way hard" in " ".join(printed.split())
    assert json.loads(bending("bend --preset strong --print-params").out) == {
        "way": "hard",
        "trials": 1,
        "force_n": 5.0,
    }
    assert bending("bend -o out").code == 0
    assert json.loads(Path("out/manifest.json").read_text())["params"] == {
        **{"way": "gentle", "trials": 1, "angle_deg": 10.0},
    }


def test_kinds_that_no_field_tells_apart_are_a_mistake_of_the_stage() -> None:
    @dataclasses.dataclass(frozen=True)
    class One:
        size: Annotated[int, Range(1)] = 1

    @dataclasses.dataclass(frozen=True)
    class Other:
        size: Annotated[int, Range(1)] = 2

    class Fake:
        params = One | Other
        function = test_kinds_that_no_field_tells_apart_are_a_mistake_of_the_stage

    with pytest.raises(Exception, match="size"):
        params_of.tag(Fake())  # type: ignore[arg-type]
