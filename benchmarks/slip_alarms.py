"""Which slips the slip alarm leads in simulated trials, next to what it must beat and to what it could do at best.

    python benchmarks/slip_alarms.py FOLDER [--seeds 0,1,2,3] [--per-hour 60] [--set-on-both]

A seed is a rig: a model of 30 trials, 24 further trials that levels are set on, 24 that are
counted on, and 24 in which the plan stays below what friction holds, so that nothing slips. Each score has its level from
the same 24 trials; with ``--set-on-both`` from these and half of those in which nothing slips, which are then not counted.
Rows of the table: the model; one trained on shuffled plans; the model given another trial's plan; the true future in the
place of the forecast; persistence; and with the model's forecasts the score that alarms had before (change of an axis' mean
load at the last step), the ratio of the largest shear load to that of now, and the shear load of now over what presses,
which no forecast is needed for.
"""

from __future__ import annotations

import argparse
import dataclasses
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import tacpipe
from tacpipe.arrays import AnyFloats, Floats
from tacpipe.signals import anticipation
from tacpipe.signals.leads import Leads, events, leads, near, summed
from tacpipe.signals.loads import axes, loads
from tacpipe.signals.shear import floors, pressing, rise_and_fall, shear
from tacpipe.tasks.forward import predictors, tracks
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.tracks import Track

TRAINED, SET, COUNTED = 30, 24, 24  # trials
SLIPS, HOLDS = "1.15", "0.95"  # largest load of the plan over the limit of friction
OTHER = 7  # how many trials further the plan of another is taken from
Score = Callable[[Any, Any], Any]


def command(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "tacpipe", *words, "--quiet"], check=True, stdout=subprocess.DEVNULL)


def prepared(folder: Path, seed: int) -> None:
    """Simulate, and train two models; what is stored already is reused."""

    def chain(name: str, trials: int, seed: int, effort: str) -> str:
        place = str(folder / name)
        asked = ("--trials", str(trials), "--seed", str(seed), "--effort", effort)
        command("simulate", "forward", *asked, "-o", f"{place}-recordings")
        command("synchronize", f"{place}-recordings", "-o", f"{place}-synced")
        command("segment", "contacts", f"{place}-synced", "-o", place)
        return place

    trained = chain("trained", TRAINED, seed, SLIPS)
    chain("further", TRAINED + SET + COUNTED, seed, SLIPS)  # begins with the trials that the model is trained on
    chain("holding", COUNTED, 10 + seed, HOLDS)
    split = str(folder / "split")
    command("split", trained, "-o", split, "--scheme", "random")
    for name, actions in (("model", "planned"), ("shuffled", "shuffled")):
        size = ("--epochs", "6", "--stride", "2", "--actions", actions)
        command("train", "forward", trained, "--split", split, "-o", str(folder / name), *size)


@dataclasses.dataclass(frozen=True)
class Trial:
    """A trial's rows, and a score of each of them by name."""

    track: Track
    scores: dict[str, AnyFloats]  # (time,)


def trials(folder: Path, dataset: str, models: dict[str, Forecaster], names: slice) -> Iterator[Trial]:
    """Yield the trials of a dataset with all scores."""
    recordings = tacpipe.open(folder / dataset).recordings
    model = models["model"]
    layout, least = model.codec.layout, floors(model.channel_scale, model.codec.layout)
    along = [place for place, (_, axis) in enumerate(axes(layout)) if axis in "xy"]
    every = [tracks.track(recordings[name], model.codec, model.pose) for name in sorted(recordings)[names]]

    def risen(ahead: AnyFloats, now: AnyFloats) -> Floats:
        return rise_and_fall(ahead, now, layout, least)

    def moved(ahead: AnyFloats, now: AnyFloats) -> AnyFloats:
        found: AnyFloats = np.abs(loads(ahead[:, -1], layout) - loads(now, layout))[:, along].max(axis=1)
        return found

    def ratio(ahead: AnyFloats, now: AnyFloats) -> AnyFloats:
        found: AnyFloats = (shear(ahead, layout).max(axis=1) / np.maximum(shear(now, layout), least / 5)).max(axis=1)
        return found

    def present(ahead: AnyFloats, now: AnyFloats) -> AnyFloats:
        found: AnyFloats = (shear(now, layout) / np.maximum(pressing(now, layout), least)).max(axis=1)
        return found

    for place, track in enumerate(every):
        other = every[(place + OTHER) % len(every)].arm
        elsewhere = dataclasses.replace(track, arm=other[np.minimum(np.arange(len(track.arm)), len(other) - 1)])
        starts = track.starts(model.context, model.horizon)
        own = [(some.now, some.future, some.count) for some in predictors.forecasts(model, track, starts)]
        now, future, count = (np.concatenate(each) for each in zip(*own, strict=True))
        at, later = track.tactile[now], track.tactile[future]
        shuffled, another = (
            np.concatenate([some.count for some in predictors.forecasts(one, rows, starts)])
            for one, rows in ((models["shuffled"], track), (model, elsewhere))
        )
        found = {
            "model": risen(count, at),
            "model of shuffled plans": risen(shuffled, at),
            "model, another trial's plan": risen(another, at),
            "true future": risen(later, at),
            "persistence": risen(np.repeat(at[:, None], model.horizon, axis=1), at),
            "before: change of load, model": moved(count, at),
            "before: change of load, true future": moved(later, at),
            "ratio of largest shear to now, model": ratio(count, at),
            "shear now over pressing": present(count, at),
        }
        rows = {name: np.full(len(track.t_ns), np.nan) for name in found}
        for name, values in found.items():
            rows[name][now] = values
        yield Trial(track, rows)


