"""Roles of recordings under each scheme."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.splits import Roles, Scheme, assign

OBJECTS = ("4", "10", "bottle")


def recordings(count: int, **attributes: str) -> dict[str, dict[str, str]]:
    return {f"trial-{i:03d}": {"object": OBJECTS[i % 3], **attributes} for i in range(count)}


def with_role(roles: Roles, role: str, fold: int = 0) -> set[str]:
    return {name for (name, at), found in roles.items() if found == role and at == fold}


@given(st.integers(5, 200), st.floats(0, 0.4), st.floats(0, 0.4), st.integers(0, 9))
def test_random_gives_every_recording_one_role_and_the_shares_asked_for(
    count: int, val: float, test: float, seed: int
) -> None:
    roles = assign(recordings(count), Scheme(val=val, test=test, seed=seed))
    assert len(roles) == count
    assert Counter(roles.values())["test"] == round(test * count)
    assert Counter(roles.values())["val"] == round(val * count)


def test_the_order_in_which_recordings_come_does_not_matter_and_the_seed_does() -> None:
    found = recordings(30)
    reverse = dict(reversed(found.items()))
    for name in ("random", "kfold", "blocked", "leave-one-out"):
        assert assign(found, Scheme(name)) == assign(reverse, Scheme(name))
    assert assign(found, Scheme(seed=0)) != assign(found, Scheme(seed=1))


@pytest.mark.parametrize("name", ["random", "blocked"])
def test_stratified_shares_hold_for_every_object(name: str) -> None:
    found = recordings(60)
    roles = assign(found, Scheme(name, val=0.1, test=0.2, stratify="object"))
    tested = Counter(found[recording]["object"] for recording in with_role(roles, "test"))
    assert tested == {"4": 4, "10": 4, "bottle": 4}


def test_kfold_tests_every_recording_once_in_parts_that_differ_by_one() -> None:
    found = recordings(23)
    roles = assign(found, Scheme("kfold", folds=5, val=0.1, stratify="object"))
    parts = [with_role(roles, "test", fold) for fold in range(5)]
    assert sorted(name for part in parts for name in part) == sorted(found)
    assert {len(part) for part in parts} == {4, 5}
    assert all(len(with_role(roles, "val", fold)) == 2 for fold in range(5))


def objects(count: int, trials: int) -> dict[str, dict[str, str]]:
    """Recordings of ``count`` objects, so many of each."""
    return {f"o{i}-{j}": {"object": f"o{i}"} for i in range(count) for j in range(trials)}


@pytest.mark.parametrize("stratify", ["", "object"])
def test_kfold_apart_tests_unknown_objects_and_known_ones_side_by_side(stratify: str) -> None:
    found = objects(7, 6)
    roles = assign(found, Scheme("kfold", folds=3, val=0.2, stratify=stratify, apart="object"))
    plain = assign(found, Scheme("kfold", folds=3, val=0.2, stratify=stratify))
    unknown_in: list[str] = []
    for fold in range(3):
        learned = {found[name]["object"] for role in ("train", "val") for name in with_role(roles, role, fold)}
        unknown = {one["object"] for one in found.values()} - learned
        unknown_in += unknown
        tested = with_role(roles, "test", fold)
        assert {name for name in found if found[name]["object"] in unknown} <= tested
        known = {name for name in tested if found[name]["object"] in learned}
        assert known == {name for name in with_role(plain, "test", fold) if found[name]["object"] in learned}
        assert known
        assert with_role(roles, "val", fold)
    assert sorted(unknown_in) == sorted({one["object"] for one in found.values()})  # each is unknown once


def test_the_objects_that_are_unknown_together_follow_from_the_seed_and_parts_are_even() -> None:
    found = objects(8, 1)
    alike = [assign(found, Scheme("kfold", folds=4, val=0, seed=seed, apart="object")) for seed in (1, 1, 2)]
    assert alike[0] == alike[1] != alike[2]
    assert all(2 <= len(with_role(alike[0], "test", fold)) <= 4 for fold in range(4))  # 2 unknown, up to 2 known


def test_a_recording_that_comes_in_later_is_unknown_together_with_its_object() -> None:
    scheme = Scheme("kfold", folds=3, val=0.2, apart="object")
    old = assign(objects(6, 4), scheme)
    found = objects(9, 5)
    new = assign(found, scheme, keep=old)
    assert {key: new[key] for key in old} == old
    learned = [{found[name]["object"] for name in found if new[name, fold] in ("train", "val")} for fold in range(3)]
    unknown = [{f"o{i}" for i in range(9)} - one for one in learned]
    assert sorted(name for one in unknown for name in one) == sorted(f"o{i}" for i in range(9))
    assert {len(one) for one in unknown} == {3}


def test_an_older_split_that_kept_nothing_apart_cannot_be_extended_to_do_so() -> None:
    old = assign(objects(4, 6), Scheme("kfold", folds=3))
    with pytest.raises(TacpipeError, match="did not keep object apart"):
        assign(objects(4, 7), Scheme("kfold", folds=3, apart="object"), keep=old)


def test_blocked_trains_on_the_first_and_tests_the_last() -> None:
    roles = assign(recordings(10), Scheme("blocked", val=0.2, test=0.3))
    assert [roles[f"trial-{i:03d}", 0] for i in range(10)] == ["train"] * 5 + ["val"] * 2 + ["test"] * 3


def test_leave_one_out_has_a_fold_a_value_in_the_order_of_numbers() -> None:
    found = recordings(12)
    roles = assign(found, Scheme("leave-one-out", val=0.25))
    for fold, value in enumerate(("4", "10", "bottle")):
        assert {found[name]["object"] for name in with_role(roles, "test", fold)} == {value}
        assert len(with_role(roles, "val", fold)) == 2


def test_authors_roles_are_taken_and_val_is_drawn_from_their_training_part() -> None:
    found = recordings(20, authors_role="train") | {"x": {"authors_role": "test"}}
    roles = assign(found, Scheme("authors", val=0.2))
    assert with_role(roles, "test") == {"x"}
    assert len(with_role(roles, "val")) == 4


def test_authors_own_val_is_left_as_it_is() -> None:
    found = recordings(5, authors_role="train") | {"x": {"authors_role": "val"}}
    assert with_role(assign(found, Scheme("authors", val=0.4)), "val") == {"x"}


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
        (Scheme(val=0.6, test=0.5), "leave nothing to train on"),
        (Scheme("kfold", folds=1), "1 folds cannot be made"),
        (Scheme("leave-one-out", by="colour"), "has no attribute colour; it has object"),
        (Scheme(stratify="colour"), "has no attribute colour"),
        (Scheme("kfold", folds=4, apart="object"), "3 values of object cannot be kept apart in 4 folds"),
        (Scheme("kfold", folds=2, apart="colour"), "has no attribute colour"),
        (Scheme("random", apart="object"), "apart object goes with the scheme kfold alone"),
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
