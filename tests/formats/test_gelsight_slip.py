"""Published trials of two GelSight Mini become recordings of two streams of frames."""

from pathlib import Path

import numpy as np
import pytest

import tacpipe
from tacpipe.video import decoding, stream
from tests.conftest import Lab, sample_data
from tests.formats import video_files
from tests.video import videos


def test_a_trial_becomes_two_streams_of_the_frames_of_its_videos_and_two_labels(lab: Lab) -> None:
    source = lab.folder / "gels"
    folder = video_files.write_gelsight(source)
    video_files.write_gelsight(source, "green_rope", 2, slip=True)

    assert lab.call("ingest gelsight-slip gels -o data/gels").code == 0

    dataset = tacpipe.open(lab.folder / "data/gels")
    assert {recording.name: recording.attributes["slip"] for recording in dataset} == {
        "green_rope-2": True,
        "lemon-1": False,
    }
    recording = dataset["lemon-1"]
    assert recording.attributes["object"] == "lemon"
    for camera in (0, 2):
        columns = recording.columns(f"gel{camera}")
        video_format = stream.read_format(columns)
        assert video_format is not None
        images = videos.sound_images(video_format, decoding.read_batches(columns))
        expected = videos.decoded(folder / f"camera_{camera}.avi")
        assert len(images) == len(expected) == 13 + camera
        assert all(np.array_equal(images[row], image) for row, image in enumerate(expected))
        assert columns.column("t_ns").to_pylist() == [row * 40_000_000 for row in range(13 + camera)]


def test_a_folder_without_trials_and_a_trial_without_a_video_are_refused_in_a_sentence(lab: Lab) -> None:
    (lab.folder / "empty").mkdir()
    assert "holds no trial" in lab.call("ingest gelsight-slip empty -o data/gels").err
    folder = video_files.write_gelsight(lab.folder / "gels")
    (folder / "camera_2.avi").unlink()
    refused = lab.call("ingest gelsight-slip gels -o data/gels")
    assert refused.code == 1
    assert "lacks camera_2.avi" in refused.err


@pytest.mark.data
@pytest.mark.skipif(not (sample_data() / "gelsight_slip").exists(), reason="published recordings are not here")
def test_published_trials_keep_the_packets_of_their_files(lab: Lab) -> None:
    source = sample_data() / "gelsight_slip" / "lemon"
    assert lab.call(f"ingest gelsight-slip {source} -o data/gels").code == 0
    dataset = tacpipe.open(lab.folder / "data/gels")
    for recording in dataset:
        folder = Path(source, f"exp_num_{recording.name.removeprefix('lemon-')}")
        for camera in (0, 2):
            packets = recording.columns(f"gel{camera}").column("packet").to_pylist()
            assert packets == videos.packets(folder / f"camera_{camera}.avi")
