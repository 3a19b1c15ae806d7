"""What a live session is asked for, as the recording process hands it to the model's process."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any, Self

OWN = ("forecast", "alarm", "latency", "material", "touch")  # streams that a session adds to the rig, those of its task


@dataclass(frozen=True)
class Options:
    """A live session."""

    model: str  # path of the model
    rig: str  # text of the rig file, with the session's own streams
    streams: tuple[str, ...]  # of the rig that are handed on, in the order of their numbers
    steps: tuple[int, ...] = ()  # that are published; empty: every step of the horizon
    quantiles: tuple[int, ...] = ()  # levels in percent that are published next to each forecast
    publish: tuple[str, ...] = ()  # addresses
    alarms_per_hour: float = 0.0  # 0: no alarms
    alarms_on: str = ""  # recordings that their levels are set on
    split: str = ""  # whose validation recordings are meant; empty: all
    settle_ms: float = 2.0
    plan_stream: str = ""  # stream of an arm whose set-points are the planned motion; empty: none
    kind: str = "forecast"  # of messages that the model makes: forecast, material or touch
    sensor: str = ""  # of a model of materials: which of those that it knows; empty: the only one
    every_ms: float = 100.0  # of a model of materials: from one answer to the next
    least: float = 0.25  # of a model of materials: fraction of the slide that it reads before it names one
    pause_s: float = (
        0.0  # of a model of materials: after which a slide is over and another may begin; 0: one a recording
    )
    rank: str = "contact"  # of a model of touch: what candidates are ranked by
    nice: int = 1  # by how much the model's process stands back behind the recording
    allow_look_ahead: bool = False  # accept a model that was trained on rows that look ahead
    realtime: bool = False  # whether both run before all ordinary programs

    def to_json(self) -> str:
        """Return the options as one line."""
        return json.dumps(asdict(self)) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the options of such a line."""
        found: Any = json.loads(text)
        fields: Any = {name: tuple(value) if isinstance(value, list) else value for name, value in found.items()}
        return cls(**fields)
