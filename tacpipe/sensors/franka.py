"""Franka Research 3 arms by the Franka Control Interface (FCI), version 10: the whole state of the robot every millisecond.

A TCP connection to port 1337 asks for the state, which then comes by UDP as long as the connection stays: a u64 count of
milliseconds and 1369 bytes, packed, little-endian, numbers as float32. Reading takes no right to move the arm. The Panda
(FER) speaks FCI 5, whose layout differs. Source: the layout that libfranka publishes, as franky-sim 1.0.4 sends it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import Bools, Bytes, Float32s, Floats
from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors.framing import Framer, PacketFramer
from tacpipe.sensors.sensor import Ask, Device, Dialogue, LocalAddress, Samples, Sensor
from tacpipe.signals import kinematics

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = 10
HEADER = struct.Struct("<III")  # command, number of the message, its size in bytes with this header
CONNECT = struct.Struct("<IIIHH")  # header, version, UDP port that the state is sent to
CONNECTED = struct.Struct("<IIIHH4x")  # header, status, version of the robot
CONNECT_COMMAND, DONE, OTHER_VERSION = 0, 0, 1
LARGEST = 1 << 20  # bytes of a message; more is none
RATE_HZ = 1000.0  # fixed
JOINTS = 7
FLAGS = 41  # kinds of errors
AFFINE = 1e-3  # tolerance of the last row of a pose to (0, 0, 0, 1)

POSE, INERTIA = 16, 9  # matrices, column after column
FLOATS = {  # names and counts of numbers, in their order
    **dict.fromkeys(("O_T_EE", "O_T_EE_d", "F_T_EE", "EE_T_K", "F_T_NE", "NE_T_EE"), POSE),
    **{"m_ee": 1, "I_ee": INERTIA, "F_x_Cee": 3, "m_load": 1, "I_load": INERTIA, "F_x_Cload": 3},
    **{"elbow": 2, "elbow_d": 2},
    **dict.fromkeys(("tau_J", "tau_J_d", "dtau_J", "q", "q_d", "dq", "dq_d", "ddq_d"), JOINTS),
    **{"joint_contact": JOINTS, "cartesian_contact": 6, "joint_collision": JOINTS, "cartesian_collision": 6},
    **{"tau_ext_hat_filtered": JOINTS, "O_F_ext_hat_K": 6, "K_F_ext_hat_K": 6},
    **{"O_dP_EE_d": 6, "O_ddP_O": 3, "elbow_c": 2, "delbow_c": 2, "ddelbow_c": 2},
    **{"O_T_EE_c": POSE, "O_dP_EE_c": 6, "O_ddP_EE_c": 6},
    **{"theta": JOINTS, "dtheta": JOINTS, "accelerometer_top": 18, "accelerometer_bottom": 18},
}
STATE = np.dtype(
    [("message_id", "<u8")]
    + [(name, "<f4", count) for name, count in FLOATS.items()]
    + [("motion_mode", "u1"), ("control_mode", "u1"), ("errors", "u1", FLAGS), ("last_errors", "u1", FLAGS)]
    + [("robot_mode", "u1"), ("success_rate", "<f4")]
)
MEASURED, AIMED = "O_T_EE", "O_T_EE_d"  # poses
READ = (MEASURED, "q", "dq", "tau_J", "tau_ext_hat_filtered", "O_F_ext_hat_K", "success_rate")  # floats that are read
MODES = ("robot_mode", "motion_mode", "control_mode")
ERRORS = ("errors", "last_errors")


@dataclass(frozen=True)
class Franka(Sensor):
    """The arm of a Franka Research 3, without its hand."""

    summary: ClassVar[str] = "Franka Research 3 arms by the Franka Control Interface (FCI), version 10."
    links: ClassVar[tuple[str, ...]] = ("tcp+udp",)
    counter: ClassVar[int | None] = 1 << 62  # u64 milliseconds, of which none was ever sent beyond
    exclusive: ClassVar[str] = (
        "The arm serves one FCI connection: while this one reads, no other program can move it by FCI, nor can Desk; a "
        "program that moves it must send its state to a tap itself."
    )

    targets: bool = False  # the pose that the controller aims at (O_T_EE_d) is recorded too
    rate_hz: float = RATE_HZ  # fixed

    def __post_init__(self) -> None:
        if self.rate_hz != RATE_HZ:
            raise UsageError(f"franka: rate_hz is {self.rate_hz:g}; the arm always sends {RATE_HZ:g} states a second.")

    def fields(self) -> list[pa.Field]:
        """Return pose of the end effector, angles, velocities, torques, external torques, external load, modes, errors.

        With ``targets`` the pose that the controller aims at stands behind the load.

        Floats are widened to the float64 that arms have elsewhere; the load is that on the stiffness frame, in the frame
        of the base; errors are a bit each, in the order of the interface.
        """
        import pyarrow as pa

        from tacpipe.channels import schema

        angles, speeds = schema.joint_fields(JOINTS)
        external = [
            schema.float_field(f"joint{joint}_external_torque_nm", "N m", "external_torque")
            for joint in range(1, JOINTS + 1)
        ]
        status = {"unit": "1", "quantity": "status"}
        return [
            *schema.pose_fields(),
            *angles,
            *speeds,
            *schema.joint_torque_fields(JOINTS),
            *external,
            *schema.wrench_fields(),
            *(schema.target_pose_fields() if self.targets else []),
            pa.field("success_rate", pa.float32(), metadata={"unit": "1", "quantity": "share"}),
            *(pa.field(name, pa.uint8(), metadata=status) for name in MODES),
            *(pa.field(name, pa.uint64(), metadata=status) for name in ERRORS),
        ]

    def framer(self) -> Framer:
        """Return a framer that takes packets of a state's size whose numbers are finite, and whose pose is one."""
        poses = (MEASURED, AIMED) if self.targets else (MEASURED,)
        return PacketFramer([STATE.itemsize], lambda packets: _are_states(packets, *poses))

    def decode(self, frames: Bytes) -> Samples:
        """Return the samples of states, with their count of milliseconds for time and counter."""
        states = np.ascontiguousarray(frames).view(STATE)[:, 0]
        floats = [states[name].astype(np.float64) for name in READ[1:-1]]
        floats += [_poses(states, AIMED)] if self.targets else []
        count_ms = states["message_id"].astype(np.int64)
        return Samples(
            (
                np.hstack([_poses(states, MEASURED), *floats]),
                states["success_rate"][:, None].astype(np.float32),
                np.column_stack([states[name] for name in MODES]),
                np.column_stack([_packed(states[name]) for name in ERRORS]),
            ),
            seq=count_ms,
            t_device_ns=count_ms * 1_000_000,
        )

    def encode(self, samples: Samples) -> Bytes:
        """Return states that hold these samples, their other fields zero; the pose is exact to a float32."""
        floats, success_rate, modes, errors = samples.values
        assert samples.seq is not None
        states = np.zeros(len(samples), STATE)
        states["message_id"] = samples.seq
        states[MEASURED] = _flat(floats[:, :7])
        if self.targets:
            states[AIMED] = _flat(floats[:, -7:])
        place = 7
        for name in READ[1:-1]:
            states[name] = floats[:, place : place + FLOATS[name]]
            place += FLOATS[name]
        states["success_rate"] = success_rate[:, 0]
        for number, name in enumerate(MODES):
            states[name] = modes[:, number]
        for number, name in enumerate(ERRORS):
            states[name] = errors[:, number : number + 1] >> np.arange(FLAGS, dtype=np.uint64) & np.uint64(1)
        return states.view(np.uint8).reshape(len(samples), STATE.itemsize)

    def opening(self, local: LocalAddress) -> Dialogue:
        """Ask for the state at the port that the link listens on. Raises `DeviceError` if the arm refuses."""
        request = CONNECT.pack(CONNECT_COMMAND, 1, CONNECT.size, VERSION, local["port"])
        reply = yield Ask(request, whole, what="the arm's reply to a connection (FCI must be activated in Desk)")
        if len(reply) < CONNECTED.size:
            raise DeviceError(
                f"The arm's reply has {len(reply)} bytes; it should have {CONNECTED.size}. Is this an FCI?"
            )
        _, _, _, status, version = CONNECTED.unpack(reply[: CONNECTED.size])
        if status == OTHER_VERSION or version != VERSION:
            raise DeviceError(
                f"The arm speaks FCI version {version}, and {VERSION} can be read, that of the Franka Research 3. Update "
                f"its system, or record its state through a tap."
            )
        if status != DONE:
            raise DeviceError(f"The arm refused the connection with status {status}. Activate FCI in Desk.")

    def device(self) -> Device:
        """Return an arm that waits for a connection."""
        return _Arm(streaming=False)


