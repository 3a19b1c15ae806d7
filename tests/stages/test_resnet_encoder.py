"""The encoder of docs/extending/encoder.md, a ResNet of torchvision, with weights from a local file."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import test_docs as docs
from tests.stages.test_extract import extract, frames_of
from tests.video import videos

PAGE = docs.ROOT / "docs/extending/encoder.md"
pytestmark = pytest.mark.long


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The function that the page prints. Skipped without a torchvision that works with the installed torch."""
    try:
        import torchvision  # type: ignore[import-not-found]  # noqa: F401
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"needs torchvision: {error}")
    (block,) = [block for block in docs.fenced_blocks(PAGE.read_text()) if block.title == "resnet_encoder.py"]
    (tmp_path / "resnet_encoder.py").write_text(block.text)
    monkeypatch.syspath_prepend(tmp_path)
    import resnet_encoder  # type: ignore[import-not-found]

    yield resnet_encoder.load
    del sys.modules["resnet_encoder"]


def write_weights(path: Path, seed: int) -> Path:
    """Write randomly initialised weights in torchvision's format."""
    import torch
    from torchvision.models import resnet18  # type: ignore[import-not-found]

    torch.manual_seed(seed)
    torch.save(resnet18().state_dict(), path)
    return path


def test_each_frame_has_the_512_features_of_the_weights_in_the_file(
    load: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tacpipe.plugins.registry.load_encoder", lambda name: load)
    path = videos.write(tmp_path / "gel.mp4", "libx264", 5)
    features = []
    for seed in (0, 1):
        weights = write_weights(tmp_path / f"resnet{seed}.pth", seed)
        table = extract({"gel": frames_of(path)}, "extract.encoder", encoder="resnet18", weights=str(weights))["gel"]
        assert table.column_names == ["t_ns", "seq", *(f"feature{number:03d}" for number in range(1, 513))]
        values = np.column_stack([table.column(name).to_numpy() for name in table.column_names[2:]])
        expected = load(weights)(np.stack([*videos.decoded(path), *[videos.decoded(path)[-1]] * 27]))[:5]
        np.testing.assert_array_equal(values, expected)
        features.append(values)
    assert np.abs(features[0] - features[1]).mean() > 0.01
