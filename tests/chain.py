"""The forward chain on a few simulated trials, as a lab would type it."""

from pathlib import Path

from tests import commands

TRAIN = "train forward data/latents --split data/split --architecture gru --hidden 16"
CHAIN = (
    "simulate forward -o data/recordings --trials 8 --duration-s 5",
    "synchronize data/recordings -o data/synced",
    "segment contacts data/synced -o data/segments",
    "split data/segments -o data/split --scheme random --val 0.25 --test 0.25",
    "compress pca data/segments --split data/split -o data/latents --components 6",
    f"{TRAIN} -o models/forward --epochs 2",
    "evaluate models/forward data/latents --split data/split -o results/forward",
    "report results/forward -o report.html",
)


def run(folder: Path) -> None:
    """Run the chain in ``folder``."""
    (folder / ".tacpipe").mkdir(exist_ok=True)
    commands.run(folder, CHAIN)
