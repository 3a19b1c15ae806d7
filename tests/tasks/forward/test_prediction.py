"""Test that predictions of recordings are tables of the forecaster's results, at the time of prediction."""

from pathlib import Path

import numpy as np
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tacpipe.tasks.forward import prediction as forward_prediction
from tacpipe.tasks.forward.prediction import ForwardModel
from tests.fake_recordings import FakeShard, dataset
from tests.stages.learning_fakes import CHANNELS, motion, table
from tests.tasks.forward.trials import HORIZON, compressed, predicted_windows, trained

TEST = motion(20)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return trained(tmp_path_factory.mktemp("model"))


def test_each_row_holds_what_the_model_says_of_the_steps_asked_for(model: dict[str, bytes]) -> None:
    table = forward_prediction.predict(model, dataset(TEST), [1, 4]).recordings[TEST.name].streams[""]
    _, _, windows = predicted_windows(ForwardModel.load(model), TEST)
    assert table.column_names[:3] == ["t_ns", f"{CHANNELS[0]}_t1", f"{CHANNELS[0]}_t4"]
    assert table.num_columns == 1 + 2 * len(CHANNELS)
    assert table["t_ns"].to_pylist()[:2] == [4 * 20_000_000, 5 * 20_000_000]
    for channel, name in enumerate(CHANNELS):
        for step in (1, 4):
            expected = dict(windows.each_prediction())["model"].count[:, step - 1, channel]
            assert np.allclose(table[f"{name}_t{step}"].to_numpy(), expected, rtol=1e-5)
    about = table.schema.field(f"{CHANNELS[0]}_t4").metadata
    assert about[b"quantity"] == b"prediction" and about[b"step"] == b"4" and about[b"taxel"] == b"1"


def test_a_model_of_latents_tells_counts(tmp_path: Path) -> None:
    training = compressed(*(motion(seed) for seed in range(3)))
    model = trained(tmp_path, training, compressed(motion(9), files=training.files))
    recordings = compressed(TEST, files=training.files)
    table = forward_prediction.predict(model, recordings, [HORIZON]).recordings[TEST.name].streams[""]
    assert table.column_names == ["t_ns", *(f"{name}_t{HORIZON}" for name in CHANNELS)]
    with pytest.raises(TacpipeError, match="another codec"):
        forward_prediction.predict(model, compressed(TEST), [1])


def test_a_recording_without_a_window_has_a_table_without_rows(model: dict[str, bytes]) -> None:
    short = FakeShard("short", table(np.zeros((3, len(CHANNELS)))))
    output = forward_prediction.predict(model, dataset(short), [1]).recordings["short"].streams[""]
    assert (output.num_rows, output.num_columns) == (0, 1 + len(CHANNELS))


@pytest.mark.parametrize("step", [0, HORIZON + 1, -1])
def test_steps_that_the_model_does_not_reach_are_refused(step: int, model: dict[str, bytes]) -> None:
    with pytest.raises(TacpipeError, match=rf" 1 to {HORIZON} steps ahead, not {step}\."):
        forward_prediction.predict(model, dataset(TEST), [1, step])


def test_the_stage_reads_steps_as_a_list(model: dict[str, bytes]) -> None:
    stage = registry.load("predict")
    result = stage(stage.params(steps="1, 3"), dataset(files=model), dataset(TEST))
    assert f"{CHANNELS[-1]}_t3" in result.recordings[TEST.name].streams[""].column_names
    with pytest.raises(TacpipeError, match=r"config\.json"):
        stage(stage.params(), dataset(), dataset(TEST))
