"""Keys: what must change one does, what must not does not, and no two identities share one."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tacpipe.datasets.manifest import Manifest
from tacpipe.engine import keys
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io.hashing import canonical, digest
from tacpipe.plugins import given_params
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import AnyStage, stage
from tacpipe.store.records import RecordingEntry, Shard, Step
from tests.conftest import Lab, write_source

numbers = st.integers(-(2**80), 2**80) | st.floats(allow_nan=False, allow_infinity=False)
texts = st.text('a"\\,:[]{} 1\u00e9e\u0301\U0001f590\n', max_size=6) | st.text(max_size=6)
values = st.recursive(
    st.none() | st.booleans() | numbers | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=8,
)
names = st.text("abcdefgh", min_size=1, max_size=4)
shas = st.binary(min_size=1, max_size=2).map(lambda content: hashlib.sha256(content).hexdigest())
scalars = st.none() | st.booleans() | numbers | texts
attributes = st.dictionaries(names, scalars, max_size=4)
shards = st.dictionaries(names, shas.map(lambda sha: {"digest": sha, "rows": 1, "bytes": 2}), min_size=1, max_size=3)
entries = st.builds(lambda attributes, streams: {"attributes": attributes, "shards": streams}, attributes, shards)
recordings = st.dictionaries(names, entries, min_size=1, max_size=4)


@dataclass(frozen=True)
class Params:
    rate_hz: float = 50.0  # rate of the grid
    frames: int = 400  # kept
    grid: Literal["uniform", "logged"] = "uniform"  # rows of the grid
    order: Literal[1, 2] = 1  # order of the filter
    gains: tuple[float, ...] = (1.0, 2.0)  # one a channel
    strict: bool = True  # refuse gaps
    note: str | None = None  # free text
    cutoff_hz: float | None = None  # cutoff of the filter


finite = st.floats(allow_nan=False, allow_infinity=False)
any_params = st.builds(
    Params,
    finite,
    st.integers(),
    st.sampled_from(["uniform", "logged"]),
    st.sampled_from([1, 2]),
    st.lists(finite, max_size=3).map(tuple),
    st.booleans(),
    st.none() | texts,
    st.none() | finite,
)


def cut(params: Params) -> None: ...


STAGE: AnyStage = stage(version=3)(cut)


def build_cut_params(**options: Any) -> Params:
    params = given_params.build("cut", STAGE, options=options)
    assert isinstance(params, Params)
    return params


def key(
    params: Any = None, inputs: Mapping[str, Any] | None = None, name: str = "cut", definition: AnyStage = STAGE
) -> str:
    return digest(keys.identity(name, definition.version, params or Params(), inputs or {}))


def with_types(value: Any) -> Any:
    """Return the value in a form in which two are equal only if they are of the same types throughout."""
    if isinstance(value, list | tuple):
        return ["list", *map(with_types, value)]
    if isinstance(value, dict):
        return [
            "mapping",
            *sorted(([name, with_types(inner)] for name, inner in value.items()), key=lambda pair: pair[0]),
        ]
    return [type(value).__name__, repr(value)]


def reverse_throughout(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: reverse_throughout(value[name]) for name in reversed(value)}
    return [reverse_throughout(inner) for inner in value] if isinstance(value, list) else value


# ---- values


@given(values)
def test_canonical_json_tells_the_value_back_so_no_two_values_share_a_digest(value: Any) -> None:
    assert with_types(json.loads(canonical(value))) == with_types(value)


@given(values, values)
def test_where_one_value_ends_and_the_next_begins_is_part_of_the_digest(first_value: Any, right: Any) -> None:
    structures = [
        [first_value, right],
        [[first_value], right],
        [first_value, [right]],
        [[first_value, right]],
        {"a": first_value, "b": right},
    ]
    digests = [digest(value) for value in structures]
    same = {
        (first, second)
        for first in range(5)
        for second in range(first)
        if with_types(structures[first]) == with_types(structures[second])
    }
    assert {
        (first, second) for first in range(5) for second in range(first) if digests[first] == digests[second]
    } == same


@given(values)
def test_the_order_of_keys_does_not_count_however_deep_they_lie(value: Any) -> None:
    assert canonical(reverse_throughout(value)) == canonical(value)


@pytest.mark.parametrize(
    ("value", "content"),
    [
        ({}, b"{}"),
        ([], b"[]"),
        ("", b'""'),
        (None, b"null"),
        (True, b"true"),
        (1, b"1"),
        (1.0, b"1.0"),
        (0.1, b"0.1"),
        (1e16, b"1e+16"),
        (1e-05, b"1e-05"),
        (5e-324, b"5e-324"),
        (1.7976931348623157e308, b"1.7976931348623157e+308"),
        (2**70, b"1180591620717411303424"),
        (-(2**63), b"-9223372036854775808"),
        ("\u00e9", b'"\\u00e9"'),  # composed
        ("e\u0301", b'"e\\u0301"'),  # decomposed: another text, as it is for a file system
        ("\U0001f590", b'"\\ud83d\\udd90"'),
        ("\x00\x7f\u2028/", b'"\\u0000\\u007f\\u2028/"'),
        ((1, (2,)), b"[1,[2]]"),  # a tuple is a list
        (np.float64(0.1), b"0.1"),
        ({"b": 1, "a": {"d": None, "c": [True]}, "B": "\n"}, b'{"B":"\\n","a":{"c":[true],"d":null},"b":1}'),
    ],
)
def test_canonical_json_is_to_the_byte_what_it_was(value: Any, content: bytes) -> None:
    assert canonical(value) == content
    assert digest(value) == hashlib.sha256(content).hexdigest()


def test_a_whole_number_a_number_and_a_truth_are_three_values() -> None:
    assert len({digest(value) for value in (1, 1.0, True, "1", [1], None)}) == 6


@given(st.text(max_size=3), st.characters(categories=["Cs"]), st.text(max_size=3))
def test_text_that_is_no_unicode_is_refused_as_a_value_and_as_a_name(before: str, half: str, after: str) -> None:
    for value in (before + half + after, {before + half + after: 1}, ["a", {"b": [half]}]):
        with pytest.raises(TacpipeError, match="cannot be made") as caught:
            digest(value)
        str(caught.value).encode()  # the sentence itself can be printed


def test_two_halves_of_a_character_are_not_the_character() -> None:
    assert digest("\U0001f590") != digest("\ufffd\ufffd")
    with pytest.raises(TacpipeError, match="cannot be made"):
        digest("\ud83d\udd90")  # each half would be escaped as the character's is


@pytest.mark.parametrize(
    "value",
    [np.float32(1.5), np.int64(3), np.bool_(True), np.array([1]), Path("a"), 1j, pytest.param(1 << 20_000, id="huge")],
)
def test_what_json_does_not_know_is_refused_in_a_sentence_that_is_not_endless(value: object) -> None:
    for content in (value, {"recordings": {f"trial-{number}": value for number in range(1000)}}):
        with pytest.raises(TacpipeError, match="cannot be made") as caught:
            digest(content)
        assert len(str(caught.value)) < 1000


def test_a_list_that_goes_on_for_ever_or_is_too_deep_is_refused() -> None:
    endless: list[Any] = []
    endless.append(endless)
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    for value in (endless, deep):
        with pytest.raises(TacpipeError, match="cannot be made"):
            digest(value)


# ---- params


@given(any_params)
def test_the_order_in_which_params_are_given_does_not_count(params: Params) -> None:
    options = {name: value for name, value in asdict(params).items() if value is not None}
    backwards = dict(reversed(options.items()))
    assert (
        key(build_cut_params(**options))
        == key(build_cut_params(**backwards))
        == key(build_cut_params(**{**options, "frames": params.frames}))
    )


@given(any_params, any_params)
def test_two_sets_of_params_share_a_key_only_if_they_are_equal(first: Params, second: Params) -> None:
    first_built, right = build_cut_params(**asdict(first)), build_cut_params(**asdict(second))
    assert (key(first_built) == key(right)) == (first_built == right)


@given(any_params, st.data())
def test_any_one_param_that_changes_changes_the_key(params: Params, data: st.DataObject) -> None:
    alternative = data.draw(any_params)
    name = data.draw(st.sampled_from(list(asdict(params))))
    value = getattr(alternative, name)
    assume(value != getattr(params, name))
    assert key(build_cut_params(**asdict(replace(params, **{name: value})))) != key(build_cut_params(**asdict(params)))


@given(any_params)
def test_params_come_back_from_a_key_and_give_it_again(params: Params) -> None:
    before = build_cut_params(**asdict(params))
    after = params_of.from_json(STAGE, json.loads(canonical(params_of.to_json(before))))
    assert after == before and key(after) == key(before)


@given(st.integers(-(10**15), 10**15))
def test_a_whole_number_given_for_a_number_gives_the_same_key_from_wherever_it_comes(number: int) -> None:
    expected = key(build_cut_params(rate_hz=float(number), gains=[float(number)], cutoff_hz=float(number)))
    assert key(build_cut_params(rate_hz=number, gains=[number], cutoff_hz=number)) == expected
    sets = [f"rate_hz={number}", f"gains=[{number}.0]", f"cutoff_hz={number}"]
    assert key(given_params.build("cut", STAGE, sets=sets)) == expected


@pytest.mark.parametrize("text", ["2e-2", "0.02", "+2.0E-2", ".2e-1"])
def test_a_number_with_an_exponent_is_a_number_as_everywhere_but_in_yaml(text: str) -> None:
    assert key(given_params.build("cut", STAGE, sets=[f"rate_hz={text}"])) == key(build_cut_params(rate_hz=0.02))


def test_minus_zero_is_zero() -> None:
    assert key(build_cut_params(rate_hz=-0.0, gains=[-0.0], cutoff_hz=-0.0)) == key(
        build_cut_params(rate_hz=0, gains=[0], cutoff_hz=0.0)
    )
    assert (
        str(build_cut_params(rate_hz=-0.0).rate_hz) == "0.0"
    )  # No stage divides by a sign that its key does not hold.


@pytest.mark.parametrize("value", [True, 1.0])
def test_a_choice_among_whole_numbers_is_that_number_and_nothing_that_equals_it(value: object) -> None:
    with pytest.raises(UsageError, match=r"order is .*; it must be one of 1, 2"):
        build_cut_params(order=value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), pytest.param(1 << 20_000, id="huge")])
@pytest.mark.parametrize("name", ["rate_hz", "cutoff_hz", "gains"])
def test_a_number_that_is_none_is_refused_with_the_name_of_its_param(name: str, value: float) -> None:
    with pytest.raises(UsageError, match=name.replace("_", "-")) as caught:
        build_cut_params(**{name: [1.0, value] if name == "gains" else value})
    assert caught.value.exit_code == 2 and len(str(caught.value)) < 500


def test_text_that_is_no_unicode_is_refused_with_the_name_of_its_param() -> None:
    with pytest.raises(UsageError, match="note"):  # A terminal gives this for bytes that are no UTF-8.
        build_cut_params(note="caf\udce9")


def test_composed_and_decomposed_text_are_two_values_of_a_param() -> None:
    assert key(build_cut_params(note="caf\u00e9")) != key(build_cut_params(note="cafe\u0301"))


@pytest.mark.parametrize("value", [np.float64(25.0), np.float64(-0.0)])
def test_a_number_of_numpy_gives_the_key_of_the_number(value: np.float64) -> None:
    assert key(build_cut_params(rate_hz=value)) == key(build_cut_params(rate_hz=float(value)))


# ---- identities


@given(entries, st.data())
def test_a_recordings_key_rests_on_its_streams_and_on_the_attributes_that_are_declared(
    entry: RecordingEntry, data: st.DataObject
) -> None:
    reads = tuple(data.draw(st.lists(names, max_size=3)))
    changed = data.draw(attributes)
    before, after = keys.of_recording(entry, reads), keys.of_recording({**entry, "attributes": changed}, reads)
    declared = [
        {name: values_by_name[name] for name in reads if name in values_by_name}
        for values_by_name in (entry["attributes"], changed)
    ]
    assert (digest(before) == digest(after)) == (with_types(declared[0]) == with_types(declared[1]))


@given(entries, entries)
def test_streams_their_names_and_their_digests_count_and_rows_and_bytes_do_not(
    first: RecordingEntry, second: RecordingEntry
) -> None:
    streams = [{name: shard["digest"] for name, shard in entry["shards"].items()} for entry in (first, second)]
    first_key, right = (keys.of_recording(entry, ()) for entry in (first, second))
    assert (digest(first_key) == digest(right)) == (streams[0] == streams[1])
    counted: dict[str, Shard] = {name: {**shard, "rows": 7, "bytes": 8} for name, shard in first["shards"].items()}
    assert digest(keys.of_recording({**first, "shards": counted}, ())) == digest(first_key)


@given(recordings, recordings)
def test_a_key_over_a_dataset_rests_on_names_attributes_and_streams_in_any_order(
    first: dict[str, Any], second: dict[str, Any]
) -> None:
    def dataset_digest(dataset_entries: dict[str, Any], reads: tuple[str, ...] | None = None) -> str:
        return digest(keys.of_dataset(Manifest("scale", 1, recordings=dataset_entries), reads, dataset_entries))

    def dataset_content(dataset_entries: dict[str, Any]) -> Any:
        return {
            name: [entry["attributes"], {stream: shard["digest"] for stream, shard in entry["shards"].items()}]
            for name, entry in dataset_entries.items()
        }

    assert dataset_digest(dict(reversed(first.items()))) == dataset_digest(first)
    assert (dataset_digest(first) == dataset_digest(second)) == (
        with_types(dataset_content(first)) == with_types(dataset_content(second))
    )
    bare = {name: {**entry, "attributes": {}} for name, entry in first.items()}
    assert dataset_digest(first, ()) == dataset_digest(bare, ())


def test_stage_version_params_and_inputs_each_change_the_key() -> None:
    later = stage(version=4)(cut)
    distinct = {
        key(),
        key(name="cut.fit"),
        key(definition=later),
        key(build_cut_params(frames=401)),
        key(inputs={"recording": {}}),
        key(inputs={"other": {}}),
        key(inputs={"recording": {"shards": {}}}),
    }
    assert len(distinct) == 7


@given(st.lists(names, min_size=2, max_size=2, unique=True))
def test_what_lies_behind_a_dataset_counts_where_the_whole_of_it_is_read(stages: list[str]) -> None:
    step: Step = {"stage": stages[0], "version": 1, "params": {"factor": 2}, "fitted": None}
    other_steps: list[Step] = [
        {**step, "stage": stages[1]},
        {**step, "version": 2},
        {**step, "params": {"factor": 3}},
        {**step, "fitted": {}},
    ]
    chains = [[], [step], [step, step], *([other_step] for other_step in other_steps)]
    distinct = {digest(keys.of_dataset(Manifest("scale", 1, chain=chain), None, {})) for chain in chains}
    assert len(distinct) == len(chains)


# ---- what keys were, so that they never change silently

SHA = hashlib.sha256
TRIAL = '{"inputs":{"trial":0},"params":{"offset":0,"rows":3,"trials":1},"stage":"simulate.toy","version":1}'
SCALE = (
    '{"inputs":{"recording":{"attributes":{},"shards":{"left":{"digest":"%s"},"right":{"digest":"%s"}}}},'
    '"params":{"factor":2,"gate":"","pause_s":0.0,"refuse":-1},"stage":"scale","version":1}'
)
NAMED = (
    '{"inputs":{"recording":{"attributes":{"material":"cork"},"shards":{"left":{"digest":"%s"},"right":{"digest":"%s"}}}},'
    '"params":{},"stage":"named","version":1}'
)
TOTAL = (
    '{"inputs":{"recordings":{"files":{},"lineage":{"chain":[{"fitted":null,"params":{"factor":2,"gate":"","pause_s":0.0,'
    '"refuse":-1},"stage":"scale","version":1}],"params":{"factor":2,"gate":"","pause_s":0.0,"refuse":-1},"stage":"scale",'
    '"version":1},"recordings":{"trial-000":{"attributes":{"material":"cork","trial":0},"shards":{"":{"digest":"%s"}}}}}},'
    '"params":{},"stage":"total","version":1}'
)
INGEST = '{"inputs":{"files":{"a.txt":"%s"}},"params":{},"stage":"ingest.numbers","version":1}'
RUN = (
    '{"datasets":["%s"],"fold":0,"named":{},"params":{"factor":2,"gate":"","pause_s":0.0,"refuse":-1},"role":null,"run":"scale",'
    '"sources":{},"version":[1,null]}'
)
ENTRY = '{"attributes":{"material":"cork","trial":0},"shards":{"left":"%s","right":"%s"}}'
DATASET = '{"files":{},"recordings":{"trial-000":' + ENTRY + "}}"


def test_keys_and_digests_are_those_of_the_identities_as_the_format_tells_them(lab: Lab) -> None:
    write_source("src", a="1 2 3")
    lab.run("simulate toy --trials 1 --rows 3 -o data/r")
    lab.run("scale data/r -o data/s")
    lab.run("named data/r -o data/n")
    lab.run("total data/s -o data/t")
    lab.run("ingest numbers src -o data/i")
    streams = lab.manifest("data/r").recordings["trial-000"]["shards"]
    streams_digests = (streams["left"]["digest"], streams["right"]["digest"])
    scaled = lab.manifest("data/s").recordings["trial-000"]["shards"][""]["digest"]
    manifest = SHA((lab.folder / "data/r/manifest.json").read_bytes()).hexdigest()
    identities = [
        TRIAL,
        SCALE % streams_digests,
        NAMED % streams_digests,
        TOTAL % scaled,
        INGEST % SHA(b"1 2 3").hexdigest(),
        RUN % manifest,
    ]
    for identity in identities:
        name = SHA(identity.encode()).hexdigest()
        assert (lab.folder / ".tacpipe" / "records" / name[:2] / f"{name}.json").exists(), identity
    assert lab.manifest("data/r").digest == SHA((DATASET % streams_digests).encode()).hexdigest()


def test_a_key_is_to_the_digit_what_it_was() -> None:
    inputs = {"recording": keys.of_recording({"attributes": {"a": 1.5}, "shards": {"": {"digest": "ab"}}}, None)}
    params = build_cut_params(rate_hz=100, note="caf\u00e9", gains=[1, 0.1])
    assert (
        key(params, inputs)
        == SHA(
            b'{"inputs":{"recording":{"attributes":{"a":1.5},"shards":{"":{"digest":"ab"}}}},"params":{"cutoff_hz":null,'
            b'"frames":400,"gains":[1.0,0.1],"grid":"uniform","note":"caf\\u00e9","order":1,"rate_hz":100.0,"strict":true},'
            b'"stage":"cut","version":3}'
        ).hexdigest()
    )
