"""Franka Research 3 arms with the Franka Control Interface (FCI), version 10: the robot's state every millisecond.

A TCP connection to port 1337 requests the state, which is sent by UDP while the connection is open: a u64 count of
milliseconds and 1369 bytes, packed, little-endian, with numbers as float32. Reading does not need control of the arm. The
Panda (FER) uses FCI 5, whose layout differs. Source: the layout published by libfranka, as sent by franky-sim 1.0.4.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import Bools, Bytes, Float32s, Floats
from tacpipe.channels import schema
from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors.framing import Framer, PacketFramer
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor
from tacpipe.signals import kinematics

VERSION = 10
HEADER = struct.Struct("<III")  # command, number of the message, size in bytes including this header
CONNECT = struct.Struct("<IIIHH")  # header, version, UDP port for the state
CONNECTED = struct.Struct("<IIIHH4x")  # header, status, version of the robot
CONNECT_COMMAND, DONE, OTHER_VERSION = 0, 0, 1
MAX_MESSAGE = 1 << 20  # bytes
RATE_HZ = 1000.0  # fixed by the device
JOINTS = 7
FLAGS = 41  # kinds of errors
AFFINE = 1e-3  # maximum deviation of the last row of a pose from (0, 0, 0, 1)

POSE, INERTIA = 16, 9  # number of matrix elements, in column-major order
FLOATS = {  # number of floats by name, in order
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
MEASURED, TARGET = "O_T_EE", "O_T_EE_d"  # poses
# floats that become channels
READ = (MEASURED, "q", "dq", "tau_J", "tau_ext_hat_filtered", "O_F_ext_hat_K", "success_rate")
MODES = ("robot_mode", "motion_mode", "control_mode")
ERRORS = ("errors", "last_errors")


@dataclass(frozen=True)
class Franka(Sensor):
    """The arm of a Franka Research 3, without its hand."""

    summary: ClassVar[str] = "Franka Research 3 arms with the Franka Control Interface (FCI), version 10."
    links: ClassVar[tuple[str, ...]] = ("tcp+udp",)
    counter: ClassVar[int | None] = 1 << 62  # u64 milliseconds, which never reach this value
    exclusive: ClassVar[str] = (
        "The arm accepts one FCI connection: while it is recorded, neither Desk nor another program can move it by FCI. A "
        "program that moves it must send its state to a tap."
    )

    targets: bool = False  # record the controller's target pose (O_T_EE_d), too
    rate_hz: float = RATE_HZ  # states per second, fixed by the device

    def __post_init__(self) -> None:
        if self.rate_hz != RATE_HZ:
            raise UsageError(f"franka: rate_hz is {self.rate_hz:g}; it must be {RATE_HZ:g}, the fixed rate of the arm.")

    def fields(self) -> list[pa.Field]:
        """Return the fields of end-effector pose, joints, load, modes and errors, in this order.

        Joints have angles, velocities, torques and external torques. With ``targets``, the target pose follows the
        load. Floats are converted to float64, as for other arms. The load acts on the stiffness frame and is in the
        base frame. Each error is one bit, in the order of the interface.
        """
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
        """Return a framer for packets with the size of a state, finite numbers and a valid pose."""
        poses = (MEASURED, TARGET) if self.targets else (MEASURED,)
        return PacketFramer([STATE.itemsize], lambda packets: _are_states(packets, *poses))

    def decode(self, frames: Bytes) -> Samples:
        """Return the samples of states. The count of milliseconds is both time and counter."""
        states = np.ascontiguousarray(frames).view(STATE)[:, 0]
        floats = [states[name].astype(np.float64) for name in READ[1:-1]]
        floats += [_poses(states, TARGET)] if self.targets else []
        count_ms = states["message_id"].astype(np.int64)
        return Samples(
            (
                np.hstack([_poses(states, MEASURED), *floats]),
                states["success_rate"][:, None].astype(np.float32),
                np.column_stack([states[name] for name in MODES]),
                np.column_stack([_pack_flags(states[name]) for name in ERRORS]),
            ),
            seq=count_ms,
            t_device_ns=count_ms * 1_000_000,
        )

    def encode(self, samples: Samples) -> Bytes:
        """Return states with the values of ``samples``, and zeros in all other fields. The pose has float32 precision."""
        floats, success_rate, modes, errors = samples.values
        assert samples.seq is not None
        states = np.zeros(len(samples), STATE)
        states["message_id"] = samples.seq
        states[MEASURED] = _to_matrices(floats[:, :7])
        if self.targets:
            states[TARGET] = _to_matrices(floats[:, -7:])
        column = 7
        for name in READ[1:-1]:
            states[name] = floats[:, column : column + FLOATS[name]]
            column += FLOATS[name]
        states["success_rate"] = success_rate[:, 0]
        for index, name in enumerate(MODES):
            states[name] = modes[:, index]
        for index, name in enumerate(ERRORS):
            states[name] = errors[:, index : index + 1] >> np.arange(FLAGS, dtype=np.uint64) & np.uint64(1)
        return states.view(np.uint8).reshape(len(samples), STATE.itemsize)

    def opening(self, local: LocalAddress) -> Dialogue:
        """Request the state at the port on which the link listens. Raises `DeviceError` if the arm refuses."""
        request = CONNECT.pack(CONNECT_COMMAND, 1, CONNECT.size, VERSION, local["port"])
        reply = yield Ask(request, message_size, what="the arm's reply to a connection (FCI must be activated in Desk)")
        if len(reply) < CONNECTED.size:
            raise DeviceError(
                f"The arm's reply has {len(reply)} bytes; it should have {CONNECTED.size}. Check the address."
            )
        _, _, _, status, version = CONNECTED.unpack(reply[: CONNECTED.size])
        if status == OTHER_VERSION or version != VERSION:
            raise DeviceError(
                f"The arm uses FCI version {version}; only version {VERSION} (Franka Research 3) is supported. Update its "
                f"system, or record its state through a tap."
            )
        if status != DONE:
            raise DeviceError(f"The arm refused the connection with status {status}. Activate FCI in Desk.")


def message_size(data: bytes) -> int:
    """Return the size of the message at the front of ``data``, or 0 if it is incomplete.

    Raises `DeviceError` if the size in its header is invalid.
    """
    if len(data) < HEADER.size:
        return 0
    size = int(HEADER.unpack_from(data)[2])
    if not HEADER.size <= size <= MAX_MESSAGE:
        raise DeviceError(
            f"The device sent a message of {size} bytes, which is not FCI. Check that this is the arm's address."
        )
    return size if len(data) >= size else 0


def _matrices(states: NDArray[np.void], name: str) -> Float32s:
    """Return an end-effector pose in the base frame as matrices (frame, 4, 4)."""
    return states[name].reshape(-1, 4, 4).transpose(0, 2, 1)


def _poses(states: NDArray[np.void], name: str) -> Floats:
    """Return an end-effector pose as position and quaternion (frame, 7)."""
    pose = _matrices(states, name).astype(np.float64)
    return np.hstack([pose[:, :3, 3], kinematics.matrices_to_quaternions(pose[:, :3, :3])])


def _to_matrices(poses: Floats) -> Floats:
    """Return positions with quaternions (frame, 7) as column-major matrices (frame, 16)."""
    matrices = np.zeros((len(poses), 4, 4))
    matrices[:, :3, :3], matrices[:, :3, 3], matrices[:, 3, 3] = (
        kinematics.quaternions_to_matrices(poses[:, 3:]),
        poses[:, :3],
        1,
    )
    return matrices.transpose(0, 2, 1).reshape(-1, POSE)


def _pack_flags(flags: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return flags (frame, flag) as bits of one number (frame,). The first flag is the lowest bit."""
    packed: NDArray[np.uint64] = ((flags != 0).astype(np.uint64) << np.arange(FLAGS, dtype=np.uint64)).sum(axis=1)
    return packed


def _are_states(frames: Bytes, *poses: str) -> Bools:
    """Return a mask (frame,) of the packets with finite numbers and valid poses in the fields ``poses``."""
    states = np.ascontiguousarray(frames).view(STATE)[:, 0]
    good = np.ones(len(states), dtype=bool)
    for name in {*READ, *poses}:
        good &= np.isfinite(states[name]).reshape(len(states), -1).all(axis=1)
    for name in poses:
        last_row = np.where(good[:, None], _matrices(states, name)[:, 3], 0)
        good &= (np.abs(last_row - (0, 0, 0, 1)) <= AFFINE).all(axis=1)
    return good
