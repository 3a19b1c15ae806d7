"""Params of `tacpipe train touch`, which define how a touch model is built and trained; one class per architecture.

Classes of other packages extend `Patches` or `Pointnet`, which select the inputs, and build another network.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NotRequired, TypedDict

from tacpipe.plugins.constraints import (
    CommaList,
    Dropout,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
    Seed,
    StoredAs,
    Unit,
)
from tacpipe.plugins.params import Panels, added
from tacpipe.plugins.stage import Presets
from tacpipe.tasks.task import ModelConfig
from tacpipe.training.devices import Precision

if TYPE_CHECKING:
    from torch import nn

    from tacpipe.models.point_networks import PointNetworkShape
    from tacpipe.tasks.touch.inputs import CloudInputs, PatchOptions
    from tacpipe.tasks.touch.members import Member
    from tacpipe.tasks.touch.predictor import StoredMember
    from tacpipe.tasks.touch.training import FittedModel, TrainingGrasps

Draws = Annotated[int, Range(1, 100_000)]
Targets = Annotated[str, CommaList(Literal["pdc_th", "pdc_mf", "e_th", "e_mf"], min_items=1)]


@dataclass(frozen=True)
class TouchModelParams(ABC):
    """Params of all touch models."""

    ARCHITECTURES: ClassVar[str] = "touch"  # name of the task in entry points
    TITLE: ClassVar[str] = ""  # name in reports; empty: the architecture
    architecture: str = "tree-ensemble"
    targets: Targets = "pdc_th,pdc_mf,e_th,e_mf"  # targets: pressure and electrodes of thumb and middle finger
    # name of this run in a report, to distinguish runs of the same method, such as blocked
    run_label: Annotated[str, StoredAs("setting")] = ""
    seed: Seed = 0  # random seed of initial weights, the order of grasps, drawn points and cuts
    baselines: bool = True  # store the training readings, from which evaluate computes the baselines
    use_validation: bool = True  # also train on validation grasps if nothing is chosen by them
    PANELS: ClassVar[Panels] = {
        "Model": (
            *(
                "architecture",
                "inputs",
                "place",
                "trees",
                "leaf",
                "shrink_novel",
                "multi_target",
                "networks",
                "points",
                "draws",
            ),
            *("backbone", "radius_mm", "hidden", "dropout", "normalisation", "wrist", "head", "transform"),
        ),
        "Training": (
            *("loss", "epochs", "batch", "learning_rate", "cycle", "weight_decay", "patience", "select"),
            *("rotation_deg", "precision", "seed", "baselines"),
        ),
        "Data": ("targets", "use_validation", "run_label"),
    }

    @property
    def chooses_by_validation(self) -> bool:
        """Whether validation grasps select a network's epoch or stop its training."""
        return False

    @classmethod
    def report_names(cls, architecture: str, *, coloured: bool) -> list[str]:
        """Return the name of a model in reports, and of its inputs if they are not the default."""
        return [cls.TITLE or architecture, *([] if coloured else ["without colour"])]

    @abstractmethod
    def fit(self, grasps: TrainingGrasps, model: FittedModel) -> None:
        """Train on ``grasps`` and add the members, their tensors and their history to ``model``.

        `Patches` and `Pointnet` implement it for the networks that an architecture builds.
        """

    def load_member(self, stored: StoredMember) -> Member:
        """Return a member of a model, forests by default. Raises `ValueError` if ``stored`` is untrusted and invalid."""
        return stored.forests()


@dataclass(frozen=True)
class Trees(TouchModelParams):
    """Forests over the geometry of a grasp: our most accurate model."""

    # tree-ensemble: the mean of one forest per target and one of all targets; trees: one forest per target
    architecture: Annotated[
        Literal["tree-ensemble", "trees"], StoredAs("architecture", {"tree-ensemble": "strong"})
    ] = "tree-ensemble"
    # xyz: positions of points; rgb: positions and colours; pointnet: cont adds contact points, pose the wrist
    inputs: Literal["rgb", "xyz"] = "rgb"
    place: bool = False  # also read the position of the grasp in the camera frame
    trees: PositiveInt = 300  # number of trees per forest
    leaf: NonNegativeInt = 0  # minimum number of training grasps per leaf; 0: 2, 4 or 8, by out-of-bag error
    # shrink predictions for novel objects towards the constant, by the fraction with the smallest error on left-out objects
    shrink_novel: bool = added(False)
    PRESETS: ClassVar[Presets] = {"quick": {"trees": 100}}

    @property
    def coloured(self) -> bool:
        """Whether colours are read."""
        return self.inputs == "rgb"

    @property
    def adds_joint_forest(self) -> bool:
        """Whether a forest of all targets is averaged with the forests of single targets."""
        return self.architecture == "tree-ensemble"

    def fit(self, grasps: TrainingGrasps, model: FittedModel) -> None:
        """Add one forest per target and, in a tree-ensemble, one of all targets."""
        grasps.grow_forests(self, model)

    @classmethod
    def report_names(cls, architecture: str, *, coloured: bool) -> list[str]:
        """Return the inputs as the name of separate trees."""
        if architecture == "trees":
            return ["trees on geometry and colour" if coloured else "trees on geometry"]
        return super().report_names(architecture, coloured=coloured)


