"""Test untrusted models and codecs: only JSON and safetensors are opened, and they are checked first."""

import functools
import json
import pickle
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

import tacpipe
from tacpipe.codecs.frame_autoencoder import COLUMNS, ROWS, _Network, read_encoder
from tacpipe.errors import TacpipeError
from tacpipe.models.forest import Forest
from tacpipe.plugins import registry
from tests import chain
from tests.conftest import tacpipe as ran
from tests.fake_recordings import FakeDataset
from tests.promises.counts import count
from tests.promises.limits import GIB, bound_memory, is_sentence, sample_cases
from tests.promises.mutations import mutate
from tests.promises.targets import Opened
from tests.tasks.forward import trials
from tests.tasks.material import textures
from tests.tasks.touch import handmade

Files = dict[str, bytes]
SMALL = GIB  # memory that refusing a model may take
ALL = {"targets": "pdc_th,pdc_mf,e_th,e_mf"}
KINDS = (
    *(
        "forward recurrent",
        "touch strong",
        "forward gru",
        "material minirocket",
        "material statistics",
        "material raec",
    ),
    "touch pointnet",
)


@functools.cache
def _folder() -> Path:
    import tempfile

    return Path(tempfile.mkdtemp())


@functools.cache
def model_files(kind: str) -> Files:
    """Return the files of a small model."""
    task, _, architecture = kind.partition(" ")
    folder = _folder() / kind.replace(" ", "-")
    if kind == "forward recurrent":
        latents = trials.compressed(*(trials.motion(seed) for seed in range(2)))
        watched = trials.compressed(trials.motion(10), files=latents.files)
        return dict(trials.trained(folder, latents, watched, architecture=architecture, epochs=1))
    if task == "forward":
        return dict(trials.trained(folder, architecture=architecture, epochs=1))
    if task == "material":
        short = {} if architecture in ("minirocket", "statistics") else {"epochs": 1}
        return dict(textures.trained(folder, architecture=architecture, **short))
    changed = {**handmade.POINTNET, **ALL, "epochs": 1} if architecture == "pointnet" else {}
    return dict(handmade.trained(folder, **changed))


def load_model(kind: str, files: Mapping[str, bytes]) -> Any:
    return registry.load_task(kind.partition(" ")[0]).load(files)


def evaluate_model(kind: str, files: Mapping[str, bytes]) -> Any:
    """Evaluate a model on a recording that fits it."""
    task = kind.partition(" ")[0]
    if task == "forward":
        recording = trials.motion(11)
        latents = model_files(kind)  # The codec is unchanged.
        recordings = (
            trials.compressed(recording, files=latents) if "codec.json" in latents else trials.dataset(recording)
        )
    else:
        recordings = textures.slides(8, 1) if task == "material" else handmade.recordings(6, 1)
    stage: Any = registry.load("evaluate")
    return stage(stage.params(), model=FakeDataset(files=files), recordings=recordings)


@pytest.fixture(autouse=True)
def _models_are_trained_before_memory_is_bounded(request: pytest.FixtureRequest) -> None:
    arguments = getattr(getattr(request.node, "callspec", None), "params", {})
    for kind in [arguments["kind"]] if "kind" in arguments else ["forward recurrent", "touch strong"]:
        model_files(kind)
    if "size" in arguments:
        model_files(SIZES[arguments["case"]][0])


def check_refusal(read: Callable[[], object], match: str | None = None) -> None:
    with bound_memory(SMALL), pytest.raises(TacpipeError, match=match) as error:
        read()
    assert is_sentence(str(error.value)), str(error.value)
    count("hostile inputs refused")


