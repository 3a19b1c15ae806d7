"""Materials whose labels a sensor does not learn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import Assignments, CommaList
from tacpipe.printable import listed
from tacpipe.tasks.material.naming import NUMBERS, UNKNOWN, Naming


def materials(
    assignments: str, classes: Sequence[int], sensors: Iterable[str], naming: Naming = NUMBERS
) -> dict[str, set[int]]:
    """Return the materials whose labels each sensor does not learn; ``assignments`` is like ``roboskin=17,18,19,20``.

    >>> materials("b=3,4", [1, 2, 3, 4], ["a", "b"])
    {'a': set(), 'b': {3, 4}}
    """
    by_sensor: dict[str, set[int]] = {name: set() for name in sensors}
    for name, numbers in Assignments(str, between=";").items(assignments).items():
        try:
            sensor_materials = {naming.read(word) for word in CommaList().items(numbers)}
        except ValueError:
            sensor_materials = {UNKNOWN}
        if name not in by_sensor or not sensor_materials <= set(classes):
            raise UsageError(
                f"hold_out names {name}={numbers}; the sensors are {', '.join(by_sensor)} and the classes "
                f"{listed(map(naming.name, classes), 20)}."
            )
        by_sensor[name] |= sensor_materials
    return by_sensor
