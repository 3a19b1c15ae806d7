"""Train the model of a task on recordings of the training role, stopped by those of validation.

Options that belong to one architecture are refused with another; ``--architecture`` states which there are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import (
    Assignments,
    CommaList,
    Names,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
    Seed,
)
from tacpipe.plugins.stage import stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.plugins.stage import Result, Workspace

Presets = Mapping[str, Mapping[str, object]]
Dropout = Annotated[float, Range(0, below=1)]
Draws = Annotated[int, Range(1, 100_000)]
HeldOut = Annotated[str, Assignments(Annotated[str, CommaList(NonNegativeInt, least=1)], between=";")]
Targets = Annotated[str, CommaList(Literal["pdc_th", "pdc_mf", "e_th", "e_mf"], least=1)]


@dataclass(frozen=True)
class Forward:
    """Size of a model of the task ``forward`` and of its windows, and how it is trained."""

    architecture: str
    # what the model reads of the planned motion: planned, none, or shuffled (another window's, a negative control)
    actions: Literal["planned", "none", "shuffled"] = "planned"
    hidden: PositiveInt = 128  # units per layer
    epochs: PositiveInt = 16  # maximum number of passes over the training windows
    batch: PositiveInt = 128  # windows per step of the optimiser
    learning_rate: PositiveFloat = 2e-3  # of Adam; the peak if it goes through a cycle
    cycle: bool = True  # raise and lower the learning rate once over all epochs
    patience: PositiveInt = 16  # epochs without a lower validation error after which training ends
    gradient_clip: PositiveFloat = 1.0  # largest norm of the gradient
    windows: Literal["all", "contact"] = "all"  # training windows: all, or those within one contact
    stride: PositiveInt = 1  # rows from one training window to the next
    seed: Seed = 0  # random seed of initial weights and of the order of windows
    context: PositiveInt = 10  # past rows that the model reads
    horizon: PositiveInt = 10  # future rows that it predicts
    baselines: bool = True  # fit the linear baselines too, for evaluate to compare with


@dataclass(frozen=True)
class Change(Forward):
    """A model that predicts the change since the last row; auto is taxelwise on raw channels and gru on latents."""

    # network; auto: taxelwise for raw channels, gru for latents and for channels that do not lie taxel by taxel
    architecture: Literal["auto", "taxelwise", "gru", "lstm", "tcn"] = "auto"
    dropout: Dropout = 0.2  # fraction of units left out of each training step
    # error that training minimises; auto: absolute, and huber for latents of increments, whose median is often 0
    loss: Literal["auto", "absolute", "huber", "squared"] = "auto"
    PRESETS: ClassVar[Presets] = {"quick": {"hidden": 32, "epochs": 3}}


@dataclass(frozen=True)
class Recurrent(Forward):
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


Params = Change | Recurrent


@stage(version=3)
def forward(params: Params, train: Dataset, val: Dataset, workspace: Workspace, init: Model | None = None) -> Result:
    """Train a model that predicts future tactile signals.

    It reads past tactile signals, past motion and the planned motion. ``init`` is a model to begin with: its weights
    and scalings are taken over.
    """
    from dataclasses import asdict

    from tacpipe.plugins.stage import Result
    from tacpipe.tasks.forward import task

    return Result(files=task.train(asdict(params), train, val, workspace, init.files if init else None))


@dataclass(frozen=True)
class Material:
    """What every classifier of materials reads and learns."""

    architecture: str
    sensors: Names = ""  # sensors to learn for; empty for all
    # quantities to read; empty: tactile, and for minirocket also vibration (22 readings a frame)
    quantities: Names = ""
    setting: str = ""  # words that set this run apart from others of its kind in a report, as blocked
    seed: Seed = 0  # random seed of kernels, initial weights, the order of slides and pairs
    baselines: bool = True  # fit the mean-level and shuffled-label baselines too, for evaluate to compare with
    # labels to learn; permuted: those of the training slides in random order, a negative control
    labels: Literal["true", "permuted"] = "true"


@dataclass(frozen=True)
class Minirocket(Material):
    """Random convolutions and a linear readout, of each sensor alone: the best classifier that we know."""

    # classifier: minirocket, random convolutions and a linear readout
    architecture: Literal["minirocket"] = "minirocket"
    features: Annotated[int, Range(84)] = 10_000  # of each sensor
    use_validation: bool = True  # learn from validation slides too: nothing is chosen by them
    PRESETS: ClassVar[Presets] = {"quick": {"features": 1_000}}


@dataclass(frozen=True)
class Spectra(Material):
    """Spectra over spatial frequency, by which sensors learn materials from one another."""

    # spectra: power over spatial frequency
    architecture: Literal["spectra"] = "spectra"
    use_validation: bool = True  # learn from validation slides too: nothing is chosen by them
    hold_out: HeldOut = ""  # materials whose labels a sensor does not learn, as roboskin=17,18,19,20
    # metres a second of slides whose recordings have no speed
    speeds: Annotated[str, Assignments(PositiveFloat)] = "biotac=0.025,roboskin=0.05"


@dataclass(frozen=True)
class Network(Material):
    """What recurrent classifiers have in common."""

    hold_out: HeldOut = ""  # materials whose labels a sensor does not learn, as roboskin=17,18,19,20
    reduce: str = ""  # sensor that learns from a part of the batches alone; needs --no-shuffle
    ratio: Literal[100, 90, 50, 25, 17, 11] = 100  # percentage of the batches that it learns from
    # network in front of a sensor's, as biotac=mlp; by default cnn for a 6 x 10 grid, else none
    headers: Annotated[str, Assignments(Literal["none", "mlp", "cnn"])] = ""
    hidden: PositiveInt = 90  # units of each LSTM
    # of the input: none; standard: mean 0 and deviation 1 of each channel; spread: one deviation for all channels,
    # zero stays zero; log: spread of log(1 + x)
    scaling: Literal["none", "standard", "spread", "log"] = "none"
    epochs: PositiveInt = 300  # maximum number of passes over the training slides
    batch: PositiveInt = 32  # slides of each sensor per step of the optimiser
    learning_rate: PositiveFloat = 5e-4  # of Adam
    cycle: bool = False  # raise and lower the learning rate once over all epochs
    patience: NonNegativeInt = 0  # epochs without a better validation accuracy after which training ends; 0: all epochs
    shuffle: bool = True  # other batches every epoch
    drop_last: bool = False  # leave out the batch that is not full, in evaluation too, as the published code does
    # weights to keep: best, of the highest validation accuracy; last, of the last epoch
    select: Literal["best", "last"] = "best"

    def check(self) -> None:
        """Refuse a reduced sensor that would see all batches in the end, and a ratio of none."""
        if self.reduce and self.shuffle:
            raise UsageError(
                f"reduce is {self.reduce} and batches are shuffled, so that this sensor would learn from all slides in "
                f"the end; give --no-shuffle with --reduce."
            )
        if self.ratio != 100 and not self.reduce:
            raise UsageError(f"ratio is {self.ratio} and no sensor is reduced; name one with --reduce.")


@dataclass(frozen=True)
class Raec(Network):
    """The paper's recurrent autoencoder with a classifier, learned jointly for unlike sensors or for each alone."""

    # raec: the paper's recurrent autoencoder
    architecture: Literal["raec"] = "raec"
    joint: bool = True  # align the latents of unlike sensors on slides of the same material
    known: str = ""  # with --init: sensor of that model whose latents stay; the others learn to meet them
    # pairs of joint learning: random; fixed: drawn once; permuted: of other materials, a negative control
    pairing: Literal["random", "fixed", "permuted"] = "random"
    # alignment loss: pairs of one material, or contrast with all other slides too
    agreement: Literal["pairs", "contrast"] = "pairs"
    decoder: Literal["D1", "D2"] = "D1"  # D1: latents are its first state; D2: they are its input at every step
    latents: PositiveInt = 40  # numbers that a slide is encoded to
    # how a cnn is undone: nearest; last, with the last frame's indices, as published
    unpool: Literal["nearest", "last"] = "nearest"
    reconstruction_weight: NonNegativeFloat = 0.01  # of the squared error of reconstructed slides
    classification_weight: NonNegativeFloat = 1.0  # of the negative log-likelihood of classes
    alignment_weight: NonNegativeFloat = 1.0  # of the alignment loss between sensors
    align_from: NonNegativeInt = 20  # first epoch, from 0, in which latents are aligned
    dropout: Dropout = 0.0  # fraction of latents left out of each training step; 0 as in the published code
    PRESETS: ClassVar[Presets] = {
        "paper": {"epochs": 2000},
        "authors": {  # the published code with its quirks; to be given slides of the layout authors
            "epochs": 2000,
            "pairing": "fixed",
            "shuffle": False,
            "drop_last": True,
            "unpool": "last",
            "select": "last",
            "seed": 1,
        },
        "quick": {"epochs": 30},
    }

    def check(self) -> None:
        """Refuse what states nothing without joint learning."""
        super().check()
        if not self.joint:
            given = [("known", self.known), ("pairing", self.pairing), ("agreement", self.agreement)]
            odd = [f"{name} is {value}" for name, value in given if value and value not in ("random", "fixed", "pairs")]
            if odd:
                raise UsageError(f"{odd[0]} and sensors are not learned jointly; leave out --no-joint, or that.")


