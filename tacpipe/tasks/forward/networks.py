"""Build the network of a forecaster, check its output, and record it for one window at a time."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import AnyFloats
from tacpipe.codecs import codec as codecs
from tacpipe.codecs.codec import INCREMENTS
from tacpipe.errors import TacpipeError
from tacpipe.models import forecasts
from tacpipe.models.change import PlainForecast
from tacpipe.models.forecasts import Ensemble
from tacpipe.models.windows import ARM, POSE, ForecastShape, ForecastWindows
from tacpipe.tasks.forward.params import ForwardModelParams
from tacpipe.tasks.forward.rows import acted

if TYPE_CHECKING:
    from tacpipe.tasks.forward.forecaster import Forecaster

METHODS = ("calibrate", "loss")  # methods of a network that scales itself
TRIED = 2  # windows


def shape(params: ForwardModelParams, codec: codecs.Codec) -> ForecastShape:
    """Return what a network for the codec's features reads and predicts."""
    places = codec.layout if codec.kind == "raw" else ()
    changes = codec.representation == INCREMENTS
    return ForecastShape(len(codec.latents), params.context, params.horizon, tuple(places), changes)


def build(params: ForwardModelParams, codec: codecs.Codec) -> nn.Module:
    """Return the network that ``params`` build, of random weights, for the codec's features; several as an `Ensemble`.

    Raises `TacpipeError` where they build something else.
    """
    members = [_member(params, codec) for _ in range(params.members)]
    return members[0] if len(members) == 1 else Ensemble(members)


def _member(params: ForwardModelParams, codec: codecs.Codec) -> nn.Module:
    """Return one network that scales itself; a plain one is put between scales."""
    sizes = shape(params, codec)
    network = params.build(sizes)
    if not isinstance(network, nn.Module):
        raise TacpipeError(
            f"The architecture {params.architecture} built {type(network).__name__}; it must build a torch.nn.Module."
        )
    scaling_methods = [name for name in METHODS if hasattr(network, name)]
    if not scaling_methods:
        return PlainForecast(network, sizes, loss=forecasts.resolved_loss("auto", changes=sizes.increments))
    lacking = [name for name in (*METHODS, "change_only") if not hasattr(network, name)]
    if lacking:
        raise TacpipeError(
            f"The network of the architecture {params.architecture} has {scaling_methods[0]} and no "
            f"{lacking[0]}: one that scales "
            f"itself needs {', '.join(METHODS)} and change_only, a plain network none of them but change_only."
        )
    return network


@torch.no_grad()
def check(network: nn.Module, params: ForwardModelParams, windows: ForecastWindows, features: int) -> None:
    """Raise `TacpipeError` where a network returns something else than features to come for a few ``windows``."""
    sample = ForecastWindows(*(part[:, :TRIED] for part in windows))
    training = network.training
    features_ahead = network.eval()(sample)
    network.train(training)
    expected = (params.horizon, sample.touch.shape[1], features)
    if not isinstance(features_ahead, Tensor) or tuple(features_ahead.shape) != expected:
        returned = (
            str(tuple(features_ahead.shape)) if isinstance(features_ahead, Tensor) else type(features_ahead).__name__
        )
        raise TacpipeError(
            f"The network of the architecture {params.architecture} returns {returned} for {expected[1]} windows; it must "
            f"return (horizon, window, feature), here {expected}."
        )


TRACED = 12  # windows that both must agree on; the first calls of a recording profile and optimize it
WALK, STEP = 20.0, 0.002  # random steps between rows of tried windows: hundredths of a feature's training range, m


class Network:
    """The network of a forecaster, for one window at a time.

    One window is little work: of a forecast's time in the network, more than half goes into calling some hundred
    operations from Python. `torch.jit.trace` and `freeze` record them once. A network that cannot be recorded, or whose
    recording gives other numbers for any tried window, runs as it is.
    """

    def __init__(self, forecaster: Forecaster) -> None:
        """Record it; where that gives other numbers, keep it as it is."""
        self._forecaster = forecaster
        self._recorded = None if forecaster.actions == "shuffled" else _recorded(forecaster)

    @property
    def is_recorded(self) -> bool:
        """True if the traced network is used."""
        return self._recorded is not None

    @torch.no_grad()
    def features(self, windows: ForecastWindows) -> AnyFloats:
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
        predicted: Tensor = self.network(acted(ForecastWindows(touch, arm, finger), self.actions))
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


def _tried(forecaster: Forecaster) -> list[ForecastWindows]:
    """Return windows (one each) that walk, rest, jump and hold still."""
    rng = np.random.default_rng(0)
    context, rows = forecaster.context, forecaster.context + forecaster.horizon
    examples = []
    for number in range(TRACED):
        size = 0.0 if number == 0 else float(rng.lognormal(0, 1))
        moved = rng.random((context, 1, 1)) < rng.random()  # other rows repeat the one before
        walk = WALK * rng.normal(0, size, (context, 1, len(forecaster.codec.latents))) * moved
        touch = walk.cumsum(axis=0) * forecaster.feature_half / 100
        arm = rng.normal(0, STEP * size, (rows, 1, ARM)).cumsum(axis=0)
        arm[..., 3:POSE] += forecaster.orientation
        arm[..., 3:POSE] /= np.linalg.norm(arm[..., 3:POSE], axis=-1, keepdims=True)
        finger = 0.04 + rng.normal(0, STEP * size, (context, 1)) * moved[:, 0]
        examples.append(ForecastWindows(*(torch.from_numpy(part.astype(np.float32)) for part in (touch, arm, finger))))
    return examples
