"""The taxelwise network on the newest frames of a skin instead of rows at fixed lags.

Skins are logged faster than they are read: most rows repeat the one before, and ten rows hold two or three frames. This
network reads the last frames that are new, with their ages in rows, and more rows of the arm. Frames further back cost
nothing, as the repeated rows between them are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from tacpipe.models.change import closing
from tacpipe.models.taxelwise import TaxelwiseForecast
from tacpipe.models.windows import MOTION, UP, Windows, held

PATTERN = 16  # newest rows of which it is read whether each is new, from which follows when the next frame is due
DENSE, SPARSE = 10, 5  # newest rows of the arm that are all read; of older ones each fifth


def newest(touch: Tensor, frames: int) -> tuple[Tensor, Tensor]:
    """Return the rows of the last ``frames`` new frames of ``touch`` (row, window, channel), newest first, and their ages.

    Both are (frame, window), int64; an age is in rows, 0 for the last row. Where there are fewer frames the first row, which
    counts as new, is repeated.

    >>> rows, ages = newest(torch.tensor([1.0, 1.0, 2.0, 2.0, 3.0, 3.0])[:, None, None], 4)
    >>> rows[:, 0].tolist(), ages[:, 0].tolist()
    ([4, 2, 0, 0], [1, 3, 5, 5])
    """
    rows = torch.arange(len(touch), device=touch.device)[:, None]
    at = torch.where(held(touch) == 0, rows, 0).sort(dim=0, descending=True).values
    at = torch.cat([at, at.new_zeros(max(frames - len(at), 0), at.shape[1])])[:frames]
    return at, len(touch) - 1 - at


class FramesForecast(TaxelwiseForecast):
    """Reads raw channels; begins at persistence. The past that it reads may be repeated at its beginning."""

    def __init__(self, layout: Sequence[Mapping[str, str]], *, hidden: int, frames: int, **shared: Any) -> None:
        """Make a model of random weights that reads the last ``frames`` new frames."""
        super().__init__(layout, hidden=hidden, **shared)
        self.frames = frames
        self.pattern = min(PATTERN, self.context)
        ages = range(self.context - 1, -1, -1)
        self.arm_rows = [row for row, age in enumerate(ages) if age < DENSE or age % SPARSE == 0]
        own = 2 * frames * self.axes + frames
        whole = self.sensors * 2 * frames * self.axes
        inputs = whole + UP + len(self.arm_rows) * (MOTION + 1) + frames + self.pattern
        for name, width in (("own", own), ("told", inputs)):
            self.register_buffer(f"{name}_mean", torch.zeros(width))
            self.register_buffer(f"{name}_scale", torch.ones(width))
        half = max(hidden // 2, 1)
        self.own, self.plan = nn.Linear(own, hidden), nn.GRU(MOTION + self.pattern, half)
        self.whole = nn.Sequential(
            nn.Linear(inputs, hidden), nn.GELU(), self.drop, nn.Linear(hidden, hidden), nn.GELU()
        )
        self.gate = nn.Sequential(nn.Linear(self.pattern, 32), nn.GELU(), nn.Linear(32, self.horizon))

    def _new(self, windows: Windows) -> Tensor:
        """Return which of the newest rows are new (window, row), weighed as new frames are rare."""
        return 3 - 4 * held(windows.touch)[-self.pattern :].T

    def _read(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """Return the inputs of each taxel (window, taxel, …) and of the whole (window, …)."""
        touch = windows.touch
        rows, ages = newest(touch, self.frames)
        seen = touch[rows, torch.arange(touch.shape[1], device=touch.device)]  # (frame, window, channel)
        change, level = self._by_taxel(touch[-1] - seen[1:]), self._by_taxel(touch[-1:])
        plain = torch.cat([change, level]) / self.axis_scale
        fine = torch.cat([torch.asinh(8 * change / self.change_scale), torch.asinh(2 * level / self.change_scale)])
        own = torch.cat([fine, plain]).permute(1, 2, 0, 3).flatten(2)  # (window, taxel, frame and axis)
        age = torch.log1p(ages.to(touch.dtype)).T  # (window, frame)
        own = torch.cat([own, age[:, None].expand(-1, own.shape[1], -1)], -1)
        sensors = plain.view(*plain.shape[:2], self.sensors, self.taxels, self.axes)
        spread = sensors.std(3) if self.taxels > 1 else torch.zeros_like(sensors.mean(3))
        load = torch.cat([sensors.mean(3), spread], -1).permute(1, 0, 2, 3).flatten(1)
        steps, up = self.arm(windows)
        past = steps[self.arm_rows].transpose(0, 1).flatten(1)
        fresh = 1 - held(touch)[-self.pattern :].T
        return own, torch.cat([load, up, past, closing(windows)[self.arm_rows].T, age, fresh], -1)
