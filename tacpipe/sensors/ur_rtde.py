"""Universal Robots arms with RTDE, the real-time data exchange of their controllers, protocol version 2.

Packages over TCP are big-endian: u16 size including the header, u8 type, payload. The host requests the version, sends a
recipe (rate and outputs), and starts the stream. A data package contains the recipe's number and the outputs in order.
Reading does not need control of the arm. Source: Universal Robots, Real-Time Data Exchange (RTDE) Guide.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Bools, Bytes, Ints
from tacpipe.channels import schema
from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor
from tacpipe.signals import kinematics

WIRE = {  # numpy type and number of elements, by RTDE type
    "BOOL": ("u1", 1),
    "UINT8": ("u1", 1),
    "UINT32": (">u4", 1),
    "UINT64": (">u8", 1),
    "INT32": (">i4", 1),
    "DOUBLE": (">f8", 1),
    "VECTOR3D": (">f8", 3),
    "VECTOR6D": (">f8", 6),
    "VECTOR6INT32": (">i4", 6),
    "VECTOR6UINT32": (">u4", 6),
}
POSE, TARGET_POSE = "actual_TCP_pose", "target_TCP_pose"  # x, y, z in metres and a rotation vector in rad
POSES = (POSE, TARGET_POSE)
TYPES = {
    **dict.fromkeys(("target_q", "target_qd", "target_qdd", "target_current", "target_moment"), "VECTOR6D"),
    **dict.fromkeys(("actual_q", "actual_qd", "actual_current", "actual_current_window"), "VECTOR6D"),
    **dict.fromkeys(("joint_control_output", "joint_temperatures", "actual_joint_voltage"), "VECTOR6D"),
    **dict.fromkeys((POSE, "actual_TCP_speed", "actual_TCP_force", TARGET_POSE, "target_TCP_speed"), "VECTOR6D"),
    **dict.fromkeys(("ft_raw_wrench", "payload_inertia"), "VECTOR6D"),
    **dict.fromkeys(("actual_tool_accelerometer", "elbow_position", "elbow_velocity", "payload_cog"), "VECTOR3D"),
    **dict.fromkeys(("actual_digital_input_bits", "actual_digital_output_bits"), "UINT64"),
    **dict.fromkeys(
        ("robot_mode", "safety_mode", "safety_status", "tool_output_voltage", "time_scale_source"), "INT32"
    ),
    "joint_mode": "VECTOR6INT32",
    **dict.fromkeys(("timestamp", "actual_execution_time", "speed_scaling", "target_speed_fraction"), "DOUBLE"),
    **dict.fromkeys(("actual_momentum", "actual_main_voltage", "actual_robot_voltage"), "DOUBLE"),
    **dict.fromkeys(("actual_robot_current", "io_current", "payload", "tcp_force_scalar"), "DOUBLE"),
    **dict.fromkeys((f"standard_analog_{kind}{n}" for kind in ("input", "output") for n in (0, 1)), "DOUBLE"),
    **dict.fromkeys(("tool_analog_input0", "tool_analog_input1", "tool_output_current", "tool_temperature"), "DOUBLE"),
    **dict.fromkeys(("euromap67_24V_voltage", "euromap67_24V_current"), "DOUBLE"),
    **dict.fromkeys(("joint_position_deviation_ratio", "collision_detection_ratio"), "DOUBLE"),
    **dict.fromkeys(("runtime_state", "robot_status_bits", "safety_status_bits", "analog_io_types"), "UINT32"),
    **dict.fromkeys(("euromap67_input_bits", "euromap67_output_bits", "tool_mode"), "UINT32"),
    **dict.fromkeys(("tool_analog_input_types", "script_control_line"), "UINT32"),
    **dict.fromkeys((f"output_bit_registers{span}" for span in ("0_to_31", "32_to_63")), "UINT32"),
    **dict.fromkeys(("tool_output_mode", "tool_digital_output0_mode", "tool_digital_output1_mode"), "UINT8"),
}
REGISTERS = {"bit": ("BOOL", range(64, 128)), "int": ("INT32", range(48)), "double": ("DOUBLE", range(48))}
REGISTER = re.compile(r"(?:output|input)_(bit|int|double)_register_(\d{1,3})")
JOINTS = 6
JOINT_NAMES = {  # suffix after "joint1_", unit and quantity, by output
    "actual_q": ("rad", "rad", "joint_position"),
    "actual_qd": ("velocity_rad_s", "rad/s", "joint_velocity"),
    "actual_current": ("current_a", "A", "current"),
    "target_q": ("target_rad", "rad", "target_joint_position"),
    "target_qd": ("target_velocity_rad_s", "rad/s", "target_joint_velocity"),
    "target_qdd": ("target_acceleration_rad_s2", "rad/s^2", "target_joint_acceleration"),
    "target_current": ("target_current_a", "A", "target_current"),
    "target_moment": ("target_torque_nm", "N m", "target_joint_torque"),
    "joint_temperatures": ("temperature_c", "degC", "temperature"),
    "actual_joint_voltage": ("voltage_v", "V", "voltage"),
}


def type_of(output: str) -> str | None:
    """Return the RTDE type of an output, or None if there is no such output.

    >>> type_of("actual_q"), type_of("output_int_register_24"), type_of("q")
    ('VECTOR6D', 'INT32', None)
    """
    match = REGISTER.fullmatch(output)
    if match is None:
        return TYPES.get(output)
    kind, count = REGISTERS[match[1]]
    return kind if int(match[2]) in count else None


def fields_of(output: str) -> list[pa.Field]:
    """Return the fields of an output: the common fields of arms, or its name in lower case with a number per element."""
    if output == POSE:
        return schema.pose_fields()
    if output == TARGET_POSE:
        return schema.target_pose_fields()
    if output == "actual_TCP_force":
        return schema.wrench_fields()
    if output == "actual_TCP_speed":
        return schema.twist_fields()
    if output in JOINT_NAMES:
        suffix, unit, quantity = JOINT_NAMES[output]
        return [schema.float_field(f"joint{n}_{suffix}", unit, quantity) for n in range(1, JOINTS + 1)]
    kind = type_of(output)
    assert kind is not None
    letters, count = WIRE[kind]
    native = pa.bool_() if kind == "BOOL" else pa.from_numpy_dtype(np.dtype(letters).newbyteorder("="))
    name = output.lower()
    names = [name] if count == 1 else [f"{name}{number}" for number in range(1, count + 1)]
    return [pa.field(name, native, metadata={"unit": "1", "quantity": "state"}) for name in names]


HEADER = struct.Struct(">HB")
PROTOCOL = 2
VERSION, CONTROLLER, TEXT, DATA, OUTPUTS, INPUTS, START, PAUSE = b"VvMUOISP"
KINDS = (VERSION, CONTROLLER, TEXT, DATA, OUTPUTS, INPUTS, START, PAUSE)
STAMP = "timestamp"  # seconds since the controller started
MAX_VALUE = 1e12  # upper bound of all outputs: metres, newtons, radians, seconds since the start
MAX_PACKAGE = 4096  # bytes


@dataclass(frozen=True)
class UrRtde(Sensor):
    """An arm of a UR controller. RTDE has no counter; skipped samples are visible in the controller's time."""

    summary: ClassVar[str] = "Universal Robots arms with RTDE (CB3 from 3.4, e-Series)."
    links: ClassVar[tuple[str, ...]] = ("tcp",)

    outputs: tuple[str, ...] = (  # names of RTDE outputs; the time is always included
        "actual_q",
        "actual_qd",
        POSE,
        "actual_TCP_speed",
        "actual_TCP_force",
    )
    rate_hz: float = 500.0  # samples per second: up to 500 for an e-Series, 125 for a CB3

    def __post_init__(self) -> None:
        """Raise `UsageError` for unknown or repeated outputs, and for an invalid rate."""
        unknown = [name for name in self.outputs if type_of(name) is None or name == STAMP]
        if unknown or not self.outputs or len(set(self.outputs)) < len(self.outputs):
            problem = (
                f"outputs contains {unknown[0]}" if unknown else f"outputs are {', '.join(self.outputs) or 'none'}"
            )
            raise UsageError(
                f"ur-rtde: {problem}; list outputs of the RTDE guide, each once, such as actual_q or "
                f"output_int_register_24. The time is always included."
            )
        if not 1 <= self.rate_hz <= 500:
            raise UsageError(f"ur-rtde: rate_hz is {self.rate_hz:g}; it must be between 1 and 500.")

    @property
    def package(self) -> np.dtype[np.void]:
        """The structured type of a data package: header, recipe, time, and outputs."""
        return np.dtype(
            [("size", ">u2"), ("type", "u1"), ("recipe", "u1"), (STAMP, ">f8")]
            + [(name, *WIRE[type_of(name) or ""]) for name in self.outputs]
        )

    def fields(self) -> list[pa.Field]:
        """Return the fields of the outputs. Joints, pose, speed and load have the same names as for other arms."""
        return [field for name in self.outputs for field in fields_of(name)]

    def framer(self) -> Framer:
        """Return a framer for packages. Data packages must have the size of the recipe, and another package must follow.

        There is no checksum, and an incomplete package would take its missing bytes from the next.
        """
        size = self.package.itemsize

        def check(frames: Bytes) -> Bools:
            kinds = frames[:, 2]
            data = (kinds == DATA) & (frames.shape[1] == size)
            if data.any():
                data &= (frames[:, 3] > 0) & _are_numbers(
                    np.ascontiguousarray(frames[:, :size]).view(self.package)[:, 0]
                )
            return np.asarray(data | (np.isin(kinds, KINDS) & (kinds != DATA)))

        return ByteFramer(Framing(header=HEADER.size, sizes=_sizes, max_size=MAX_PACKAGE, check=check, confirm=1))

    def decode(self, frames: Bytes) -> Samples:
        """Return the samples of data packages, with the controller's time. Other packages have no sample."""
        dtype = self.package
        rows = np.flatnonzero(frames[:, 2] == DATA) if frames.shape[1] == dtype.itemsize else np.zeros(0, np.int64)
        records = np.ascontiguousarray(frames[rows][:, : dtype.itemsize])
        packages = records.view(dtype)[:, 0] if len(rows) else np.zeros(0, dtype)
        return Samples(
            tuple(_to_columns(packages[name], name) for name in self.outputs),
            t_device_ns=np.rint(packages[STAMP] * 1e9).astype(np.int64),
            rows=rows.astype(np.int64),
        )

    def encode(self, samples: Samples) -> Bytes:
        """Return the data packages of these samples."""
        assert samples.t_device_ns is not None
        packages = np.zeros(len(samples), self.package)
        packages["size"], packages["type"], packages["recipe"] = self.package.itemsize, DATA, 1
        packages[STAMP] = samples.t_device_ns / 1e9
        for name, block in zip(self.outputs, samples.values, strict=True):
            wire_values = (
                np.hstack([block[:, :3], kinematics.quaternions_to_vectors(block[:, 3:])]) if name in POSES else block
            )
            packages[name] = wire_values[:, 0] if packages[name].ndim == 1 else wire_values
        return packages.view(np.uint8).reshape(len(samples), self.package.itemsize)

    def opening(self, local: LocalAddress) -> Dialogue:
        """Negotiate the version, request the outputs, and start. Raises `DeviceError` if the controller refuses."""
        reply = yield _ask(VERSION, PROTOCOL.to_bytes(2, "big"))
        if reply[HEADER.size :] != b"\1":
            raise DeviceError(
                "The controller does not support RTDE version 2. Update it to CB3 3.10, e-Series 5.4 or later."
            )
        names = (STAMP, *self.outputs)
        reply = yield _ask(OUTPUTS, struct.pack(">d", self.rate_hz) + ",".join(names).encode())
        answer = reply[HEADER.size :]
        recipe, kinds = answer[:1], answer[1:].decode("latin-1").split(",")
        for name, kind in zip(names, kinds, strict=False):
            if kind != type_of(name):
                raise DeviceError(
                    f"The controller reports type {kind} for the output {name}, which should be {type_of(name)}. Remove it "
                    f"from the option outputs, or update the controller."
                )
        if len(kinds) != len(names) or recipe in (b"", b"\0"):
            raise DeviceError(
                f"The controller refused the outputs {', '.join(names)}. Request fewer outputs, or a lower rate."
            )
        reply = yield _ask(START, b"")
        if reply[HEADER.size :] != b"\1":
            raise DeviceError("The controller refused to start the stream. Close other RTDE clients and try again.")

    def closing(self) -> bytes:
        """Pause the stream."""
        return pack_package(PAUSE)