def worth(setting: list[Trial], counted: list[Trial], name: str, horizon: int, per_hour: float) -> list[Leads]:
    """Return what a score is worth on trials, with its level from others."""
    period_ns = round(float(np.median([np.median(np.diff(one.track.t_ns)) for one in setting])))

    def slips(one: Trial) -> Any:
        assert one.track.slips is not None
        return events(one.track.t_ns, one.track.slips)

    level = anticipation.level(
        np.concatenate([one.scores[name] for one in setting]),
        np.concatenate([~near(one.track.t_ns, slips(one), horizon * period_ns) for one in setting]),
        np.repeat(np.arange(len(setting)), [len(one.track.t_ns) for one in setting]),
        horizon=horizon,
        rate_hz=1e9 / period_ns,
        per_minute=per_hour / 60,
    )
    found = []
    for one in counted:
        states = np.where(np.isfinite(one.scores[name]), (one.scores[name] > level).astype(np.int64), -1)
        found.append(leads(one.track.t_ns, states, slips(one), horizon * period_ns, period_ns))
    return found


def interval(several: list[Leads]) -> tuple[float, float]:
    """Return the middle 95 % of the fraction of slips that are led, of 2,000 resamples of trials."""
    rng = np.random.default_rng(0)
    led, count = (np.array(each) for each in zip(*((len(one.leads_ms), one.events) for one in several), strict=True))
    chosen = rng.integers(len(several), size=(2000, len(several)))
    low, high = np.percentile(led[chosen].sum(axis=1) / count[chosen].sum(axis=1), [2.5, 97.5])
    return float(low), float(high)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", default="0,1,2,3")
    parser.add_argument("--per-hour", type=float, default=60.0)
    parser.add_argument("--set-on-both", action="store_true")
    chosen = parser.parse_args()
    several: dict[str, list[Leads]] = {}
    holding: dict[str, list[Leads]] = {}
    for seed in map(int, chosen.seeds.split(",")):
        folder = chosen.folder / f"seed{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        prepared(folder, seed)
        models = {name: Forecaster.load(tacpipe.open(folder / name).files) for name in ("model", "shuffled")}
        further = list(trials(folder, "further", models, slice(TRAINED, None)))
        calm = list(trials(folder, "holding", models, slice(None)))
        horizon = models["model"].horizon
        setting = further[:SET]
        if chosen.set_on_both:
            setting, calm = setting + calm[: len(calm) // 2], calm[len(calm) // 2 :]
        for name in further[0].scores:
            several.setdefault(name, []).extend(worth(setting, further[SET:], name, horizon, chosen.per_hour))
            holding.setdefault(name, []).extend(worth(setting, calm, name, horizon, chosen.per_hour))
        print(f"seed {seed}: {summed(several['model'])}", file=sys.stderr, flush=True)
    print("score | slips led | by 60 ms or more | median lead ms | false alarms an hour | where nothing slips")
    for name, found in several.items():
        one, quiet = summed(found), summed(holding[name])
        early = sum(lead >= 60 for each in found for lead in each.leads_ms)
        cells = (f"{one['led']} of {one['events']}", early, one["median_lead_ms"], one["false_alarms_per_hour"])
        print(" | ".join(map(str, (name, *cells, quiet["false_alarms_per_hour"]))))
    low, high = interval(several["model"])
    print(f"95 % interval of the fraction that the model leads, over trials: {low:.3f} to {high:.3f}")
    minutes = [summed(several["model"])["minutes"], summed(holding["model"])["minutes"]]
    print(f"{minutes[0]:.1f} minutes without a slip near, and {minutes[1]:.1f} where nothing slips")


if __name__ == "__main__":
    main()
