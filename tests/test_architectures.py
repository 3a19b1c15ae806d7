"""Architectures of other packages: choices like built-in ones, their version in keys, and why one does not fit."""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tacpipe.errors import ResultWarning, TacpipeError
from tacpipe.plugins import architectures, given_params, registry
from tacpipe.plugins import params as params_of
from tests.conftest import Ran, forget, run_python, write_plugin

MODULE = '''
from dataclasses import dataclass
from typing import Any, Literal

from tacpipe.plugins.constraints import PositiveInt
from tacpipe.tasks.forward.params import ForwardModelParams
from tacpipe.tasks.material.params import MaterialModelParams, NetworkParams
from tacpipe.tasks.touch.params import Patches


@dataclass(frozen=True)
class Plain(ForwardModelParams):
    """A linear map of the last row."""

    architecture: Literal["plain"] = "plain"  # plain: a linear map
    width: PositiveInt = 3  # of nothing
    returned: Literal["right", "wrong"] = "right"

    def build(self, shape):
        """Return the network."""
        from torch import nn

        class Last(nn.Module):
            def __init__(self, wrong):
                super().__init__()
                self.layer, self.wrong = nn.Linear(shape.past + shape.plan, shape.features), wrong

            def forward(self, past, plan):
                import torch

                found = self.layer(torch.cat([past[-1].expand(len(plan), -1, -1), plan], -1))
                return found[1:] if self.wrong else found

        return Last(self.returned == "wrong")


@dataclass(frozen=True)
class Scores(NetworkParams):
    """The mean of each channel, weighed."""

    architecture: Literal["scores"] = "scores"

    def build(self, shape):
        """Return the network."""
        from torch import nn

        class Mean(nn.Module):
            def __init__(self):
                super().__init__()
                self.layer = nn.Linear(shape.channels, shape.classes)

            def forward(self, frames):
                return self.layer(frames.mean(dim=0))

        return Mean()


@dataclass(frozen=True)
class Flat(Patches):
    """The middle of a patch."""

    architecture: Literal["flat"] = "flat"

    def build(self, shape):
        """Return the network."""
        from torch import nn

        class Middle(nn.Module):
            def __init__(self):
                super().__init__()
                self.layer = nn.Linear(shape.channels + shape.numbers, shape.values)

            def forward(self, points, numbers):
                import torch

                return self.layer(torch.cat([points.mean(dim=(1, 2)), numbers], dim=1))

        return Middle()


@dataclass(frozen=True)
class Unfinished(MaterialModelParams):
    """A classifier that nothing fits."""

    architecture: Literal["unfinished"] = "unfinished"


@dataclass(frozen=True)
class Majority(MaterialModelParams):
    """Names the most frequent material of each sensor."""

    architecture: Literal["majority"] = "majority"

    def fit(self, slides):
        """Return the most frequent material of the training slides by sensor."""
        materials = {sensor: some.materials.tolist() for sensor, some in slides.training.items()}
        return {f"{sensor}.txt": str(max(set(names), key=names.count)).encode() for sensor, names in materials.items()}


@dataclass(frozen=True)
class Double(ForwardModelParams):
    """A name that the library has."""

    architecture: Literal["double", "gru"] = "double"

    def build(self, shape):
        """Return nothing."""


class Odd:
    """Not params of the task."""
'''
ENTRIES = """[tacpipe.models]
forward.plain = lab_architectures:Plain
forward.double = lab_architectures:Double
forward.odd = lab_architectures:Odd
forward.lost = nowhere_at_all:Lost
material.scores = lab_architectures:Scores
material.majority = lab_architectures:Majority
material.unfinished = lab_architectures:Unfinished
touch.flat = lab_architectures:Flat
"""


def declare(folder: Path, version: str) -> None:
    """Write the metadata of the package."""
    write_plugin(folder, "lab_architectures", ENTRIES)
    about = f"Metadata-Version: 2.1\nName: lab-architectures\nVersion: {version}\n\nText: no\n"
    (folder / "lab_architectures.egg-info" / "PKG-INFO").write_text(about)
    forget()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "lab_architectures.py").write_text(MODULE)
    monkeypatch.syspath_prepend(folder)
    declare(folder, "1.0")
    yield folder
    sys.modules.pop("lab_architectures", None)
    forget()


