"""How a model of the task ``forward`` is built and trained: the params of `tacpipe train forward`, one class a family.

Classes of other packages extend `ForwardModelParams`, whose `build` states what a network reads and returns.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, NotRequired, TypedDict, cast

from tacpipe.channels import arm
from tacpipe.plugins.constraints import Dropout, PositiveFloat, PositiveInt, Seed
from tacpipe.plugins.params import Panels, added
from tacpipe.plugins.stage import Channels, Label, Presets, Requirements
from tacpipe.tasks.task import ModelConfig
from tacpipe.training.devices import Precision

if TYPE_CHECKING:
    from torch import nn

    from tacpipe.models.windows import ForecastShape


@dataclass(frozen=True)
class ForwardModelParams(ABC):
    """Size of a model of the task ``forward`` and of its windows, and how it is trained.

    Each architecture extends it, adds params of its own, and builds its network.
    """

    ARCHITECTURES: ClassVar[str] = "forward"  # the task, as entry points name it
    architecture: str = "auto"
    # part of the planned motion that the model reads: planned, none, or shuffled (another window's, a negative control)
    actions: Literal["planned", "none", "shuffled"] = "planned"
    hidden: PositiveInt = 128  # units per layer
    epochs: PositiveInt = 16  # maximum number of passes over the training windows
    batch: PositiveInt = 128  # windows per step of the optimiser
    learning_rate: PositiveFloat = 2e-3  # learning rate of Adam; the peak if it goes through a cycle
    cycle: bool = True  # raise and lower the learning rate once over all epochs
    patience: PositiveInt = 16  # epochs without a lower validation error after which training ends
    gradient_clip: PositiveFloat = 1.0  # largest norm of the gradient
    windows: Literal["all", "contact"] = "all"  # training windows: all, or those within one contact
    stride: PositiveInt = 1  # rows from one training window to the next
    seed: Seed = 0  # random seed of initial weights and of the order of windows
    context: PositiveInt = 10  # past rows that the model reads
    horizon: PositiveInt = 10  # future rows that it predicts
    baselines: bool = True  # fit the linear baselines too, for evaluate to compare with
    # precision of products in training; bfloat16 takes half the memory and rounds to 3 digits, weights stay in float32
    precision: Precision = added("float32")
    # networks with different random weights whose forecasts are averaged
    members: PositiveInt = added(1)
    arm: str = added("")  # stream whose position and orientation are the motion; empty: the only one with a position
    PANELS: ClassVar[Panels] = {
        "Model": ("architecture", "members", "actions", "hidden", "dropout", "context", "horizon"),
        "Training": (
            *("loss", "epochs", "batch", "learning_rate", "cycle", "patience", "gradient_clip"),
            *("precision", "seed", "baselines"),
        ),
        "Data": ("windows", "stride", "arm"),
    }

    def resolved(
        self, layout: Sequence[Mapping[str, str]], start: ForwardModelParams | None, *, changes: bool
    ) -> ForwardModelParams:
        """Return these params with the meaning of ``auto`` for channels that lie like ``layout``; latents have none.

        ``start`` are the params of the model to begin with, ``changes`` states that features are increments.
        """
        return self

    @abstractmethod
    def build(self, shape: ForecastShape) -> nn.Module:
        """Return the network, of random weights, for what it reads and predicts (`tacpipe.models.windows.ForecastShape`).

        **A plain network** is called as ``network(past, plan)`` and returns (horizon, window, feature), float32.

        - ``past`` (context, window, ``shape.past``) describes each row that was measured, the last one now: of each feature
          the difference from now (in units of the usual change, compressed by asinh) and the level (mean 0, deviation 1,
          within 8 deviations); whether the row repeats the one before; the width of the gripper against now; motion.
        - ``plan`` (horizon, window, ``shape.plan``) is the motion to come: position, rotation, velocity, angular velocity
          and acceleration of the hand as it sees them now, scaled, and the direction up. Without an arm it is constant.
        - It returns the change from now, in units of the usual change, or, where the network has ``change_only = False``,
          levels as ``past`` has them. Zeros are persistence, so a last layer of zeros begins there.

        **A network that scales itself** has the methods ``calibrate(windows, ahead)``, which fits its scales on training
        windows, and ``loss(windows, ahead)``, which returns a scalar, and the attribute ``change_only``. It is called as
        ``network(windows)`` with `tacpipe.models.windows.ForecastWindows` in the units of the recordings, and returns the
        features to come in theirs. `tacpipe.models.change.ChangeForecast` has all but ``forward``.

        Of either kind, a prediction depends on its own window alone (so no normalisation over the batch), and each step on
        the plan up to it, or evaluation of shuffled and missing plans means nothing.

        The task makes the windows, fits scales on training recordings, trains (Adam, early stopping, checkpoints that
        resume, bfloat16), stores weights as safetensors, fits the baselines, and evaluates. A plain
        network learns the absolute error, of latents of increments Huber's. Raise `TacpipeError` for what cannot be read.
        """


@dataclass(frozen=True)
class Change(ForwardModelParams):
    """A model that predicts the change since the last row; auto is taxelwise on raw channels and gru on latents."""

    # network; auto: taxelwise for raw channels, gru for latents and for channels that do not lie taxel by taxel
    architecture: Literal["auto", "taxelwise", "gru", "lstm", "tcn"] = "auto"
    dropout: Dropout = 0.2  # fraction of units left out of each training step
    # error that training minimises; auto: absolute, and huber for latents of increments, whose median is often 0
    loss: Literal["auto", "absolute", "huber", "squared"] = "auto"
    PRESETS: ClassVar[Presets] = {"quick": {"hidden": 32, "epochs": 3}}

    def resolved(
        self, layout: Sequence[Mapping[str, str]], start: ForwardModelParams | None, *, changes: bool
    ) -> ForwardModelParams:
        """Return these params with the meaning of ``auto``: the architecture of ``start`` if that one predicts change."""
        from tacpipe.models import forecasts

        choice = self.architecture
        if choice == forecasts.AUTO and isinstance(start, Change):
            choice = start.architecture
        architecture = cast("Literal['taxelwise', 'gru', 'lstm', 'tcn']", forecasts.resolved(choice, layout))
        return dataclasses.replace(
            self, architecture=architecture, loss=forecasts.resolved_loss(self.loss, changes=changes)
        )

    def build(self, shape: ForecastShape) -> nn.Module:
        """Return the network; ``auto`` and the loss are resolved before."""
        from tacpipe.models import forecasts

        return forecasts.build(
            self.architecture,
            shape.features,
            shape.layout,
            hidden=self.hidden,
            context=self.context,
            horizon=self.horizon,
            dropout=self.dropout,
            loss=self.loss,
            changes=shape.increments,
        )


@dataclass(frozen=True)
class Recurrent(ForwardModelParams):
    """The paper's model, which predicts levels; it has no dropout and minimises the squared error."""

    # network: recurrent is the paper's
    architecture: Literal["recurrent"] = "recurrent"
    PRESETS: ClassVar[Presets] = {
        "paper": {
            "hidden": 200,
            "epochs": 50,
            "batch": 32,
            "learning_rate": 1e-3,
            "cycle": False,
            "patience": 5,
            "context": 10,
            "horizon": 10,
        },
        "quick": {"hidden": 32, "epochs": 3},
    }

    def build(self, shape: ForecastShape) -> nn.Module:
        """Return the paper's network between its scalings."""
        from tacpipe.models.forecasts import RecurrentForecast

        return RecurrentForecast(shape.features, self.hidden)


