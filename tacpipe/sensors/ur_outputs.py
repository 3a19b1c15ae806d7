"""The outputs of a UR controller that RTDE sends: their types on the wire, and the columns that they become.

Source: Universal Robots, Real-Time Data Exchange (RTDE) Guide, table "Robot controller outputs".
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pyarrow as pa

WIRE = {  # type to numpy's and how many
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
JOINT_NAMES = {  # output to what stands behind "joint1_", the unit and the quantity
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
    """Return the type of an output on the wire, None if there is no such output.

    >>> type_of("actual_q"), type_of("output_int_register_24"), type_of("q")
    ('VECTOR6D', 'INT32', None)
    """
    match = REGISTER.fullmatch(output)
    if match is None:
        return TYPES.get(output)
    kind, count = REGISTERS[match[1]]
    return kind if int(match[2]) in count else None


def fields_of(output: str) -> list[pa.Field]:
    """Return the fields that an output becomes: those that arms have elsewhere, or its own name, small, and a number."""
    import pyarrow as pa

    from tacpipe.channels import schema

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
