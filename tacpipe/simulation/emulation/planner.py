"""Send the planned motion of an emulated hand, as the controller of an arm would."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

from tacpipe.sensors import plan
from tacpipe.simulation import pick_and_move
from tacpipe.simulation.emulation.emulator import Emulator


@contextlib.contextmanager
def send_plans(emulator: Emulator, port: int, rate_hz: float) -> Iterator[None]:
    """Send plans at a rate to a UDP port of this computer in the block."""
    is_over = threading.Event()
    offset_ns = time.time_ns() - time.monotonic_ns()

    def send_repeatedly() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as controller:
            while not is_over.wait(1 / rate_hz):
                since_ns = time.monotonic_ns() - emulator.epoch_ns
                t_ns = since_ns + pick_and_move.plan_points_ns()
                poses = emulator.world.arm(t_ns)[:, 1:]
                packet = plan.packet((t_ns + emulator.epoch_ns + offset_ns).tolist(), poses)
                controller.sendto(packet, ("127.0.0.1", port))

    controller = threading.Thread(target=send_repeatedly, daemon=True)
    controller.start()
    try:
        yield
    finally:
        is_over.set()
        controller.join()
