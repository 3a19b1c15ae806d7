"""Roles of recordings under each scheme."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.datasets.splits import Roles, Scheme, assign, separated
from tacpipe.errors import TacpipeError

OBJECTS = ("4", "10", "bottle")


def recordings(count: int, **attributes: str) -> dict[str, dict[str, str]]:
    return {f"trial-{i:03d}": {"object": OBJECTS[i % 3], **attributes} for i in range(count)}


def with_role(roles: Roles, role: str, fold: int = 0) -> set[str]:
    return {name for (name, at), role_of_name in roles.items() if role_of_name == role and at == fold}


@given(st.integers(5, 200), st.floats(0, 0.4), st.floats(0, 0.4), st.integers(0, 9))
def test_random_gives_every_recording_one_role_and_the_shares_asked_for(
    count: int, val: float, test: float, seed: int
) -> None:
    roles = assign(recordings(count), Scheme(val=val, test=test, seed=seed))
    assert len(roles) == count
    assert Counter(roles.values())["test"] == round(test * count)
    assert Counter(roles.values())["val"] == round(val * count)


@pytest.mark.parametrize("name", ["random", "kfold", "blocked", "leave-one-out", "authors"])
def test_a_share_to_calibrate_on_is_taken_from_training_and_leaves_the_other_roles_as_they_are(name: str) -> None:
    labelled = {
        f"{at}-{name}": attributes | {"authors_role": at}
        for at in ("train", "test")
        for name, attributes in recordings(30).items()
    }
    without, roles = (assign(labelled, Scheme(name, calibration=share)) for share in (0, 0.2))
    calibration = {key for key, role in roles.items() if role == "calibration"}
    trained = Counter(fold for (_, fold), role in without.items() if role in ("train", "val"))
    assert {key: role for key, role in without.items() if key not in calibration} == {
        key: role for key, role in roles.items() if key not in calibration
    }
    for fold in trained:
        total = 60 if name in ("random", "blocked") else trained[fold]
        assert sum(at == fold for _, at in calibration) == round(0.2 * total)
    assert {without[key] for key in calibration} == {"train"}


def test_the_order_in_which_recordings_come_does_not_matter_and_the_seed_does() -> None:
    labelled = recordings(30)
    reverse = dict(reversed(labelled.items()))
    for name in ("random", "kfold", "blocked", "leave-one-out"):
        assert assign(labelled, Scheme(name)) == assign(reverse, Scheme(name))
    assert assign(labelled, Scheme(seed=0)) != assign(labelled, Scheme(seed=1))


@pytest.mark.parametrize("name", ["random", "blocked"])
def test_stratified_shares_hold_for_every_object(name: str) -> None:
    labelled = recordings(60)
    roles = assign(labelled, Scheme(name, val=0.1, test=0.2, stratify="object"))
    tested = Counter(labelled[recording]["object"] for recording in with_role(roles, "test"))
    assert tested == {"4": 4, "10": 4, "bottle": 4}


def test_kfold_tests_every_recording_once_in_parts_that_differ_by_one() -> None:
    labelled = recordings(23)
    roles = assign(labelled, Scheme("kfold", folds=5, val=0.1, stratify="object"))
    parts = [with_role(roles, "test", fold) for fold in range(5)]
    assert sorted(name for part in parts for name in part) == sorted(labelled)
    assert {len(part) for part in parts} == {4, 5}
    assert all(len(with_role(roles, "val", fold)) == 2 for fold in range(5))


def objects(count: int, trials: int) -> dict[str, dict[str, str]]:
    """Recordings of ``count`` objects, so many of each."""
    return {f"o{i}-{j}": {"object": f"o{i}"} for i in range(count) for j in range(trials)}


@pytest.mark.parametrize("stratify", ["", "object"])
def test_kfold_apart_tests_unknown_objects_and_known_ones_side_by_side(stratify: str) -> None:
    labelled = objects(7, 6)
    roles = assign(labelled, Scheme("kfold", folds=3, val=0.2, stratify=stratify, apart="object"))
    plain = assign(labelled, Scheme("kfold", folds=3, val=0.2, stratify=stratify))
    unknown_in: list[str] = []
    for fold in range(3):
        learned = {labelled[name]["object"] for role in ("train", "val") for name in with_role(roles, role, fold)}
        unknown = {attributes["object"] for attributes in labelled.values()} - learned
        unknown_in += unknown
        tested = with_role(roles, "test", fold)
        assert {name for name in labelled if labelled[name]["object"] in unknown} <= tested
        known_objects = {name for name in tested if labelled[name]["object"] in learned}
        assert known_objects == {name for name in with_role(plain, "test", fold) if labelled[name]["object"] in learned}
        assert known_objects
        assert with_role(roles, "val", fold)
    assert sorted(unknown_in) == sorted(
        {attributes["object"] for attributes in labelled.values()}
    )  # each is unknown once


def test_the_objects_that_are_unknown_together_follow_from_the_seed_and_parts_are_even() -> None:
    labelled = objects(8, 1)
    alike = [assign(labelled, Scheme("kfold", folds=4, val=0, seed=seed, apart="object")) for seed in (1, 1, 2)]
    assert alike[0] == alike[1] != alike[2]
    assert all(2 <= len(with_role(alike[0], "test", fold)) <= 4 for fold in range(4))  # 2 unknown, up to 2 known


def test_a_recording_that_comes_in_later_is_unknown_together_with_its_object() -> None:
    scheme = Scheme("kfold", folds=3, val=0.2, apart="object")
    old = assign(objects(6, 4), scheme)
    labelled = objects(9, 5)
    new = assign(labelled, scheme, keep=old)
    assert {key: new[key] for key in old} == old
    learned = [
        {labelled[name]["object"] for name in labelled if new[name, fold] in ("train", "val")} for fold in range(3)
    ]
    unknown = [{f"o{i}" for i in range(9)} - fold_objects for fold_objects in learned]
    assert sorted(name for fold_objects in unknown for name in fold_objects) == sorted(f"o{i}" for i in range(9))
    assert {len(fold_objects) for fold_objects in unknown} == {3}


def test_an_older_split_that_kept_nothing_apart_cannot_be_extended_to_do_so() -> None:
    old = assign(objects(4, 6), Scheme("kfold", folds=3))
    with pytest.raises(TacpipeError, match="did not keep object apart"):
        assign(objects(4, 7), Scheme("kfold", folds=3, apart="object"), keep=old)


def test_blocked_trains_on_the_first_and_tests_the_last() -> None:
    roles = assign(recordings(10), Scheme("blocked", val=0.2, test=0.3))
    assert [roles[f"trial-{i:03d}", 0] for i in range(10)] == ["train"] * 5 + ["val"] * 2 + ["test"] * 3


def test_leave_one_out_has_a_fold_a_value_in_the_order_of_numbers() -> None:
    labelled = recordings(12)
    roles = assign(labelled, Scheme("leave-one-out", val=0.25))
    for fold, value in enumerate(("4", "10", "bottle")):
        assert {labelled[name]["object"] for name in with_role(roles, "test", fold)} == {value}
        assert len(with_role(roles, "val", fold)) == 2


def test_authors_roles_are_taken_and_val_is_drawn_from_their_training_part() -> None:
    labelled = recordings(20, authors_role="train") | {"x": {"authors_role": "test"}}
    roles = assign(labelled, Scheme("authors", val=0.2))
    assert with_role(roles, "test") == {"x"}
    assert len(with_role(roles, "val")) == 4


def test_authors_own_val_is_left_as_it_is() -> None:
    labelled = recordings(5, authors_role="train") | {"x": {"authors_role": "val"}}
    assert with_role(assign(labelled, Scheme("authors", val=0.4)), "val") == {"x"}


def test_a_missing_authors_role_is_named() -> None:
    with pytest.raises(TacpipeError, match="Recording trial-000 has no attribute authors_role"):
        assign(recordings(3), Scheme("authors"))


@pytest.mark.parametrize("name", ["random", "kfold", "blocked"])
def test_an_older_split_keeps_its_roles_when_recordings_come_in(name: str) -> None:
    scheme = Scheme(name, val=0.1, test=0.2)
    old = assign(recordings(20), scheme)
    new = assign(recordings(40), scheme, keep=old)
    assert {key: new[key] for key in old} == old
    assert len(with_role(new, "test")) == 2 * len(with_role(old, "test"))


def test_a_new_object_adds_a_fold_and_moves_none() -> None:
    scheme = Scheme("leave-one-out", val=0.0)
    old = assign(recordings(9), scheme)
    new = assign(recordings(9) | {"new": {"object": "1"}}, scheme, keep=old)
    assert {key: new[key] for key in old} == old
    assert with_role(new, "test", 3) == {"new"}
    assert new["new", 0] == "train"


def test_an_older_split_of_other_folds_is_refused() -> None:
    old = assign(recordings(20), Scheme("kfold", folds=4))
    with pytest.raises(TacpipeError, match="has 4 folds"):
        assign(recordings(21), Scheme("kfold", folds=5), keep=old)


@pytest.mark.parametrize(
    ("scheme", "message"),
    [
        (Scheme("lucky"), "no split scheme lucky"),
        (Scheme(val=0.6, test=0.5), "leave no recordings to train on"),
        (Scheme("kfold", folds=1), "1 folds cannot be made"),
        (Scheme("leave-one-out", by="colour"), "has no attribute colour; it has object"),
        (Scheme(stratify="colour"), "has no attribute colour"),
        (Scheme(stratify="objcet"), "Did you mean object\\?"),
        (Scheme("kfold", folds=4, apart="object"), "3 values of object cannot be kept apart in 4 folds"),
        (Scheme("kfold", folds=2, apart="colour"), "has no attribute colour"),
        (Scheme("random", apart="object"), "apart object belongs to the scheme kfold"),
    ],
)
def test_a_split_that_cannot_be_says_why(scheme: Scheme, message: str) -> None:
    with pytest.raises(TacpipeError, match=message):
        assign(recordings(6), scheme)


def test_a_split_of_nothing_and_one_that_leaves_nothing_to_train_on_are_refused() -> None:
    with pytest.raises(TacpipeError, match="no recordings"):
        assign({}, Scheme())
    with pytest.raises(TacpipeError, match="none of 1 recordings to train on"):
        assign(recordings(1), Scheme(test=0.6, val=0.0))


# ---- several attributes, repeats, the other way round


def two_sensors(materials: int = 4, trials: int = 10) -> dict[str, dict[str, str | int]]:
    """Recordings of two sensors, so many trials of each material."""
    return {
        f"{sensor}-m{material:02d}-t{trial:03d}": {"sensor": sensor, "material": material}
        for sensor in ("biotac", "roboskin")
        for material in range(1, materials + 1)
        for trial in range(trials)
    }


@pytest.mark.parametrize("name", ["random", "kfold"])
def test_several_attributes_are_spread_evenly_in_all_their_combinations(name: str) -> None:
    labelled = two_sensors()
    roles = assign(labelled, Scheme(name, val=0.2, test=0.2, stratify="sensor, material"))
    tested = Counter((labelled[name]["sensor"], labelled[name]["material"]) for name in with_role(roles, "test"))
    assert len(tested) == 8
    assert set(tested.values()) == {2}


def test_repeats_are_other_draws_and_the_first_is_that_without_repeats() -> None:
    labelled = recordings(40)
    single, thrice = assign(labelled, Scheme(seed=4)), assign(labelled, Scheme(seed=4, repeats=3))
    assert {key: role for key, role in thrice.items() if key[1] == 0} == single
    tested = [with_role(thrice, "test", fold) for fold in range(3)]
    assert {len(names) for names in tested} == {6}
    assert len({frozenset(names) for names in tested}) == 3


def test_blocked_in_reverse_tests_the_first_of_each_stratum_and_trains_on_the_last() -> None:
    roles = assign(recordings(10), Scheme("blocked", val=0.2, test=0.3, reverse=True))
    assert [roles[f"trial-{i:03d}", 0] for i in range(10)] == ["test"] * 3 + ["val"] * 2 + ["train"] * 5
    labelled = two_sensors(materials=1)
    roles = assign(labelled, Scheme("blocked", val=0.0, test=0.1, stratify="sensor", reverse=True))
    assert with_role(roles, "test") == {"biotac-m01-t000", "roboskin-m01-t000"}


# ---- folds of the authors


def published_recordings(blocks: int = 4, size: int = 6, tests: int = 0) -> dict[str, dict[str, str | int]]:
    labelled: dict[str, dict[str, str | int]] = {
        f"roboskin-fold{block}-{i:03d}": {"sensor": "roboskin", "material": i % 3, "authors_fold": block}
        for block in range(blocks)
        for i in range(size)
    }
    for i in range(tests):
        labelled[f"roboskin-test-{i:03d}"] = {"sensor": "roboskin", "material": 0, "authors_role": "test"}
    return labelled


def test_blocks_of_the_authors_are_tested_in_turn_where_they_name_no_test() -> None:
    labelled = published_recordings()
    roles = assign(labelled, Scheme("authors", val=0.25, stratify="material"))
    for fold in range(4):
        assert with_role(roles, "test", fold) == {name for name in labelled if labelled[name]["authors_fold"] == fold}
        watched = with_role(roles, "val", fold)
        assert len(watched) == 4  # a quarter of 18, rounded to even
        assert {labelled[name]["material"] for name in watched} == {0, 1, 2}


def test_blocks_of_the_authors_are_watched_in_turn_where_they_name_the_test() -> None:
    labelled = published_recordings(tests=5)
    roles = assign(labelled, Scheme("authors", val=0.25))
    for fold in range(4):
        assert with_role(roles, "test", fold) == {name for name in labelled if "authors_role" in labelled[name]}
        assert with_role(roles, "val", fold) == {
            name for name in labelled if labelled[name].get("authors_fold") == fold
        }
        assert len(with_role(roles, "train", fold)) == 18


@pytest.mark.parametrize(("tests", "role"), [(0, "test"), (5, "val")])
def test_recordings_beside_the_blocks_are_dealt_into_as_many_even_parts(tests: int, role: str) -> None:
    without_block: dict[str, dict[str, str | int]] = {
        f"biotac-{i:03d}": {"sensor": "biotac", "material": i % 3} for i in range(24)
    }
    labelled = published_recordings(tests=tests) | without_block
    roles = assign(labelled, Scheme("authors", val=0.2, stratify="sensor,material"))
    parts = [with_role(roles, role, fold) & set(without_block) for fold in range(4)]
    assert sorted(name for part in parts for name in part) == sorted(without_block)
    assert all(Counter(without_block[name]["material"] for name in part) == {0: 2, 1: 2, 2: 2} for part in parts)
    other_seed = assign(labelled, Scheme("authors", val=0.2, stratify="sensor,material", seed=1))
    assert parts != [with_role(other_seed, role, fold) & set(without_block) for fold in range(4)]


def test_roles_that_authors_gave_beside_their_blocks_hold_in_every_fold() -> None:
    labelled = published_recordings()
    labelled |= {"x": {"material": 0, "authors_role": "train"}, "y": {"material": 0, "authors_role": "val"}}
    roles = assign(labelled, Scheme("authors", val=0.2))
    assert {roles["x", fold] for fold in range(4)} == {"train"}
    assert {roles["y", fold] for fold in range(4)} == {"val"}


def test_a_block_that_is_no_number_is_named() -> None:
    with pytest.raises(TacpipeError, match="Recording a has authors_fold first; it must be a whole number"):
        assign({"a": {"authors_fold": "first"}, "b": {"authors_fold": 0}}, Scheme("authors"))


# ---- few to train on


def training_names(count: int, **options: object) -> set[str]:
    scheme = Scheme(val=0.2, test=0.2, stratify="sensor,material", few=count, **options)  # type: ignore[arg-type]
    return with_role(assign(two_sensors(), scheme), "train")


def test_few_leaves_so_many_of_each_sensor_spread_over_materials_and_touches_no_other_role() -> None:
    labelled = two_sensors()
    scheme = Scheme(val=0.2, test=0.2, stratify="sensor,material")
    without_limit = assign(labelled, scheme)
    roles = assign(labelled, Scheme(val=0.2, test=0.2, stratify="sensor,material", few=8, few_by="sensor"))
    chosen = Counter((labelled[name]["sensor"], labelled[name]["material"]) for name in with_role(roles, "train"))
    assert set(chosen.values()) == {2}
    assert len(chosen) == 8
    assert with_role(roles, "unused") == with_role(without_limit, "train") - with_role(roles, "train")
    assert all(with_role(roles, role) == with_role(without_limit, role) for role in ("val", "test"))


@given(st.integers(1, 24), st.integers(1, 24), st.integers(0, 9))
def test_the_fewer_are_among_the_more(first: int, second: int, seed: int) -> None:
    fewer, larger = sorted((first, second))
    assert training_names(fewer, few_by="sensor", seed=seed) <= training_names(larger, few_by="sensor", seed=seed)
    assert len(training_names(fewer, few_by="sensor", seed=seed)) == 2 * fewer


def test_few_without_an_attribute_is_of_all_and_few_of_leaves_the_others_alone() -> None:
    assert len(training_names(10)) == 10
    chosen = Counter(name.split("-")[0] for name in training_names(10, few_of="sensor=roboskin"))
    assert chosen == {"biotac": 24, "roboskin": 10}
    assert len(training_names(1000)) == 48


def test_few_counts_those_that_an_older_split_trains_on() -> None:
    scheme = Scheme(val=0.2, test=0.2, few=10)
    old = assign(recordings(30), scheme)
    new = assign(recordings(60), scheme, keep=old)
    assert {key: new[key] for key in old} == old
    assert with_role(new, "train") == with_role(old, "train")


@pytest.mark.parametrize(
    ("scheme", "message"),
    [
        (Scheme(repeats=0), "repeats 0 does not fit"),
        (Scheme("kfold", folds=2, repeats=2), "repeats 2 does not fit the scheme kfold"),
        (Scheme(reverse=True), "reverse belongs to the scheme blocked"),
        (Scheme(few=-1), "few is -1"),
        (Scheme(few_by="object"), "few is 0; it must be the number"),
        (Scheme(few=2, few_of="object"), "few_of is 'object'; it must be an attribute and a value"),
        (Scheme(few=2, few_of="object=spoon"), "No recording has object spoon"),
        (Scheme(few=2, few_by="colour"), "has no attribute colour"),
        (Scheme(stratify="object,colour"), "has no attribute colour"),
    ],
)
def test_options_that_cannot_be_say_why(scheme: Scheme, message: str) -> None:
    with pytest.raises(TacpipeError, match=message):
        assign(recordings(6), scheme)


@given(st.sampled_from(["random", "kfold"]), st.integers(0, 99), st.integers(1, 4))
def test_values_of_the_group_stay_whole_in_every_fold(name: str, seed: int, trials: int) -> None:
    labelled = {
        f"o{i}-{trial}": {"object": f"o{i}", "session": f"s{i // 2}"} for i in range(16) for trial in range(trials)
    }
    roles = assign(labelled, Scheme(name, folds=4, seed=seed, val=0.2, test=0.25, group="object, session"))
    sessions = [[name for name, labels in labelled.items() if labels["session"] == f"s{i}"] for i in range(8)]
    assert len(roles) == len(labelled) * (4 if name == "kfold" else 1)
    assert not separated(roles, sessions)
    tests = Counter(recording for (recording, _), role in roles.items() if role == "test")
    assert sum(tests.values()) == len(labelled) * (1 if name == "kfold" else 0.25)
    assert set(tests.values()) == {1}


def test_groups_that_share_recordings_are_one_group() -> None:
    labelled = {f"t{i}": {"object": f"o{i % 6}", "session": f"s{i // 4}"} for i in range(24)}
    with pytest.raises(TacpipeError, match="2 folds cannot be made of 1 groups by object,session"):
        assign(labelled, Scheme("kfold", folds=2, group="object,session"))
    roles = assign(labelled, Scheme("kfold", folds=2, group="session", val=0.4))
    assert {role for (_, fold), role in roles.items() if fold == 0} == {"train", "val", "test"}


@given(st.sampled_from(["random", "kfold", "blocked", "leave-one-out", "authors"]), st.integers(0, 99))
def test_equal_recordings_have_one_role_in_every_scheme(name: str, seed: int) -> None:
    labelled = {f"t{i:02d}": {"object": f"o{i % 4}", "authors_role": ("train", "test")[i % 3 == 0]} for i in range(24)}
    equal = [["t00", "t01", "t13"], ["t02", "t23"]]
    roles = assign(labelled, Scheme(name, seed=seed), {}, equal)
    assert not separated(roles, equal)
    if name in ("leave-one-out", "authors"):  # the scheme selects what is tested: recordings are only added to that
        plain = assign(labelled, Scheme(name, seed=seed))
        assert {key for key, role in plain.items() if role == "test"} <= {
            key for key, role in roles.items() if role == "test"
        }


def test_a_copy_takes_the_role_of_the_recording_in_the_older_split() -> None:
    labelled = recordings(12)
    older = assign(labelled, Scheme(test=0.3))
    copies = {f"copy-{name}": labels for name, labels in labelled.items()}
    equal = [[f"copy-{name}", name] for name in labelled]
    roles = assign({**labelled, **copies}, Scheme(test=0.3), older, equal)
    assert {(name, fold): role for (name, fold), role in roles.items() if name in labelled} == older
    assert all(roles[f"copy-{name}", 0] == role for (name, _), role in older.items())
