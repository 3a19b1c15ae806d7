"""Assign the roles train, val, calibration and test to whole recordings, never to windows.

Windows of one recording overlap and resemble each other, so splitting them would test on training data. Roles depend
only on names, attributes and a seed, not on the order of the names.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tacpipe.channels.schema import TRUTH
from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import ROLES, Attribute
from tacpipe.printable import listed, plain, suggestion

SCHEMES = ("random", "kfold", "blocked", "leave-one-out", "authors")
SHARES = (0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6)  # fractions of validation recordings that errors suggest
_NAMED = 12  # number of attributes named in an error
UNUSED = "unused"  # role of recordings that a few-shot split removes from training
_PRECEDENCE = ("test", "val", "calibration", "train", UNUSED)  # the first role of equal recordings becomes that of all
Attributes = Mapping[str, Attribute]
Roles = dict[tuple[str, int], str]  # (recording, fold) -> role


@dataclass(frozen=True)
class Scheme:
    """How recordings are assigned to roles."""

    name: str = "random"
    # fraction of the recordings, or of the training recordings if the scheme selects the test recordings
    val: float = 0.15
    calibration: float = 0.0  # fraction for calibration, of the same recordings as val
    test: float = 0.15  # fraction of the recordings; ignored if the scheme selects them
    seed: int = 0
    folds: int = 5  # kfold: number of folds
    by: str = "object"  # leave-one-out: attribute whose values are tested one by one
    stratify: str = ""  # comma-separated attributes whose values are spread evenly over the roles; empty for none
    apart: str = ""  # kfold: attribute whose values are divided among the folds, each unknown in one; empty for none
    # random, kfold: comma-separated attributes, recordings with equal values stay together; empty: none
    group: str = ""
    repeats: int = 1  # random: number of folds, each drawn independently
    reverse: bool = False  # blocked: test the first recordings and train on the last
    few: int = 0  # number of training recordings; others are unused; 0 for all
    few_by: str = ""  # attribute with ``few`` training recordings per value; empty for ``few`` in total
    # attribute=value of the recordings that ``few`` applies to, such as sensor=roboskin; empty for all
    few_of: str = ""


def assign(
    attributes: Mapping[str, Attributes],
    scheme: Scheme,
    keep: Mapping[tuple[str, int], str] = {},
    equal: Sequence[Sequence[str]] = (),
) -> Roles:
    """Return the role of each recording in each fold. ``attributes`` contains the attributes of each recording by name.

    ============== =====================================================================================
    random         fractions ``test``, ``val`` and ``calibration``, drawn independently in each of ``repeats`` folds
    kfold          in fold k the k-th of ``folds`` equal parts is tested, ``val`` of the others is drawn at random
    blocked        in the order of names, which for most sets is that of time: train, then calibration, val, test;
                   reversed with ``reverse``
    leave-one-out  in fold k the recordings with the k-th value of ``by`` are tested
    authors        the attribute ``authors_role``; if none of them is val, ``val`` of train is drawn.
                   If recordings have ``authors_fold``, there is one fold per block: see below
    ============== =====================================================================================

    In all schemes ``calibration`` is a fraction of the same recordings as ``val``.

    Blocks of ``authors_fold`` take turns. If recordings have the ``authors_role`` test, these are tested in every fold,
    and the k-th block is val in fold k. Otherwise the k-th block is tested, and ``val`` of the others is drawn.
    Recordings with neither attribute are divided into as many equal parts, which take the same turns.

    With ``apart``, fold k of kfold tests all recordings with the attribute's values in its k-th part, so that none of
    these values is in train or val, and in addition the k-th part of the other recordings. So unknown and known values
    are tested together, and every value is unknown in one fold.

    With ``few``, only this number of the training recordings is used, spread evenly over the values of ``stratify``;
    the others have the role ``unused``. The recordings of a smaller ``few`` are a subset of those of a larger one.

    With ``group``, recordings that share the value of one of its attributes have the same role. Groups are drawn like
    recordings, so fractions are those of groups.

    ``keep`` contains the roles of an older split, which are not changed; only recordings without a role are assigned.
    ``equal`` are groups of recordings with equal content, which get the same role: they are drawn as one recording, or
    if the scheme selects the test recordings, all have the role of the first in the order test, val, calibration, train.
    Raises `TacpipeError` for an invalid scheme, fraction or attribute, and if no recording is left for training.
    """
    older_names = {name for name, _ in keep}
    is_drawn = scheme.name in ("random", "blocked") or (scheme.name == "kfold" and not scheme.apart)
    leaders = _leaders(attributes, scheme, older_names, equal if is_drawn else ())
    drawn = (
        {name: labels for name, labels in attributes.items() if leaders.get(name, name) == name}
        if leaders
        else attributes
    )
    _check(drawn, scheme)
    fresh = sorted(set(drawn).difference(older_names))
    if scheme.name == "random":
        folds = [_draw_roles(fresh, drawn, scheme, draw) for draw in range(scheme.repeats)]
    elif scheme.name == "blocked":
        folds = [_assign_blocks(fresh, drawn, scheme)]
    elif scheme.name == "authors":
        folds = _assign_author_roles(fresh, drawn, scheme)
    elif scheme.name == "kfold":
        folds = _assign_folds(fresh, drawn, scheme, keep)
    else:
        folds = _leave_one_out(drawn, scheme, keep)
    roles = {(name, fold): role for fold, roles_by_name in enumerate(folds) for name, role in roles_by_name.items()}
    older_roles = _older_roles(attributes, keep, len(folds), scheme)
    roles |= older_roles
    roles = {
        (name, fold): roles[leader, fold] for name, leader in leaders.items() for fold in range(len(folds))
    } | roles
    if scheme.few:
        roles |= _limit_training(roles, older_roles, attributes, scheme)
    for group, fold in itertools.product(equal, range(len(folds))):
        decisive = [name for name in group if (name, fold) in older_roles] or group
        role = min((roles[name, fold] for name in decisive), key=_PRECEDENCE.index)
        roles |= {(name, fold): role for name in group if (name, fold) not in older_roles}
    for fold in range(len(folds)):
        if not any(role == "train" for (_, at), role in roles.items() if at == fold):
            raise TacpipeError(
                f"Fold {fold} of the {scheme.name} split leaves none of {len(attributes)} recordings to train on. "
                f"Lower val and test, or add recordings."
            )
    return dict(sorted(roles.items(), key=lambda item: (item[0][1], item[0][0])))


def separated(roles: Mapping[tuple[str, int], str], groups: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Return the groups of recordings with different roles in any fold.

    >>> separated({("a", 0): "train", ("b", 0): "test", ("c", 0): "test"}, [["a", "b"], ["b", "c"]])
    [['a', 'b']]
    """
    folds = {fold for _, fold in roles}
    return [group for group in groups if any(len({roles[name, fold] for name in group}) > 1 for fold in folds)]


