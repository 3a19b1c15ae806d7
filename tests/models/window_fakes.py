"""Windows of random touch and of a hand that moves smoothly, for the tests of models."""

import torch
from torch import Tensor

from tacpipe.models.windows import ForecastWindows

CONTEXT, HORIZON = 5, 4
LAYOUT = [
    {"stream": f"xela{sensor}", "taxel": str(taxel), "axis": axis}
    for sensor in (1, 2)
    for taxel in (1, 2)
    for axis in "xyz"
]


def windows(
    count: int = 6, features: int = len(LAYOUT), context: int = CONTEXT, horizon: int = HORIZON
) -> ForecastWindows:
    """Random windows; some frames of touch are held."""
    generator = torch.Generator().manual_seed(1)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    touch = 100 * drawn(context, count, features)
    if context > 2:
        touch[2, ::2] = touch[1, ::2]
    rows = context + horizon
    start, pace = drawn(1, count, 4), 0.05 * drawn(1, count, 4)
    steps = torch.arange(rows)[:, None, None]
    turned = torch.nn.functional.normalize(start + pace * steps, dim=-1)
    place = drawn(1, count, 3) + 0.01 * drawn(rows, count, 3).cumsum(0)
    arm = torch.cat([place, turned, 0.2 * drawn(rows, count, 6)], -1)
    return ForecastWindows(touch, arm, 0.04 + 0.001 * drawn(context, count))


def ahead(inputs: ForecastWindows) -> Tensor:
    """Touch that moves on from the last row (horizon, window, feature)."""
    generator = torch.Generator().manual_seed(2)
    shape = (inputs.horizon, *inputs.touch.shape[1:])
    return inputs.touch[-1] + 10 * torch.randn(*shape, generator=generator).cumsum(0)
