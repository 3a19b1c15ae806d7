"""Params of `tacpipe train forward`: how a model is built and trained, with one class per model family.

Other packages subclass `ForwardModelParams`, whose `build` documents the inputs and outputs of a network.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, NotRequired, TypedDict, cast

from tacpipe.channels import arm
from tacpipe.plugins import fields
from tacpipe.plugins.constraints import Dropout, PositiveFloat, PositiveInt, Seed
from tacpipe.plugins.params import Panels, added
from tacpipe.plugins.requirements import Channels, Label, Requirements
from tacpipe.plugins.stage import Presets
from tacpipe.tasks.task import ModelConfig
from tacpipe.training.devices import Precision

if TYPE_CHECKING:
    from torch import nn

    from tacpipe.models.windows import ForecastShape


@dataclass(frozen=True)
class ForwardModelParams(ABC):
    """Size of a model of the task ``forward``, its windows, and its training.

    Each architecture subclasses it, adds its own params, and builds its network.
    """

    ARCHITECTURES: ClassVar[str] = "forward"  # name of the task in entry points
    architecture: str = "auto"
    # part of the planned motion that the model reads: planned, none, or shuffled (another window's, a negative control)
    actions: Literal["planned", "none", "shuffled"] = "planned"
    hidden: PositiveInt = 128  # units per layer
    epochs: PositiveInt = 16  # maximum number of passes over the training windows
    batch: PositiveInt = 128  # windows per step of the optimiser
    learning_rate: PositiveFloat = 2e-3  # learning rate of Adam, or its peak if cycle is set
    cycle: bool = True  # raise and lower the learning rate once over all epochs
    patience: PositiveInt = 16  # epochs without a lower validation error before training stops
    gradient_clip: PositiveFloat = 1.0  # maximum norm of the gradient
    windows: Literal["all", "contact"] = "all"  # training windows: all, or those within one contact
    stride: PositiveInt = 1  # rows from one training window to the next
    seed: Seed = 0  # random seed of initial weights and of the order of windows
    context: PositiveInt = 10  # past rows that the model reads
    horizon: PositiveInt = 10  # future rows that it predicts
    baselines: bool = True  # also fit the linear baselines, with which evaluate compares the model
    # precision of products in training; bfloat16 takes half the memory and rounds to 3 digits, weights stay in float32
    precision: Precision = added("float32")
    # networks with different random weights whose forecasts are averaged
    members: PositiveInt = added(1)
    arm: str = added("")  # stream whose position and orientation are the motion; empty: the only stream with a position
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
        """Return these params with values of ``auto`` replaced according to the channel ``layout``.

        Latents have no layout.

        ``start`` are the params of the initial model, and ``changes`` is True if features are increments.
        """
        return self

    @abstractmethod
    def build(self, shape: ForecastShape) -> nn.Module:
        """Return the network, with random weights, for the sizes in ``shape`` (`tacpipe.models.windows.ForecastShape`).

        **A plain network** is called as ``network(past, plan)`` and returns (horizon, window, feature), float32.

        - ``past`` (context, window, ``shape.past``) describes each measured row, of which the last is the current one.
          It contains each feature's difference from the current row (in units of the RMS change, compressed by
          asinh) and its level (mean 0, standard deviation 1, clipped to 8 standard deviations), whether the row repeats
          the previous one, the gripper's width relative to the current width, and motion.
        - ``plan`` (horizon, window, ``shape.plan``) is the future motion: position, rotation, velocity, angular
          velocity and acceleration in the current frame of the hand, scaled, and the vertical direction. Without an arm
          it is constant.
        - The output is the change from the current row, in units of the RMS change; if the network has ``change_only
          = False``, it is levels in the scale of ``past``. Zeros are persistence, so initialize the last layer with
          zeros.

        **A network that scales itself** has the methods ``calibrate(windows, ahead)``, which fits its scales on
        training windows, and ``loss(windows, ahead)``, which returns a scalar, and the attribute ``change_only``. It is
        called as ``network(windows)`` with `tacpipe.models.windows.ForecastWindows` in the units of the recordings, and
        returns the future features in the same units. `tacpipe.models.change.ChangeForecast` implements all but
        ``forward``.

        For both kinds, a prediction must depend only on its own window (so no batch normalisation), and each step only
        on the plan up to that step; otherwise the evaluation of shuffled and missing plans is meaningless.

        The task creates the windows, fits scales on training recordings, trains (Adam, early stopping, resumable
        checkpoints, bfloat16), stores weights as safetensors, fits the baselines, and evaluates. A plain network
        minimises the absolute error, or Huber's for latents of increments. Raise `TacpipeError` for inputs that cannot
        be read.
        """


@dataclass(frozen=True)
class Change(ForwardModelParams):
    """Params of a model that predicts the change since the last row.

    ``auto`` is taxelwise on raw channels and gru on latents.
    """

    # auto: taxelwise for raw channels with a taxel layout, gru for latents and other channels
    architecture: Literal["auto", "taxelwise", "gru", "lstm", "tcn"] = "auto"
    dropout: Dropout = 0.2  # fraction of units dropped in each training step
    # error that training minimises; auto: absolute, and huber for latents of increments, whose median is often 0
    loss: Literal["auto", "absolute", "huber", "squared"] = "auto"
    PRESETS: ClassVar[Presets] = {"quick": {"hidden": 32, "epochs": 3}}

    def resolved(
        self, layout: Sequence[Mapping[str, str]], start: ForwardModelParams | None, *, changes: bool
    ) -> ForwardModelParams:
        """Return these params with values of ``auto`` replaced; uses the architecture of ``start`` if it predicts change."""
        from tacpipe.models import forecasts

        choice: str = self.architecture
        if choice == forecasts.AUTO and start and start.architecture in fields.choices(Change, "architecture"):
            choice = start.architecture
        architecture = cast(
            "Literal['taxelwise', 'gru', 'lstm', 'tcn']", forecasts.resolve_architecture(choice, layout)
        )
        return dataclasses.replace(
            self, architecture=architecture, loss=forecasts.resolve_loss(self.loss, changes=changes)
        )

    def build(self, shape: ForecastShape) -> nn.Module:
        """Return the network. ``auto`` in architecture and loss must be resolved before."""
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
    """Params of the paper's model, which predicts levels, has no dropout and minimises the squared error."""

    # recurrent: the recurrent network of the paper
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
        """Return the paper's network with scaling of its inputs and outputs."""
        from tacpipe.models.forecasts import RecurrentForecast

        return RecurrentForecast(shape.features, self.hidden)


