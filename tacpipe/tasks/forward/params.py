"""How a model of the task ``forward`` is built and trained: the params of `tacpipe train forward`, one class a family."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from tacpipe.plugins.constraints import PositiveFloat, PositiveInt, Range, Seed
from tacpipe.plugins.params import added
from tacpipe.training.devices import Precision

Presets = Mapping[str, Mapping[str, object]]
Panels = Mapping[str, Sequence[str]]
Dropout = Annotated[float, Range(0, below=1)]


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
    # of products in training; bfloat16 takes half the memory and rounds to 3 digits, weights stay in float32
    precision: Precision = added("float32")
    arm: str = added("")  # stream whose position and orientation are the motion; empty: the only one with a position
    PANELS: ClassVar[Panels] = {
        "Model": ("architecture", "actions", "hidden", "dropout", "context", "horizon"),
        "Training": (
            *("loss", "epochs", "batch", "learning_rate", "cycle", "patience", "gradient_clip"),
            *("precision", "seed", "baselines"),
        ),
        "Data": ("windows", "stride", "arm"),
    }


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
