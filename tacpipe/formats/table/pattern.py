"""Match paths with patterns such as ``{trial}/skin_{hand}.csv`` and return the text of their placeholders.

``{name}`` matches one or more characters except slashes; ``*`` any text without a slash, ``**`` any folders. A
placeholder that occurs twice must match the same text.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath

from tacpipe.errors import UsageError
from tacpipe.printable import plain

TRIAL = "trial"  # placeholder that distinguishes the recordings in a folder
_ISO_DATE = r"(?:19|20)\d\d(?P<mark>[-_.]?)[01]\d(?P=mark)[0-3]\d"
_DATE = rf"(?<!\d)(?:{_ISO_DATE}|[0-3]\d(?P<point>[-_.])[01]\d(?P=point)(?:19|20)\d\d)"
_CLOCK = r"(?:[-_ T]{1,3}[0-2]\d(?P<colon>[-_.h]?)[0-5]\d(?:(?P=colon)[0-5]\d)?(?!\d))?"
_SLOT = re.compile(rf"(?P<date>{_DATE}{_CLOCK})|\d+")
_COUNTED = (  # words before numbers that count recordings rather than parts of a sensor
    "trial|run|session|take|episode|day|subject|participant|person|user|object|obj|item|grasp|slide|press|contact|exp|experiment|test|rep|repetition|set|series|recording|rec|sample|demo|sequence|seq|log|measurement|file|cycle"
)
_COUNTER = re.compile(rf"(?:^|[^a-z])({_COUNTED})[-_ #.]*$", re.IGNORECASE)
_Token = tuple[str, str]  # kind (each letter of a name is its own kind) and text
MAX_STEPS = 10_000_000  # maximum number of steps for matching a text
_PART = re.compile(r"\{(\w+)\}|(\*\*/?)|(\*)|([^{}*]+)|(.)", re.DOTALL)


@functools.lru_cache(maxsize=1024)
def compile_pattern(pattern: str) -> re.Pattern[str]:
    """Return the regular expression of a pattern. Raises `UsageError` if a brace has no partner."""
    parts, names = [], set()
    for name, folders, any_text, literal, stray in _PART.findall(pattern):
        if stray:
            raise UsageError(
                f"The pattern {plain(pattern)} has a brace without its partner. Write placeholders as {{name}}."
            )
        if name:
            parts.append(f"(?P={name})" if name in names else f"(?P<{name}>[^/]+?)")
            names.add(name)
        elif folders:
            parts.append("(?:.*/)?" if folders.endswith("/") else ".*")
        else:
            parts.append("[^/]*" if any_text else re.escape(literal))
    try:
        return re.compile("".join(parts), re.DOTALL)
    except re.error as error:
        raise UsageError(f"The pattern {plain(pattern)} cannot be read: {error}.") from error


def match(pattern: str, text: str) -> dict[str, str] | None:
    """Return the text of each placeholder if the pattern matches all of ``text``, else None.

    Raises `UsageError` if a text can match in too many ways.

    >>> match("{trial}/skin_{hand}.csv", "t-07/skin_left.csv")
    {'trial': 't-07', 'hand': 'left'}
    >>> match("**/{trial}.csv", "a/b/t1.csv"), match("*.csv", "a/t1.csv"), match("{a}-{a}", "x-y")
    ({'trial': 't1'}, None, None)
    """
    if _max_steps(pattern, text) > MAX_STEPS:
        raise UsageError(
            f"{plain(text)} of {len(text):,} characters can match the pattern {plain(pattern)} in too many ways. Rename it, "
            f"or use fewer placeholders."
        )
    matched = compile_pattern(pattern).fullmatch(text)
    return None if matched is None else matched.groupdict()


def _max_steps(pattern: str, text: str) -> int:
    """Return the maximum number of steps for matching a text with a pattern, from the ways to divide it."""
    parts = _PART.findall(pattern)
    wildcards = sum(not literal for *_, literal, _ in parts)
    literals = [literal for *_, literal, _ in parts[1:-1] if literal]
    places_per_cut: int = max(map(text.count, literals), default=1) if len(literals) >= wildcards - 1 else len(text)
    return len(text) * int(places_per_cut ** max(wildcards - 1, 0))


def placeholders(pattern: str) -> tuple[str, ...]:
    """Return the names in braces, in order.

    >>> placeholders("{trial}/skin_{hand}.csv")
    ('trial', 'hand')
    """
    return tuple(compile_pattern(pattern).groupindex)


def fill_pattern(pattern: str, values: Mapping[str, str]) -> str:
    """Return a pattern with its placeholders replaced. Raises `UsageError` if one has no value.

    >>> fill_pattern("{object}-{trial}", {"object": "cup", "trial": "3"})
    'cup-3'
    """
    missing = [name for name in placeholders(pattern) if name not in values]
    if missing:
        available = ", ".join(values) or "none"
        raise UsageError(f"{plain(pattern)} names {{{missing[0]}}}, which no file pattern has; there are {available}.")
    return re.sub(r"\{(\w+)\}", lambda placeholder: values[placeholder[1]], pattern)


def generalize(paths: Sequence[PurePath]) -> str:
    """Return a pattern that matches relative paths of equal depth, and the paths of later recordings.

    Dates, numbers that differ, numbers that count recordings, and text that differs become placeholders; the last level
    that differs contains the trial. Other numbers stay: ``skin1.csv`` is a sensor.

    >>> generalize([PurePath("2026-05-01 cork/trial_1/skin1.csv"), PurePath("2026-05-01 cork/trial_2/skin1.csv")])
    '{date} cork/trial_{trial}/skin1.csv'
    >>> generalize([PurePath("2026-05-01 cork.csv"), PurePath("2026-05-02 felt.csv")])
    '{date} {trial}.csv'
    >>> generalize([PurePath("object1/cork/skin.csv")]), generalize([PurePath("skin2.csv")])
    ('object{object}/{trial}/skin.csv', 'skin2.csv')
    """
    levels = list(zip(*(path.parts for path in paths), strict=True))
    differing_levels = [level for level, names in enumerate(levels) if len(set(names)) > 1]
    trial_level = (
        differing_levels[-1] if differing_levels else len(levels) - 2
    )  # the folder of a single file is the recording
    texts_in_use: dict[str, tuple[str, ...]] = {}
    level_patterns = []
    for level, names in enumerate(levels):
        text = _level_pattern([_tokens(name) for name in names], level, texts_in_use, is_last=level == trial_level)
        level_patterns.append(f"{{{TRIAL}}}" if level == trial_level and "{" not in text else text)
    return "/".join(level_patterns)


def _tokens(name: str) -> list[_Token]:
    """Return the dates, the numbers and the other characters of a name."""
    tokens: list[_Token] = []
    end = 0
    for match in _SLOT.finditer(name):
        tokens += [(letter, letter) for letter in name[end : match.start()]]
        tokens.append(("date" if match["date"] else "number", match[0]))
        end = match.end()
    return tokens + [(letter, letter) for letter in name[end:]]


def _level_pattern(
    names: Sequence[list[_Token]], level: int, in_use: dict[str, tuple[str, ...]], *, is_last: bool
) -> str:
    """Return the pattern of one level of paths from the ``names`` at this level, which are split into tokens.

    Each part that differs becomes a placeholder. ``in_use`` maps placeholders to their texts; those of this level are added,
    and a placeholder with the same texts is used again. If ``is_last``, the last part that differs is the trial.
    """
    common_parts = _common_parts(names)
    differing = [index for index, (_, texts) in enumerate(common_parts) if len(set(texts)) > 1]
    pattern = ""
    for index, (kind, texts) in enumerate(common_parts):
        counter = _COUNTER.search(pattern)
        word = re.search(r"(?<![A-Za-z])([A-Za-z]{2,})[-_ #.]*$", pattern)
        if kind not in ("date", "number", "text"):
            pattern += kind
            continue
        if kind == "number" and index not in differing and not counter:
            pattern += texts[0]
            continue
        if kind == "date":
            name = "date"
        elif kind == "number" and counter:
            name = counter[1].lower()
        elif is_last and index == differing[-1]:
            name = TRIAL
        else:
            name = word[1].lower() if kind == "number" and word else f"folder{level + 1}"
        matching = [
            placeholder
            for placeholder, texts_in_use in in_use.items()
            if texts_in_use == texts and (placeholder == name or len(set(texts)) > 1)
        ]
        candidates = (f"{name}{number}" if number > 1 else name for number in itertools.count(1))
        name = matching[0] if matching else next(candidate for candidate in candidates if candidate not in in_use)
        in_use[name] = texts
        pattern += f"{{{name}}}"
    return pattern


def _common_parts(names: Sequence[list[_Token]]) -> list[tuple[str, tuple[str, ...]]]:
    """Return the parts that all names have in common, as kind and text in each name.

    Between the common start and the common end, everything else is a single part of the kind ``text``.
    """
    kinds = [[kind for kind, _ in tokens] for tokens in names]
    start_count = _count_common_start(kinds)
    end_count = 0
    if any(tokens != kinds[0] for tokens in kinds):
        start_count = _count_without_open_ended(kinds[0], start_count)
        end_count = _count_without_open_ended(
            kinds[0][::-1], _count_common_start([tokens[start_count:][::-1] for tokens in kinds])
        )
        while any(
            len(tokens) == start_count + end_count for tokens in kinds
        ):  # a placeholder has at least one character
            if start_count:
                start_count = _count_without_open_ended(kinds[0], start_count - 1)
            else:
                end_count = _count_without_open_ended(kinds[0][::-1], end_count - 1)
    parts = [(kinds[0][index], tuple(tokens[index][1] for tokens in names)) for index in range(start_count)]
    if any(len(tokens) > start_count + end_count for tokens in names):
        middles = tuple("".join(text for _, text in tokens[start_count : len(tokens) - end_count]) for tokens in names)
        parts.append(("text", middles))
    parts += [(kinds[0][-index], tuple(tokens[-index][1] for tokens in names)) for index in range(end_count, 0, -1)]
    return parts


def _count_common_start(sequences: Sequence[Sequence[str]]) -> int:
    """Return the length of the common prefix of all sequences."""
    return sum(1 for _ in itertools.takewhile(lambda elements: len(set(elements)) == 1, zip(*sequences, strict=False)))


def _count_without_open_ended(kinds: Sequence[str], count: int) -> int:
    """Return ``count`` less the dates and numbers at the end of the first ``count`` elements.

    If a placeholder followed one of them directly, it would be ambiguous where the date or number ends.
    """
    while count and kinds[count - 1] in ("date", "number"):
        count -= 1
    return count