def build_train_params(task: str, **options: Any) -> Any:
    """Return the params of `tacpipe train TASK` for some options."""
    name = f"train.{task}"
    return given_params.build(name, registry.load(name), options=options)


def test_every_choice_of_a_built_in_architecture_but_the_automatic_one_is_an_entry_point() -> None:
    for task in registry.tasks():
        stage = registry.load(f"train.{task}")
        choices = [choice for kind in params_of.kinds(stage) for choice in params_of.choices(kind, "architecture")]
        assert {*choices} - {"auto"} == {*registry.architectures(task)} - {"auto"}
        assert params_of.kinds(stage)[0]().architecture == stage.params.__dataclass_fields__["architecture"].default


def test_an_architecture_of_another_package_is_a_choice_and_its_params_are_options(package: Path) -> None:
    assert build_train_params("forward", architecture="plain", width=5).width == 5
    with pytest.raises(TacpipeError, match="--width belongs to the architecture plain"):
        build_train_params("forward", architecture="gru", width=5)
    with pytest.raises(TacpipeError, match="--dropout belongs to"):
        build_train_params("forward", architecture="plain", dropout=0.1)
    stage = registry.load("train.forward")
    assert set(params_of.panels(stage)) == set(params_of.fields(stage))
    assert params_of.panels(stage)["width"] == "Model"


