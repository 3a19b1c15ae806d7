"""Train the model of a task on recordings of the training role, stopped by those of validation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from tacpipe.stage import stage

if TYPE_CHECKING:
    from tacpipe.dataset import Dataset, Model
    from tacpipe.stage import Result, Workspace


@dataclass(frozen=True)
class Params:
    """Kind and size of the model and of its windows, and how it is trained."""

    architecture: str = "taxelwise"  # taxelwise, gru, lstm and tcn tell the change; recurrent is the paper's
    actions: str = "planned"  # what the model is told of the plan: planned, none, or shuffled as a negative control
    hidden: int = 128  # units of a layer
    dropout: float = 0.2  # share of units left out of each training step; the recurrent model has none
    loss: str = "absolute"  # absolute, huber or squared error; the recurrent model has squared
    epochs: int = 16  # most passes over the training windows
    batch: int = 128  # windows a step of the optimiser
    learning_rate: float = 2e-3  # of Adam, without unit; the peak where it goes through a cycle
    cycle: bool = True  # let the learning rate rise and fall over all epochs
    patience: int = 16  # epochs without a lower validation error after which training ends
    gradient_clip: float = 1.0  # largest norm of the gradient
    windows: str = "all"  # all, or contact: those that lie within one contact
    stride: int = 1  # rows from one training window to the next
    seed: int = 0  # of first weights and shuffles
    context: int = 10  # rows of the past that the model reads
    horizon: int = 10  # rows ahead that it predicts
    baselines: bool = True  # fit the linear baselines too, so that evaluate shows them
    PRESETS: ClassVar[Mapping[str, Mapping[str, object]]] = {
        "paper": {
            "architecture": "recurrent",
            "hidden": 200,
            "dropout": 0.0,
            "loss": "squared",
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


@stage(version=3)
def forward(params: Params, train: Dataset, val: Dataset, workspace: Workspace, init: Model | None = None) -> Result:
    """Train the forecast of touch: past touch and motion and the planned motion give the touch to come.

    ``init`` is a model to begin with: its weights and scalings are taken over.
    """
    from dataclasses import asdict

    from tacpipe.stage import Result
    from tacpipe.tasks import forward as task

    return Result(files=task.train(asdict(params), train, val, workspace, init.files if init else None))


@dataclass(frozen=True)
class MaterialParams:
    """Kind of the classifier, what it is told, and how networks are trained; the defaults are the strongest we know."""

    architecture: str = "minirocket"  # minirocket; raec, the paper's recurrent autoencoder; its x-lstm; or spectra
    sensors: str = ""  # sensors to learn for, with commas; empty for all
    quantities: str = ""  # of the columns to read; empty: tactile, and vibration (22 readings a frame) for minirocket
    setting: str = ""  # words that set this run apart from others of its kind in a report, as blocked
    seed: int = 0  # of kernels, first weights, shuffles and pairs
    baselines: bool = True  # fit the mean-level and shuffled-label baselines too, so that evaluate shows them
    labels: str = "true"  # true, or permuted: dealt out anew among the training slides, a negative control
    features: int = 10_000  # of minirocket, for each sensor
    use_validation: bool = True  # let minirocket and spectra learn from validation slides too: they choose nothing
    joint: bool = True  # raec: draw the latents of unlike sensors together where they felt the same material
    known: str = ""  # raec with --init: sensor of that model whose latents stay; the others learn to meet them
    pairing: str = "random"  # pairs of joint learning: random; fixed, drawn once; permuted, of other materials
    agreement: str = "pairs"  # what draws latents together: pairs of one material; contrast, to all other slides too
    hold_out: str = ""  # materials whose labels a sensor is not told, as roboskin=17,18,19,20; not minirocket
    reduce: str = ""  # sensor that learns from a share of the batches alone; needs --no-shuffle
    ratio: int = 100  # that share in percent: 100, 90, 50, 25, 17 or 11
    headers: str = ""  # in front of the networks, as biotac=mlp: none, mlp or cnn; cnn for a 6 x 10 grid, else none
    decoder: str = "D1"  # of raec: D1, latents are its first state; D2, its input at every step
    hidden: int = 90  # units of each LSTM
    latents: int = 40  # numbers that a slide becomes
    speeds: str = "biotac=0.025,roboskin=0.05"  # metres a second of slides whose recordings do not tell; of spectra
    scaling: str = "none"  # of a network's input: none; standard; spread, zero staying zero; log, spread of log(1 + x)
    epochs: int = 300  # most passes over the training slides
    batch: int = 32  # slides of each sensor in a step of the optimiser
    learning_rate: float = 5e-4  # of Adam, without unit
    cycle: bool = False  # let the learning rate rise and fall over all epochs
    patience: int = 0  # epochs without a better validation accuracy after which training ends; 0: never before time
    reconstruction_weight: float = 0.01  # of the squared error of slides made again
    classification_weight: float = 1.0  # of the negative log-likelihood of classes
    alignment_weight: float = 1.0  # of the squared difference of latents between sensors
    align_from: int = 20  # first epoch, from 0, in which latents are drawn together
    dropout: float = 0.2  # share of latents left out, where dropout_mode says so
    dropout_mode: str = "noop"  # noop: none, as in the published code, whose dropout has no effect; latent
    shuffle: bool = True  # other batches every epoch
    drop_last: bool = False  # leave out the batch that is not full, also when judging, as the published code does
    unpool: str = "nearest"  # how a cnn is undone: nearest; last, with the last frame's indices, as published
    select: str = "best"  # weights to keep: best, of the highest validation accuracy; last, of the last epoch
    PRESETS: ClassVar[Mapping[str, Mapping[str, object]]] = {
        "paper": {"architecture": "raec", "epochs": 2000},
        "authors": {  # the published code with its quirks; to be given slides of the layout authors
            "architecture": "raec",
            "epochs": 2000,
            "pairing": "fixed",
            "shuffle": False,
            "drop_last": True,
            "unpool": "last",
            "select": "last",
            "seed": 1,
        },
        "quick": {"features": 1_000, "epochs": 30},
    }


@stage(version=1)
def material(
    params: MaterialParams, train: Dataset, val: Dataset | None, workspace: Workspace, init: Model | None = None
) -> Result:
    """Train a classifier of materials on slides, for each sensor alone or for unlike sensors jointly.

    ``init`` is a model whose latents of the sensor ``known`` stay while the others learn to meet them.
    """
    from dataclasses import asdict

    from tacpipe.stage import Result
    from tacpipe.tasks import material as task

    return Result(files=task.train(asdict(params), train, val, workspace, init.files if init else None))


@dataclass(frozen=True)
class TouchParams:
    """Kind of the model of touch, what it reads, and how networks are trained; the defaults are the strongest we know."""

    architecture: str = "strong"  # strong, trees of two kinds; trees, a forest a target; patches; pointnet, the paper's
    targets: str = "pdc_th,pdc_mf,e_th,e_mf"  # pressure and electrodes of thumb and middle finger, with commas
    together: bool = True  # one network foretells all targets; else one each, as in the paper
    inputs: str = "rgbcont"  # xyz, rgb, xyzcont, rgbcont, xyzpose or rgbpose; trees and patches: whether rgb is read
    setting: str = ""  # words that set this run apart from others of its kind in a report, as blocked
    seed: int = 0  # of first weights, shuffles, drawn points and cuts
    baselines: bool = True  # keep what was felt in training, so that evaluate shows constant, object mean and nearest
    use_validation: bool = True  # learn from validation grasps too where nothing is chosen by them
    place: bool = False  # trees and patches: read where the grasp is before the camera too, not its shape alone
    trees: int = 300  # of each target's forest
    leaf: int = 0  # training grasps of a leaf or more; 0: chosen of 2, 4 and 8 by out-of-bag error
    networks: int = 3  # networks of other first weights whose mean is told
    backbone: str = "points"  # of patches: points, each alone; edges, each with its nearest ones
    radius_mm: float = 20.0  # millimetres about a contact that are its patch
    hidden: int = 256  # units of the patch network's first layer behind the points
    dropout: float = 0.3  # share of these left out of each training step
    points: int = 128  # drawn of each cloud, or of each patch, anew at each visit
    draws: int = 4  # of points, over which a prediction is averaged
    normalisation: str = "none"  # of a pointnet's cloud: none; sphere; minmax of each axis; wrist, its axes
    rotation_deg: float = 0.0  # degrees; largest random turn about each axis of a pointnet's training clouds
    wrist: str = "given"  # of pointnet: given; estimated from closing axis and line of sight where none is recorded
    head: str = "fc3"  # of pointnet: fc1 to fc6, its fully connected layers
    transform: bool = True  # of pointnet: transform all channels of a cloud first, by a map that is learned
    loss: str = "balanced"  # balanced: squared error, all targets alike; rmse of normalised values, the paper's
    epochs: int = 40  # passes over the training grasps
    batch: int = 16  # grasps of a step of the optimiser
    learning_rate: float = 2e-3  # of Adam, without unit; the peak where it goes through a cycle
    cycle: bool = True  # let the learning rate rise and fall over all epochs
    weight_decay: float = 0.0  # share of each weight that is added to its gradient
    patience: int = 0  # epochs without a lower validation loss after which training ends; 0: never before time
    select: str = "last"  # weights to keep: last, of the last epoch; best, of the lowest validation loss
    PRESETS: ClassVar[Mapping[str, Mapping[str, object]]] = {
        "paper": {
            "architecture": "pointnet",
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
        "quick": {"trees": 100, "networks": 1, "epochs": 10, "points": 64},
    }


@stage(version=1)
def touch(params: TouchParams, train: Dataset, val: Dataset | None, workspace: Workspace) -> Result:
    """Train the forecast of touch before a grasp: a point cloud and two contact points give what both fingers feel."""
    from dataclasses import asdict

    from tacpipe.stage import Result
    from tacpipe.tasks import touch as task

    return Result(files=task.train(asdict(params), train, val, workspace))
