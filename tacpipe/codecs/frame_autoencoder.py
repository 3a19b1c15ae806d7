"""Train a small convolutional autoencoder of camera images on the training recordings.

Images are reduced to the means of a coarse grid. Three convolutions with stride 2 and a linear layer compute the
features, and their mirror image decodes them. The mean squared error of held-out recordings stops the training.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from tacpipe.arrays import Bytes, Float32s
from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.printable import plain
from tacpipe.training import devices, loop
from tacpipe.video.decoding import cell_means

ROWS, COLUMNS = 48, 64  # grid to which an image is reduced
CHANNELS = (3, 16, 32, 32)  # colours, and channels after each convolution
INNER = (CHANNELS[-1], ROWS // 8, COLUMNS // 8)  # shape after the convolutions
GRADIENT_CLIP = 1.0  # maximum norm of the gradient
WEIGHTS = "encoder.safetensors"
Encode = Callable[[Bytes], Float32s]  # maps images, uint8 (frame, height, width, rgb), to features (frame, feature)


class _Network(nn.Module):
    """Convolutions that encode images as features, and a decoder that mirrors them."""

    def __init__(self, components: int) -> None:
        """Create mirrored convolutions between which an image is represented by ``components`` numbers."""
        super().__init__()
        encoder_layers: list[nn.Module] = []
        decoder_layers: list[nn.Module] = []
        for number, (in_channels, out_channels) in enumerate(itertools.pairwise(CHANNELS)):
            encoder_layers += [nn.Conv2d(in_channels, out_channels, 4, 2, 1), nn.ELU()]
            decoder_layers = [
                nn.ConvTranspose2d(out_channels, in_channels, 4, 2, 1),
                *([nn.ELU()] if number else []),
                *decoder_layers,
            ]
        width = int(np.prod(INNER))
        self.encoder = nn.Sequential(*encoder_layers, nn.Flatten(), nn.Linear(width, components))
        self.decoder = nn.Sequential(nn.Linear(components, width), nn.ELU(), nn.Unflatten(1, INNER), *decoder_layers)

    def forward(self, images: Tensor) -> Tensor:
        """Return the reconstructed images (image, colour, row, column)."""
        reconstruction: Tensor = self.decoder(self.encoder(images))
        return reconstruction


def reduce_image(image: Bytes) -> Bytes:
    """Return the means of the grid cells, uint8 (row, column, rgb), of an image (height, width, rgb).

    Raises `TacpipeError` if the image has fewer pixels than cells along an axis.
    """
    height, width, _ = image.shape
    if height < ROWS or width < COLUMNS:
        raise TacpipeError(
            f"The image has {width} x {height} pixels. The autoencoder needs {COLUMNS} x {ROWS} or more."
        )
    return np.rint(cell_means(image, ROWS, COLUMNS)).astype(np.uint8)


def fit(train: Bytes, held_out: Bytes, schedule: loop.Schedule, workspace: Path, components: int) -> bytes:
    """Train an encoder with ``components`` features and return its weights as a safetensors file.

    ``train`` and ``held_out`` are reduced images, uint8 (image, row, column, rgb); the latter determine when to stop.
    ``workspace`` keeps the training after an interruption.
    """

    def window_set(images: Bytes) -> loop.WindowSet:
        pixels = torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2))).to(devices.kind())

        def loss(model: nn.Module, indices: Tensor) -> Tensor:
            batch = _to_unit_range(pixels[indices])
            return nn.functional.mse_loss(model(batch), batch)

        return loop.WindowSet(len(pixels), loss)

    training = loop.WindowTraining(window_set(train), window_set(held_out), schedule.batch)
    trained = loop.train(lambda: _Network(components).to(devices.kind()), training, schedule, workspace)
    encoder = {name: value.cpu().contiguous() for name, value in trained.weights.items() if name.startswith("encoder.")}
    return save(encoder)


def read_encoder(weights: bytes) -> Encode:
    """Return the function that encodes images with the weights that `fit` returned.

    Raises `TacpipeError` for other weights.
    """
    try:
        tensors = {name.removeprefix("encoder."): value.float() for name, value in load(weights).items()}
        if not all(value.isfinite().all() for value in tensors.values()):
            raise ValueError("not all of them are finite")
        with torch.device("meta"):  # takes no memory for a size that the weights only state
            encoder = _Network(int(tensors[max(tensors)].shape[0])).encoder
        encoder.load_state_dict(tensors, assign=True)
    except (SafetensorError, ValueError, IndexError, RuntimeError) as error:
        raise TacpipeError(f"The weights do not fit this autoencoder: {plain(str(error), 200)}.") from error
    encoder.eval()

    def encode(images: Bytes) -> Float32s:
        reduced = np.stack([reduce_image(image) for image in images]).transpose(0, 3, 1, 2)
        with torch.inference_mode():
            features: Float32s = encoder(_to_unit_range(torch.from_numpy(np.ascontiguousarray(reduced)))).numpy()
        return features

    return encode


def load_encoder(path: Path) -> Encode:
    """Load the encoder from the file `WEIGHTS` that `tacpipe extract autoencoder` wrote next to its result."""
    return read_encoder(regular.content(path))


def _to_unit_range(pixels: Tensor) -> Tensor:
    return pixels.float() / 127.5 - 1


def select_images(images: Sequence[Bytes], held_out: float) -> tuple[Bytes, Bytes]:
    """Return the images for training, and those of the last recordings, which are held out.

    ``held_out`` is the fraction of held-out recordings; at least one is held out.
    """
    count = max(1, round(held_out * len(images)))
    return np.concatenate(images[:-count]), np.concatenate(images[-count:])
