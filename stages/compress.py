"""Compress tactile channels to a few latents.

Codecs are fitted only on the training recordings. Latents are added as columns ``z00``, ``z01``, …; all other columns
and rows are unchanged. The inputs are the channels with ``quantity=tactile`` in their field metadata, minus their rest
level. ``codec.json`` and ``codec.safetensors`` contain everything for decoding latents to counts, and the
reconstruction error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import CommaList, NonNegativeFloat, PositiveFloat, PositiveInt, Range, Seed, StoredAs
from tacpipe.plugins.params import Panels
from tacpipe.plugins.stage import Fitted, Presets, Result, Workspace, stage

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

Representation = Annotated[Literal["levels", "increments"], StoredAs("of")]


@dataclass(frozen=True)
class Params:
    """Number and source of the latents."""

    components: PositiveInt = 20  # number of latents, at most the number of channels; 20 in the paper
    # use as many latents as explain this fraction of the variance instead; 0: use components
    variance: Annotated[float, Range(0, below=1)] = 0.0
    # levels: counts above rest; increments: change from the previous row
    representation: Representation = "levels"
    PANELS: ClassVar[Panels] = {"Model": ("components", "variance", "representation")}


@dataclass(frozen=True)
class AutoencoderParams:
    """Inputs, widths and training of the network."""

    frames: Literal[1, 2, 3] = 1  # consecutive rows that it reads: the paper's classes C1, C2 and C3
    components: PositiveInt = 8  # number of latents; the paper chose 8
    # widths of the encoder's hidden layers, such as 64,32; empty: those of the class
    hidden: Annotated[str, CommaList(PositiveInt)] = ""
    # levels: counts above rest; increments: change from the previous row
    representation: Representation = "levels"
    # number of networks to try with the same budget; the best is used; 0: no search
    search: Annotated[int, Range(0, 12)] = 0
    epochs: PositiveInt = 100  # maximum number of passes over the training rows
    batch: PositiveInt = 256  # rows per step of the optimiser
    learning_rate: PositiveFloat = 1e-3  # learning rate of Adam
    weight_decay: NonNegativeFloat = 1e-5  # weight decay of Adam
    patience: PositiveInt = 10  # epochs without a lower error on held-out training recordings before training stops
    seed: Seed = 0  # random seed of initial weights and of the order of rows
    PANELS: ClassVar[Panels] = {
        "Model": ("frames", "components", "hidden", "representation", "search"),
        "Training": ("epochs", "batch", "learning_rate", "weight_decay", "patience", "seed"),
    }
    PRESETS: ClassVar[Presets] = {"quick": {"epochs": 5}}

    def check(self) -> None:
        """Raise `UsageError` for hidden layers together with a search, which chooses its own widths."""
        if self.search and self.hidden:
            raise UsageError(
                f"hidden is {self.hidden} and search is {self.search}, which chooses its own widths; give only one of them."
            )


@stage(version=3)
def fit(params: Params, train: Dataset) -> Result:
    """Return the principal components of the rows in contact outside of gaps, from the training recordings."""
    from tacpipe.codecs import pca, training_rows

    rows = training_rows.stored_rows(train.recordings, params.representation)
    latents, notes = _latent_count(params.components, len(rows.channels))
    codec = pca.fit_and_measure(
        rows, components=latents, variance=params.variance, representation=params.representation
    )
    return Result(files=codec.to_files(), notes=[] if params.variance else notes)


@stage(version=1)
def fit_autoencoder(params: AutoencoderParams, train: Dataset, workspace: Workspace) -> Result:
    """Return the autoencoder trained on the rows in contact outside of gaps, from the training recordings."""
    from tacpipe.codecs import autoencoder_fit, training_rows
    from tacpipe.training.loop import Schedule

    tried = autoencoder_fit.candidate_networks(
        params.frames, params.hidden, params.search, params.learning_rate, params.weight_decay
    )
    schedule = Schedule(
        epochs=params.epochs,
        batch=params.batch,
        learning_rate=params.learning_rate,
        patience=params.patience,
        gradient_clip=autoencoder_fit.GRADIENT_CLIP,
        seed=params.seed,
    )
    rows = training_rows.read_rows(train.recordings, params.representation, params.frames)
    latents, notes = _latent_count(params.components, len(rows.channels))
    codec = autoencoder_fit.fit(
        rows, tried, schedule, workspace, components=latents, representation=params.representation
    )
    return Result(files=codec.to_files(), notes=notes)


@stage(version=2)
def pca(params: Params, recording: Recording, codec: Annotated[Fitted, fit]) -> pa.Table:
    """Compress tactile channels with principal components.

    The latents are added as columns ``z00``, ``z01``, …; all other columns and rows stay. A recording must have the
    channels that the codec was fitted on.

    Example: tacpipe compress pca data/segments --split data/split -o data/latents
    """
    from tacpipe.codecs import tactile

    return tactile.add_latents(recording, codec)


@stage(version=1)
def autoencoder(params: AutoencoderParams, recording: Recording, codec: Annotated[Fitted, fit_autoencoder]) -> pa.Table:
    """Compress tactile channels with an autoencoder.

    The latents are added as columns ``z00``, ``z01``, …; all other columns and rows stay. 15 % of the training
    recordings are held out for early stopping. A recording must have the channels that the codec was fitted on.

    Example: tacpipe compress autoencoder data/segments --split data/split -o data/codes
    """
    from tacpipe.codecs import tactile

    return tactile.add_latents(recording, codec)


def _latent_count(components: int, channels: int) -> tuple[int, list[str]]:
    """Return the number of latents, and a list with a note if there are fewer channels than requested latents."""
    if components <= channels:
        return components, []
    return channels, [
        f"components is {components} and there are {channels} tactile channels, so as many latents are kept."
    ]
