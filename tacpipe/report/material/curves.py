"""What is drawn over epochs and over the number of training slides: Figures 9 and 10 of the paper, and few slides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from tacpipe.report import epochs, markup
from tacpipe.report.material import comparison, figures, tables, wording
from tacpipe.report.material.accuracy import accuracy
from tacpipe.report.material.figures import Band
from tacpipe.report.material.methods import Method, Run, shown


@dataclass
class _Points:
    """Accuracies of one line, by number of training slides."""

    found: dict[int, tuple[float, float, float]] = field(default_factory=dict)

    @property
    def band(self) -> Band:
        slides = sorted(self.found)
        return Band(slides, *zip(*(self.found[count] for count in slides), strict=True))


def convergence(methods: Sequence[Method]) -> str:
    """Return validation accuracy by epoch, Figure 9 of the paper, one figure a sensor; empty without epochs."""
    chosen = [one for kind in ("RAEC joint", "RAEC independent") for one in methods if one.plain and one.kind == kind]
    order = [one.name for one in chosen]
    drawn = []
    for sensor in tables.sensors_of(chosen):
        curves = {one.name: [curve for run in one.of(sensor) if (curve := _validation(run, sensor))] for one in chosen}
        held = {name: found for name, found in curves.items() if found}
        if held:
            title = f"Validation accuracy by epoch, {shown(sensor)}"
            svg = epochs.by_epoch(held, "validation accuracy (%)", title, order)
            text = f"validation accuracy on {shown(sensor)} by epoch. Thick: mean over runs; thin: single runs."
            caption = wording.form("Figure 9", text, all(one.published for one in chosen))
            drawn.append(markup.figure(svg, caption))
    return _pair(drawn)


def alignment(methods: Sequence[Method]) -> str:
    """Return Figure 10 in the paper's form: how far the sensors' latents of a pair are apart; empty where none is given."""
    chosen = [one for one in methods if (one.plain or comparison.control(one)) and one.settings["joint"]]
    curves = {one.name: [curve for run in one.runs if (curve := aligned(run))] for one in chosen}
    held = {name: found for name, found in curves.items() if found}
    if not held:
        return ""
    svg = epochs.by_epoch(held, "mean squared latent difference", "Latent difference of pairs by epoch", log=True)
    text = "mean squared difference between the two latents of a training pair, by epoch."
    caption = wording.form("Figure 10", text, all(one.published for one in chosen))
    if any(comparison.control(one) for one in chosen):
        caption += " Pairs of permuted materials fall as real ones do where labels alone drive the alignment."
    return markup.figure(svg, caption)


def aligned(run: Run) -> list[float]:
    """Return the mean squared latent difference of training pairs by epoch; NaN where an epoch does not state it."""
    described = [line.get("alignment") for line in run.history]
    return (
        [float("nan") if one is None else float(one) for one in described]
        if any(one is not None for one in described)
        else []
    )


def few_slides(methods: Sequence[Method]) -> str:
    """Return accuracy over the number of training slides, a figure a sensor; empty where all have as many."""
    chosen = [one for one in methods if one.differs_only("few", "subsample_sensor")]
    drawn = []
    for sensor in tables.sensors_of(chosen):
        points: dict[str, _Points] = {}
        for method in chosen:
            fewer = {method.settings["subsample_sensor"], method.settings["few_of"]} - {""}
            if fewer <= {sensor}:
                _add(points, method.line, method, sensor)
            if fewer == {sensor}:  # such a line ends where all sensors have all slides
                loose = ("few", "few_of", "subsample_sensor", "subsample_percent")
                for one in chosen:
                    if one.plain and one.key_without(*loose) == method.key_without(*loose):
                        _add(points, method.line, one, sensor)
        bands = {name: one.band for name, one in sorted(points.items()) if len(one.found) > 1}
        if bands:
            chance = 1 / max(len(chosen[0].runs[0].config.get("classes", ())), 1)
            svg = figures.by_slides(bands, chance, f"Accuracy by number of training slides, {shown(sensor)}")
            caption = f"Accuracy on unseen {shown(sensor)} slides by number of training slides, with 95 % intervals."
            if any("other sensor whole" in name for name in bands):
                caption += " Other sensor whole: this one alone has fewer."
            if any("fixed batches" in name for name in bands):
                caption += " Fixed batches: the same in every epoch, of which a sensor learns from a share."
            drawn.append(markup.figure(svg, caption))
    if not drawn:
        return ""
    note = markup.note(wording.caution(chosen))
    return f"<h3>Few slides</h3>{_pair(drawn)}{note}"


def _add(points: dict[str, _Points], line: str, method: Method, sensor: str) -> None:
    """Add what a method states to a line."""
    found = accuracy(method.of(sensor), sensor)
    if found is None:
        return
    described = [run.learned[sensor] for run in method.of(sensor) if sensor in run.learned]
    if described:
        points.setdefault(line, _Points()).found[max(described)] = (found.fraction, found.low, found.high)


def _validation(run: Run, sensor: str) -> list[float]:
    """Return the validation accuracy on a sensor's slides by epoch, in percent; empty where none is given."""
    described = [line.get("val", {}).get(sensor, {}).get("accuracy") for line in run.history]
    return (
        [float("nan") if one is None else 100 * one for one in described]
        if any(one is not None for one in described)
        else []
    )


def _pair(drawn: Sequence[str]) -> str:
    return f'<div class="pair">{"".join(drawn)}</div>' if drawn else ""
