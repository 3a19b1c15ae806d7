"""Digests of the values of each deterministic stage on simulated recordings: `python -m tests.golden_values`."""

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

FILE = Path(__file__).parent / "golden" / "digests.json"
DIGITS = {"double": 6, "float": 4}  # Digits relative to a column's largest value: another machine may differ beyond.
INPUTS = (  # datasets that further commands read; their values are in those below
    "simulate touch --raw --trials 2 --seed 7 -o raw",
    "simulate forward --trials 4 --duration-s 5 --seed 7 --effort 1.15 --robot-rate-hz 50 -o held",
    "label held 'trial-*' --label slip=true",
    "split held -o held-split --scheme random --val 0.25 --test 0",
)
COMMANDS = {
    "simulate.forward": "simulate forward --trials 3 --duration-s 4 --seed 7 -o {0}",
    "synchronize": "synchronize simulate.forward --rate-hz 50 --values interpolate -o {0}",
    "segment.contacts": "segment contacts synchronize -o {0}",
    "segment.blocks": "segment blocks segment.contacts --parts 3 -o {0}",
    "segment.slips": "segment slips segment.contacts -o {0}",
    "simulate.material": "simulate material --trials 12 --materials 3 --seed 7 -o {0}",
    "segment.slides": "segment slides simulate.material -o {0}",
    "simulate.touch": "simulate touch --trials 2 --seed 7 -o {0}",
    "segment.grasps": "segment grasps raw -o {0}",
    "segment.losses": "segment losses held --streams xela* -o {0}",
    "train.slip": "train slip held --split held-split --streams xela* --architecture boosting --trees 5 --leaf 5 "
    "--no-match-time -o {0}",
    "split": "split segment.contacts --scheme random --val 0.34 --test 0.34 -o {0}",
    "compress.pca": "compress pca segment.contacts --split split --components 4 -o {0}",
}
PREDICTIONS = {"train.slip": "predict train.slip held --causal -o {0}"}  # the values that a model is pinned by


def values_digest(path: Path) -> str:
    """Return the digest of a dataset's values: floats rounded, encodings and library versions left out."""
    import numpy as np

    import tacpipe
    from tacpipe.io.hashing import bytes_digest, digest

    digests: dict[str, Any] = {}
    for name, shard in tacpipe.open(path).recordings.items():
        for stream in shard.streams:
            table = shard.table(stream)
            for field, column in zip(table.schema, table.columns, strict=True):
                if str(field.type) in DIGITS:
                    values = column.to_numpy().astype(np.float64)
                    largest = float(np.nanmax(np.abs(values), initial=0.0)) or 1.0
                    content = (np.nan_to_num(values / largest, nan=9.0).round(DIGITS[str(field.type)]) + 0.0).tobytes()
                else:
                    content = json.dumps(column.to_pylist()).encode()
                digests[f"{name}/{stream}/{field.name}"] = bytes_digest(content)
    return digest(digests)


def current() -> dict[str, dict[str, Any]]:
    """Return version and digest of each stage as the code stands."""
    from tacpipe.plugins import registry
    from tests import commands

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / ".tacpipe").mkdir()
        predictions = [command.format(f"{name}-predicted") for name, command in PREDICTIONS.items()]
        lines = [*INPUTS, *(command.format(name) for name, command in COMMANDS.items()), *predictions]
        commands.run(Path(folder), lines)
        digests = {}
        for name in COMMANDS:
            stage = registry.load(name)
            path = f"{name}-predicted" if name in PREDICTIONS else name
            version = [stage.version] + ([stage.fit.version] if stage.fit else [])
            digests[name] = {"version": version, "digest": values_digest(Path(folder) / path)}
    return digests


def bless() -> None:
    """Write the digests; refuse one that changed under an unchanged version."""
    pinned = json.loads(FILE.read_text()) if FILE.exists() else {}
    now = current()
    for name, value in now.items():
        before = pinned.get(name)
        if before and before["version"] == value["version"] and before["digest"] != value["digest"]:
            sys.exit(f"{name} gives other values under the same version {value['version']}: raise its version first.")
    FILE.write_text(json.dumps(now, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    os.environ.pop("TACPIPE_STORE", None)
    bless()
