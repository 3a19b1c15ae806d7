"""Record for each call of an undisturbed run what a kill or a power failure would leave."""

import os
import signal
from dataclasses import dataclass

from tests.promises.operations import Call
from tests.promises.operations_power import Disk
from tests.promises.operations_tree import State

POWERS = 3  # seeds of what a loss of power takes along


@dataclass(frozen=True)
class Aftermath:
    """State of the folder after one fault, and how the run ended."""

    state: State
    fault: str
    outcome: str  # done, failed, killed or dark; "done, dark" is a loss of power after the end

    @property
    def dark(self) -> bool:
        """Return whether power was lost."""
        return self.outcome.endswith("dark")


class Survey:
    """Follows the calls of a run, and notes what a kill or a loss of power at each would leave."""

    def __init__(self, disk: Disk, chosen: range) -> None:
        self.disk, self._chosen, self._number = disk, chosen, 0  # numbers of calls
        self.remains: list[Aftermath] = []
        self.kills: dict[int, State] = {}  # Each state that a kill leaves, by the number of its call.

    def before(self, call: Call) -> None:
        self._number += 1
        if call.changes and self._number in self._chosen:
            self.kills[self._number] = self.disk.killed()
            self.remains.append(Aftermath(self.kills[self._number], f"a kill before {self._described(call)}", "killed"))
            self._lose(f"before {self._described(call)}", "dark")

    def after(self, call: Call) -> None:
        self.disk.record_call(call.name, call.path, call.source)
        if call.name == "write" and self._number in self._chosen:
            torn = self.disk.torn(call.path)
            if torn is not None:
                self.remains.append(Aftermath(torn, f"a kill amid {self._described(call)}", "killed"))

    def end(self) -> None:
        """Note what a loss of power leaves of a command that has ended."""
        self._lose("after the end", "done, dark")

    def _lose(self, when: str, outcome: str) -> None:
        for seed in range(POWERS):
            self.remains.append(Aftermath(self.disk.lost(seed), f"loss of power ({seed}) {when}", outcome))

    def _described(self, call: Call) -> str:
        return f"call {self._number}, {call.name} {call.path.removeprefix(f'{self.disk.root}/')}"


class Killer:
    """Kills this process before one call, so that nothing is cleaned up."""

    def __init__(self, number: int) -> None:
        self._calls_left = number

    def before(self, call: Call) -> None:
        self._calls_left -= 1
        if self._calls_left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def after(self, call: Call) -> None:
        pass