Params = ForwardModelParams  # params of any architecture
PAPER = Recurrent.architecture  # architecture of the paper


class CodecDescription(TypedDict):
    """Representation that a model reads, in its configuration."""

    kind: str  # name of the codec in `tacpipe compress`; raw: no codec
    of: str  # levels or increments
    frames: int
    latents: int
    name: str  # name in reports


class ArmColumns(TypedDict):
    """Columns of the arm that a model reads, in its configuration."""

    position: Sequence[str]
    orientation: Sequence[str]


class ModelInputs(TypedDict):
    """Columns that a model reads, in its configuration."""

    tactile: list[str]
    layout: list[dict[str, str]]  # stream, taxel and axis of each channel
    orientation_reference: list[float]  # (4,), quaternions have the sign that is nearest to this one
    plan_velocity: NotRequired[str]  # source of a plan's velocities; absent: same source as past velocities
    unit: NotRequired[str]  # unit of the channels; absent: counts
    pose: NotRequired[ArmColumns]  # columns of the arm; absent: those of a Panda


class ForwardScaling(TypedDict):
    """Ranges and standard deviations over usable training rows, in a model's configuration."""

    feature_half: list[float]  # half the range of each feature
    channel_count: list[float]  # standard deviation of each channel in counts


class LookAhead(TypedDict):
    """How far rows of the training recordings look ahead in time, in a model's configuration."""

    mean_ms: float
    max_ms: float


class TrainingRest(TypedDict):
    """Rest levels of the training recordings, in a model's configuration."""

    mean: list[float]  # (channel,)
    deviation: list[float]  # (channel,), standard deviation over recordings


class RestShift(TypedDict):
    """Distance of a recording's rest levels from the training mean, in standard deviations of the training recordings."""

    largest: float  # over channels
    median: float


class QuantileDescription(TypedDict):
    """Calibration of a model's quantiles, in its configuration."""

    levels: list[int]  # percent
    method: str
    recordings: dict[str, int]
    most_promised: float


class ForwardConfig(ModelConfig):
    """Content of ``config.json`` in a model of the task ``forward``."""

    codec: CodecDescription
    context: int
    horizon: int
    inputs: ModelInputs
    rate_hz: float
    gap_ms: dict[str, float]  # maximum time between samples without a gap, by stream
    look_ahead: NotRequired[LookAhead]
    timeline: str
    scaling: ForwardScaling
    largest_level: float
    validation: dict[str, float]  # loss and epoch of the stored weights
    objects: list[str]
    counts: dict[str, dict[str, int]]
    baselines: NotRequired[dict[str, float]]
    rest_levels: NotRequired[TrainingRest]
    sessions: NotRequired[list[str]]  # sessions of training and validation recordings; absent: unknown
    quantiles: NotRequired[QuantileDescription]


REQUIREMENTS = Requirements(
    "forward",
    stages=("synchronize", "segment contacts"),
    optional_stages=("compress pca or compress autoencoder, for a model of latents",),
    roles="one or more recordings with the role train, and one or more with val",
    channels=(
        Channels(
            "tactile",
            (),
            "1 or more columns of one or more streams, with any number of taxels and axes. If the rules of the columns "
            "contain {taxel} and {axis}, the model reads each taxel separately",
        ),
        Channels(
            arm.POSITION,
            tuple(arm.METRES),
            "x, y and z of the hand, in one stream; --arm selects it if several have a position",
            "Without it, train with --actions none.",
        ),
        Channels(
            arm.ORIENTATION,
            ("1",),
            "the quaternion x, y, z, w of the hand, in the stream of the position",
            "Without it, the orientation is assumed to be constant.",
        ),
        Channels(
            "joint_position",
            ("rad",),
            "7 angles in the stream of the position, with 7 columns of joint_velocity [rad/s]",
            "Without them, velocities are differences between poses, as for any arm other than a Franka.",
        ),
        Channels(
            arm.WIDTH,
            tuple(arm.METRES),
            "the distance between the fingers, 1 column",
            "Without it, the distance is assumed to be constant.",
        ),
    ),
    labels=(
        Label(
            "object",
            "the grasped object, any value",
            "Without it, known and novel objects are not reported separately.",
        ),
        Label(
            "session",
            "the day or the mounting of the sensors, any text",
            "Without it, test recordings of a training session are not noted.",
        ),
    ),
)