@dataclass(frozen=True)
class PointNetwork(TouchModelParams, ABC):
    """Params of all networks that read points."""

    # whether one network predicts all targets; otherwise one network per target, as in the paper
    multi_target: Annotated[bool, StoredAs("together")] = True
    networks: PositiveInt = 3  # number of networks with different initial weights, whose mean is the prediction
    points: Draws = 128  # number of points sampled from each cloud, or patch, at each visit
    draws: Draws = 4  # number of draws of points over which a prediction is averaged
    # balanced: squared error in which all targets count the same; rmse of normalised values, the paper's
    loss: Literal["balanced", "rmse"] = "balanced"
    epochs: PositiveInt = 40  # passes over the training grasps
    batch: Annotated[int, Range(2)] = 16  # grasps per step of the optimiser, which normalises them by their own spread
    learning_rate: PositiveFloat = 2e-3  # learning rate of Adam; the peak if it follows a cycle
    cycle: bool = True  # raise and lower the learning rate once over all epochs
    weight_decay: NonNegativeFloat = 0.0  # fraction of each weight that is added to its gradient
    patience: NonNegativeInt = 0  # epochs without a lower validation loss after which training ends; 0: all epochs
    # weights to keep: last, of the last epoch; best, of the lowest validation loss
    select: Literal["last", "best"] = "last"
    # precision of products in training; bfloat16 takes half the memory and rounds to 3 digits, weights stay in float32
    precision: Precision = added("float32")

    @property
    def chooses_by_validation(self) -> bool:
        """Whether validation grasps select a network's epoch or stop its training."""
        return self.select == "best" or bool(self.patience)

    @property
    @abstractmethod
    def point_inputs(self) -> CloudInputs | PatchOptions:
        """Inputs of the network from a cloud, defined by `Patches` and `Pointnet`."""

    def fit(self, grasps: TrainingGrasps, model: FittedModel) -> None:
        """Add networks trained by the shared loop: one for all targets or one for each."""
        grasps.train_networks(self, model)

    def load_member(self, stored: StoredMember) -> Member:
        """Return the network of some targets."""
        return stored.network(self)

    @abstractmethod
    def build(self, shape: PointNetworkShape) -> nn.Module:
        """Return a network with random weights for these inputs and outputs.

        ``shape`` is a `tacpipe.models.point_networks.PointNetworkShape`.

        The network is called as ``network(points, numbers)`` and returns scaled values (cloud, ``shape.values``), the
        targets' values as columns.

        - If the architecture extends `Patches`, ``points`` are (cloud, 3, point, ``shape.channels``): patches about the
          two contacts, in the axes of the grasp, and the whole cloud. Channels are position in metres, then colour.
        - If it extends `Pointnet`, ``points`` are the whole cloud (cloud, point, ``shape.channels``), as defined by
          ``inputs`` and ``normalisation``.
        - ``numbers`` (cloud, ``shape.numbers``) are features of the grasp.

        The task samples points at each visit, scales the readings, trains (Adam, the loss and epoch selected by params,
        resumable checkpoints, bfloat16), averages over ``networks`` and ``draws``, stores weights as safetensors, and
        evaluates next to the baselines.
        """


