"""Draw the moving picture of the front page: `python docs/moving_picture.py FOLDER`, a part of `make pictures`.

Models of slips and of forecasts are trained on simulated trials, and predict another simulated trial. FOLDER holds the
datasets; stored results are reused.
"""

from __future__ import annotations

import functools
import io
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import live_demo
import numpy as np

import tacpipe
from tacpipe.arrays import Floats

if TYPE_CHECKING:
    import pandas as pd
    from PIL.Image import Image

PICTURE = Path(__file__).parent / "images" / "slip.gif"
SEED, TRIALS = 7, ("--trials", "6", "--duration-s", "6", "--same-skins", "--plan-rate-hz", "10")
BEFORE_S, AFTER_S, STEP_S = 1.4, 0.5, 0.04  # drawn time around a slip, and between two frames
FRAME_MS = 90  # time for which a frame is shown: slow motion
STEPS = (1, 3, 5, 10)  # forecast steps of the model, in rows
TRAINING = ("--epochs", "4", "--stride", "4")
PER_MINUTE = "1"  # false alarms per minute for which the alarm's level was set
SKINS = {"xela1": "finger 1", "xela2": "finger 2"}
SIDE = 4  # taxels along each side of a skin
MEASURED, FORECAST, ALARM, SLIP = "#222222", "#1f6feb", "#d95f02", "#9ecae1"
COLOURS = 96  # colours of the picture


def main(folder: Path) -> Path:
    """Train, predict and draw; return the path of the picture."""
    live_demo.train(folder, 0)
    live_demo.simulate(SEED, TRIALS, folder / "replayed")
    paths = {name: str(folder / name) for name in ("recordings", "synced", "segments", "split", "forward", "replayed")}
    for words in (
        ("synchronize", paths["recordings"], "-o", paths["synced"]),
        ("segment", "contacts", paths["synced"], "-o", paths["segments"]),
        (*("train", "forward", paths["segments"], "--split", paths["split"], "-o", paths["forward"]), *TRAINING),
        ("predict", paths["forward"], paths["replayed"], "-o", str(folder / "forecasts")),
        ("predict", str(folder / "model"), paths["replayed"], "-o", str(folder / "slips")),
    ):
        live_demo.run_tacpipe(*words, "--quiet")
    draw(folder)
    return PICTURE