class _Arm(Device):
    """The arm's side of a connection.

    It sends its state to ``port`` once that was given, and answers no other command.
    """

    port: int | None = None

    def hear(self, data: bytes) -> list[bytes]:
        self.heard += data
        replies = []
        while (size := whole(bytes(self.heard))) > 0:
            message = bytes(self.heard[:size])
            del self.heard[:size]
            command, number, _ = HEADER.unpack_from(message)
            if command == CONNECT_COMMAND and size == CONNECT.size:
                _, _, _, version, port = CONNECT.unpack(message)
                status = DONE if version == VERSION else OTHER_VERSION
                replies.append(CONNECTED.pack(command, number, CONNECTED.size, status, VERSION))
                if status == DONE:
                    self.streaming, self.port = True, port
        return replies


def whole(data: bytes) -> int:
    """Return how many bytes the message at the front of ``data`` takes, 0 while it is not whole.

    Raises `DeviceError` where none can begin there.
    """
    if len(data) < HEADER.size:
        return 0
    size = int(HEADER.unpack_from(data)[2])
    if not HEADER.size <= size <= LARGEST:
        raise DeviceError(f"A message of {size} bytes came where one of FCI should be. Is this the arm's address?")
    return size if len(data) >= size else 0


def _matrices(states: NDArray[np.void], name: str) -> Float32s:
    """Return a pose of the end effector in the base's frame as matrices (frame, 4, 4)."""
    poses: Float32s = states[name].reshape(-1, 4, 4).transpose(0, 2, 1)
    return poses


