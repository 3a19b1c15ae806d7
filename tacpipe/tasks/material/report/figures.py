"""Draw confusions, training curves, latents and typical slides."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from tacpipe.arrays import AnyFloats, Ints
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import Chart, Charts, Fold, SmallPrint, counted, fold, form, listed
from tacpipe.report.charts import Curve
from tacpipe.report.context import Context, curves_of_methods, is_published, loss_chart, without_gaps
from tacpipe.tasks.material.report import scores
from tacpipe.tasks.material.report.methods import (
    MaterialResult,
    Method,
    has_usual_settings,
    method_title,
    ordered_sensors,
    runs_on,
    sensor_title,
    sensors_of,
)
from tacpipe.tasks.material.report.predictions import MODEL, NOTHING, SlidePredictions
from tacpipe.tasks.material.report.scores import accuracy

MAX_PAIRS = 3  # maximum number of pairs of materials in a sentence
CONFUSION_NOTE = (
    "Unseen slides. Blue: correct; orange: wrong. The intensity is the fraction of the slides of a material."
)


def confusion_folds(context: Context) -> list[Fold]:
    """Return the confusions of the best and of the joint method, one chart per sensor."""
    figures = []
    joint = scores.main_method(context.methods)
    for sensor in sensors_of([method for method in context.methods if has_usual_settings(method.settings)]):
        compared = next(
            (method for method in context.comparisons if method.question.part == sensor_title(sensor)), None
        )
        best = compared.best.method if compared and compared.best else None
        shown_methods = dict.fromkeys(method for method in (best, joint) if method and runs_on(method, sensor))
        figures += [_confusion_chart(method, sensor) for method in shown_methods]
    return fold("Which materials are confused", Charts(figures), SmallPrint(CONFUSION_NOTE)) if figures else []


def count_confusions(method: Method, sensor: str) -> tuple[Ints, list[int] | list[str]]:
    """Return the confusion counts (material, predicted), pooled over runs, and the names of the materials."""
    import pandas as pd

    tables = []
    for run in runs_on(method, sensor):
        rows = run.details.predictions.of(sensor)
        is_predicted = rows.predicted[MODEL] != NOTHING
        truth, answers = (rows.named(numbers[is_predicted]) for numbers in (rows.materials, rows.predicted[MODEL]))
        tables.append(pd.DataFrame({"truth": truth, "named": answers}))
    rows_of_runs = pd.concat(tables)
    materials = sorted({*rows_of_runs["truth"], *rows_of_runs["named"]})
    counts = pd.crosstab(rows_of_runs["truth"], rows_of_runs["named"]).reindex(
        index=materials, columns=materials, fill_value=0
    )
    return counts.to_numpy(dtype=np.int64), materials


def describe_worst(counts: Ints, materials: Sequence[int | str]) -> str:
    """Return a sentence on the materials that are most often confused with another."""
    wrong = counts - np.diag(np.diag(counts))
    order = np.argsort(-wrong, axis=None, kind="stable")[:MAX_PAIRS]
    phrases = []
    for index in order:
        row, column = np.unravel_index(index, wrong.shape)
        if wrong[row, column]:
            phrases.append(f"{materials[row]} for {materials[column]} ({wrong[row, column]} of {counts[row].sum()})")
    return f"Most often it takes {listed(phrases)}." if phrases else "It confuses no materials."


def _confusion_chart(method: Method, sensor: str) -> Chart:
    """Return the confusion matrix of a method on a sensor's slides, with its accuracy and worst confusions."""
    counts, materials = count_confusions(method, sensor)
    runs = len(runs_on(method, sensor))
    label = runs_on(method, sensor)[0].details.predictions.naming.key
    names = [str(material) for material in materials]
    spec = charts.matrix(counts, names, label, "named")
    spec["usermeta"] = {"most": 150 + 30 * len(names)}
    pooled = f", {runs} runs pooled" if runs > 1 else ""
    caption = f"{counts.trace()} of {counts.sum()} right{pooled}. {describe_worst(counts, materials)}"
    return Chart(f"{sensor_title(sensor)}: {method.name}", spec, caption)


