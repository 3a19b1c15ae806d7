"""Test that a depth camera returns one image per entry, and that a missing one raises an error."""

from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from tacpipe.clouds.cloud import DepthFrame
from tacpipe.errors import DeviceError, UsageError
from tacpipe.links.link import LinkLostError
from tests.links.peers import Quiet, open_address

open3d = pytest.importorskip("open3d", reason="open3d is not installed")

DEPTH = np.arange(12, dtype=np.uint16).reshape(3, 4) * 100
COLOURS = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)


class RealSense:
    """A stand-in for Open3D's sensor, with images of the test."""

    images: ClassVar[list[Any]] = []

    @staticmethod
    def enumerate_devices() -> list[Any]:
        return [SimpleNamespace(serial="831612070000"), SimpleNamespace(serial="831612071111")]

    def init_sensor(self, config: Any, index: int) -> bool:
        return True

    def start_capture(self) -> bool:
        return True

    def stop_capture(self) -> None:
        self.images.clear()

    def get_metadata(self) -> Any:
        matrix = np.array([[600.0, 0, 2], [0, 610, 1.5], [0, 0, 1]])
        return SimpleNamespace(intrinsics=SimpleNamespace(intrinsic_matrix=matrix), depth_scale=1000.0)

    def capture_frame(self, *, wait: bool, align_depth_to_color: bool) -> Any:
        image = self.images.pop(0) if self.images else open3d.t.geometry.RGBDImage()
        if isinstance(image, Exception):
            raise image
        return image


@pytest.fixture
def connected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open3d.t.io, "RealSenseSensor", RealSense)
    colours = open3d.t.geometry.Image(open3d.core.Tensor(COLOURS))
    depth = open3d.t.geometry.Image(open3d.core.Tensor(DEPTH[..., None]))
    RealSense.images = [open3d.t.geometry.RGBDImage(colours, depth)]


@pytest.mark.usefixtures("connected")
@pytest.mark.parametrize("place", ["1", "831612071111"])
def test_an_image_carries_depth_colours_and_how_its_rays_run(place: str) -> None:
    link = open_address(f"camera:{place}", Quiet())
    ((_, content),) = link.read(1)
    frame = DepthFrame.from_bytes(content)

    assert frame.depth.tolist() == DEPTH.tolist()
    assert frame.colours is not None and frame.colours.tolist() == COLOURS.tolist()
    assert (frame.focal, frame.centre) == ((600, 610), (2, 1.5))
    assert frame.unit_m == pytest.approx(0.001)
    assert link.read(0.01) == []
    link.close()


@pytest.mark.usefixtures("connected")
def test_a_camera_that_is_unplugged_is_lost() -> None:
    RealSense.images = [RuntimeError("device disconnected")]
    link = open_address("camera:0", Quiet())
    with pytest.raises(LinkLostError):
        link.read(1)
    link.close()


@pytest.mark.usefixtures("connected")
def test_a_camera_that_is_gone_can_still_be_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    link = open_address("camera:0", Quiet())

    def fail_to_stop(camera: RealSense) -> None:
        raise RuntimeError("device disconnected")

    monkeypatch.setattr(RealSense, "stop_capture", fail_to_stop)
    link.close()
    with pytest.raises(LinkLostError):
        link.read(0)


@pytest.mark.usefixtures("connected")
def test_a_camera_that_is_not_there_lists_those_that_are() -> None:
    with pytest.raises(DeviceError, match=r"camera 2.*831612070000, 831612071111"):
        open_address("camera:2", Quiet())
    with pytest.raises(UsageError, match="camera:front"):
        open_address("camera:front", Quiet())


def test_without_any_camera_the_sentence_says_to_plug_one_in() -> None:
    if open3d.t.io.RealSenseSensor.enumerate_devices():
        pytest.skip("a RealSense is connected")
    with pytest.raises(DeviceError, match="camera 0"):
        open_address("camera:0", Quiet())
