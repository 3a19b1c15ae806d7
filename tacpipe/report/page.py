"""One page of results: what came out in a sentence, then figures, tables, and where the numbers come from."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.errors import TacpipeError
from tacpipe.report import figures

if TYPE_CHECKING:
    from tacpipe.dataset import Dataset, Shard

Tree = Mapping[str, Any]

SHOWN_STEPS = (1, 3, 5, 10)
TRACE_S = 12.0  # seconds of a recording that are drawn
EXPLAINED = {
    "model": "the trained model",
    "persistence": "nothing changes: the last frame is held",
    "codec_persistence": "the last frame is held after going through the codec",
    "codec": "the true future through the codec, which is what compression alone costs",
    "context_mean": "the mean of the frames the model reads",
}
_STYLE = """
:root { color-scheme: light dark; --paper: #fff; --text: #1c1e21; --faint: #8a8f98; --note: #5b626c; --panel: #f4f5f7;
  --model: #1f6feb; --persistence: #d9730d; --codec: #2f9e63; --other: #8a6fc9; }
@media (prefers-color-scheme: dark) { :root { --paper: #15171a; --text: #e3e5e8; --panel: #1f2226;
  --faint: #7d838c; --note: #a6adb7; --model: #6cabff; --persistence: #ff9d4d; --codec: #5fce93; --other: #b79cf2; } }
body { background: var(--paper); color: var(--text); font: 16px/1.5 system-ui, sans-serif; max-width: 72rem;
  margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.15rem; margin-top: 2.5rem; } h3 { font-size: 1rem; margin-bottom: .3rem; }
.headline { background: var(--panel); border-left: .35rem solid var(--faint); padding: .8rem 1.1rem; font-size: 1.3rem; }
.better { border-color: var(--codec); } .worse { border-color: var(--persistence); }
.note { color: var(--note); font-size: .9rem; }
.badge { background: var(--persistence); color: var(--paper); border-radius: .3rem; padding: .1rem .5rem;
  font-size: .85rem; vertical-align: middle; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); gap: 1.5rem; }
figure { margin: 1rem 0; } figcaption { color: var(--note); font-size: .9rem; } svg { max-width: 100%; height: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { text-align: right; padding: .25rem .8rem; border-bottom: 1px solid var(--panel); }
th:first-child, td:first-child, .words th, .words td { text-align: left; } .scroll { overflow-x: auto; }
code { font-size: .85rem; overflow-wrap: anywhere; }
"""


def render(results: Sequence[Dataset], *, title: str, traces: int = 2) -> bytes:
    """Return the page for one or more results of ``tacpipe evaluate``, as UTF-8; the same results give the same bytes.

    Raises `TacpipeError` where a dataset has no ``metrics.json``.
    """
    for one in results:
        if "metrics.json" not in one.files:
            raise TacpipeError("There is no metrics.json in this dataset. Give the output of `tacpipe evaluate`.")
    body = "".join(_result(one, number, len(results), traces) for number, one in enumerate(results, 1))
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head>\n'
        f"<body><h1>{escape(title)}</h1>\n{body}</body></html>\n"
    ).encode()


def headline(metrics: Tree, rate_hz: float = 0.0) -> tuple[str, str]:
    """Return the result in a sentence or two, and a word for it: ``better``, ``worse`` or ``unclear``.

    It speaks of the last step's squared error in counts; the 95 % interval is over recordings.
    """
    told = metrics.get("skill", {}).get("mse_counts", {})
    steps = [int(name[1:]) for name in told if name != "mean"]
    if not steps:
        return (
            "No recording was left to judge the model on: it has seen all that were given, or none holds a window.",
            "",
        )
    step = max(steps)
    one = told[f"t{step}"]
    when = f"t+{step}" + (f" ({1000 * step / rate_hz:.0f} ms ahead)" if rate_hz else "")
    recordings = metrics["counts"]["recordings"]
    if "low" not in one:
        return f"The model is {_gain(one['mean'])} than persistence at {when}, on a single recording: no interval.", ""
    interval = f"95 % interval {_skill(one['low'])} to {_skill(one['high'])} over {recordings} recordings"
    if one["low"] <= 0 <= one["high"]:
        sentence = f"The model cannot be told from persistence at {when}: skill {_skill(one['mean'])}, {interval}."
        return sentence, "unclear"
    word = "better" if one["low"] > 0 else "worse"
    return (
        f"The model is {_gain(one['mean'])} than persistence at {when}: skill {_skill(one['mean'])}, {interval}.",
        word,
    )


def _gain(skill: float) -> str:
    """Return skill in words.

    >>> _gain(0.2), _gain(-3.5)
    ('20 % better', '350 % worse')
    """
    percent = abs(100 * skill)
    return f"{percent:,.{0 if percent >= 10 else 1}f} % {'better' if skill >= 0 else 'worse'}"


def _skill(value: float) -> str:
    """Return a skill with its sign.

    >>> _skill(-43.559), _skill(0.1234)
    ('−43.6', '+0.123')
    """
    told = f"{value:+.3g}" if abs(value) < 1000 else f"{value:+,.0f}"
    return told.replace("-", "−")


def _result(result: Dataset, number: int, of: int, traces: int) -> str:
    """Return the part of the page that one result has."""
    metrics = json.loads(result.files["metrics.json"])
    config = json.loads(result.files["config.json"]) if "config.json" in result.files else {}
    rate_hz = float(config.get("rate_hz", 0.0))
    sentence, word = headline(metrics, rate_hz)
    simulated = any(shard.attributes.get("simulated") for shard in result.shards.values())
    badge = ' <span class="badge">simulated</span>' if simulated else ""
    name = ": ".join(str(config[key]) for key in ("task", "architecture") if key in config) or "result"
    trials = list(csv.DictReader(io.StringIO(result.files.get("trials.csv", b"").decode())))
    parts = [
        f"<h2>{f'{number}. ' if of > 1 else ''}{escape(name.replace('_', ' '))}{badge}</h2>",
        f'<p class="headline {word}">{escape(sentence)}</p>',
        _floor(metrics),
        _counts(metrics, simulated),
        _horizon_figures(metrics, rate_hz),
        _error_tables(metrics),
        _trials(trials),
        _traces(result, trials, traces),
        _seen(metrics),
        _training(result.files),
        _provenance(result.manifest),
    ]
    return "\n".join(part for part in parts if part) + "\n"


def _counts(metrics: Tree, simulated: bool) -> str:
    """Return how much the result rests on."""
    counts = metrics.get("counts", {})
    text = (
        f"{counts.get('recordings', 0)} recordings that the model has not seen, {counts.get('windows', 0)} windows; "
        f"because windows overlap, they are worth about {counts.get('effective_windows', 0)}. "
        "Intervals come from drawing whole recordings anew. "
        "Skill is 1 − squared error of the model / squared error of persistence."
    )
    if simulated:
        text += " These recordings were simulated: nothing here is evidence about a real sensor."
    return f'<p class="note">{escape(text)}</p>'


def _floor(metrics: Tree) -> str:
    """Return a warning where the codec alone loses more than persistence errs, empty otherwise."""
    if "codec" not in metrics:
        return ""
    floor, baseline = (metrics[name]["mse_counts"]["all"] for name in ("codec", "persistence"))
    steps = _steps(floor)
    lost = [step for step in steps if floor[f"t{step}"] >= baseline[f"t{step}"]]
    if not lost:
        return ""
    which = "at every step" if lost == steps else f"up to t+{max(lost)}"
    text = (
        f"The codec alone loses more than persistence errs {which} (squared error of the true future through the codec: "
        f"{_number(floor['mean'])} counts² on average), so a model of its latents can hardly win there in counts."
    )
    return f"<p>{escape(text)}</p>"


def _steps(scores: Tree) -> list[int]:
    return sorted(int(name[1:]) for name in scores if name != "mean")


def _predictors(metrics: Tree) -> list[str]:
    """Return the names of model and baselines, model first, then persistence."""
    found = [name for name, scores in metrics.items() if name not in ("skill", "seen") and "mse_counts" in scores]
    order = list(EXPLAINED)
    return sorted(found, key=lambda name: (order.index(name) if name in order else len(order), name))


def _horizon_figures(metrics: Tree, rate_hz: float) -> str:
    """Return error and skill over the time ahead, side by side."""
    names = _predictors(metrics)
    if not names:
        return ""
    steps = _steps(metrics[names[0]]["mse_counts"]["all"])
    ahead_ms = [1000 * step / rate_hz if rate_hz else float(step) for step in steps]
    errors = {
        name: [np.sqrt(metrics[name]["mse_counts"]["all"][f"t{step}"]) for step in steps]
        for name in names
        if name != "context_mean"
    }
    parts = [
        _figure(
            figures.errors_by_horizon(errors, ahead_ms, "root mean squared error (counts)"),
            "Error over all channels and unseen recordings. Lower is better.",
        )
    ]
    told = metrics["skill"]["mse_counts"]
    if all("low" in told.get(f"t{step}", {}) for step in steps):
        skill = {part: [told[f"t{step}"][part] for step in steps] for part in ("mean", "low", "high")}
        caption = "Skill over persistence, with its 95 % interval over recordings."
        parts.append(_figure(figures.skill_by_horizon(skill, ahead_ms), caption))
    return f'<div class="pair">{"".join(parts)}</div>'


def _error_tables(metrics: Tree) -> str:
    """Return errors by predictor, skill with intervals, and errors by sensor and axis."""
    names = _predictors(metrics)
    if not names:
        return ""
    groups = metrics[names[0]]["mae_counts"]
    shown = [f"t{step}" for step in _steps(groups["all"]) if step in SHOWN_STEPS] + ["mean"]
    heads = [name.replace("t", "t+") if name != "mean" else name for name in shown]
    parts = []
    for measure, title in (
        ("mae_counts", "Mean absolute error (counts)"),
        ("mse_counts", "Mean squared error (counts²)"),
    ):
        rows = [[name, *(_number(metrics[name][measure]["all"][step]) for step in shown)] for name in names]
        parts.append(_table(title, ["", *heads], rows))
    rows = [[name, *(_number(metrics[name]["mse_feature"][step]) for step in shown)] for name in names]
    parts.append(_table("Mean squared error (latents scaled to ±1, as in the paper)", ["", *heads], rows))
    rows = []
    for measure, told in metrics["skill"].items():
        rows.append([measure, *(_interval(told.get(step, {})) for step in shown)])
    parts.append(_table("Skill over persistence, with 95 % interval", ["", *heads], rows))
    rows = [
        [f"{name}, {group}", *(_number(metrics[name]["mae_counts"][group][step]) for step in shown)]
        for group in groups
        if group != "all"
        for name in names[:2]
    ]
    parts.append(_table("Mean absolute error by sensor and axis (counts)", ["", *heads], rows))
    legend = "; ".join(f"{name}: {EXPLAINED[name]}" for name in names if name in EXPLAINED)
    return f'<h3>Errors</h3><p class="note">{escape(legend)}.</p>' + "".join(parts)


def _trials(trials: Sequence[Mapping[str, str]]) -> str:
    """Return the skill on each unseen recording."""
    judged = [one for one in trials if one["seen"] == "false" and one["skill"]]
    if not judged:
        return ""
    skill, windows = [float(one["skill"]) for one in judged], [int(one["windows"]) for one in judged]
    better = sum(value > 0 for value in skill)
    caption = (
        f"Skill on each recording; better than persistence on {better} of {len(skill)}. Larger dots: more windows."
    )
    keys = ("mse_counts_model", "mse_counts_persistence")
    rows = [
        [one["recording"], one["windows"], *(_number(float(one[key])) for key in keys), _skill(float(one["skill"]))]
        for one in sorted(judged, key=lambda one: float(one["skill"]))
    ]
    heads = ["recording", "windows", "model (counts²)", "persistence (counts²)", "skill"]
    return (
        "<h3>By recording</h3>"
        + _figure(figures.skill_by_trial(skill, windows), caption)
        + _table("All recordings, the worst first", heads, rows)
    )


def _traces(result: Dataset, trials: Sequence[Mapping[str, str]], count: int) -> str:
    """Return example predictions of the recordings of median, lowest and highest skill."""
    judged = sorted(
        (one for one in trials if one["seen"] == "false" and one["skill"] and one["recording"] in result.shards),
        key=lambda one: float(one["skill"]),
    )
    if not judged or not count:
        return ""
    chosen = {"median": judged[len(judged) // 2], "lowest": judged[0], "highest": judged[-1]}
    drawn: dict[str, str] = {}
    for rank, one in list(chosen.items())[:count]:
        name = one["recording"]
        if name not in drawn:
            caption = (
                f"{name}, the recording of {rank} skill ({_skill(float(one['skill']))}). Each prediction stands at "
                "the time at which it was known: one that sees ahead runs left of the truth, persistence lies on it."
            )
            drawn[name] = _figure(_trace(result.shards[name]), caption)
    return "<h3>Predictions</h3>" + "".join(drawn.values())


def _trace(shard: Shard) -> str:
    """Return the first seconds of a recording's first two latents and of what was predicted for them."""
    table = shard.table()
    time_s = (table.column("t_ns").to_numpy() - table.column("t_ns")[0].as_py()) / 1e9
    shown_s = time_s[time_s <= TRACE_S]
    contact = table.column("contact").to_numpy()
    broken = np.concatenate([[False], np.diff(contact) != 0])
    latents = [name for name in table.column_names if f"{name}_t1" in table.column_names][:2]

    def values(name: str) -> figures.Floats:
        column: figures.Floats = table.column(name).to_numpy().astype(np.float64)
        column[broken] = np.nan
        return column[: len(shown_s)]

    steps = [step for step in (1, 5, 10) if f"{latents[0]}_t{step}" in table.column_names]
    ahead = {name: {f"t+{step}": values(f"{name}_t{step}") for step in steps} for name in latents}
    return figures.traces(shown_s, {name: values(name) for name in latents}, ahead)


def _seen(metrics: Tree) -> str:
    """Return the errors on recordings that the model was trained on, which prove nothing."""
    seen = metrics.get("seen", {})
    told = seen.get("skill", {}).get("mse_counts", {}).get("mean", {})
    if "mean" not in told:
        return ""
    text = (
        f"Left out of all above: {seen['counts']['recordings']} recordings that the model was trained or stopped on. "
        f"Its skill on these is {_skill(told['mean'])}, averaged over all steps."
    )
    return f'<h3>Recordings the model has seen</h3><p class="note">{escape(text)}</p>'


def _training(files: Mapping[str, bytes]) -> str:
    """Return the losses by epoch, where the result holds them."""
    if "history.jsonl" not in files:
        return ""
    history = [json.loads(line) for line in files["history.jsonl"].splitlines()]
    if not history:
        return ""
    best = min(history, key=lambda line: line["val_loss"])
    caption = f"{len(history)} epochs; the weights of epoch {best['epoch']} were kept, whose validation loss is lowest."
    return "<h3>Training</h3>" + _figure(figures.losses(history), caption)


def _provenance(manifest: Tree) -> str:
    """Return the chain of stages behind a result, with params and digests."""
    steps = [*manifest.get("chain", ()), {key: manifest.get(key) for key in ("stage", "version", "params")}]
    rows = []
    for step in steps:
        params = ", ".join(f"{key} = {json.dumps(value)}" for key, value in (step.get("params") or {}).items())
        fitted = ", ".join(f"{name} {digest[:12]}" for name, digest in (step.get("fitted") or {}).items())
        rows.append([str(step.get("stage")), str(step.get("version")), params, fitted])
    table = _table("Stages, the oldest first", ["stage", "version", "params", "fitted"], rows)
    named = [("this result", str(manifest.get("digest", "")))]
    for argument, inputs in manifest.get("inputs", {}).items():
        several = inputs if isinstance(inputs, list) else [inputs]
        named += [(argument, one["dataset"] if isinstance(one, dict) else str(one)) for one in several]
    items = "".join(f"<li>{escape(name)}: <code>{escape(digest)}</code></li>" for name, digest in named if digest)
    return f'<h3>Where it comes from</h3><div class="words">{table}</div><ul>{items}</ul>'


def _number(value: float) -> str:
    """Return a number with four digits, without exponent where it is not tiny.

    >>> _number(12345.6), _number(0.012345)
    ('12,346', '0.01235')
    """
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _interval(one: Tree) -> str:
    """Return a skill and its interval, as far as they are defined.

    >>> _interval({"mean": 0.5, "low": 0.25, "high": 0.75})
    '+0.5 (+0.25 to +0.75)'
    """
    if "mean" not in one:
        return "not defined"
    return _skill(one["mean"]) + (f" ({_skill(one['low'])} to {_skill(one['high'])})" if "low" in one else "")


def _figure(svg: str, caption: str) -> str:
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"


def _table(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in rows)
    return (
        f'<h4>{escape(title)}</h4><div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )
