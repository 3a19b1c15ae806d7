"""Publish messages by LSL in this process, read them with pylsl's own inlet, and print them as JSON."""

import json
import sys
from typing import Any

import numpy as np

from tacpipe.live import publishing
from tacpipe.tasks.forward.live.messages import ForecastDescription, ForecastMessage
from tacpipe.tasks.material.live.messages import SLIDING, MaterialDescription, MaterialMessage

SOON_S = 120.0
COUNT = 5


def forecast() -> tuple[Any, list[Any]]:
    values = np.array([[1.5, -2.25], [3.0, 1e-3]], np.float32)
    messages = [ForecastMessage(seq, seq, values + seq if seq % 2 else None) for seq in range(COUNT)]
    return ForecastDescription(("a", "b"), (1, 2), "count", 50.0, "models/forward"), messages


def material() -> tuple[Any, list[Any]]:
    names = ("cork", "felt")
    probabilities = [None, *(np.array([seq / 10, 1 - seq / 10], np.float32) for seq in range(1, COUNT))]
    messages = [
        MaterialMessage(seq, seq, names, values, SLIDING, 10 * seq, seq / 10)
        for seq, values in enumerate(probabilities)
    ]
    return MaterialDescription(names, "biotac", 100, True, "order", 10.0, "models/material"), messages


def main(kind: str, name: str) -> None:
    import pylsl

    about, messages = {"forecast": forecast, "material": material}[kind]()
    publisher: Any = publishing.publisher(f"lsl:{name}", about)
    (stream_info,) = pylsl.resolve_byprop("name", name, 1, SOON_S)
    inlet = pylsl.StreamInlet(stream_info, recover=False)
    info = inlet.info(SOON_S)
    inlet.open_stream(SOON_S)
    labels, units = [], []
    channel = info.desc().child("channels").child("channel")
    while not channel.empty():
        labels.append(channel.child_value("label"))
        units.append(channel.child_value("unit"))
        channel = channel.next_sibling("channel")
    rows = []
    for message in messages:
        publisher.publish(message)
        rows.append(inlet.pull_sample(SOON_S)[0])
    publisher.close()
    print(
        json.dumps({"type": info.type(), "rate": info.nominal_srate(), "labels": labels, "units": units, "rows": rows})
    )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
