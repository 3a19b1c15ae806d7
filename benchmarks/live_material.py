"""How often a model of materials is right early: python benchmarks/live_material.py MODEL RECORDINGS SLIDES SPLIT.

Of each test recording of SPLIT, the samples that have come at a fraction of the slide are given to what `tacpipe live` runs.
Prints the fraction of slides whose material is named right, by fraction, and processor time per answer.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np

import tacpipe
from tacpipe.plugins import registry
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.live.slide import SLIDES, Held, SlideSoFar, slide_params

FRACTIONS = (0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
EVERY = 2  # of the test recordings every second one
LEAST = 0.01


def main(model: str, recordings: str, slides: str, split: str) -> None:
    opened = tacpipe.open(model)
    classifier = Classifier.load(opened.files)
    params = slide_params(opened.source.chain)
    sensor = next(iter(classifier.layouts))
    slide = SlideSoFar(classifier, params, sensor, LEAST)
    stage = registry.load(SLIDES)
    names = sorted(tacpipe.open(slides).select(split=split, role="test").recordings)[::EVERY]
    whole = tacpipe.open(recordings)
    right: dict[float, list[bool]] = {fraction: [] for fraction in (*FRACTIONS, np.inf)}
    took_s = []
    for name in names:
        recording = whole[name]
        truth = classifier.naming.name(classifier.naming.number(recording.attributes[classifier.naming.key]))
        tables = {stream: recording.table(stream) for stream in recording.streams}
        rows = stage(replace(params, crop="none"), Held(tables, {"sensor": sensor})).streams["slide"]
        t_ns = rows.column("t_ns").to_numpy()
        for fraction, found in right.items():
            last = t_ns[min(len(t_ns), round(fraction * slide.frames)) - 1] if np.isfinite(fraction) else np.inf
            came = {
                stream: table.slice(0, int((table.column("t_ns").to_numpy() <= last).sum()))
                for stream, table in tables.items()
            }
            began_s = time.process_time()
            answer = slide.answer({stream: table for stream, table in came.items() if table.num_rows})
            took_s.append(time.process_time() - began_s)
            scores = answer.probabilities
            found.append(scores is not None and classifier.names[int(scores.argmax())] == truth)
    print(f"{len(names)} slides, {len(classifier.classes)} materials")
    for fraction, found in right.items():
        print(f"{fraction * slide.frames:6.0f} rows: {np.mean(found):.2f} right")
    print(f"processor time an answer: median {1e3 * np.median(took_s):.1f} ms, at most {1e3 * max(took_s):.1f} ms")


if __name__ == "__main__":
    main(*sys.argv[1:])