@dataclass(frozen=True)
class Patches(PointNetwork):
    """Networks on points near both contacts, in the axes of the grasp."""

    # patches: networks that read points near both contacts
    architecture: Literal["patches"] = "patches"
    # xyz: positions of points; rgb: positions and colours; pointnet: cont adds contact points, pose the wrist
    inputs: Literal["rgb", "xyz"] = "rgb"
    place: bool = False  # also read the position of the grasp in the camera frame
    backbone: Literal["points", "edges"] = "points"  # points: each point separately; edges: with its neighbours
    radius_mm: Annotated[PositiveFloat, Unit("mm")] = 20.0  # radius of the patch around a contact
    hidden: Annotated[int, Range(2)] = 256  # units of the first layer after the points
    dropout: Dropout = 0.3  # fraction of the ``hidden`` units dropped in each training step
    PRESETS: ClassVar[Presets] = {"quick": {"networks": 1, "epochs": 10, "points": 64}}

    @property
    def point_inputs(self) -> PatchOptions:
        """Points near both contacts."""
        from tacpipe.tasks.touch.inputs import PatchOptions

        return PatchOptions(self.points, self.radius_mm / 1000, self.inputs == "rgb", self.place)

    def build(self, shape: PointNetworkShape) -> nn.Module:
        """Return the patch network for inputs and outputs of this shape, with random weights."""
        from tacpipe.models.point_networks import PatchNetwork

        return PatchNetwork(
            shape.channels,
            shape.numbers,
            shape.values,
            backbone=self.backbone,
            hidden=self.hidden,
            dropout=self.dropout,
        )


@dataclass(frozen=True)
class Pointnet(PointNetwork):
    """The paper's network, which reads the whole cloud."""

    # pointnet: the paper's network
    architecture: Literal["pointnet"] = "pointnet"
    TITLE: ClassVar[str] = "PointNet"
    # xyz: positions of points; rgb: positions and colours; pointnet: cont adds contact points, pose the wrist
    inputs: Literal["xyz", "rgb", "xyzcont", "rgbcont", "xyzpose", "rgbpose"] = "rgbcont"
    # normalisation of a cloud; minmax: of each axis; wrist: axes of the wrist
    normalisation: Literal["none", "sphere", "minmax", "wrist"] = "none"
    # maximum random rotation about each axis in training
    rotation_deg: Annotated[float, Range(0, 180), Unit("degrees")] = 0.0
    # rotation of the wrist: as recorded, or estimated from closing axis and line of sight
    wrist: Literal["given", "estimated"] = "given"
    # head of the network: number of fully connected layers
    head: Literal["fc1", "fc2", "fc3", "fc4", "fc5", "fc6"] = "fc3"
    transform: bool = True  # transform all channels of a cloud first, by a learned map
    PRESETS: ClassVar[Presets] = {
        "paper": {
            "multi_target": False,
            "use_validation": False,
            "networks": 1,
            "points": 750,
            "draws": 1,
            "normalisation": "minmax",
            "loss": "rmse",
            "epochs": 250,
            "batch": 10,
            "learning_rate": 0.01,
            "cycle": False,
        },
        "quick": {"networks": 1, "epochs": 10, "points": 64},
    }

    @property
    def point_inputs(self) -> CloudInputs:
        """The whole cloud, with contact points and wrist as selected by ``inputs``."""
        from tacpipe.tasks.touch.inputs import CloudInputs

        return CloudInputs(self.inputs, self.points, self.normalisation, self.rotation_deg, self.wrist)

    def build(self, shape: PointNetworkShape) -> nn.Module:
        """Return the paper's network."""
        from tacpipe.models.point_networks import HEADS, PointNet

        return PointNet(shape.channels, shape.numbers, shape.values, head=HEADS[self.head], transform=self.transform)


Params = TouchModelParams  # params of any architecture


DEFAULT = TouchModelParams.architecture  # default architecture
PAPER = Pointnet.architecture  # architecture of the paper


class MemberDescription(TypedDict):
    """Description of a member of a model, which predicts some of its targets."""

    kind: str  # forest or network; only a forest has the fields below
    targets: list[str]
    groups: NotRequired[list[list[str]]]  # targets of each forest
    features: NotRequired[list[str]]
    coloured: NotRequired[bool]
    placed: NotRequired[bool]
    leaves: NotRequired[list[int]]


class GraspQuantiles(TypedDict):
    """Calibration of a model's quantiles."""

    levels: list[int]  # in percent
    method: str
    grasps: int


class TouchConfig(ModelConfig):
    """``config.json`` of a touch model."""

    split: str
    targets: list[str]
    objects: list[str]
    counts: dict[str, int]  # number of grasps by role
    members: list[MemberDescription]
    parameters: int | None  # number of trainable parameters; None for forests
    learned_objects: NotRequired[list[str]]  # object of each training grasp, for the baselines
    kept_of_novel: NotRequired[dict[str, float]]  # shrinkage factor by target
    quantiles: NotRequired[GraspQuantiles]
