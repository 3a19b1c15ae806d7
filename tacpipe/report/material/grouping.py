"""Which results are runs of the same method: those that differ in seed, fold and what has no effect."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from tacpipe.comparison.naming import distinct_names
from tacpipe.report.material.methods import Method, Run, Tree, base_name, ordered, shown

# In these, runs of one method may differ; run_label and quantities are shown as split and vibration.
_NO_METHOD = ("seed", "fold", "sensors", "baselines", "patience", "run_label", "quantities")
_CLOSED = {  # all that has an effect on what is fitted in closed form
    "minirocket": ("features", "use_validation", "labels"),
    "spectra": ("speeds", "use_validation", "labels", "hold_out"),
}
_RAECS = ("decoder", "unpool", "reconstruction_weight", "latents")  # of no effect on X-LSTM
_PAIRS = ("alignment_weight", "align_from", "alignment_loss")  # of no effect where sensors learn alone
USUAL = (("elsewhere", False), ("elsewhere", True), ("layout", "time"))  # that need not be stated
_SAME = 0.75  # training slides in this ratio are as many: folds differ in size, some learn from validation slides too


def grouped(runs: Sequence[Run]) -> list[Method]:
    """Return the methods of runs, sorted by name.

    A method is architecture, joint or not, number of training slides, layout and split of the slides, and all params but
    the seed. Its name states what keeps it from being plain, and the settings in which it differs from others that would
    have the same name.
    """
    places = [_place(run) for run in runs]
    main = max(dict.fromkeys(places), key=places.count, default=("", "time"))
    few: list[float] = []
    found: dict[str, tuple[Tree, list[Run]]] = {}
    for run, place in zip(runs, places, strict=True):
        whole = _whole([one for one, other in zip(runs, places, strict=True) if other == place])
        settings: Tree = {**_settings(run), "elsewhere": place != main, **_few(run, whole, few)}
        found.setdefault(json.dumps(settings, sort_keys=True), (settings, []))[1].append(run)
    names = distinct_names([(base_name(settings), settings) for settings, _ in found.values()], USUAL)
    made = [
        Method(name, settings, marks, tuple(same))
        for (name, marks), (settings, same) in zip(names, found.values(), strict=True)
    ]
    return sorted(made, key=lambda method: method.name)


def _settings(run: Run) -> dict[str, Any]:
    """Return all that makes a method but the number of its slides; what is of no effect is left out."""
    config, params, architecture = run.config, run.params, run.architecture
    frozen = str(params.get("frozen_sensor", ""))
    joint = bool(config.get("joint", architecture == "raec" and params.get("joint", False)))
    closed = _CLOSED.get(architecture)
    ratio = 100 if closed else int(params.get("subsample_percent", 100))
    idle = {
        *_NO_METHOD,
        "features",
        "use_validation",
        "speeds",
        *((_RAECS + _PAIRS) if architecture == "x-lstm" else () if joint or frozen else _PAIRS),
    }
    split, layout = _place(run)
    return {
        **{name: value for name, value in params.items() if (name in closed if closed else name not in idle)},
        "architecture": architecture,
        "joint": joint,
        "frozen_sensor": bool(frozen),  # each run reports on the sensor that was mapped, so both are one method
        "pairing": str(params.get("pairing", "random")) if joint or frozen else "random",
        "labels": str(params.get("labels", "true")),
        "subsample_sensor": str(params.get("subsample_sensor", "")) if ratio < 100 else "",
        "subsample_percent": ratio if params.get("subsample_sensor") else 100,
        "hold_out": "" if architecture == "minirocket" else str(params.get("hold_out", "")),
        "vibration": "vibration" in config.get("quantities", str(params.get("quantities", "")).split(","))
        and "vibration" not in config.get("absent", ()),
        "layout": layout,
        "split": split,
        "simulated": run.simulated,
    }


def _place(run: Run) -> tuple[str, str]:
    """Return the split and the layout of a run's slides: what is given together of results is of one of each."""
    split = run.config.get("split", "")
    layouts = {one.get("layout", "time") for one in run.config.get("sensors", {}).values()}
    described = str(split.get("scheme", "")) if isinstance(split, Mapping) else str(split)
    return described, "authors" if "authors" in layouts else "time"


def _whole(runs: Sequence[Run]) -> dict[str, int]:
    """Return the largest number of training slides that any run has, by sensor."""
    whole: dict[str, int] = {}
    for run in runs:
        for sensor, count in run.trained.items():
            whole[sensor] = max(count, whole.get(sensor, 0))
    return whole


def _few(run: Run, whole: Mapping[str, int], described: list[float]) -> dict[str, str]:
    """Return the number of training slides of a run where it has not all, and the sensor that this is so for if not all.

    Numbers are rounded to those of other runs that have about as many; ``described`` has the fractions of before. A
    sensor that learns from some batches alone has all slides: that is a setting.
    """
    fewer = {}
    for sensor in ordered(set(run.trained)):
        fraction = run.trained[sensor] / max(whole[sensor], 1)
        if fraction > _SAME:
            continue
        same = [one for one in described if _SAME < one / fraction < 1 / _SAME]
        if not same:
            described.append(fraction)
        fewer[sensor] = str(round((same or [fraction])[0] * whole[sensor]))
    if set(fewer) == set(run.trained) and len(set(fewer.values())) == 1:
        return {"few": next(iter(fewer.values())), "few_of": ""}
    few = ", ".join(f"{shown(sensor)} {count}" for sensor, count in fewer.items())
    return {"few": few, "few_of": ",".join(fewer)}