def without_val(roles: Mapping[tuple[str, int], str]) -> list[int]:
    """Return the folds in which no recording has the role val, sorted.

    >>> without_val({("a", 0): "train", ("b", 0): "val", ("a", 1): "test", ("b", 1): "train"})
    [1]
    """
    return sorted({fold for _, fold in roles} - {fold for (_, fold), role in roles.items() if role == "val"})


def sufficient_val(
    attributes: Mapping[str, Attributes],
    scheme: Scheme,
    keep: Mapping[tuple[str, int], str] = {},
    equal: Sequence[Sequence[str]] = (),
) -> float | None:
    """Return the smallest of some larger fractions ``val`` with validation recordings in each fold, or None.

    Arguments are those of `assign`.
    """
    for val in SHARES:
        try:
            if val > scheme.val and not without_val(assign(attributes, replace(scheme, val=val), keep, equal)):
                return val
        except TacpipeError:  # such a large fraction leaves no training recordings
            continue
    return None


def _check(attributes: Mapping[str, Attributes], scheme: Scheme) -> None:
    """Raise `TacpipeError` for an unknown scheme, no recordings, or fractions and folds that leave none to train on."""
    if scheme.name not in SCHEMES:
        raise TacpipeError(f"There is no split scheme {scheme.name}; there are {', '.join(SCHEMES)}.")
    if not attributes:
        raise TacpipeError("There are no recordings to split. Give a dataset with recordings.")
    shares = (scheme.val, scheme.calibration, scheme.test)
    if min(shares) < 0 or sum(shares) >= 1:
        raise TacpipeError(
            f"val {scheme.val}, calibration {scheme.calibration} and test {scheme.test} leave no recordings to train "
            "on; each must be 0 or more, and their sum below 1."
        )
    if scheme.name == "kfold" and not 2 <= scheme.folds <= len(attributes):
        units = f"groups by {plain(scheme.group)}" if scheme.group else "recordings"
        raise TacpipeError(
            f"{scheme.folds} folds cannot be made of {len(attributes)} {units}; folds must lie between 2 and that."
        )
    _check_options(scheme)