Params = ForwardModelParams  # params of any architecture
PAPER = Recurrent.architecture  # the architecture of the paper


class CodecDescription(TypedDict):
    """The representation that a model reads, in its configuration."""

    kind: str  # as `tacpipe compress` names it; raw: no codec
    of: str  # levels or increments
    frames: int
    latents: int
    name: str  # in reports


class ArmColumns(TypedDict):
    """The columns of the arm that a model reads, in its configuration."""

    position: Sequence[str]
    orientation: Sequence[str]


class ModelInputs(TypedDict):
    """The columns that a model reads, in its configuration."""

    tactile: list[str]
    layout: list[dict[str, str]]  # stream, taxel and axis of each channel
    orientation_reference: list[float]  # (4,): quaternions have the sign that is nearest to this one
    plan_velocity: NotRequired[str]  # source of a plan's velocities; absent: as those of the past
    unit: NotRequired[str]  # of the channels; absent: counts
    pose: NotRequired[ArmColumns]  # absent: the columns of a Panda


class ForwardScaling(TypedDict):
    """Spreads over usable training rows, in a model's configuration."""

    feature_half: list[float]  # half the range of each feature
    channel_count: list[float]  # the standard deviation of each channel in counts


class LookAhead(TypedDict):
    """The time by which rows of the training recordings look ahead, in a model's configuration."""

    mean_ms: float
    max_ms: float


class AlarmLevels(TypedDict, total=False):
    """The levels of alarms that validation recordings set, in a model's configuration; empty without recordings."""

    sd: list[float]  # usual change of each load
    theta: dict[str, list[float | None]]  # level of each load by predictor; None: never


class QuantileDescription(TypedDict):
    """The calibration of a model's quantiles, in its configuration."""

    levels: list[int]  # percent
    method: str
    recordings: dict[str, int]
    most_promised: float


class ForwardConfig(ModelConfig):
    """``config.json`` of a model of the task ``forward``."""

    codec: CodecDescription
    context: int
    horizon: int
    inputs: ModelInputs
    rate_hz: float
    gap_ms: dict[str, float]  # longest time without a gap by stream
    look_ahead: NotRequired[LookAhead]
    timeline: str
    scaling: ForwardScaling
    largest_level: float
    validation: dict[str, float]  # loss and epoch of the stored weights
    objects: list[str]
    counts: dict[str, dict[str, int]]
    baselines: NotRequired[dict[str, float]]
    anticipation: NotRequired[AlarmLevels]
    quantiles: NotRequired[QuantileDescription]


REQUIREMENTS = Requirements(
    "forward",
    stages=("synchronize", "segment contacts"),
    optional_stages=("compress pca or compress autoencoder: a model of latents",),
    roles="one recording or more with the role train, and one or more with val",
    channels=(
        Channels(
            "tactile",
            (),
            "1 or more columns of one or more streams, any number of taxels and axes; {taxel} and {axis} in the rule of a "
            "column state where it lies, and then the model reads taxel by taxel",
        ),
        Channels(
            arm.POSITION,
            tuple(arm.METRES),
            "x, y and z of the hand, in one stream (--arm names it where several have a position)",
            "train with --actions none",
        ),
        Channels(
            arm.ORIENTATION,
            ("1",),
            "the quaternion x, y, z, w of the hand, in the stream of the position",
            "the hand is taken to keep its orientation",
        ),
        Channels(
            "joint_position",
            ("rad",),
            "7 angles in the stream of the position, with as many of joint_velocity [rad/s]",
            "velocities are differences of the pose, as with any arm but a Franka",
        ),
        Channels(arm.WIDTH, tuple(arm.METRES), "the width between the fingers, 1 column", "it counts as constant"),
    ),
    labels=(Label("object", "what is held, any value", "known and novel objects are not reported apart"),),
)
