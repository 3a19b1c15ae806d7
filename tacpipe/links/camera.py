"""Read Intel RealSense depth cameras through Open3D. Each entry is one image of depth and colour."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np

from tacpipe.clouds.cloud import DepthFrame
from tacpipe.errors import DeviceError, UsageError
from tacpipe.links.link import Arrived, OpenLink
from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Sensor

PAUSE_S = 0.002  # pause between polls; frames are at least 11 ms apart


def open_camera(target: str, sensor: Sensor, name: str) -> CameraLink:
    """Open the camera with this index or serial number.

    Raises `DeviceError` if it is not connected or used by another program, and `MissingModuleError` without Open3D.
    """
    with extras.explain_missing(name):
        import open3d
    sensor_class = getattr(open3d.t.io, "RealSenseSensor", None)
    if sensor_class is None:
        raise DeviceError(f"{name}: this Open3D was built without RealSense; record clouds by folder:PATH instead.")
    serials = [str(device.serial) for device in sensor_class.enumerate_devices()]
    serial = _serial(target, serials, name)
    camera = sensor_class()
    try:
        camera.init_sensor(open3d.t.io.RealSenseSensorConfig({"serial": serial}), 0)
        camera.start_capture()
    except RuntimeError as error:
        raise DeviceError(
            f"{name}: the RealSense {serial} does not start; stop other programs that use it, and connect it to a "
            f"USB 3 port."
        ) from error
    return CameraLink(name, camera)


def _serial(target: str, serials: list[str], name: str) -> str:
    """Return the serial number of the camera at ``target``, which is an index or a serial number.

    Raises `UsageError` for another target, and `DeviceError` if the camera is not connected.
    """
    if target in serials:
        return target
    if not target.isdigit():
        raise UsageError(
            f"camera:{target} is not a camera; write camera:INDEX, such as camera:0, or camera:SERIAL_NUMBER."
        )
    if len(target) < 4 and int(target) < len(serials):
        return serials[int(target)]
    connected = f"there are {', '.join(serials)}" if serials else "there is none at all"
    raise DeviceError(f"{name}: no RealSense camera {target} is connected; {connected}. Connect it to a USB 3 port.")


class CameraLink(OpenLink):
    """An open RealSense camera."""

    packets = True

    def __init__(self, name: str, camera: Any) -> None:
        super().__init__(name)
        self.camera = camera
        metadata = camera.get_metadata()
        matrix = np.asarray(metadata.intrinsics.intrinsic_matrix)
        self._focal = float(matrix[0, 0]), float(matrix[1, 1])
        self._centre = float(matrix[0, 2]), float(matrix[1, 2])
        self._unit_m = 1 / float(metadata.depth_scale)  # RealSense reports counts per metre, not metres per count

    def _receive(self, timeout_s: float) -> Arrived:
        """Return the next image as a depth frame, or nothing after ``timeout_s``.

        Raises `LinkLostError` without the camera.
        """
        deadline = time.monotonic() + timeout_s
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
            if self._closed or time.monotonic() >= deadline:
                return []
            time.sleep(PAUSE_S)

    def _release(self) -> None:
        with contextlib.suppress(RuntimeError):  # the camera was unplugged
            self.camera.stop_capture()