def _check_options(scheme: Scheme) -> None:
    """Raise `TacpipeError` for options that the scheme does not have, or values that are out of range."""
    if scheme.apart and scheme.name != "kfold":
        raise TacpipeError(
            f"apart {scheme.apart} belongs to the scheme kfold, not to {scheme.name}. "
            f"To keep values apart one by one, choose leave-one-out by {scheme.apart}."
        )
    if scheme.repeats < 1 or (scheme.repeats > 1 and scheme.name != "random"):
        raise TacpipeError(
            f"repeats {scheme.repeats} does not fit the scheme {scheme.name}; it must be 1 or more, and 1 with all "
            f"schemes but random."
        )
    if scheme.reverse and scheme.name != "blocked":
        raise TacpipeError(f"reverse belongs to the scheme blocked, not to {scheme.name}; leave it out.")
    if scheme.few < 0 or (not scheme.few and (scheme.few_by or scheme.few_of)):
        raise TacpipeError(
            f"few is {scheme.few}; it must be the number of recordings to train on, or 0 for all, without few_by and "
            f"few_of."
        )
    if scheme.few_of and not all(scheme.few_of.partition("=")):
        raise TacpipeError(f"few_of is {scheme.few_of!r}; it must be an attribute and a value, as sensor=roboskin.")


def _leaders(
    attributes: Mapping[str, Attributes], scheme: Scheme, older_names: Collection[str], equal: Sequence[Sequence[str]]
) -> dict[str, str]:
    """Return the recording that is drawn for each recording, or nothing if each is drawn itself.

    Recordings that share a value of ``group`` or are ``equal`` are drawn as one, directly or through others. It is the
    first by name, or the first with a role in the older split.
    """
    groups: dict[object, list[str]] = {number: list(group) for number, group in enumerate(equal)}
    for attribute in filter(None, map(str.strip, scheme.group.split(","))):
        for name in sorted(attributes):
            groups.setdefault((attribute, _value(name, attributes, attribute)), []).append(name)
    members = {name: [name] for name in sorted(attributes)} if groups else {}  # recordings joined with each
    for group in groups.values():
        for name in group[1:]:
            if members[name] is not members[group[0]]:
                members[group[0]] += members[name]
                members |= dict.fromkeys(members[name], members[group[0]])
    return {
        name: min(joined, key=lambda member: (member not in older_names, member)) for name, joined in members.items()
    }


def _draw_roles(
    names: Sequence[str], attributes: Mapping[str, Attributes], scheme: Scheme, draw: int
) -> dict[str, str]:
    """Return roles with the fractions of the scheme, with the values of ``stratify`` spread evenly over them."""
    order = _order(names, attributes, scheme, np.random.default_rng([scheme.seed, draw]))
    return _assign_in_order(order, scheme, ("test", "val", "calibration", "train"))


def _assign_in_order(order: Sequence[str], scheme: Scheme, roles: Sequence[str]) -> dict[str, str]:
    """Return the role of each recording: the first recordings in ``order`` have the first role, and so on."""
    shares = {"val": scheme.val, "calibration": scheme.calibration, "test": scheme.test}
    counts = {role: round(share * len(order)) for role, share in shares.items()}
    counts["train"] = len(order) - sum(counts.values())
    return dict(zip(order, (role for role in roles for _ in range(counts[role])), strict=False))


