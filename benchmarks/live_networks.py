"""What the network of a forecast costs, one window at a time and in one thread, by what runs it.

    python benchmarks/live_networks.py MODEL [--calls 500] [--skip compile,aoti]

Printed is the processor's time of one forecast from windows to features, the largest difference from eager over random
windows as a fraction of a row's spread, whether all bits are equal, and the time to make it. What is not installed is left
out: onnxruntime with onnxscript, a C++ compiler for the last two.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

import tacpipe
from tacpipe.errors import TacpipeError
from tacpipe.models.windows import ARM, Windows
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.rows import acted
from tacpipe.tasks.forward.traced import Network

Run = Callable[[Windows], Any]


class Flat(torch.nn.Module):
    """A network that is given the parts of windows, for tools that take tensors alone."""

    def __init__(self, forecaster: Forecaster) -> None:
        super().__init__()
        self.network, self.actions = forecaster.model, forecaster.actions

    def forward(self, touch: torch.Tensor, arm: torch.Tensor, finger: torch.Tensor) -> torch.Tensor:
        """Return the features to come (horizon, window, feature)."""
        found: torch.Tensor = self.network(acted(Windows(touch, arm, finger), self.actions))
        return found


def eager(forecaster: Forecaster) -> Run:
    """As offline evaluation runs it."""
    return lambda windows: forecaster.model(acted(windows, forecaster.actions))


def inference_mode(forecaster: Forecaster) -> Run:
    """Without version counters."""

    def run(windows: Windows) -> torch.Tensor:
        with torch.inference_mode():
            found: torch.Tensor = forecaster.model(acted(windows, forecaster.actions))
        return found

    return run


def traced(forecaster: Forecaster) -> Run:
    """Operations recorded once and run without Python between them."""
    made = Network(forecaster)
    if not made.is_recorded:
        raise TacpipeError("The recording gives other numbers.")
    return lambda windows: made.features(windows).swapaxes(0, 1)


def compiled(forecaster: Forecaster) -> Run:
    """`torch.compile`, which needs a C++ compiler on the computer that runs it."""
    flat = torch.compile(Flat(forecaster))
    return lambda windows: flat(*windows)


def compiled_ahead(forecaster: Forecaster) -> Run:
    """AOTInductor: a C++ compiler on the computer that makes the package alone."""
    exported = torch.export.export(Flat(forecaster), tuple(random_windows(forecaster, 0)))
    path = Path(tempfile.mkdtemp()) / "network.pt2"
    torch._inductor.aoti_compile_and_package(exported, package_path=str(path))
    package = torch._inductor.aoti_load_package(str(path))
    return lambda windows: package(*windows)


def onnx(forecaster: Forecaster) -> Run:
    """`torch.export` to ONNX, and onnxruntime with one thread."""
    import onnxruntime  # type: ignore[import-not-found,unused-ignore]

    path = Path(tempfile.mkdtemp()) / "network.onnx"
    torch.onnx.export(
        Flat(forecaster), tuple(random_windows(forecaster, 0)), str(path), dynamo=True, external_data=False
    )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [one.name for one in session.get_inputs()]
    places = {name: {"touch": 0, "arm": 1, "finger": 2}[name] for name in names}
    return lambda windows: session.run(None, {name: windows[at].numpy() for name, at in places.items()})[0]


WAYS = {
    "eager": eager,
    "eager, inference mode": inference_mode,
    "trace and freeze": traced,
    "onnx": onnx,
    "compile": compiled,
    "aoti": compiled_ahead,
}


def random_windows(forecaster: Forecaster, seed: int) -> Windows:
    """Return one window of plausible size: counts that walk, an arm that moves a little."""
    rng = np.random.default_rng(seed)
    context, horizon = forecaster.context, forecaster.horizon
    touch = rng.normal(0, 30, (context, 1, len(forecaster.codec.latents))).cumsum(axis=0)
    arm = rng.normal(0, 0.001, (context + horizon, 1, ARM)).cumsum(axis=0)
    arm[..., 3:7] += forecaster.orientation
    arm[..., 3:7] /= np.linalg.norm(arm[..., 3:7], axis=-1, keepdims=True)
    finger = rng.normal(0.04, 0.001, (context, 1))
    return Windows(*(torch.from_numpy(one.astype(np.float32)) for one in (touch, arm, finger)))


def measured(forecaster: Forecaster, calls: int, skipped: set[str]) -> Iterator[str]:
    """Yield a row of the table for each way; calls of all ways are interleaved."""
    several = [random_windows(forecaster, seed) for seed in range(64)]
    runs: dict[str, Run] = {}
    made_s: dict[str, float] = {}
    for name, make in WAYS.items():
        if name in skipped:
            continue
        began_s = time.perf_counter()
        try:
            run = make(forecaster)
            for windows in several[:8]:
                run(windows)
        except Exception as error:  # of a tool that is absent or does not know an operation
            yield f"| {name} | did not run: {type(error).__name__}: {str(error).splitlines()[0][:90]} | | | |"
            continue
        runs[name], made_s[name] = run, time.perf_counter() - began_s
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for call in range(calls):
        windows = several[call % len(several)]
        for name, run in runs.items():
            began_s = time.process_time()
            run(windows)
            taken[name].append((time.process_time() - began_s) * 1e3)
    truth = [np.asarray(runs["eager"](windows)) for windows in several]
    for name, run in runs.items():
        found = [np.asarray(run(windows)) for windows in several]
        spread = float(np.std(truth))
        apart = max(float(np.abs(one - other).max()) for one, other in zip(found, truth, strict=True)) / spread
        same = all(np.array_equal(one, other) for one, other in zip(found, truth, strict=True))
        each = taken[name]
        yield (
            f"| {name} | {np.median(each):.2f} | {np.quantile(each, 0.99):.2f} | {'same bits' if same else f'{apart:.1e}'} "
            f"| {made_s[name]:.1f} |"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--calls", type=int, default=500)
    parser.add_argument("--skip", default="")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    forecaster = Forecaster.load(tacpipe.open(chosen.model).files)
    print("| network | median ms | 99 % ms | against eager | made in s |")
    print("| --- | --- | --- | --- | --- |")
    with torch.no_grad():
        for row in measured(forecaster, chosen.calls, set(chosen.skip.split(","))):
            print(row, flush=True)


if __name__ == "__main__":
    main()