def pack_package(kind: int, payload: bytes = b"") -> bytes:
    r"""Return a package of type ``kind``.

    >>> pack_package(VERSION, b"\0\2").hex(" ")
    '00 05 56 00 02'
    """
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def _ask(kind: int, payload: bytes) -> Ask:
    """Return a request whose reply has the same type. Text packages may precede the reply.

    Finding the reply raises `DeviceError` for bytes that are not RTDE.
    """

    def find(data: bytes) -> int | tuple[int, int]:
        offset = 0
        while len(data) >= offset + HEADER.size:
            size, package_kind = HEADER.unpack_from(data, offset)
            if package_kind not in KINDS or size < HEADER.size:
                raise DeviceError(
                    f"The bytes {data[offset : offset + 8].hex(' ')} are not RTDE. Check that the port is 30004."
                )
            if package_kind == kind:
                return (offset, offset + size) if len(data) >= offset + size else 0
            offset += size
        return 0

    return Ask(pack_package(kind, payload), find, what=f"the controller's reply to RTDE package {chr(kind)}")


def _sizes(heads: Bytes) -> Ints:
    return heads[:, 0].astype(np.int64) * 256 + heads[:, 1]


def _to_columns(values: AnyArray, name: str) -> AnyArray:
    """Convert an output's values to columns (sample, channel) in native byte order. Poses get a quaternion."""
    block = values[:, None] if values.ndim == 1 else values
    block = block.astype(bool if type_of(name) == "BOOL" else block.dtype.newbyteorder("="))
    return np.hstack([block[:, :3], kinematics.vectors_to_quaternions(block[:, 3:])]) if name in POSES else block


def _are_numbers(packages: AnyArray) -> Bools:
    """Return a mask (package,) of the packages whose floats are all plausible."""
    good = np.ones(len(packages), dtype=bool)
    for name in packages.dtype.names or ():
        values = packages[name].reshape(len(packages), -1)
        if values.dtype.kind == "f":
            good &= (np.abs(values) < MAX_VALUE).all(axis=1)  # also False for NaN
    return good
