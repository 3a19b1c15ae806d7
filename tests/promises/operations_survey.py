"""What a kill or a loss of power would leave at each call of a run: noted while it runs undisturbed."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass

from tests.promises.operations import Call
from tests.promises.operations_power import Disk
from tests.promises.operations_tree import State

POWERS = 3  # seeds of what a loss of power takes along


@dataclass(frozen=True)
class Left:
    """What one fault left behind: the state, and what is asked of it."""

    state: State
    fault: str
    ended: str  # done, failed, killed or dark; "done, dark" is a loss of power after the end

    @property
    def dark(self) -> bool:
        """Whether power was lost."""
        return self.ended.endswith("dark")


class Survey:
    """Follows the calls of a run, and notes what a kill or a loss of power at each would leave."""

    def __init__(self, disk: Disk, chosen: range) -> None:
        self.disk, self._chosen, self._number = disk, chosen, 0  # numbers of calls
        self.left: list[Left] = []
        self.kills: dict[int, State] = {}  # what each kill leaves, by the number of its call

    def before(self, call: Call) -> None:
        self._number += 1
        if call.changes and self._number in self._chosen:
            self.kills[self._number] = self.disk.killed()
            self.left.append(Left(self.kills[self._number], f"a kill before {self._described(call)}", "killed"))
            self._lose(f"before {self._described(call)}", "dark")

    def after(self, call: Call) -> None:
        self.disk.made(call.name, call.path, call.source)
        if call.name == "write" and self._number in self._chosen:
            torn = self.disk.torn(call.path)
            if torn is not None:
                self.left.append(Left(torn, f"a kill amid {self._described(call)}", "killed"))

    def end(self) -> None:
        """Note what a loss of power leaves of a command that has ended."""
        self._lose("after the end", "done, dark")

    def _lose(self, when: str, ended: str) -> None:
        for seed in range(POWERS):
            self.left.append(Left(self.disk.lost(seed), f"loss of power ({seed}) {when}", ended))

    def _described(self, call: Call) -> str:
        return f"call {self._number}, {call.name} {call.path.removeprefix(f'{self.disk.root}/')}"


class Killer:
    """Kills this process before one call, so that nothing is cleaned up."""

    def __init__(self, number: int) -> None:
        self._left = number

    def before(self, call: Call) -> None:
        self._left -= 1
        if self._left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def after(self, call: Call) -> None:
        pass
