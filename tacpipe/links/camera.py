"""Depth cameras: Intel RealSense, through Open3D. Each entry is one image of depth and colour."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np

from tacpipe.clouds.cloud import DepthFrame
from tacpipe.errors import DeviceError, UsageError
from tacpipe.links.link import Arrived, Opened
from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Sensor

PAUSE_S = 0.002  # pause between polls; frames are at least 11 ms apart


def open_camera(place: str, sensor: Sensor, name: str) -> CameraLink:
    """Return the open camera of this number, or of this serial number.

    Raises `DeviceError` where it is not connected, or held by another program, `MissingModuleError` without Open3D.
    """
    with extras.explain_missing(name):
        import open3d
    kind = getattr(open3d.t.io, "RealSenseSensor", None)
    if kind is None:
        raise DeviceError(f"{name}: this Open3D was built without RealSense; record clouds by folder:PATH instead.")
    serials = [str(device.serial) for device in kind.enumerate_devices()]
    serial = _serial(place, serials, name)
    camera = kind()
    try:
        camera.init_sensor(open3d.t.io.RealSenseSensorConfig({"serial": serial}), 0)
        camera.start_capture()
    except RuntimeError as error:
        raise DeviceError(
            f"{name}: the RealSense {serial} does not start; stop other programs that use it, and connect it to a "
            f"USB 3 port."
        ) from error
    return CameraLink(name, camera)


def _serial(place: str, serials: list[str], name: str) -> str:
    """Return the serial number of the camera that ``place``, a number or a serial number, names."""
    if place in serials:
        return place
    if not place.isdigit():
        raise UsageError(f"camera:{place} names no camera; it should read camera:0, or hold a serial number.")
    if len(place) < 4 and int(place) < len(serials):
        return serials[int(place)]
    described = f"there are {', '.join(serials)}" if serials else "there is none at all"
    raise DeviceError(f"{name}: no RealSense camera {place} is connected; {described}. Plug it in to a USB 3 port.")


class CameraLink(Opened):
    """An open RealSense camera."""

    packets = True

    def __init__(self, name: str, camera: Any) -> None:
        super().__init__(name)
        self.camera = camera
        metadata = camera.get_metadata()
        matrix = np.asarray(metadata.intrinsics.intrinsic_matrix)
        self._focal = float(matrix[0, 0]), float(matrix[1, 1])
        self._centre = float(matrix[0, 2]), float(matrix[1, 2])
        self._unit_m = 1 / float(metadata.depth_scale)  # RealSense states counts per metre

    def _receive(self, timeout_s: float) -> Arrived:
        until = time.monotonic() + timeout_s
        while True:
            try:
                image = self.camera.capture_frame(wait=False, align_depth_to_color=True)
            except RuntimeError as error:
                raise self.lost("it was unplugged") from error
            if not image.is_empty():
                t_ns = time.monotonic_ns()
                depth, colours = (
                    np.asarray(image.depth.as_tensor().numpy()),
                    np.asarray(image.color.as_tensor().numpy()),
                )
                frame = DepthFrame(depth[..., 0], self._focal, self._centre, self._unit_m, colours)
                return [(t_ns, frame.to_bytes())]
            if self._closed or time.monotonic() >= until:
                return []
            time.sleep(PAUSE_S)

    def _release(self) -> None:
        with contextlib.suppress(RuntimeError):  # the camera was unplugged
            self.camera.stop_capture()