Points = dict[int, tuple[float, float, float]]  # number of training slides -> accuracy, and the bounds of its interval


def training_folds(methods: Sequence[Method]) -> list[Fold]:
    """Return validation accuracy and latent difference by epoch."""
    figures = [*validation_charts(methods), *alignment_charts(methods)]
    return blocks.fold("Training", Charts(figures)) if figures else []


def validation_charts(methods: Sequence[Method]) -> list[Chart]:
    """Return validation accuracy by epoch, as in Figure 9 of the paper, one chart per sensor.

    Empty if there are no epochs.
    """
    networks = [method for method in methods if has_usual_settings(method.settings)]
    families = ("RAEC joint", "RAEC independent")
    shown_methods = sorted((m for m in networks if m.family in families), key=lambda m: families.index(m.family))
    order = [method.name for method in shown_methods]
    figures = []
    for sensor in sensors_of(shown_methods):
        loss_curves = curves_of_methods(shown_methods, functools.partial(_validation_by_epoch, sensor=sensor))
        if loss_curves:
            spec = loss_chart(loss_curves, "validation accuracy (%)", order)
            title = blocks.form(
                "Figure 9",
                f"validation accuracy on {sensor_title(sensor)}",
                all(method.published for method in shown_methods),
            )
            figures.append(Chart(title, spec, "Thick: mean over runs; thin: single runs."))
    return figures


def alignment_charts(methods: Sequence[Method]) -> list[Chart]:
    """Return Figure 10 of the paper: the distance between paired latents of the sensors; empty if it was not logged."""
    shown_methods = [
        method
        for method in methods
        if (has_usual_settings(method.settings) or scores.is_control(method)) and method.settings["joint"]
    ]
    loss_curves = curves_of_methods(shown_methods, alignment_by_epoch)
    if not loss_curves:
        return []
    spec = loss_chart(loss_curves, "mean squared latent difference", log=True)
    title = blocks.form(
        "Figure 10", "latent difference of training pairs", all(method.published for method in shown_methods)
    )
    caption = ""
    if any(scores.is_control(method) for method in shown_methods):
        caption = (
            "If the alignment is driven only by labels, the latent difference of permuted pairs decreases as for "
            "real pairs."
        )
    return [Chart(title, spec, caption)]


def alignment_by_epoch(run: MaterialResult) -> list[float]:
    """Return the mean squared latent difference of training pairs by epoch; NaN for epochs without it."""
    return without_gaps([epoch.get("alignment") for epoch in run.history])


def few_slides_folds(methods: Sequence[Method]) -> list[Fold]:
    """Return accuracy by number of training slides, one chart per sensor; empty if all methods have the same number."""
    shown_methods = [
        candidate for candidate in methods if has_usual_settings(candidate.settings, "few", "subsample_sensor")
    ]
    figures = []
    for sensor in sensors_of(shown_methods):
        points: dict[str, Points] = {}
        for method in shown_methods:
            fewer = {method.settings["subsample_sensor"], method.settings["few_of"]} - {""}
            if fewer <= {sensor}:
                _add_points(points, method_title(method), method, sensor)
            if fewer == {sensor}:  # this line ends at the full number of slides of all sensors
                loose = ("few", "few_of", "subsample_sensor", "subsample_percent")
                for candidate in shown_methods:
                    is_same = candidate.key_without(*loose) == method.key_without(*loose)
                    if is_same and has_usual_settings(candidate.settings):
                        _add_points(points, method_title(method), candidate, sensor)
        drawn_points = {name: candidate for name, candidate in sorted(points.items()) if len(candidate) > 1}
        if drawn_points:
            lines = []
            for name, accuracies in drawn_points.items():
                slides = sorted(accuracies)
                mean, low, high = (100 * np.array([accuracies[count] for count in slides])).T
                lines.append(Curve(name, slides, mean, low, high))
            chance = 100 / max(len(shown_methods[0].details[0].config.get("classes", ())), 1)
            spec = charts.lines(lines, "training slides", "accuracy (%)", level=("chance", chance))
            caption = "Unseen slides, with 95 % intervals; dashed across: chance."
            if any("other sensor whole" in name for name in drawn_points):
                caption += "The other sensor has all of its slides."
            if any("fixed batches" in name for name in drawn_points):
                caption += (
                    "Fixed batches: the batches are the same in every epoch, and a sensor learns from a part of them."
                )
            figures.append(Chart(f"Accuracy on {sensor_title(sensor)} by number of training slides", spec, caption))
    return blocks.fold("Few slides", Charts(figures)) if figures else []


