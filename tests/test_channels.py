"""Channels found by quantity, unit and component, whatever their columns are called."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import arm as pose
from tacpipe.channels import biotac_sp, places, schema
from tacpipe.channels import streams as absent
from tacpipe.channels.streams import columns_with_quantity, signal
from tacpipe.datasets.overview import streams_of
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


@dataclass
class Recording:
    """A recording without a store."""

    tables: Mapping[str, pa.Table]
    name: str = "trial"

    @property
    def streams(self) -> tuple[str, ...]:
        return tuple(sorted(self.tables))

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        return self.tables[stream]


def table(**columns: tuple[list[Any], dict[str, str]]) -> pa.Table:
    fields = [pa.field(name, pa.array(values).type, metadata=kind) for name, (values, kind) in columns.items()]
    return pa.table([pa.array(values) for values, _ in columns.values()], schema=pa.schema(fields))


def streams(tables: Mapping[str, pa.Table]) -> dict[str, pa.Table]:
    return streams_of(Recording(tables))  # type: ignore[arg-type]


TIME = ([10, 20], {"quantity": "time"})


def test_streams_that_lie_apart_are_given_without_truth_and_events() -> None:
    left, right = table(t_ns=TIME, a=([1, 2], {})), table(t_ns=TIME, b=([3, 4], {}))
    assert streams({"one": left, "events": right, "truth": right, "two": right}) == {"one": left, "two": right}


def test_a_synchronized_table_falls_apart_under_the_names_that_were_recorded() -> None:
    parts = streams(
        {
            "": table(
                t_ns=TIME,
                xela_x=([1, 2], {"stream": "xela", "quantity": "tactile"}),
                xela_held=([True, False], {"stream": "xela", "quantity": "mask"}),
                robot_xela_x=([3, 4], {"stream": "robot"}),
                gt_force_n=([5, 6], {"stream": "truth"}),
            )
        }
    )
    assert {name: part.to_pydict() for name, part in parts.items()} == {
        "xela": {"t_ns": [10, 20], "x": [1, 2]},
        "robot": {"t_ns": [10, 20], "xela_x": [3, 4]},
    }
    assert columns_with_quantity(parts["xela"], "tactile") == ["x"]
    assert columns_with_quantity(parts["robot"], "tactile") == []


def test_a_table_that_was_one_from_the_start_is_one_stream_without_name() -> None:
    assert list(streams({"": table(t_ns=TIME, a=([1, 2], {}))})) == [""]


def test_a_signal_is_that_of_the_first_stream_with_its_quantity() -> None:
    force = {"quantity": "force"}
    tables = {
        "pose": table(t_ns=TIME, a=([1, 2], {})),
        "wrench": table(t_ns=TIME, x=([1.0, 2.0], force), other=([0.0, 0.0], {}), y=([3.0, 4.0], force)),
    }
    values = signal(tables, "force")
    assert values is not None
    np.testing.assert_array_equal(values[0], [10, 20])
    np.testing.assert_array_equal(values[1], [[1.0, 3.0], [2.0, 4.0]])
    assert signal(tables, "velocity") is None


def test_a_xela_uskin_is_a_square_of_four_by_four_in_the_order_of_its_taxels() -> None:
    positions, unit = places.taxel_positions([field for field in schema.uskin_fields() if field.name.endswith("_x")])

    assert unit == "mm" and positions.shape == (16, 2)
    pitch = places.USKIN_PITCH_M * 1e3
    np.testing.assert_allclose(positions[0] - positions[-1], [-3 * pitch, -3 * pitch])
    np.testing.assert_allclose(np.linalg.norm(np.diff(positions[:4], axis=0), axis=1), pitch)


def test_electrodes_lie_by_their_number_whatever_the_order_of_the_columns() -> None:
    fields = [field for field in schema.biotac_fields() if field.name.startswith("electrode")]

    positions, unit = places.taxel_positions(fields)
    turned, _ = places.taxel_positions(fields[::-1])

    assert unit == "mm"
    np.testing.assert_array_equal(positions, turned[::-1])
    assert positions[:, 1].argmax() == 6  # electrode 7 is at the tip, which is at the top
    np.testing.assert_allclose(positions[0], positions[10] * (-1, 1))  # 11 mirrors 1


def test_a_biotac_sp_is_rolled_out_as_its_published_electrodes() -> None:
    fields = [field for field in biotac_sp.fields() if field.name.startswith("th_electrode")]

    positions, _ = places.taxel_positions(fields)

    np.testing.assert_allclose(positions, 1e3 * biotac_sp.unrolled_positions_m()[:, ::-1])


def test_a_roboskin_has_sixty_places_of_its_own() -> None:
    positions, unit = places.taxel_positions(schema.roboskin_fields())

    assert unit == "mm" and len({tuple(position) for position in positions.round(3).tolist()}) == 60


def test_row_and_column_numbers_come_before_any_layout() -> None:
    fields = [
        pa.field(f"t{n}", pa.float32(), metadata={"row": str(n % 2 + 1), "column": str(n // 2 + 1)}) for n in range(6)
    ]

    positions, unit = places.taxel_positions(fields)

    assert unit == "grid"
    np.testing.assert_array_equal(positions[:3], [[1, -1], [1, -2], [2, -1]])


def test_an_unknown_array_is_a_grid_in_which_no_two_taxels_lie_on_one_another() -> None:
    for count in (1, 2, 7, 48, 96):
        positions, unit = places.taxel_positions([pa.field(f"c{n}", pa.int16()) for n in range(count)])
        assert unit == "grid" and len({tuple(position) for position in positions.tolist()}) == count


def test_numbers_beyond_a_known_layout_make_a_grid() -> None:
    fields = [pa.field(f"e{n}", pa.int16(), metadata={"electrode": str(n)}) for n in (1, 2, 40)]

    assert places.taxel_positions(fields)[1] == "grid"


PAGE = Path(__file__).parents[1] / "docs" / "reference" / "recordings.md"


def test_the_quantities_of_the_page_of_formats_are_the_vocabulary() -> None:
    (row,) = (line for line in PAGE.read_text().splitlines() if line.startswith("| `quantity` |"))
    assert set(re.findall(r"`([a-z_]+)`", row)) - {"quantity"} == schema.QUANTITIES


@pytest.mark.parametrize(
    ("word", "symbol"),
    [
        ("Newton", "N"),
        ("counts", "count"),
        ("Celsius", "degC"),
        ("millimeters", "mm"),
        ("kpa", "kPa"),
        ("rad/s", "rad/s"),
    ],
)
def test_a_unit_that_is_spelled_out_is_suggested_as_its_symbol(word: str, symbol: str) -> None:
    assert schema.unit_from_text(word) == symbol
    assert schema.describe_unknown_unit(word) == (
        "" if word == symbol else f"There is no unit {word}. Did you mean {symbol}?"
    )


@pytest.mark.parametrize("unit", ["m/s^2", "N m", "1/s", "µN", "mPa s", "W/m²", "gf", "%", "count/N", "N/mm^2", "kΩ"])
def test_products_and_quotients_of_symbols_are_units(unit: str) -> None:
    assert schema.is_unit(unit) and not schema.is_unit(f"{unit}x") and not schema.is_unit(f"foo {unit}")


def test_electrodes_lie_on_the_pad_and_mirror_each_other() -> None:
    places = biotac_sp.electrode_positions_m()
    assert places.shape == (24, 3)
    np.testing.assert_array_equal(places[:10] * (1, 1, -1), places[10:20])
    assert (places[:10, 2] > 0).all()
    assert (places[:, 1] < 0).all()
    np.testing.assert_allclose(
        places[0], [9.81456e-3, -2.7686e-3, 3.98526e-3], rtol=1e-6
    )  # 0.3864, -0.1090, 0.1569 inch
    np.testing.assert_allclose(places[23], [1.91262e-3, -7.57174e-3, 0], rtol=1e-6)  # 0.0753, -0.2981, 0 inch
    assert (np.linalg.norm(places, axis=1) < 0.012).all()


def test_electrodes_are_unrolled_in_their_order_along_the_finger_and_mirrored_across_it() -> None:
    flat = biotac_sp.unrolled_positions_m()
    np.testing.assert_array_equal(flat[:, 0], biotac_sp.electrode_positions_m()[:, 0])
    np.testing.assert_allclose(flat[:10, 1], -flat[10:20, 1])
    assert (flat[:10, 1] > biotac_sp.electrode_positions_m()[:10, 2]).all()  # an arc is longer than its shadow
    assert flat[20, 1] == flat[23, 1] == 0
    # electrode 1 lies 0.1090 and 0.1569 inch from the axis: 0.191049 inch at 55.211 degrees from the pad's midline
    assert flat[0, 1] == pytest.approx(0.191049 * np.radians(55.211) * 0.0254, rel=1e-4)


def test_columns_of_a_reading_stand_where_the_published_files_have_them() -> None:
    fields = biotac_sp.fields()
    names = ["", *(field.name for field in fields)]  # a file begins with an empty field
    assert len(fields) == 58
    assert [names[at] for at in (1, 24, 27, 30, 53, 56)] == [
        *("mf_electrode01", "mf_electrode24", "mf_pdc", "th_electrode01", "th_electrode24", "th_pdc"),
    ]
    assert {str(field.type) for field in fields} == {"uint16"}
    assert fields[6].metadata == {b"unit": b"count", b"quantity": b"tactile", b"finger": b"mf", b"electrode": b"7"}
    assert b"electrode" not in fields[26].metadata


def test_the_four_targets_are_fifty_columns_of_a_reading() -> None:
    columns = [name for target in biotac_sp.TARGETS for name in biotac_sp.columns(target)]
    assert len(set(columns)) == len(columns) == sum(biotac_sp.width(target) for target in biotac_sp.TARGETS) == 50
    assert set(columns) <= {field.name for field in biotac_sp.fields()}


def test_values_told_by_target_have_a_column_each_that_names_target_and_electrode() -> None:
    columns = [name for target in biotac_sp.TARGETS for name in biotac_sp.value_columns(target)]
    assert columns[:4] == ["pdc_th", "pdc_mf", "e_th_01", "e_th_02"]
    assert columns[24:28] == ["e_th_23", "e_th_24", "e_mf_01", "e_mf_02"]
    assert len(columns) == 50 and columns[-1] == "e_mf_24"


@pytest.mark.parametrize(
    ("target", "share", "counts"),
    [("pdc_th", 0.05496, 49), ("pdc_mf", 0.0617, 43), ("e_th", 0.06099, 213), ("e_mf", 0.05922, 195)],
)
def test_errors_of_the_letter_in_shares_are_its_errors_in_counts(target: str, share: float, counts: int) -> None:
    zero, at = biotac_sp.to_counts(target, np.array([0.0, share]))
    assert at - zero == pytest.approx(counts, abs=0.6)
    np.testing.assert_allclose(biotac_sp.normalise(target, np.array([zero, at])), [0, share], atol=1e-12)
    assert biotac_sp.normalise(target, np.array(biotac_sp.RANGES[target])).tolist() == [0, 1]