@dataclass(frozen=True)
class XLSTM(Network):
    """The recurrent classifier without decoder that the paper compares with, of each sensor alone."""

    # x-lstm: the paper's classifier without decoder
    architecture: Literal["x-lstm"] = "x-lstm"
    PRESETS: ClassVar[Presets] = {"paper": {"epochs": 2000}, "quick": {"epochs": 30}}


MaterialParams = Minirocket | Raec | XLSTM | Spectra


@stage(version=1)
def material(
    params: MaterialParams, train: Dataset, val: Dataset | None, workspace: Workspace, init: Model | None = None
) -> Result:
    """Train a classifier of materials from slides.

    It is trained for each sensor alone or for unlike sensors jointly. ``init`` is a model whose latents of the sensor
    ``known`` stay while the others learn to meet them.
    """
    from dataclasses import asdict

    from tacpipe.plugins.stage import Result
    from tacpipe.tasks.material import task

    return Result(files=task.train(asdict(params), train, val, workspace, init.files if init else None))


@dataclass(frozen=True)
class Touch:
    """What every model of the task ``touch`` predicts and learns from."""

    architecture: str
    targets: Targets = "pdc_th,pdc_mf,e_th,e_mf"  # pressure and electrodes of thumb and middle finger
    setting: str = ""  # words that set this run apart from others of its kind in a report, as blocked
    seed: Seed = 0  # random seed of initial weights, the order of grasps, drawn points and cuts
    baselines: bool = True  # keep the training readings, for evaluate to compare with constant, object mean and nearest
    use_validation: bool = True  # learn from validation grasps too where nothing is chosen by them