def _add_points(points: dict[str, Points], name: str, method: Method, sensor: str) -> None:
    """Add the accuracy of a method to a line."""
    result = accuracy(runs_on(method, sensor), sensor)
    if result is None:
        return
    slide_counts = [run.details.learned[sensor] for run in runs_on(method, sensor) if sensor in run.details.learned]
    if slide_counts:
        points.setdefault(name, {})[max(slide_counts)] = (result.fraction, result.low, result.high)


def _validation_by_epoch(run: MaterialResult, sensor: str) -> list[float]:
    """Return the validation accuracy on a sensor's slides by epoch, in percent; empty if it was not logged."""
    accuracies = [epoch.get("val", {}).get(sensor, {}).get("accuracy") for epoch in run.history]
    return [100 * value for value in without_gaps(accuracies)]


LATENT_NOTE = (
    "Latents of unseen slides on their first two principal components, computed for both sensors together. A colour "
    "is a material, with its name at the mean of the first sensor's slides. A line connects this to the mean of the "
    "other sensor's slides of the paired material, so lines are short if the sensors are aligned. If permuted pairs "
    "have equally short lines, alignment is not evidence that the sensors measure the same."
)


def latent_folds(methods: Sequence[Method]) -> list[Fold]:
    """Return charts of a joint run, its control and two independent runs; empty without joint latents."""
    main = scores.main_method(methods)
    if main is None:
        return []
    candidates = main, scores.permuted_method(methods, main), scores.independent_method(methods, main)
    figures = [chart for method in candidates if method and (chart := _latent_chart(method))]
    return fold("Latents", Charts(figures), SmallPrint(LATENT_NOTE)) if figures else []


def project_on_plane(parts: Sequence[AnyFloats]) -> list[AnyFloats]:
    """Return sets of points (slide, latent) projected on the first two principal components of all, each (slide, 2).

    The sign of each component makes its largest weight positive.
    """
    stacked = np.vstack(parts)
    centre = stacked.mean(axis=0)
    axes = np.linalg.svd(stacked - centre, full_matrices=False)[2][:2]  # (component, latent)
    axes *= np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)])[:, None]
    return [(part - centre) @ axes.T for part in parts]


def count_nearest_partners(
    first: SlidePredictions, second: SlidePredictions, partners: Mapping[int, int]
) -> tuple[int, int]:
    """Return how many materials' mean latents are nearest to those of their partner, and how many were compared.

    ``partners`` maps materials to those of the other sensor; missing materials map to themselves.
    """
    first_materials, second_materials = np.unique(first.materials), np.unique(second.materials)
    means = [
        np.array([_part_latents(part)[part.materials == name].mean(axis=0) for name in names])
        for part, names in ((first, first_materials), (second, second_materials))
    ]
    distances = np.linalg.norm(means[0][:, None] - means[1][None], axis=2)  # (material, material of the other sensor)
    partner_names = [partners.get(int(name), int(name)) for name in first_materials]
    is_nearest = [
        nearest == name
        for nearest, name in zip(second_materials[distances.argmin(axis=1)], partner_names, strict=True)
        if name in second_materials
    ]
    return int(sum(is_nearest)), len(is_nearest)


