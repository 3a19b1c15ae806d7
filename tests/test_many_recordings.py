"""Compare a stage's peak of memory over 10 and 100 recordings: it does not grow with the recordings of a dataset."""

from pathlib import Path

import pytest

from tests import peaks
from tests.conftest import tacpipe

pytestmark = [pytest.mark.long, pytest.mark.minutes]

SIMULATE = "simulate forward --duration-s 10 --robot-rate-hz 50 --jobs 1 -o rec"
LITTLE = {  # Ten recordings have more than these bytes, which may stay in memory.
    "tacpipe.tasks.forward.evaluation.KEPT_BYTES": 1 << 20,
    "tacpipe.tasks.forward.prediction.KEPT_BYTES": 1 << 20,
    "tacpipe.tasks.forward.tracks.IN_MEMORY": 1 << 20,
    "tacpipe.tasks.forward.training.CALIBRATED": 256,  # windows: of a hundred recordings there are more than of ten
    "tacpipe.tasks.forward.training.LINEAR": 256,
    "tacpipe.io.spill.SEGMENT_BYTES": 1 << 22,
    "tacpipe.io.spill.MAX_READ_BYTES": 1 << 22,
}
STAGES = {  # The stages run in this order.
    "synchronize": "synchronize rec --jobs 1 -o synced",
    "segment": "segment contacts synced --jobs 1 -o segments",
    "split": "split segments --scheme blocked --val 0.1 --test 0 -o split",
    "compress": "compress pca segments --split split --jobs 1 -o latents",
    "train": "train forward segments --split split --preset quick --epochs 1 --stride 10 -o model",
    "predict": "predict model segments -o predicted",
    "evaluate": "evaluate model segments -o results",
    "export csv": "export csv rec --jobs 1 -o csv",
    "export hdf5": "export hdf5 rec --jobs 1 -o hdf5",
}
OF_MODELS = ("train", "predict", "evaluate")
MOST = 1.2  # times; the alarms of `evaluate` take 680 bytes a row


def test_each_stage_over_a_hundred_recordings_takes_the_memory_of_ten(tmp_path: Path) -> None:
    peak_bytes: dict[int, dict[str, int]] = {}
    for count in (10, 100):
        folder = tmp_path / f"of-{count}"
        (folder / ".tacpipe").mkdir(parents=True)
        process = tacpipe(folder, f"{SIMULATE} --trials {count}")
        assert process.returncode == 0, process.stderr
        peak_bytes[count] = {
            stage: peaks.bytes_of(folder, command, LITTLE if stage in OF_MODELS else {})
            for stage, command in STAGES.items()
        }
    ratios = {stage: peak_bytes[100][stage] / peak_bytes[10][stage] for stage in STAGES}
    assert {stage: ratio for stage, ratio in ratios.items() if ratio >= MOST} == {}
