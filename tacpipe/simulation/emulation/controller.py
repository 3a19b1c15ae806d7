"""Send the plans of an emulated controller of an arm."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator

from tacpipe.arrays import Floats, Times
from tacpipe.sensors import plan
from tacpipe.simulation import pick_and_move


@contextlib.contextmanager
def send_plans(poses_at: Callable[[Times], Floats], epoch_ns: int, port: int, rate_hz: float) -> Iterator[None]:
    """Send plans at a rate to a UDP port of this computer in the block.

    ``poses_at`` returns the poses (time, 7) at times since ``epoch_ns`` on the monotonic clock.
    """
    is_over = threading.Event()
    offset_ns = time.time_ns() - time.monotonic_ns()

    def send_repeatedly() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as controller:
            while not is_over.wait(1 / rate_hz):
                t_ns = time.monotonic_ns() - epoch_ns + pick_and_move.plan_points_ns()
                packet = plan.packet((t_ns + epoch_ns + offset_ns).tolist(), poses_at(t_ns))
                controller.sendto(packet, ("127.0.0.1", port))

    controller = threading.Thread(target=send_repeatedly, daemon=True)
    controller.start()
    try:
        yield
    finally:
        is_over.set()
        controller.join()