def _latent_chart(method: Method) -> Chart | None:
    """Return a chart of the latents of one run of a method, or of one run per sensor if each has its own model.

    Returns None if there are no latents of two sensors.
    """
    sensors_and_predictions = _paired_predictions(method.details)
    if sensors_and_predictions is None:
        return None
    sensors, predictions = sensors_and_predictions
    points = project_on_plane([_part_latents(sensor_predictions) for sensor_predictions in predictions])
    stored_partners = method.details[0].config.get("partners", {})
    partners = {int(material): int(partner) for material, partner in stored_partners.items()}
    nearest_count, count = count_nearest_partners(predictions[0], predictions[1], partners)
    dots: list[charts.DataRow] = []
    for sensor, sensor_predictions, positions in zip(sensors, predictions, points, strict=True):
        shape = sensor_title(sensor)
        for name, recording, (x, y) in zip(
            sensor_predictions.named(sensor_predictions.materials),
            sensor_predictions.recordings,
            positions,
            strict=True,
        ):
            dots.append({"name": str(name), "x": float(x), "y": float(y), "shape": shape, "tip": str(recording)})
    spec = charts.scatter(
        dots,
        "first principal component",
        "second principal component",
        shapes=[sensor_title(sensor) for sensor in sensors],
        legend=False,
    )
    spec["layer"].append(charts.joined(_latent_rows(points, predictions, partners)))
    partner_text = "the material that it was paired with" if partners else "the same material"
    caption = f"For {nearest_count} of {count} materials, the other sensor's nearest mean is {partner_text}."
    return Chart(f"{method.name}: latents of both sensors", spec, caption)


def _latent_rows(
    points: Sequence[AnyFloats], predictions: Sequence[SlidePredictions], partners: Mapping[int, int]
) -> list[tuple[str, AnyFloats, AnyFloats]]:
    """Return each material's name, and the mean (coordinate,) of its points for either sensor.

    For the second sensor, it is the mean of the material's partner, if it has a partner.
    """
    means = [
        {
            int(material): positions[sensor_predictions.materials == material].mean(axis=0)
            for material in np.unique(sensor_predictions.materials)
        }
        for positions, sensor_predictions in zip(points, predictions, strict=True)
    ]
    names = dict(
        zip(predictions[0].materials.tolist(), predictions[0].named(predictions[0].materials).tolist(), strict=True)
    )
    return [
        (str(names[material]), first_mean, means[1][partners.get(material, material)])
        for material, first_mean in means[0].items()
        if partners.get(material, material) in means[1]
    ]


def _paired_predictions(runs: Sequence[MaterialResult]) -> tuple[tuple[str, str], list[SlidePredictions]] | None:
    """Return two sensors and their predictions, from the first run with both sensors, else from the first run of each.

    None if no two sensors have latents of equal dimension.
    """
    with_latents = [run for run in runs if run.predictions.latents is not None]
    sensors = ordered_sensors([sensor for run in with_latents for sensor in run.sensors])[:2]
    if len(sensors) < 2:
        return None
    joint_run = next((run for run in with_latents if set(sensors) <= set(run.sensors)), None)
    runs_by_sensor = [joint_run or next(run for run in with_latents if sensor in run.sensors) for sensor in sensors]
    predictions = [run.predictions.of(sensor) for run, sensor in zip(runs_by_sensor, sensors, strict=True)]
    if len({_part_latents(part).shape[1] for part in predictions}) > 1:
        return None
    return (sensors[0], sensors[1]), predictions


def _part_latents(part: SlidePredictions) -> AnyFloats:
    assert part.latents is not None
    return part.latents


SLIDE, PROFILE = "slide", "profile"