@dataclass(frozen=True)
class Trees(Touch):
    """Forests over the geometry of a grasp: the best model that we know."""

    # strong: trees of two kinds; trees: a forest a target
    architecture: Literal["strong", "trees"] = "strong"
    inputs: Literal["rgb", "xyz"] = "rgb"  # what is read of a cloud: places and colours, or places alone
    place: bool = False  # read where the grasp is before the camera too, not its shape alone
    trees: PositiveInt = 300  # of each target's forest
    leaf: NonNegativeInt = 0  # fewest training grasps of a leaf; 0: chosen of 2, 4 and 8 by out-of-bag error
    PRESETS: ClassVar[Presets] = {"quick": {"trees": 100}}


@dataclass(frozen=True)
class PointNetwork(Touch):
    """What networks that read points have in common."""

    together: bool = True  # one network for all targets; else one each, as in the paper
    networks: PositiveInt = 3  # networks of other initial weights, whose mean is the prediction
    points: Draws = 128  # drawn of each cloud, or of each patch, anew at each visit
    draws: Draws = 4  # of points, over which a prediction is averaged
    # balanced: squared error in which all targets count the same; rmse of normalised values, the paper's
    loss: Literal["balanced", "rmse"] = "balanced"
    epochs: PositiveInt = 40  # passes over the training grasps
    batch: Annotated[int, Range(2)] = 16  # grasps per step of the optimiser, which normalises them by their own spread
    learning_rate: PositiveFloat = 2e-3  # of Adam; the peak if it goes through a cycle
    cycle: bool = True  # raise and lower the learning rate once over all epochs
    weight_decay: NonNegativeFloat = 0.0  # fraction of each weight that is added to its gradient
    patience: NonNegativeInt = 0  # epochs without a lower validation loss after which training ends; 0: all epochs
    # weights to keep: last, of the last epoch; best, of the lowest validation loss
    select: Literal["last", "best"] = "last"


@dataclass(frozen=True)
class Patches(PointNetwork):
    """Points about both contacts, in the axes of the grasp."""

    # patches: networks that read points about both contacts
    architecture: Literal["patches"] = "patches"
    inputs: Literal["rgb", "xyz"] = "rgb"  # what is read of a point: place and colour, or place alone
    place: bool = False  # read where the grasp is before the camera too, not its shape alone
    backbone: Literal["points", "edges"] = "points"  # points: each alone; edges: each with its nearest ones
    radius_mm: PositiveFloat = 20.0  # millimetres about a contact that are its patch
    hidden: Annotated[int, Range(2)] = 256  # units of the first layer behind the points
    dropout: Dropout = 0.3  # fraction of these left out of each training step
    PRESETS: ClassVar[Presets] = {"quick": {"networks": 1, "epochs": 10, "points": 64}}


@dataclass(frozen=True)
class Pointnet(PointNetwork):
    """The paper's network, which reads the whole cloud."""

    # pointnet: the paper's network
    architecture: Literal["pointnet"] = "pointnet"
    # what is read: place (xyz) or place and colour (rgb) of points, with contact points (cont) and wrist (pose)
    inputs: Literal["xyz", "rgb", "xyzcont", "rgbcont", "xyzpose", "rgbpose"] = "rgbcont"
    # of a cloud; minmax of each axis; wrist's axes
    normalisation: Literal["none", "sphere", "minmax", "wrist"] = "none"
    rotation_deg: Annotated[float, Range(0, 180)] = 0.0  # degrees; largest random turn about each axis in training
    # rotation of the wrist: as recorded, or estimated from closing axis and line of sight
    wrist: Literal["given", "estimated"] = "given"
    head: Literal["fc1", "fc2", "fc3", "fc4", "fc5", "fc6"] = "fc3"  # fully connected layers
    transform: bool = True  # transform all channels of a cloud first, by a learned map
    PRESETS: ClassVar[Presets] = {
        "paper": {
            "together": False,
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


TouchParams = Trees | Patches | Pointnet


@stage(version=1)
def touch(params: TouchParams, train: Dataset, val: Dataset | None, workspace: Workspace) -> Result:
    """Train a model that predicts the touch of a planned grasp.

    It reads a point cloud and two contact points.
    """
    from dataclasses import asdict

    from tacpipe.plugins.stage import Result
    from tacpipe.tasks.touch import task

    return Result(files=task.train(asdict(params), train, val, workspace))