def draw(folder: Path) -> None:
    """Draw the trial in which the alarm precedes a slip by the median time, as frames of `PICTURE`."""
    from PIL import Image

    leads = {}
    for name in tacpipe.open(folder / "slips").recordings:
        slips, (slip_ns, _) = _slips(folder, name)
        alarms_ns = slips["t_ns"][(slips[f"alarm_{PER_MINUTE}"] > 0) & (slips["t_ns"] <= slip_ns)]
        if len(alarms_ns) and slip_ns - slips["t_ns"].iloc[0] > BEFORE_S * 1e9:
            leads[name] = slip_ns - int(alarms_ns.iloc[-1] if len(alarms_ns) == 1 else alarms_ns.iloc[0])
    chosen = sorted(leads, key=lambda name: leads[name])[len(leads) // 2]
    frames = [_frame(folder, chosen, at_s) for at_s in np.arange(-BEFORE_S, AFTER_S, STEP_S)]
    shown = [frames[0], frames[len(frames) // 2], frames[-4], frames[-1]]  # have all colours
    palette = Image.fromarray(np.concatenate([np.asarray(frame) for frame in shown])).quantize(COLOURS)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    durations = [*[FRAME_MS] * len(others), 1500]
    first.save(PICTURE, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)


@functools.cache
def _table(folder: Path, dataset: str, name: str, stream: str = "") -> pd.DataFrame:
    """Return a stream of a recording, read once for all frames."""
    return tacpipe.open(folder / dataset)[name].table(stream).to_pandas()


def _slips(folder: Path, name: str) -> tuple[pd.DataFrame, tuple[int, int]]:
    """Return the predictions of slips in a recording, and the begin and end of its slip in the simulation."""
    truth = _table(folder, "replayed", name, "truth")
    slipping_ns = truth["t_ns"][truth["gt_slip"] > 0]
    predicted = _table(folder, "slips", name)
    return predicted, (int(slipping_ns.iloc[0]), int(slipping_ns.iloc[-1]))


def _frame(folder: Path, name: str, at_s: float) -> Image:
    """Draw the session at a time since the slip in s."""
    from matplotlib.figure import Figure
    from PIL import Image

    slips, slip = _slips(folder, name)
    slip_ns, _ = slip
    now_ns = slip_ns + round(at_s * 1e9)
    figure = Figure(figsize=(9.2, 2.9), dpi=80, layout="constrained")
    grid = figure.add_gridspec(1, 4, width_ratios=[1, 1, 1.9, 1.9])
    for column, skin in enumerate(SKINS):
        _draw_skin(figure.add_subplot(grid[column]), _table(folder, "replayed", name, skin), now_ns, SKINS[skin])
    forecasts = _table(folder, "forecasts", name)
    _draw_forecast(figure.add_subplot(grid[2]), _table(folder, "replayed", name, "xela1"), forecasts, slip_ns, now_ns)
    _draw_alarm(figure.add_subplot(grid[3]), slips, slip, now_ns)
    buffer = io.BytesIO()
    figure.savefig(buffer)
    return Image.open(buffer).convert("RGB")


def _draw_skin(axes: Any, skin: pd.DataFrame, now_ns: int, title: str) -> None:
    """Draw the load of each taxel as a colour and its shear as an arrow."""
    names = [[f"taxel{number:02d}_{axis}" for number in range(1, SIDE**2 + 1)] for axis in "xyz"]
    rest = skin.iloc[:20].median()
    values: list[Floats] = [
        (skin[axis].iloc[int(np.searchsorted(skin["t_ns"], now_ns)) - 1] - rest[axis]).to_numpy(float) for axis in names
    ]
    columns, rows = np.meshgrid(range(SIDE), range(SIDE))
    axes.imshow(np.abs(values[2]).reshape(SIDE, SIDE), cmap="viridis", vmin=0, vmax=4500)
    axes.quiver(columns, rows, values[0], values[1], color="white", scale=6000, width=0.02, angles="xy")
    axes.set_title(f"{title}: load, shear", fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])


def _draw_forecast(axes: Any, skin: pd.DataFrame, forecasts: pd.DataFrame, slip_ns: int, now_ns: int) -> None:
    """Draw the load of the taxel that is loaded most before the slip, up to now, and its forecast."""
    channels = [f"taxel{number:02d}_z" for number in range(1, SIDE**2 + 1)]
    rest = skin[channels].iloc[:20].median()
    before = (skin["t_ns"] > slip_ns - BEFORE_S * 1e9) & (skin["t_ns"] < slip_ns)
    channel = str((skin[channels][before] - rest).abs().median().idxmax())
    past = skin[skin["t_ns"] <= now_ns]
    axes.plot((past["t_ns"] - slip_ns) / 1e9, past[channel] - rest[channel], color=MEASURED, label="measured")
    known = forecasts[forecasts["t_ns"] <= now_ns]
    if len(known):
        last, period_ns = known.iloc[-1], np.median(np.diff(forecasts["t_ns"]))
        times_s = [(last["t_ns"] + step * period_ns - slip_ns) / 1e9 for step in STEPS]
        values = [last[f"xela1_{channel}_t{step}"] for step in STEPS]  # above rest
        axes.plot(times_s, values, "o--", color=FORECAST, markersize=3, label="forecast")
    levels = skin[channel][(skin["t_ns"] > slip_ns - BEFORE_S * 1e9) & (skin["t_ns"] < slip_ns + AFTER_S * 1e9)]
    low, high = levels.min() - rest[channel], levels.max() - rest[channel]
    axes.set_ylim(low - 0.1 * (high - low), high + 0.25 * (high - low))
    axes.set_title(f"load of {channel[:-2]}, counts", fontsize=9)
    axes.legend(loc="upper left", fontsize=8, frameon=False, ncols=2)
    _draw_time(axes, now_ns - slip_ns)


def _draw_alarm(axes: Any, slips: pd.DataFrame, slip: tuple[int, int], now_ns: int) -> None:
    """Draw the probability of a slip up to now, the alarms, and the slip once it has begun."""
    slip_ns, past = slip[0], slips[slips["t_ns"] <= now_ns]
    at_s = (past["t_ns"] - slip_ns) / 1e9
    on = past[f"alarm_{PER_MINUTE}"] > 0
    axes.plot(at_s, past["probability"], color=MEASURED)
    axes.plot(at_s[on], past["probability"][on], "o", color=ALARM, markersize=4)
    if len(past) and on.iloc[-1]:
        axes.text(0.03, 0.85, "ALARM", color=ALARM, weight="bold", transform=axes.transAxes)
    if now_ns >= slip_ns:
        axes.axvspan(0, (min(now_ns, slip[1]) - slip_ns) / 1e9, color=SLIP, alpha=0.6)
        axes.text(0.01, 0.06, "slip", fontsize=9)
    axes.set_ylim(0, 1.02)
    axes.set_title("probability of a slip within 0.3 s (simulated)", fontsize=9)
    _draw_time(axes, now_ns - slip_ns)


def _draw_time(axes: Any, now_ns: int) -> None:
    axes.axvline(now_ns / 1e9, color="#aaaaaa", linewidth=0.8)
    axes.set_xlim(-BEFORE_S, AFTER_S)
    axes.set_xlabel("s from the slip", fontsize=8)
    axes.tick_params(labelsize=8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


if __name__ == "__main__":
    print(main(Path(sys.argv[1])))
