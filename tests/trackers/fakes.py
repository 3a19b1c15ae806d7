"""Trackers of a third party: one that keeps what it is called with, and one that fails where it is asked to."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ENTRY_POINTS = "[tacpipe.trackers]\nkeeping = keeping_tracker:Keeping\nfailing = keeping_tracker:Failing\n"


class Keeping:
    """Appends each call to the file at its place, as JSON lines."""

    def __init__(self, place: str) -> None:
        self._place = Path(place or "kept.jsonl")

    def _keep(self, *call: Any) -> None:
        with self._place.open("a") as file:
            file.write(json.dumps(call) + "\n")

    def start(self, name: str, params: Mapping[str, Any]) -> str:
        print("a client that prints on standard output")
        self._keep("start", name, dict(params))
        return str(self._place)

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        self._keep("line", epoch, dict(metrics))

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        self._keep("end", None if path is None else str(path), dict(figures))


class Failing(Keeping):
    """Fails in the call that its place names, after it has spoilt torch's generator."""

    def _keep(self, *call: Any) -> None:
        import torch

        torch.manual_seed(13)
        with Path("failing.jsonl").open("a") as file:
            file.write(json.dumps(call) + "\n")
        if call[0] == str(self._place):
            raise ConnectionError(f"no answer to {call[0]}")