def _order(
    names: Sequence[str], attributes: Mapping[str, Attributes], scheme: Scheme, rng: np.random.Generator
) -> list[str]:
    """Return the names in an order in which every prefix has the same fraction of each stratum, to within one recording.

    Recordings are shuffled within their stratum, and sorted by (rank + 1/2) / size of the stratum.
    """
    positions: dict[str, float] = {}
    for stratum in _strata(names, attributes, scheme).values():
        shuffled = rng.permutation(len(stratum))
        positions |= {stratum[i]: (rank + 0.5) / len(stratum) for rank, i in enumerate(shuffled)}
    ties = dict(zip(names, rng.random(len(names)), strict=True))
    return sorted(names, key=lambda name: (positions[name], ties[name]))


def _limit_training(
    roles: Roles, older_roles: Mapping[tuple[str, int], str], attributes: Mapping[str, Attributes], scheme: Scheme
) -> Roles:
    """Return the role ``unused`` for training recordings beyond ``few``. Roles of an older split do not change.

    Raises `TacpipeError` if no recording has the value of ``few_of``.
    """
    attribute, _, value = scheme.few_of.partition("=")
    candidates = [name for name in sorted(attributes) if not attribute or _value(name, attributes, attribute) == value]
    if not candidates:
        raise TacpipeError(f"No recording has {attribute} {value}, of which few was to leave {scheme.few} to train on.")
    groups: dict[str, list[str]] = {}
    for name in candidates:
        groups.setdefault(_value(name, attributes, scheme.few_by) if scheme.few_by else "", []).append(name)
    unused: Roles = {}
    for fold in sorted({fold for _, fold in roles}):
        for group in _sort_naturally(set(groups)):
            trained = [name for name in groups[group] if roles.get((name, fold)) == "train"]
            new_names = [name for name in trained if (name, fold) not in older_roles]
            used_count = max(scheme.few - (len(trained) - len(new_names)), 0)
            order = _order(new_names, attributes, scheme, np.random.default_rng([scheme.seed, fold, 1]))
            unused |= {(name, fold): UNUSED for name in order[used_count:]}
    return unused


def _draw_validation(
    names: Sequence[str], attributes: Mapping[str, Attributes], scheme: Scheme, draw: int
) -> dict[str, str]:
    """Return roles of recordings that are not tested: the shares ``val`` and ``calibration`` of them, the rest train."""
    return _draw_roles(names, attributes, replace(scheme, test=0), draw)


def _assign_blocks(names: Sequence[str], attributes: Mapping[str, Attributes], scheme: Scheme) -> dict[str, str]:
    """Return roles in the order of names, stratum by stratum, reversed with ``reverse``."""
    roles: dict[str, str] = {}
    for stratum in _strata(names, attributes, scheme).values():
        order = stratum[::-1] if scheme.reverse else stratum
        roles |= _assign_in_order(order, scheme, ("train", "calibration", "val", "test"))
    return roles


def _assign_author_roles(
    names: Sequence[str], attributes: Mapping[str, Attributes], scheme: Scheme
) -> list[dict[str, str]]:
    """Return the folds of the scheme authors. Raises `TacpipeError` if a recording has no valid ``authors_role``."""
    blocks = sorted({_block(name, attributes) for name in attributes if _has_block(attributes[name])})
    if blocks:
        return _authors_folds(names, attributes, scheme, blocks)
    roles = {}
    for name in names:
        role = attributes[name].get("authors_role")
        if role not in ROLES:
            problem = f"has authors_role {role!r}" if role is not None else "has no attribute authors_role"
            raise TacpipeError(
                f"Recording {name} {problem}; the scheme authors needs {', '.join(ROLES)} there. Ingest with "
                f"--authors-role, set it with `tacpipe label`, or choose another scheme."
            )
        roles[name] = str(role)
    drawn_scheme = replace(scheme, val=0) if "val" in roles.values() else scheme
    trained = [name for name in names if roles[name] == "train"]
    return [roles | _draw_validation(trained, attributes, drawn_scheme, 0)]


