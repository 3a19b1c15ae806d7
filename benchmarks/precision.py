"""A training step of each network in float32 and in bfloat16: milliseconds, and the error of loss and gradient.

``python benchmarks/precision.py [--device cuda]``; whether bfloat16 pays on a processor depends on its instructions
(AMX, AVX512-BF16).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from tacpipe.models import recurrent_autoencoder
from tacpipe.models.forecasts import RecurrentForecast, build
from tacpipe.models.patches import PatchNetwork
from tacpipe.models.pointnet import PointNet
from tacpipe.models.windows import POSE, Windows

CONTEXT, HORIZON, REPEATS = 10, 10, 7
LAYOUT = [
    {"stream": stream, "taxel": f"{taxel:02}", "axis": axis}
    for stream in ("left", "right")
    for taxel in range(16)
    for axis in "xyz"
]
Case = tuple[nn.Module, Callable[[], Tensor]]


def forward(architecture: str, features: int, windows: int, hidden: int) -> Case:
    arm = torch.randn(CONTEXT + HORIZON, windows, 13)
    arm[..., 3:POSE] /= arm[..., 3:POSE].norm(dim=-1, keepdim=True)
    given = Windows(50 * torch.randn(CONTEXT, windows, features), arm, 0.01 * torch.rand(CONTEXT, windows))
    ahead = 50 * torch.randn(HORIZON, windows, features)
    model: nn.Module
    if architecture == "recurrent":
        model = RecurrentForecast(features, hidden)
    else:
        layout = LAYOUT if architecture == "taxelwise" else ()
        make = partial(build, hidden=hidden, context=CONTEXT, horizon=HORIZON)
        model = make(architecture, features, layout, dropout=0.0, loss="absolute")
    model.calibrate(given, ahead)
    return model, lambda: model.loss(given, ahead)


def raec(slides: int) -> Case:
    model = recurrent_autoencoder.RecurrentAutoencoder(recurrent_autoencoder.Shape(19, 20))
    frames, classes = torch.randn(400, slides, 19), torch.randint(0, 20, (slides,))

    def loss() -> Tensor:
        made = model(frames)
        return nn.functional.cross_entropy(made.scores, classes) + 0.01 * nn.functional.mse_loss(made.frames, frames)

    return model, loss


def touch(model: nn.Module, *shape: int) -> Case:
    points, numbers, values = torch.randn(shape), torch.randn(shape[0], 6), torch.randn(shape[0], 50)
    return model, lambda: (model(points, numbers) - values).square().mean()


CASES: dict[str, Callable[[], Case]] = {
    "taxelwise 128": partial(forward, "taxelwise", len(LAYOUT), 128, 128),
    "gru 128": partial(forward, "gru", 20, 128, 128),
    "gru 512": partial(forward, "gru", 20, 128, 512),
    "tcn 512": partial(forward, "tcn", 20, 128, 512),
    "recurrent 200": partial(forward, "recurrent", 20, 32, 200),
    "raec 90": partial(raec, 32),
    "patches": lambda: touch(PatchNetwork(6, 6, 50, backbone="points", hidden=256, dropout=0.0), 16, 3, 128, 6),
    "pointnet": lambda: touch(PointNet(6, 6, 50), 10, 750, 6),
}


def wait(device: str) -> None:
    """Wait for all that was given to a device."""
    if device == "cuda":
        torch.cuda.synchronize()


def measured(case: Case, precision: str) -> tuple[float, float, Tensor]:
    """Return the milliseconds of the fastest step, the loss and the gradient of all weights."""
    model, loss = case
    best_s, value = float("inf"), 0.0
    device = next(model.parameters()).device.type
    for _ in range(REPEATS):
        wait(device)
        began_s = time.perf_counter()
        with torch.autocast(device, torch.bfloat16, enabled=precision == "bfloat16"):
            found = loss()
        model.zero_grad()
        found.backward()  # type: ignore[no-untyped-call]
        wait(device)
        best_s, value = min(best_s, time.perf_counter() - began_s), float(found.detach())
    return 1e3 * best_s, value, torch.cat([one.grad.flatten() for one in model.parameters() if one.grad is not None])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    torch.set_default_device(parser.parse_args().device)
    torch.manual_seed(0)
    for name, make in CASES.items():
        case = make()
        (exact_ms, exact, gradient), (ms, rounded, other) = (measured(case, one) for one in ("float32", "bfloat16"))
        apart = float((other - gradient).norm() / gradient.norm())
        print(
            f"{name:15} {exact_ms:8.1f} {ms:8.1f} ms  {exact_ms / ms:5.2f} times as fast  "
            f"loss {abs(rounded - exact) / abs(exact):.0e}  gradient {apart:.0e}"
        )


if __name__ == "__main__":
    main()