def holds_slides(dataset: Dataset) -> bool:
    """Return whether a dataset contains slides."""
    return any(SLIDE in shard.streams or PROFILE in shard.streams for shard in dataset.recordings.values())


def profile_folds(datasets: Sequence[Dataset]) -> list[Fold]:
    """Return a fold with the counts of slides and charts of a typical slide per sensor, or an empty list without slides."""
    shards = [shard for dataset in datasets for shard in dataset.recordings.values() if holds_slides(dataset)]
    if not shards:
        return []
    published = all(is_published(dataset, MaterialResult.SETS) for dataset in datasets)
    sensors = ordered_sensors([str(shard.attributes.get("sensor", "")) for shard in shards])
    descriptions = [
        _describe_counts([shard for shard in shards if shard.attributes.get("sensor", "") == sensor], sensor)
        for sensor in sensors
    ]
    figures: list[Chart] = []
    for sensor in sensors:
        sensor_shards = [
            shard for shard in shards if shard.attributes.get("sensor", "") == sensor and PROFILE in shard.streams
        ]
        if sensor_shards:
            figures += _profile_charts(typical_slide(sensor_shards), sensor, published)
    return [Fold("The slides", [SmallPrint(" ".join(descriptions)), *([Charts(figures)] if figures else [])])]


def typical_slide(shards: Sequence[Recording]) -> Recording:
    """Return the slide with the median force among those that followed the protocol, or among all if none did."""
    inside_protocol = [shard for shard in shards if not shard.attributes.get("outside_protocol")] or list(shards)

    def by_force(shard: Recording) -> tuple[float, str]:
        return float(shard.attributes.get("force_n") or 0.0), shard.name

    return sorted(inside_protocol, key=by_force)[len(inside_protocol) // 2]


def _describe_counts(shards: Sequence[Recording], sensor: str) -> str:
    """Return a sentence with the number of a sensor's slides, and of those outside the protocol."""
    outside = [shard for shard in shards if shard.attributes.get("outside_protocol")]
    slides_text = counted(len(shards), "slides")
    if not any("outside_protocol" in shard.attributes for shard in shards):
        return f"{slides_text} of {sensor_title(sensor)}."
    text = f"{slides_text} of {sensor_title(sensor)}, {len(outside):,} of them outside the protocol"
    reasons = Counter(str(shard.attributes.get("outside_protocol_why", "")) for shard in outside)
    phrases = [f"{count} {reason}" for reason, count in reasons.most_common() if reason]
    return text + (f" ({listed(phrases)})." if phrases else ".")


def _profile_charts(shard: Recording, sensor: str, published: bool) -> list[Chart]:
    """Return charts of the force and speed of one slide."""
    table = shard.table(PROFILE)
    time_ns = table["t_ns"].to_numpy()
    time_s = (time_ns - time_ns[0]) / 1e9
    during = time_s[table["phase"].to_numpy() == 0]
    shade = (float(during[0]), float(during[-1])) if len(during) else None
    profiles = (
        ("Figure 5", f"force on {sensor_title(sensor)}", "force (N)", {"force_n": "force"}, 1.0),
        (
            "Figure 6",
            f"speed on {sensor_title(sensor)}",
            "speed (mm/s)",
            {"speed_raw_m_s": "as measured", "speed_m_s": "median of 3"},
            1000.0,
        ),
    )
    figures = []
    for number, title, quantity, columns, scale in profiles:
        lines = {label: scale * table[name].to_numpy() for name, label in columns.items() if name in table.column_names}
        drawn_lines = [Curve(label, time_s, values) for label, values in lines.items() if np.isfinite(values).any()]
        if drawn_lines:
            spec = charts.lines(drawn_lines, "time (s)", quantity, shade=shade, points=False, height=190)
            caption = f"{shard.name}, the slide of median force. Shaded: the slide."
            figures.append(Chart(form(number, title, published), spec, caption))
    return figures