def _authors_folds(
    names: Sequence[str], attributes: Mapping[str, Attributes], scheme: Scheme, blocks: Sequence[int]
) -> list[dict[str, str]]:
    """Return one fold per block: the block is val if the authors name the test recordings, and test otherwise."""
    declared = {name: attributes[name].get("authors_role") for name in names}
    fixed = {name: str(declared[name]) for name in names if declared[name] == "test"}
    fixed |= {
        name: str(declared[name]) for name in names if declared[name] in ROLES and not _has_block(attributes[name])
    }
    published = any(recording.get("authors_role") == "test" for recording in attributes.values())
    part = {name: blocks.index(_block(name, attributes)) for name in names if _has_block(attributes[name])}
    part |= _assign_parts(
        [name for name in names if name not in part and name not in fixed], attributes, scheme, len(blocks)
    )
    folds = []
    for fold in range(len(blocks)):
        block_names = [name for name in names if name not in fixed and part[name] == fold]
        remaining = [name for name in names if name not in fixed and part[name] != fold]
        if published:
            trained = _draw_validation(remaining, attributes, replace(scheme, val=0), fold + 1)
            folds.append(fixed | trained | dict.fromkeys(block_names, "val"))
        else:
            folds.append(
                fixed | _draw_validation(remaining, attributes, scheme, fold + 1) | dict.fromkeys(block_names, "test")
            )
    return folds


def _has_block(attributes: Attributes) -> bool:
    return attributes.get("authors_fold") is not None


def _block(name: str, attributes: Mapping[str, Attributes]) -> int:
    block = str(attributes[name]["authors_fold"])
    if not block.isdecimal():
        raise TacpipeError(f"Recording {name} has authors_fold {block}; it must be a whole number, 0 or more.")
    return int(block)


def _assign_folds(
    names: Sequence[str], attributes: Mapping[str, Attributes], scheme: Scheme, keep: Mapping[tuple[str, int], str]
) -> list[dict[str, str]]:
    """Return the folds of the scheme kfold, with the values of ``apart`` that each tests; ``keep`` is an older split."""
    part = _assign_parts(names, attributes, scheme, scheme.folds)
    unknown = _unknown(attributes, scheme, keep) if scheme.apart else {}
    folds = []
    for fold in range(scheme.folds):
        tested = {name for name in names if fold in (part[name], unknown.get(name))}
        roles = _draw_validation([name for name in names if name not in tested], attributes, scheme, fold + 1)
        folds.append(roles | dict.fromkeys(tested, "test"))
    return folds


def _assign_parts(
    names: Sequence[str], attributes: Mapping[str, Attributes], scheme: Scheme, count: int
) -> dict[str, int]:
    """Return the index of each recording's part, of ``count`` parts whose sizes differ by at most one.

    Recordings are shuffled within each stratum, and then assigned to the parts in turn.
    """
    rng = np.random.default_rng(scheme.seed)
    strata = _strata(names, attributes, scheme).values()
    order = itertools.chain.from_iterable([stratum[i] for i in rng.permutation(len(stratum))] for stratum in strata)
    return {name: i % count for i, name in enumerate(order)}


def _unknown(
    attributes: Mapping[str, Attributes], scheme: Scheme, keep: Mapping[tuple[str, int], str]
) -> dict[str, int]:
    """Return the fold in which each recording's value of ``apart`` is unknown.

    Values are shuffled, and each is assigned to the fold with the fewest; values of an older split keep their fold.
    Raises `TacpipeError` if there are fewer values than folds.
    """
    values = {name: _value(name, attributes, scheme.apart) for name in sorted(attributes)}
    distinct = _sort_naturally(set(values.values()))
    if len(distinct) < scheme.folds:
        raise TacpipeError(
            f"{len(distinct)} values of {scheme.apart} cannot be kept apart in {scheme.folds} folds, because a fold "
            f"would have none; make at most {len(distinct)} folds."
        )
    fold_of = _unknown_before(values, scheme, keep)
    counts = Counter(fold_of.values())
    for i in np.random.default_rng([scheme.seed, 0]).permutation(len(distinct)):
        if distinct[i] not in fold_of:
            fold_of[distinct[i]] = min(range(scheme.folds), key=lambda fold: (counts[fold], fold))
            counts[fold_of[distinct[i]]] += 1
    return {name: fold_of[value] for name, value in values.items()}


