"""Materials whose labels a sensor does not learn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import Assignments, CommaList
from tacpipe.printable import listed
from tacpipe.tasks.material.naming import NUMBERS, UNKNOWN, Naming


def materials(
    given: str, classes: Sequence[int], sensors: Iterable[str], naming: Naming = NUMBERS
) -> dict[str, set[int]]:
    """Return the materials whose labels each sensor does not learn; ``given`` is like ``roboskin=17,18,19,20``.

    >>> materials("b=3,4", [1, 2, 3, 4], ["a", "b"])
    {'a': set(), 'b': {3, 4}}
    """
    found: dict[str, set[int]] = {name: set() for name in sensors}
    for name, numbers in Assignments(str, between=";").items(given).items():
        try:
            named = {naming.read(word) for word in CommaList().items(numbers)}
        except ValueError:
            named = {UNKNOWN}
        if name not in found or not named <= set(classes):
            raise UsageError(
                f"hold_out names {name}={numbers}; the sensors are {', '.join(found)} and the classes "
                f"{listed(map(naming.name, classes), 20)}."
            )
        found[name] |= named
    return found
