"""One of several processes that train networks together: ``python -m tests.training.rank RANK SIZE FOLDER [NAME...]``.

Rank 0 writes the files of each model into the folder.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import torch

from tacpipe.training import ranks
from tests.training.networks import NETWORKS


def main(rank: int, size: int, folder: Path, names: list[str]) -> None:
    torch.set_num_threads(1)

    def start() -> None:
        ranks.join(ranks.folder_store(folder / "store", size), rank, size, "cpu", rank)

    with ranks.available(start):
        for name in names or NETWORKS:
            write(folder / name, NETWORKS[name](folder / f"{name} workspace {rank}"), rank)


def write(place: Path, files: Mapping[str, bytes], rank: int) -> None:
    if rank == 0:
        place.mkdir()
        for name, content in files.items():
            (place / name).write_bytes(content)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]), sys.argv[4:])
