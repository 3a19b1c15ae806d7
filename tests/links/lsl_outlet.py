"""An LSL outlet in a separate process, made with pylsl, which sends 200 samples per second until its input ends.

Usage: python lsl_outlet.py KIND NAME FIRST
"""

import select
import sys
import time

import pylsl

KINDS = {
    "force": ("Force", 3, 200, "float32"),
    "counts": ("Tactile", 2, 200, "int32"),
    "markers": ("Markers", 1, 0, "string"),
}


def main(kind: str, name: str, first: int) -> None:
    stream = pylsl.StreamInfo(name, *KINDS[kind], f"{name}-1")
    if kind == "force":
        channels = stream.desc().append_child("channels")
        for axis in "xyz":
            channel = channels.append_child("channel")
            for key, value in (("label", f"F{axis}"), ("unit", "newtons"), ("type", f"Force{axis.upper()}")):
                channel.append_child_value(key, value)
    outlet = pylsl.StreamOutlet(stream)
    print("up", flush=True)
    outlet.wait_for_consumers(60)
    row = first
    while not select.select([sys.stdin], [], [], 0.005)[0]:
        outlet.push_sample(
            [f"trial {row} ✓"]
            if kind == "markers"
            else [row * factor for factor in range(1, stream.channel_count() + 1)]
        )
        row += 1
    print(row, flush=True)
    time.sleep(0.2)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