def _unknown_before(values: Mapping[str, str], scheme: Scheme, keep: Mapping[tuple[str, int], str]) -> dict[str, int]:
    """Return, for each value, the fold in which an older split tests all recordings with this value.

    Raises `TacpipeError` if there is no such fold.
    """
    folds_of: dict[str, set[int]] = {name: set() for name, _ in keep if name in values}
    for (name, fold), role in keep.items():
        if role == "test" and name in folds_of:
            folds_of[name].add(fold)
    tested: dict[str, set[int]] = {}
    for name, folds in sorted(folds_of.items()):
        tested[values[name]] = tested.get(values[name], folds) & folds
    values_in_training = [value for value, folds in tested.items() if not folds]
    if values_in_training:
        raise TacpipeError(
            f"The older split has no fold that tests all recordings of {scheme.apart} {values_in_training[0]}, so it "
            f"did not keep {scheme.apart} apart. Make a new split, or leave apart as it was."
        )
    return {value: min(folds) for value, folds in tested.items()}


def _leave_one_out(
    attributes: Mapping[str, Attributes], scheme: Scheme, keep: Mapping[tuple[str, int], str]
) -> list[dict[str, str]]:
    """Return one fold per value of ``by``, in sorted order; values that an older split tested keep their fold.

    Raises `TacpipeError` if there is only one value.
    """
    values = {name: _value(name, attributes, scheme.by) for name in sorted(attributes)}
    older_values = {
        fold: values[name] for (name, fold), role in sorted(keep.items()) if role == "test" and name in values
    }
    tested_values = [older_values[fold] for fold in sorted(older_values)]
    tested_values += [value for value in _sort_naturally(set(values.values())) if value not in tested_values]
    if len(tested_values) < 2:
        raise TacpipeError(
            f"All recordings have {scheme.by} {tested_values[0]}; leaving it out leaves none to train on."
        )
    folds = []
    for fold, value in enumerate(tested_values):
        roles = _draw_validation([name for name in values if values[name] != value], attributes, scheme, fold + 1)
        folds.append(roles | {name: "test" for name in values if values[name] == value})
    return folds


def _older_roles(
    attributes: Mapping[str, Attributes], keep: Mapping[tuple[str, int], str], folds: int, scheme: Scheme
) -> Roles:
    """Return the older roles of recordings that still exist. Raises `TacpipeError` if they do not match the scheme."""
    old = {fold for _, fold in keep}
    grown = scheme.name == "leave-one-out" and len(old) <= folds  # a new value adds a fold
    if keep and old != set(range(folds)) and not grown:
        raise TacpipeError(
            f"The older split has {len(old)} folds and the scheme {scheme.name} makes {folds}; the numbers must be equal. "
            f"Give the scheme and the folds of the older split."
        )
    return {(name, fold): role for (name, fold), role in keep.items() if name in attributes}


def _strata(
    names: Sequence[str], attributes: Mapping[str, Attributes], scheme: Scheme
) -> dict[tuple[str, ...], list[str]]:
    """Return the recordings by combination of values of the attributes ``stratify``, sorted by these values."""
    stratified = [attribute.strip() for attribute in scheme.stratify.split(",") if attribute.strip()]
    strata: dict[tuple[str, ...], list[str]] = {}
    for name in sorted(names):
        strata.setdefault(tuple(_value(name, attributes, attribute) for attribute in stratified), []).append(name)
    return {
        values: strata[values]
        for values in sorted(strata, key=lambda values: [_natural_key(value) for value in values])
    }


def _value(name: str, attributes: Mapping[str, Attributes], attribute: str) -> str:
    """Return the text of a recording's attribute. Raises `TacpipeError` if it has none."""
    value = attributes[name].get(attribute)
    if value is None:
        labels = sorted(label for label in attributes[name] if not label.startswith(TRUTH))
        raise TacpipeError(
            f"Recording {name} has no attribute {plain(attribute)}; it has {listed(labels, _NAMED)}."
            f"{suggestion(attribute, labels)} Name another one or set it with `tacpipe label`."
        )
    return str(value)


def _sort_naturally(values: set[str]) -> list[str]:
    """Sort text, with integers by value: 4, 10, bottle."""
    return sorted(values, key=_natural_key)


def _natural_key(value: str) -> tuple[int, int, str]:
    return (0, int(value), "") if value.isdecimal() else (1, 0, value)
