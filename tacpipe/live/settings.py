"""What a live session is asked for: the table ``[live]`` of a rig file, and options of the command, which win.

[live]
model = "models/forward"
plan = "rig:robot"
publish = ["ws:127.0.0.1:8765"]
alarms_per_hour = 6
alarms_on = "data/segments"
split = "data/split"
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from tacpipe.errors import UsageError
from tacpipe.plugins import fields, params
from tacpipe.plugins.constraints import PositiveInt, Range

MEASURED = "measured"  # in the place of an address of plans: the recorded motion is taken to continue
ALARMS = ("alarms_per_hour", "alarms_on", "split")


@dataclass(frozen=True)
class Settings:
    """A live session as it is asked for; names are those of the options, with ``_`` for ``-``."""

    model: str = ""  # trained model; a path from the folder in which the command is run
    plan: str = MEASURED  # source of plans
    publish: tuple[str, ...] = ()  # addresses
    steps: tuple[PositiveInt, ...] = ()  # ahead, that are published; empty: all
    quantiles: tuple[PositiveInt, ...] = ()  # percent, of a calibrated model, that are published too; empty: none
    alarms_per_hour: Annotated[float, Range(0, below=1e6)] = 0.0  # false alarms; 0: no alarms
    alarms_on: str = ""  # recordings that levels are set on
    split: str = ""  # whose validation recordings are meant
    settle_ms: Annotated[float, Range(0, 1000)] = 2.0
    realtime: bool = False
    allow_look_ahead: bool = False  # accept a model that was trained on rows that look ahead
    sensor: str = ""  # of a model of materials
    every_ms: Annotated[float, Range(10, 10_000)] = 100.0
    least: Annotated[float, Range(above=0, most=1)] = 0.25
    pause_s: Annotated[float, Range(0, 60)] = 0.0  # after which a slide is over; 0: a recording is one slide
    rank: str = "contact"  # criterion of a model of touch
    plan_from: str = ""  # IP address whose plans are accepted by UDP
    places: Mapping[str, str] = field(default_factory=dict, compare=False)  # file and table of what a file states

    @classmethod
    def of(cls, stated: Mapping[str, Any], where: str, given: Mapping[str, Any]) -> Settings:
        """Return what a rig file ``where`` states in its table ``[live]``, and over it what the command was ``given``.

        What was not given is None. Raises `UsageError` naming file and key, or option, for an unknown key, a value that is
        not allowed, and for what does not go together.
        """
        asked = {name: value for name, value in given.items() if value is not None}
        known = {name: wanted for name, wanted in fields.hints(cls).items() if name != "places"}
        for name, value in asked.items():
            fields.check(value, known[name], option(name))
        for name in stated:
            if name not in known:
                raise fields.unknown(name, known, f"{where}, live", "key")
        if asked.get("alarms_per_hour") == 0:  # given so, it switches off what the file states
            stated = {name: value for name, value in stated.items() if name not in ALARMS}
        if "alarms_on" in asked and "split" not in asked:  # the file's split is of the file's recordings
            stated = {name: value for name, value in stated.items() if name != "split"}
        places = {name: f"{where}, live" for name in stated if name not in asked}
        found: Settings = replace(params.filled(cls, stated, f"{where}, live", "key"), **asked, places=places)
        found._check(where)
        return found

    @contextlib.contextmanager
    def naming(self, name: str) -> Iterator[None]:
        """Have an error about the option of a key, raised in the block, name file and key where a file states it."""
        try:
            yield
        except UsageError as error:
            if name not in self.places:
                raise
            raise UsageError(f"{self.places[name]}: {str(error).replace(option(name), name)}") from error

    def named(self, name: str) -> str:
        """Return how errors name a key: by the file that states it, else by its option."""
        return f"{self.places[name]}: {name}" if name in self.places else option(name)

    def _check(self, where: str) -> None:
        if not self.model:
            raise UsageError(
                f'A live session needs a model: give --model models/forward, or state model = "models/forward" in the '
                f"table [live] of {where}."
            )
        if bool(self.alarms_per_hour) != bool(self.alarms_on):
            one, other = ALARMS[:2] if self.alarms_per_hour else ALARMS[1::-1]
            raise UsageError(
                f"{self.named(one)} needs {other if one in self.places else option(other)} with it: the levels of alarms "
                f"are set on recordings, as in `--alarms-per-hour 6 --alarms-on data/segments --split data/split`."
            )
        if self.split and not self.alarms_on:
            raise UsageError(f"{self.named('split')} has no effect without {option('alarms_on')}.")

    def steps_of(self, horizon: int) -> tuple[int, ...]:
        """Return the steps ahead that are published. Raises `UsageError` for others than the model predicts."""
        found = tuple(sorted(set(self.steps))) or tuple(range(1, horizon + 1))
        if found[-1] > horizon:
            asked = ",".join(map(str, self.steps))
            raise UsageError(f"The steps {asked} are asked for, and the model predicts 1 to {horizon} steps ahead.")
        return found


def option(name: str) -> str:
    """Return the option of the command for a key.

    >>> option("settle_ms")
    '--settle-ms'
    """
    return f"--{name.replace('_', '-')}"