def _poses(states: NDArray[np.void], name: str) -> Floats:
    """Return a pose of the end effector as position and quaternion (frame, 7)."""
    pose = _matrices(states, name).astype(np.float64)
    return np.hstack([pose[:, :3, 3], kinematics.quaternions_of(pose[:, :3, :3])])


def _flat(poses: Floats) -> Floats:
    """Return positions with quaternions (frame, 7) as matrices, column after column (frame, 16)."""
    matrices = np.zeros((len(poses), 4, 4))
    matrices[:, :3, :3], matrices[:, :3, 3], matrices[:, 3, 3] = kinematics.matrices_of(poses[:, 3:]), poses[:, :3], 1
    return matrices.transpose(0, 2, 1).reshape(-1, POSE)


def _packed(flags: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return flags (frame, flag) as a bit each of one number (frame,), the first the lowest."""
    packed: NDArray[np.uint64] = ((flags != 0).astype(np.uint64) << np.arange(FLAGS, dtype=np.uint64)).sum(axis=1)
    return packed


def _are_states(frames: Bytes, *poses: str) -> Bools:
    """Return which packets (frame,) hold finite numbers, and poses that are such in these fields."""
    states = np.ascontiguousarray(frames).view(STATE)[:, 0]
    good = np.ones(len(states), dtype=bool)
    for name in {*READ, *poses}:
        good &= np.isfinite(states[name]).reshape(len(states), -1).all(axis=1)
    for name in poses:
        last = np.where(good[:, None], _matrices(states, name)[:, 3], 0)
        good &= (np.abs(last - (0, 0, 0, 1)) <= AFFINE).all(axis=1)
    return good