def test_the_help_shows_it_in_a_panel_and_imports_nothing_heavy(
    package: Path, call: Callable[[str], Ran], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = call("train forward --architecture plain --help").out
    model = text.split("Model:")[1].split("Training:")[0]
    assert "|plain]" in model and "--width" in model
    probe = (
        "import sys; from tacpipe.cli import main; sys.argv = ['tacpipe', 'train', 'forward', '--help']\ntry:\n    "
        "main.main()\nexcept SystemExit:\n    pass\nassert 'lab_architectures' in sys.modules\nassert not {'torch', "
        "'sklearn', 'pyarrow', 'pandas', 'numpy'} & set(sys.modules)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(package))
    run_python(Path(), "-c", probe, check=True)


def test_name_and_version_of_the_package_are_in_keys_and_those_of_built_in_ones_are_as_before(package: Path) -> None:
    params = build_train_params("forward", architecture="plain")
    assert params_of.to_json(params)["plugin"] == "lab-architectures 1.0"
    assert "plugin" not in params_of.to_json(build_train_params("forward", architecture="gru"))
    before = params_of.to_json(params)
    declare(package, "1.1")
    assert params_of.to_json(params)["plugin"] == "lab-architectures 1.1"
    stage = registry.load("train.forward")
    with pytest.raises(TacpipeError, match=r"lab-architectures 1\.0, and lab-architectures 1\.1"):
        params_of.from_json(stage, before)  # a worker, or a result that is computed again
    assert params_of.from_json(stage, params_of.to_json(params)) == params
    with pytest.warns(ResultWarning, match=r"lab-architectures 1\.0, and lab-architectures 1\.1 is installed"):
        assert params_of.read(stage.params, before, "config.json") == params  # a model opens where its weights fit


def test_a_model_without_its_package_names_architecture_package_and_version(package: Path) -> None:
    stored = params_of.to_json(build_train_params("forward", architecture="plain"))
    (package / "lab_architectures.egg-info" / "entry_points.txt").write_text("")
    forget()
    stage = registry.load("train.forward")
    for read, owner in ((params_of.read, stage.params), (params_of.from_json, stage)):
        place = ("config.json",) if read is params_of.read else ()
        with pytest.raises(TacpipeError, match=r"'plain' comes from the package lab-architectures 1\.0"):
            read(owner, stored, *place)


def test_an_architecture_without_a_way_to_learn_is_no_choice_and_the_reason_names_the_method(package: Path) -> None:
    assert "unfinished" not in params_of.fields(registry.load("train.material"))["architecture"].__args__
    with pytest.raises(TacpipeError, match="must be a class with the methods fit"):
        build_train_params("material", architecture="unfinished")


@pytest.mark.parametrize(
    ("name", "reason"),
    [("lost", "nowhere_at_all"), ("odd", "must be a dataclass that extends"), ("double", "has the choice gru")],
)
def test_one_that_does_not_fit_spoils_itself_alone_and_says_why(package: Path, name: str, reason: str) -> None:
    assert build_train_params("forward", architecture="gru").architecture == "gru"
    assert name not in params_of.fields(registry.load("train.forward"))["architecture"].__args__
    with pytest.raises(TacpipeError, match=reason):
        build_train_params("forward", architecture=name)


@pytest.mark.long
def test_a_forward_network_is_trained_stored_and_read_back_and_another_shape_is_refused(
    package: Path, tmp_path: Path
) -> None:
    from tests.tasks.forward import trials

    files = trials.trained(tmp_path, architecture="plain", epochs=1, baselines=False)
    assert "network.layer.weight" in str(files["model.safetensors"][:2000])
    assert json.loads(files["config.json"])["params"]["plugin"] == "lab-architectures 1.0"
    with pytest.raises(TacpipeError, match=r"architecture plain returns \(\d+, 2, \d+\).*\(horizon, window, feature\)"):
        trials.trained(tmp_path / "wrong", architecture="plain", returned="wrong", epochs=1)


def test_plain_networks_of_material_and_touch_are_called_as_they_promise(package: Path) -> None:
    import torch

    from tacpipe.models.recurrent_autoencoder import AutoencoderShape
    from tacpipe.tasks.material import networks
    from tacpipe.tasks.touch import members

    scores = build_train_params("material", architecture="scores")
    scores_network = networks.build_network(scores, AutoencoderShape(channels=4, classes=3))
    networks.check_network(scores_network, scores, torch.zeros(5, 8, 4), 3)
    with pytest.raises(TacpipeError, match=r"returns \(2, 3\) for 2 slides.*\(2, 4\)"):
        networks.check_network(scores_network, scores, torch.zeros(5, 8, 4), 4)
    flat = build_train_params("touch", architecture="flat")
    network = members.network(flat, ["pdc_th"])
    read = flat.point_inputs
    prediction = network(torch.zeros(2, 3, 7, read.channels), torch.zeros(2, read.grasp_numbers))
    assert prediction.shape == (2, 1)


def test_an_architecture_that_extends_none_of_the_two_is_trained_by_its_own_fit(package: Path, tmp_path: Path) -> None:
    from tacpipe.tasks.material import network_training
    from tests.tasks.material import textures

    params = build_train_params("material", architecture="majority", baselines=False)
    recordings = textures.dataset(
        *(textures.slide("biotac", material, trial) for material, trial in [(1, 0), (3, 0), (3, 1), (4, 0)])
    )
    assert network_training.train(params, recordings, None, tmp_path) == {"biotac.txt": b"3"}


def test_reports_name_an_architecture_as_its_class_states_it_and_others_by_their_choice(package: Path) -> None:
    from tacpipe.tasks.material.params import Params

    titles = [
        architectures.find_or(Params, name).TITLE or name
        for name in ("raec", "x-lstm", "statistics", "scores", "uninstalled")
    ]
    assert titles == ["RAEC", "X-LSTM", "statistics", "scores", "uninstalled"]


def test_a_codec_that_is_not_installed_is_named_with_its_package() -> None:
    from tacpipe.codecs import codec

    files = {"codec.json": b'{"kind": "wavelet", "plugin": "lab-codecs 2.0"}', "codec.safetensors": b""}
    with pytest.raises(TacpipeError, match=r"'wavelet' comes from the package lab-codecs 2\.0.*autoencoder, pca"):
        codec.load(files)
    assert registry.codecs() == ["autoencoder", "pca"]
    assert architectures.task(dict) is None
