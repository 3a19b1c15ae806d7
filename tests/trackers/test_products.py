"""TensorBoard's own reader, an MLflow server on this computer and W&B's offline files have what a training gave them.

They need an environment of their own: `make test-trackers` makes it and runs these tests.
"""

import json
import os
import shlex
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.chain import TRAIN
from tests.conftest import Lab

PYTHON = os.environ.get("TACPIPE_TRACKERS_PYTHON", "")
PATIENCE_S = 300.0  # longest time for a server to start
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not PYTHON, reason="needs MLflow and W&B in an environment of their own: make test-trackers"),
]


def tool(folder: Path, command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python in the environment of the trackers."""
    return subprocess.run(
        [PYTHON, *shlex.split(command)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": "", "OMP_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def history(folder: Path, model: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / model / "history.jsonl").read_text().splitlines()]


def pairs(lines: list[dict[str, Any]], name: str) -> list[tuple[int, Any]]:
    return [(line["epoch"], pytest.approx(line[name], rel=1e-6)) for line in lines]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """The address of an MLflow server that listens on this computer alone."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    stored = f"--backend-store-uri sqlite:///{tmp_path}/server.db --default-artifact-root {tmp_path}/artifacts"
    words = shlex.split(f"-m mlflow server --host 127.0.0.1 --port {port} --workers 1 {stored}")
    environment = {**os.environ, "PYTHONPATH": "", "MLFLOW_DISABLE_TELEMETRY": "true"}
    with (tmp_path / "server.log").open("w") as log:
        process = subprocess.Popen([PYTHON, *words], env=environment, stdout=log, stderr=log, start_new_session=True)
    try:
        until_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/health").close()
                break
            except (urllib.error.URLError, ConnectionError):
                assert process.poll() is None and time.monotonic() < until_s, (tmp_path / "server.log").read_text()
                time.sleep(0.2)
        yield f"http://127.0.0.1:{port}"
    finally:
        os.killpg(process.pid, 15)
        process.wait()


def get_json(address: str, path: str, value: Mapping[str, Any] | None = None) -> Any:
    """Return what MLflow's REST API answers."""
    content = None if value is None else json.dumps(value).encode()
    request = urllib.request.Request(f"{address}/api/2.0/mlflow/{path}", content, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request) as answer:
        return json.loads(answer.read())


def test_each_product_has_the_params_the_epochs_and_the_figures(tracked: Lab, server: str) -> None:
    folder = tracked.folder
    options = f"--track tensorboard --track mlflow:{server} --track wandb --json"
    process = tool(folder, f"-m tacpipe {TRAIN} --epochs 3 -o models/x {options}")
    assert process.returncode == 0, process.stderr
    name = f"models/x-{json.loads(process.stdout)['key'][:8]}"
    lines = history(folder, "models/x")
    best = min(line["val_loss"] for line in lines)

    read = tool(folder, f"{Path(__file__).with_name('reading.py')} runs/{name}")
    board = json.loads(read.stdout)
    for metric in ("train_loss", "val_loss"):
        assert [tuple(entry) for entry in board["scalars"][metric]] == pairs(lines, metric)
    assert [step for step, _ in board["scalars"]["learning_rate"]] == [1, 2, 3]
    assert board["scalars"]["best/loss"][0][1] == pytest.approx(best) and board["hparams"]
    assert "| hidden | 16 |" in board["texts"]["params/text_summary"][0]
    assert board["texts"]["path/text_summary"] == ["models/x"]

    experiment = get_json(server, "experiments/get-by-name?experiment_name=tacpipe")["experiment"]
    (run,) = get_json(server, "runs/search", {"experiment_ids": [experiment["experiment_id"]]})["runs"]
    assert (run["info"]["run_name"], run["info"]["status"]) == (name, "FINISHED")
    params = {entry["key"]: entry["value"] for entry in run["data"]["params"]}
    assert (params["hidden"], params["epochs"], params["stage"]) == ("16", "3", "train.forward")
    stored = get_json(server, f"metrics/get-history?run_id={run['info']['run_id']}&metric_key=val_loss")["metrics"]
    assert [(entry["step"], entry["value"]) for entry in stored] == pairs(lines, "val_loss")
    assert {entry["key"]: entry["value"] for entry in run["data"]["tags"]}["tacpipe.path"] == "models/x"

    (offline,) = (folder / "wandb").glob("offline-run-*")
    content = next(offline.glob("*.wandb")).read_bytes()
    assert b"val_loss" in content and b"learning_rate" in content


def test_a_run_that_is_tracked_again_is_the_same_run_with_each_epoch_once(tracked: Lab, server: str) -> None:
    folder = tracked.folder
    for _ in range(2):
        process = tool(folder, f"-m tacpipe track models/forward results/forward --to mlflow:{server} --to tensorboard")
        assert process.returncode == 0, process.stderr
    first, second = process.stdout.split()
    lines = history(folder, "models/forward")

    experiment = get_json(server, "experiments/get-by-name?experiment_name=tacpipe")["experiment"]
    runs = get_json(server, "runs/search", {"experiment_ids": [experiment["experiment_id"]]})["runs"]
    by_name = {run["info"]["run_name"]: run for run in runs}
    assert set(by_name) == {first, second} and len(runs) == 2
    stored = get_json(server, f"metrics/get-history?run_id={by_name[first]['info']['run_id']}&metric_key=val_loss")
    assert [entry["step"] for entry in stored["metrics"]] == [line["epoch"] for line in lines]
    assert "gain" in {entry["key"] for entry in by_name[second]["data"]["metrics"]}
    board = json.loads(tool(folder, f"{Path(__file__).with_name('reading.py')} runs/{first}").stdout)
    assert [tuple(entry) for entry in board["scalars"]["val_loss"]] == pairs(lines, "val_loss")


def test_a_server_that_does_not_answer_ends_no_training(tracked: Lab) -> None:
    process = tool(tracked.folder, f"-m tacpipe {TRAIN} --epochs 3 -o models/y --track mlflow:http://127.0.0.1:9")

    assert process.returncode == 0 and process.stdout == "models/y\n"
    assert process.stderr.count("failed and is left out") == 1
    assert len(history(tracked.folder, "models/y")) == 3
