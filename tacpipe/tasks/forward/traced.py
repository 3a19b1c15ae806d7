"""A forecaster's network as one recorded list of operations: the same numbers to the bit, without Python between them.

One window is little work: of a forecast's time in the network, more than half goes into calling some hundred operations
from Python. `torch.jit.trace` and `freeze` record them once. A network that cannot be recorded, or whose recording gives
other numbers for any tried window, runs as it is.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import AnyFloats
from tacpipe.models.windows import ARM, POSE, Windows
from tacpipe.tasks.forward.rows import acted

if TYPE_CHECKING:
    from tacpipe.tasks.forward.forecaster import Forecaster

TRIED = 12  # windows that both must agree on; the first calls of a recording profile and optimize it
WALK, STEP = 20.0, 0.002  # random steps between rows of tried windows: hundredths of a feature's training range, m


class Network:
    """The network of a forecaster, for one window at a time."""

    def __init__(self, forecaster: Forecaster) -> None:
        """Record it; where that gives other numbers, keep it as it is."""
        self._forecaster = forecaster
        self._recorded = None if forecaster.actions == "shuffled" else _recorded(forecaster)

    @property
    def is_recorded(self) -> bool:
        """True if the traced network is used."""
        return self._recorded is not None

    @torch.no_grad()
    def features(self, windows: Windows) -> AnyFloats:
        """Return the features to come (window, horizon, feature), as `Forecaster.features`; ``windows`` holds one."""
        if self._recorded is None:
            return self._forecaster.features(windows)
        predicted: Tensor = self._recorded(*windows)
        features: AnyFloats = predicted.transpose(0, 1).numpy()
        return features


class _Parts(nn.Module):
    """A network that is given the parts of windows."""

    def __init__(self, forecaster: Forecaster) -> None:
        super().__init__()
        self.network, self.actions = forecaster.model, forecaster.actions

    def forward(self, touch: Tensor, arm: Tensor, finger: Tensor) -> Tensor:
        predicted: Tensor = self.network(acted(Windows(touch, arm, finger), self.actions))
        return predicted


@torch.no_grad()
def _recorded(forecaster: Forecaster) -> torch.jit.ScriptModule | None:
    """Return the recording, None where there is none that gives the same bits."""
    parts = _Parts(forecaster).eval()
    examples = _tried(forecaster)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warns of shapes that become constants, as they are here
            traced = torch.jit.trace(parts, tuple(examples[0]), check_trace=False)  # type: ignore[no-untyped-call]
            frozen: torch.jit.ScriptModule = torch.jit.freeze(traced)
            for _ in range(2):  # once while it is optimized, and as it stays
                if not all(torch.equal(frozen(*windows), parts(*windows)) for windows in examples):
                    return None
    except Exception:  # an architecture of another package may raise anything
        return None
    return frozen


def _tried(forecaster: Forecaster) -> list[Windows]:
    """Return windows (one each) that walk, rest, jump and hold still."""
    rng = np.random.default_rng(0)
    context, rows = forecaster.context, forecaster.context + forecaster.horizon
    examples = []
    for number in range(TRIED):
        size = 0.0 if number == 0 else float(rng.lognormal(0, 1))
        moved = rng.random((context, 1, 1)) < rng.random()  # other rows repeat the one before
        walk = WALK * rng.normal(0, size, (context, 1, len(forecaster.codec.latents))) * moved
        touch = walk.cumsum(axis=0) * forecaster.feature_half / 100
        arm = rng.normal(0, STEP * size, (rows, 1, ARM)).cumsum(axis=0)
        arm[..., 3:POSE] += forecaster.orientation
        arm[..., 3:POSE] /= np.linalg.norm(arm[..., 3:POSE], axis=-1, keepdims=True)
        finger = 0.04 + rng.normal(0, STEP * size, (context, 1)) * moved[:, 0]
        examples.append(Windows(*(torch.from_numpy(part.astype(np.float32)) for part in (touch, arm, finger))))
    return examples
