from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.tasks.material.losses import NONE, BatchPairs, permuted_classes

LABELS = torch.arange(600) % 20


def two(**changed: Any) -> BatchPairs:
    return BatchPairs({"a": LABELS, "b": LABELS.flip(0)}, 32, **changed)


def visited(pairs: BatchPairs, sensor: str) -> list[int]:
    return [int(row) for batch in pairs.epoch() for row in batch[sensor] if row != NONE]


@pytest.mark.parametrize("percent, count", [(100, 576), (90, 512), (50, 288), (25, 160), (17, 96), (11, 64)])
def test_a_reduced_sensor_learns_from_the_same_few_slides_in_every_epoch(percent: int, count: int) -> None:
    whole = two(pairing="fixed", shuffle=False, drop_last=True)
    reduced = two(pairing="fixed", shuffle=False, subsample_sensor="b", subsample_percent=percent)
    order = visited(whole, "b")
    every = {100: 1, 50: 2, 25: 4, 17: 6, 11: 9}.get(percent)
    kept = [n for n in range(18) if (n % every == 0 if every else n % 10)]
    assert visited(reduced, "b") == [row for n in kept for row in order[32 * n : 32 * n + 32]]
    assert len(visited(reduced, "b")) == count
    assert visited(reduced, "b") == visited(reduced, "b")
    assert visited(reduced, "a") == visited(whole, "a")
    assert len(visited(reduced, "a")) == 576


def test_every_slide_is_seen_once_an_epoch_and_the_last_batch_is_not_dropped() -> None:
    pairs = two()
    assert [len(batch["a"]) for batch in pairs.epoch()] == [32] * 18 + [24]
    for sensor in "ab":
        assert sorted(visited(pairs, sensor)) == list(range(600))


def test_dropping_the_last_batch_leaves_whole_ones() -> None:
    assert [len(batch["a"]) for batch in two(drop_last=True).epoch()] == [32] * 18


@given(st.lists(st.integers(0, 3), min_size=1, max_size=30), st.lists(st.integers(-1, 3), min_size=1, max_size=30))
def test_the_slides_of_a_row_are_of_the_same_class(first_classes: list[int], second_classes: list[int]) -> None:
    pairs = BatchPairs({"a": torch.tensor(first_classes), "b": torch.tensor(second_classes)}, 4)
    rows = [row for batch in pairs.epoch() for row in zip(batch["a"].tolist(), batch["b"].tolist(), strict=True)]
    for first, second in rows:
        if NONE not in (first, second):
            assert first_classes[first] == second_classes[second]
    assert sorted(first for first, _ in rows if first != NONE) == list(range(len(first_classes)))
    assert sorted(second for _, second in rows if second != NONE) == list(range(len(second_classes)))
    assert (NONE, NONE) not in rows
    both = sum(NONE not in row for row in rows)
    assert both == sum(min(first_classes.count(kind), second_classes.count(kind)) for kind in range(4))


def test_permuted_pairs_are_of_the_partner_class_and_of_no_class_with_itself() -> None:
    partners = permuted_classes(range(20), seed=3)
    assert sorted(partners) == sorted(partners.values()) == list(range(20))
    assert all(row != partner for row, partner in partners.items())
    pairs = two(pairing="permuted", partners=partners)
    for batch in pairs.epoch():
        for first, second in zip(batch["a"].tolist(), batch["b"].tolist(), strict=True):
            assert partners[first % 20] == (599 - second) % 20


def test_random_pairs_differ_from_epoch_to_epoch_and_fixed_ones_do_not() -> None:
    def matched(pairs: BatchPairs) -> set[tuple[int, int]]:
        return {row for batch in pairs.epoch() for row in zip(batch["a"].tolist(), batch["b"].tolist(), strict=True)}

    fixed, random, unshuffled = two(pairing="fixed"), two(), two(shuffle=False)
    assert matched(fixed) == matched(fixed)
    assert matched(unshuffled) == matched(unshuffled)
    assert matched(random) != matched(random)
    assert visited(fixed, "a") != visited(fixed, "a")
    assert visited(unshuffled, "a") == visited(unshuffled, "a")


def test_the_same_state_of_the_generator_gives_the_same_epoch() -> None:
    pairs = two()
    torch.manual_seed(7)
    first = visited(pairs, "b")
    torch.manual_seed(7)
    assert visited(pairs, "b") == first


def test_three_sensors_are_dealt_side_by_side() -> None:
    pairs = BatchPairs({"a": LABELS[:40], "b": LABELS[:60], "c": LABELS[:20]}, 16)
    rows = [row for batch in pairs.epoch() for row in zip(*(batch[name].tolist() for name in "abc"), strict=True)]
    assert len(rows) == 60
    for row in rows:
        assert len({number % 20 for number in row if number != NONE}) == 1


@pytest.mark.parametrize(
    "changed, sentence",
    [
        ({"pairing": "none"}, "pairing is 'none'"),
        ({"subsample_percent": 30, "subsample_sensor": "a", "shuffle": False}, "subsample_percent is 30"),
        ({"subsample_sensor": "c", "shuffle": False}, "subsample_sensor is c"),
        ({"subsample_sensor": "a", "subsample_percent": 50}, "give --no-shuffle"),
    ],
)
def test_what_cannot_be_dealt_is_refused(changed: dict[str, object], sentence: str) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        two(**changed)


def test_one_material_has_no_other_to_be_paired_with() -> None:
    with pytest.raises(TacpipeError, match="1 material cannot be paired"):
        permuted_classes([4], seed=0)
