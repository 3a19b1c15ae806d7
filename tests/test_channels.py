"""Channels found by quantity, unit and component, whatever their columns are called."""

from __future__ import annotations

import pyarrow as pa
import pytest

from tacpipe.channels import arm as pose
from tacpipe.channels import streams as absent
from tacpipe.errors import TacpipeError, UsageError


def field(name: str, quantity: str, stream: str = "", unit: str = "", **about: str) -> pa.Field:
    metadata = {"quantity": quantity, "stream": stream, "unit": unit, **about}
    return pa.field(name, pa.float64(), metadata={key: value for key, value in metadata.items() if value})


def arm(stream: str, names: str = "xyz", unit: str = "m") -> list[pa.Field]:
    return [field(f"{stream}_{name}", "position", stream, unit) for name in names]


@pytest.mark.parametrize(
    ("name", "part"),
    [
        *(
            (name, "x")
            for name in ("x", "qx", "q_x", "pos_x_m", "position_x_m", "tcp.position.x", "ee_X", "x_m", "rotx")
        ),
        *((name, "w") for name in ("orientation_w", "QW", "quat_w", "w")),
        *((name, "") for name in ("seconds", "q1", "height")),
    ],
)
def test_the_component_of_a_column_follows_from_its_name(name: str, part: str) -> None:
    assert pose.component(field(name, "position")) == part


def test_metadata_states_the_component_before_the_name_does() -> None:
    assert pose.component(field("up_x", "position", component="z")) == "z"
    assert pose.component(field("taxel_x", "tactile", axis="Y")) == "y"


def test_the_components_of_one_quaternion_share_a_name_and_those_of_two_do_not() -> None:
    hand = {pose.shared_name(field(f"hand_q{part}", "orientation")) for part in "xyzw"}
    cup = {pose.shared_name(field(f"cup_orientation_{part}", "orientation", component=part)) for part in "xyzw"}
    assert len(hand) == len(cup) == 1 and hand != cup


def test_a_pose_is_found_in_any_stream_in_the_order_of_its_components() -> None:
    turned = [field(f"ur5_q{part}", "orientation", "ur5", "1") for part in "wxyz"]
    columns = pose.pose(pa.schema([*turned, *arm("ur5", "zyx"), field("skin_t1", "tactile", "skin", "kPa")]))
    assert columns.position == ("ur5_x", "ur5_y", "ur5_z")
    assert columns.orientation == ("ur5_qx", "ur5_qy", "ur5_qz", "ur5_qw")


def test_an_arm_without_a_quaternion_has_none_and_no_position_is_no_arm() -> None:
    assert pose.pose(pa.schema(arm("stage"))).orientation == ()
    assert pose.pose(pa.schema([field("t1", "tactile")])) == pose.Pose()


def test_columns_without_metadata_are_found_by_the_names_of_the_first_versions() -> None:
    schema = pa.schema([pa.field(name, pa.float64()) for name in pose.DEFAULT_POSE.columns])
    assert pose.pose(schema) == pose.DEFAULT_POSE


def test_of_two_positions_the_stream_named_is_taken_and_else_the_robot() -> None:
    two_arms = pa.schema([*arm("robot"), *arm("object")])
    assert pose.pose(two_arms).position[0] == "robot_x"
    assert pose.pose(two_arms, "object").position[0] == "object_x"
    with pytest.raises(TacpipeError, match="--arm"):
        pose.pose(pa.schema([*arm("left"), *arm("right")]))
    assert pose.pose(pa.schema([*arm("left"), *arm("right")]), needed=False) == pose.Pose()
    with pytest.raises(UsageError, match=r"wrist.*robot, object"):
        pose.pose(two_arms, "wrist")


def test_a_height_alone_is_no_arm_unless_an_arm_is_needed_or_named() -> None:
    height = pa.schema([field("tcp_z_m", "position", "arm", "m")])
    assert pose.pose(height, needed=False) == pose.Pose()
    for stream, needed in (("", True), ("arm", False)):
        with pytest.raises(TacpipeError, match=r"--actions none"):
            pose.pose(height, stream, needed=needed)


def test_ground_truth_is_no_pose() -> None:
    assert pose.pose(pa.schema([field(f"gt_{part}", "position", unit="m") for part in "xyz"])) == pose.Pose()


def test_a_position_without_its_three_components_names_the_line_of_the_layout_file() -> None:
    with pytest.raises(TacpipeError, match=r'component = "x".*\[streams\.ee\] columns'):
        pose.pose(pa.schema([field(name, "position", "ee") for name in ("ee_p1", "ee_p2", "ee_p3")]))


@pytest.mark.parametrize(("unit", "factor"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001)])
def test_a_length_is_read_in_its_unit(unit: str, factor: float) -> None:
    assert pose.metres_per_unit(field("x", "position", unit=unit)) == factor


def test_a_position_in_another_unit_names_the_line_of_the_layout_file() -> None:
    with pytest.raises(TacpipeError, match=r"'inch'.*\[streams\.ee\] columns"):
        pose.metres_per_unit(field("ee_x", "position", "ee", "inch"))


def test_what_is_absent_is_named_with_what_is_there_and_where_to_declare_it() -> None:
    bare = pa.field("skin_t1", pa.uint16(), metadata={"stream": "skin"})
    message = str(absent.missing_channel_error("trial-3", "tactile", [pa.field("t_ns", pa.int64()), bare, *arm("ee")]))
    for part in ("trial-3", "tactile", "3 of position", "skin_t1", "[streams.skin] columns", 'quantity = "tactile"'):
        assert part in message


def test_columns_of_streams_name_the_stream_in_which_to_declare_them() -> None:
    streams = {"skin": [pa.field("t1", pa.uint16())], "ee": arm("ee")}
    assert "[streams.skin] columns" in str(absent.missing_channel_error("trial-3", "tactile", streams))
