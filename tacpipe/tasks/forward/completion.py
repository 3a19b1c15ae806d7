"""What is fitted of a network after its weights are trained: trees and the weights of a blend."""

from __future__ import annotations

from typing import cast

from torch import Tensor

from tacpipe.codecs import codec as codecs
from tacpipe.models.mixed import MixedForecast
from tacpipe.models.windows import Windows
from tacpipe.tasks.forward import networks
from tacpipe.tasks.forward.params import Forward, Mixed
from tacpipe.tasks.forward.rows import Rows, acted

BLENDED = 3000  # validation windows that the blend is fitted on at most, evenly spread


def completed(
    weights: dict[str, Tensor], params: Forward, codec: codecs.Codec, known: Rows, watched: Rows
) -> dict[str, Tensor]:
    """Return trained ``weights`` with what is fitted afterwards; those of most architectures as they are.

    Trees are fitted on ``known`` windows, those of training, and the blend on ``watched`` ones, those of validation.
    """
    if not isinstance(params, Mixed):
        return weights
    model = cast("MixedForecast", networks.build(params, codec))
    model.load_state_dict(weights)
    model.complete(_some(known, params.boosted), _some(watched, BLENDED), params.seed)
    return model.state_dict()


def _some(part: Rows, most: int) -> tuple[Windows, Tensor]:
    """Return at most ``most`` windows of a part, and what comes after them."""
    windows, ahead = part.pick(part.some(most))
    return Windows(*(one.cpu() for one in acted(windows, part.actions))), ahead.cpu()