def with_config(files: Files, change: Callable[[dict[str, Any]], Any], name: str = "config.json") -> Files:
    config = json.loads(files[name])
    change(config)
    return files | {name: json.dumps(config).encode()}


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every value within values; of lists the first."""
    if path:
        yield path
    children = tree.items() if isinstance(tree, dict) else list(enumerate(tree))[:1] if isinstance(tree, list) else ()
    for key, value in children:
        yield from leaves(value, (*path, key))


def set_value(tree: Any, path: tuple[Any, ...], value: Any) -> None:
    for key in path[:-1]:
        tree = tree[key]
    if value is DROPPED:
        del tree[path[-1]]
    else:
        tree[path[-1]] = value


DROPPED = object()
VALUES: tuple[Any, ...] = (
    DROPPED,
    None,
    -1,
    10**9,
    10**30,
    1.5,
    "x" * 1000,
    "",
    [],
    {},
    True,
    [[1]],
    float("nan"),
    "../../x",
    "\x1b[2J",
)


@pytest.mark.parametrize("kind", sample_cases(KINDS, 2))
def test_a_model_that_nobody_changed_is_loaded_and_judged(kind: str) -> None:
    with bound_memory(2 * SMALL):
        assert load_model(kind, model_files(kind)) is not None
        assert "metrics.json" in evaluate_model(kind, model_files(kind)).files


def try_config(kind: str, name: str, share: float) -> None:
    """Change each value of a JSON file in several ways: the model is refused, or judges as it should."""
    random = Random(0)
    tree = json.loads(model_files(kind)[name])
    tried = 0
    with bound_memory(2 * SMALL):
        for path in leaves(tree):
            for value in VALUES:
                if random.random() > share:
                    continue
                change = functools.partial(set_value, path=path, value=value)
                files = with_config(model_files(kind), change, name)
                tried += 1
                try:
                    with np.errstate(all="ignore"):
                        evaluate_model(kind, files)
                except TacpipeError as error:
                    assert is_sentence(str(error)), str(error)
    count("hostile inputs refused", tried)


@pytest.mark.parametrize("kind", sample_cases(KINDS, 1))
def test_a_configuration_that_was_changed_gives_a_sentence_or_a_result(kind: str) -> None:
    try_config(kind, "config.json", 0.02)


@pytest.mark.faults
@pytest.mark.parametrize("kind", KINDS)
def test_a_configuration_that_was_changed_anyhow_gives_a_sentence_or_a_result(kind: str) -> None:
    try_config(kind, "config.json", 0.15)


@pytest.mark.faults
def test_a_codec_that_was_changed_anyhow_gives_a_sentence_or_a_result() -> None:
    try_config("forward recurrent", "codec.json", 1.0)


@pytest.mark.parametrize("kind", sample_cases(KINDS, 2))
@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"null", b'{"task": []}', b"[" * 100_000, b"\xff\xfe", b'{"task": "os"}']
)
def test_a_configuration_that_is_none_is_refused(kind: str, content: bytes) -> None:
    check_refusal(lambda: load_model(kind, model_files(kind) | {"config.json": content}))


SIZES: dict[str, tuple[str, tuple[Any, ...]]] = {
    "hidden units of a forecaster": ("forward gru", ("params", "hidden")),
    "hidden units of the paper's": ("forward recurrent", ("params", "hidden")),
    "context": ("forward gru", ("context",)),
    "horizon": ("forward gru", ("horizon",)),
    "hidden units of an autoencoder": ("material raec", ("shapes", "biotac", "hidden")),
    "channels": ("material raec", ("shapes", "biotac", "channels")),
    "frames": ("material raec", ("sensors", "biotac", "frames")),
    "points": ("touch pointnet", ("params", "points")),
    "draws": ("touch pointnet", ("params", "draws")),
}


@pytest.mark.parametrize("case", sample_cases(sorted(SIZES, key=lambda case: SIZES[case][0] not in KINDS[:2]), 1))
@pytest.mark.parametrize("size", [10**7, 10**9, 10**12, 1 << 70])
def test_a_size_that_the_weights_do_not_have_is_refused_before_memory_is_taken(case: str, size: int) -> None:
    kind, path = SIZES[case]
    check_refusal(
        lambda: load_model(kind, with_config(model_files(kind), lambda config: set_value(config, path, size)))
    )


def weights(files: Files, change: Callable[[dict[str, torch.Tensor]], Any], name: str = "model.safetensors") -> Files:
    tensors = {key: value.clone() for key, value in load(files[name]).items()}
    change(tensors)
    return files | {name: save(tensors)}


@pytest.mark.parametrize("kind", sample_cases(KINDS, 2))
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_weights_that_are_not_finite_are_refused(kind: str, value: float) -> None:
    def spoil(tensors: dict[str, torch.Tensor]) -> None:
        name = next(
            key for key, tensor in sorted(tensors.items()) if tensor.is_floating_point() and "chosen" not in key
        )
        tensors[name].view(-1)[0] = value

    check_refusal(lambda: load_model(kind, weights(model_files(kind), spoil)))


@pytest.mark.parametrize("kind", sample_cases(KINDS, 2))
@pytest.mark.parametrize("change", ["lost", "another shape", "transposed", "one more axis", "empty", "whole numbers"])
def test_weights_of_other_shapes_are_refused(kind: str, change: str) -> None:
    def spoil(tensors: dict[str, torch.Tensor]) -> None:
        name = max(tensors, key=lambda key: (tensors[key].dim(), tensors[key].numel()))
        tensor = tensors.pop(name)
        if change != "lost":
            tensors[name] = {
                "another shape": torch.cat([tensor, tensor]),
                "transposed": tensor.flatten()[: tensor.numel() - 1],
                "one more axis": tensor[None].clone(),
                "empty": tensor[:0].clone(),
                "whole numbers": (tensor.flatten() * 0 + 1 << 20).to(torch.int64)
                if not tensor.is_floating_point()
                else tensor[..., :-1],
            }[change].contiguous()

    check_refusal(lambda: evaluate_model(kind, weights(model_files(kind), spoil)))


@pytest.mark.parametrize("change", ["lost", "one more", "not finite", "a size without values"])
def test_weights_of_an_image_encoder_that_do_not_fit_are_refused(change: str) -> None:
    tensors = {name: value for name, value in _Network(2).state_dict().items() if name.startswith("encoder.")}
    images = np.full((1, ROWS, COLUMNS, 3), 7, np.uint8)
    assert read_encoder(save(tensors))(images).shape == (1, 2)
    if change == "lost":
        del tensors["encoder.0.bias"]
    elif change == "one more":
        tensors["decoder.0.bias"] = torch.zeros(2)
    elif change == "not finite":
        tensors["encoder.0.bias"] = torch.full((16,), torch.nan)
    else:
        tensors["encoder.7.weight"] = torch.zeros(1 << 40, 0)
    check_refusal(lambda: read_encoder(save(tensors)), "The weights do not fit this autoencoder")


def safetensors(header: Any, body: bytes = b"", length: int | None = None) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + body


def a_tensor(kind: str = "F32", shape: Any = (2,), offsets: Any = (0, 8)) -> dict[str, Any]:
    return {"a": {"dtype": kind, "shape": shape, "data_offsets": offsets}}


HEADERS = {
    "nothing": b"",
    "a length beyond the file": safetensors({}, length=1 << 62),
    "a length of half the memory": safetensors({}, length=1 << 30),
    "no JSON": safetensors(b"{" * 1000),
    "brackets": safetensors(b'{"a":' + b"[" * 100_000),
    "a shape of terabytes": safetensors(a_tensor(shape=(1 << 20, 1 << 20, 1 << 20)), bytes(8)),
    "a shape that overflows": safetensors(a_tensor(shape=(1 << 32, 1 << 32)), bytes(8)),
    "a negative shape": safetensors(a_tensor(shape=(-1, -2)), bytes(8)),
    "offsets beyond the file": safetensors(a_tensor(offsets=(0, 1 << 40)), bytes(8)),
    "offsets that run backwards": safetensors(a_tensor(offsets=(8, 0)), bytes(8)),
    "a type that is none": safetensors(a_tensor(kind="O"), bytes(8)),
    "a pickle": pickle.dumps({"a": 1}),
    "an archive, as torch.save writes": b"PK\x03\x04" + bytes(500),
}


@pytest.mark.parametrize("kind", sample_cases(KINDS, 2))
@pytest.mark.parametrize("case", HEADERS)
def test_weights_whose_header_lies_are_refused(kind: str, case: str) -> None:
    check_refusal(lambda: load_model(kind, model_files(kind) | {"model.safetensors": HEADERS[case]}), "safetensors")


@pytest.mark.parametrize("case", HEADERS)
@pytest.mark.parametrize("name", ["codec.safetensors", "baselines.safetensors"])
def test_codecs_and_baselines_whose_header_lies_are_refused(case: str, name: str) -> None:
    files = model_files("forward recurrent")
    check_refusal(lambda: load_model("forward recurrent", files | {name: HEADERS[case]}), "safetensors")


@pytest.mark.faults
@pytest.mark.parametrize("kind", KINDS)
def test_files_of_a_model_changed_in_hundreds_of_ways_give_a_sentence_or_a_result(kind: str) -> None:
    files, random = model_files(kind), Random(0)
    with bound_memory(2 * SMALL):
        for _ in range(150):
            name = random.choice(list(files))
            try:
                with np.errstate(all="ignore"):
                    evaluate_model(kind, files | {name: mutate(files[name], list(files.values()), random)})
            except TacpipeError as error:
                assert is_sentence(str(error)), str(error)
    count("inputs fuzzed", 150)


def test_trees_whose_nodes_lead_back_are_refused_and_not_gone_round_for_ever() -> None:
    def spoil(tensors: dict[str, torch.Tensor]) -> None:
        name = next(key for key in tensors if key.endswith("children"))
        tensors[name][3] = torch.tensor([0, 0], dtype=tensors[name].dtype)

    check_refusal(
        lambda: load_model("touch strong", weights(model_files("touch strong"), spoil)), "children of a forest"
    )


@pytest.mark.parametrize("part", ["roots", "children", "features"])
@pytest.mark.parametrize("value", [-2, 1 << 30])
def test_trees_that_point_beyond_their_nodes_are_refused(part: str, value: int) -> None:
    def spoil(tensors: dict[str, torch.Tensor]) -> None:
        name = next(key for key in tensors if key.endswith(part))
        tensors[name].view(-1)[0] = value

    check_refusal(lambda: load_model("touch strong", weights(model_files("touch strong"), spoil)), "forest")


def test_a_forest_as_it_was_grown_is_one() -> None:
    rng = np.random.default_rng(0)
    grown = Forest.fit(rng.normal(size=(60, 4)), rng.normal(size=(60, 3)), trees=5, leaf=2, seed=0)
    grown.validate(4, 3)
    for features, values in ((3, 3), (4, 2)):
        with pytest.raises(ValueError):
            grown.validate(features, values)


# ---- as commands


EVIL = (
    "model.pt",
    "model.pkl",
    "model.bin",
    "pytorch_model.bin",
    "checkpoint.pt",
    "config.pkl",
    "codec.pkl",
    "weights.npy",
)


@pytest.mark.faults
def test_programs_beside_a_model_are_never_opened(chained: Path) -> None:
    """Pickles lie in the folder of a model and of latents, and beside them; all that reads models reads these."""
    trace = chained / "opened"
    for folder in ("models/forward", "data/latents", "results/forward", "."):
        for name in EVIL:
            (chained / folder / name).write_bytes(pickle.dumps(Opened(trace)))
        torch.save({"a": Opened(trace)}, chained / folder / "last.pt")
    for command in (
        "evaluate models/forward data/latents --split data/split -o results/again",
        "predict models/forward data/latents --split data/split -o results/told",
        "report results/forward -o again.html",
        f"{chain.TRAIN} --epochs 1 --init models/forward -o models/on",
    ):
        process = ran(chained, command)
        assert process.returncode == 0, process.stderr
    assert tacpipe.load(chained / "models/forward") is not None
    assert not trace.exists()
    pickle.loads((chained / "models/forward/model.pkl").read_bytes())  # A careless reader does this.
    assert trace.exists()
    count("hostile inputs refused", 4 * (len(EVIL) + 1))
