"""Test stages on sensors of any unit: thresholds from the noise at rest, slides by load, quaternions of any name."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.params import to_json
from tacpipe.plugins.registry import load

Recording = Callable[..., Any]
contacts, slides, slips, synchronize = (
    load(name) for name in ("segment.contacts", "segment.slides", "segment.slips", "synchronize")
)
RATE_HZ, ROWS = 100, 800
TOUCHED = slice(200, 700)  # rows in which the sensor is pressed


def stream(columns: dict[str, Any], about: dict[str, dict[str, str]], rate_hz: float = RATE_HZ) -> pa.Table:
    rows = len(next(iter(columns.values())))
    t_ns = np.rint(np.arange(rows) * 1e9 / rate_hz).astype(np.int64)
    fields = [pa.field("t_ns", pa.int64())]
    fields += [pa.field(name, pa.float64(), metadata=about[name]) for name in columns]
    return pa.table({"t_ns": t_ns, **columns}, schema=pa.schema(fields))


def skin(scale: float, unit: str, taxels: int = 4, first: int = TOUCHED.start) -> pa.Table:
    """Return a pressed array: 50 counts of load times ``scale``, noise of a hundredth of that."""
    rng = np.random.default_rng(0)
    load_now = np.zeros(ROWS)
    load_now[first : TOUCHED.stop] = 50
    columns = {f"t{n}": (10 + load_now + rng.normal(0, 0.5, ROWS)) * scale for n in range(taxels)}
    about = {"quantity": "tactile", "unit": unit, "stream": "skin"}
    return stream(columns, dict.fromkeys(columns, about))


def stage(moves: slice, unit: str = "m", scale: float = 1.0) -> pa.Table:
    """Return a linear stage at 500 Hz that moves along x at 20 mm/s in these rows of the skin."""
    time_s = np.arange(ROWS * 5) / 500
    speed = np.where((time_s >= moves.start / RATE_HZ) & (time_s < moves.stop / RATE_HZ), 0.02, 0.0)
    columns = {"px": np.cumsum(speed) / 500 * scale, "py": np.zeros(len(time_s)), "pz": np.zeros(len(time_s))}
    return stream(columns, {key: {"quantity": "position", "unit": unit} for key in columns}, 500)


def in_contact(output: Any) -> list[int]:
    return np.flatnonzero(output.streams[""].column("contact").to_numpy() >= 0).tolist()


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "count"), (0.02, "N"), (300.0, "count")])
def test_thresholds_from_the_noise_at_rest_find_the_contact_in_any_unit_and_scale(
    shard: Recording, scale: float, unit: str
) -> None:
    output = contacts(contacts.params(thresholds="noise", pad_s=0.0), shard({"": skin(scale, unit)}))
    rows = in_contact(output)
    assert (rows[0], rows[-1]) == (TOUCHED.start, TOUCHED.stop - 1)
    assert output.attributes["skin_contact_unit"] == unit


def test_counts_keep_the_thresholds_in_counts_unless_noise_is_asked_for(shard: Recording) -> None:
    output = contacts(contacts.params(), shard({"": skin(1.0, "count")}))
    assert in_contact(output) == [] and output.attributes == {}
    assert any("--thresholds noise" in note for note in output.notes)
    assert "thresholds" not in to_json(contacts.params()) and "rest" not in to_json(contacts.params())
    with pytest.raises(UsageError, match="thresholds is noise"):
        contacts.params(thresholds="noise", on_count=50.0, off_count=20.0).check()


def test_a_recording_that_begins_in_contact_has_its_rest_where_the_channels_are_lowest(shard: Recording) -> None:
    recording = shard({"": skin(1.0, "count", first=0)})
    at_start = contacts(contacts.params(thresholds="noise", pad_s=0.0), recording)
    lowest = contacts(contacts.params(thresholds="noise", pad_s=0.0, rest="lowest"), recording)
    assert in_contact(lowest) == list(range(TOUCHED.stop))
    assert in_contact(at_start) != in_contact(lowest)
    level = float(lowest.streams[""].schema.field("t0").metadata[b"rest"])
    assert level == pytest.approx(10, abs=0.5)


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "count"), (0.02, "N")])
@pytest.mark.parametrize(("place", "to_m"), [("m", 1.0), ("mm", 1000.0)])
def test_a_slide_of_any_sensor_is_where_it_is_touched_and_the_stage_moves(
    shard: Recording, scale: float, unit: str, place: str, to_m: float
) -> None:
    recording = shard({"skin": skin(scale, unit), "stage": stage(slice(300, 600), place, to_m)})
    output = slides(slides.params(trigger="load", frames=200), recording)
    t_ns = output.streams["slide"].column("t_ns").to_numpy()
    middle = (t_ns[0] + t_ns[-1]) / 2 / 1e9
    assert len(t_ns) == 200 and middle == pytest.approx(4.5, abs=0.05)
    assert output.attributes["speed_m_s"] == pytest.approx(0.02, rel=1e-3)
    assert output.attributes["load_mean"] == pytest.approx(50 * scale, rel=0.02)
    assert output.attributes["outside_protocol"] is False


def test_without_a_stage_the_slide_is_the_contact(shard: Recording) -> None:
    output = slides(slides.params(trigger="load", crop="none"), shard({"skin": skin(1.0, "count")}))
    t_ns = output.streams["slide"].column("t_ns").to_numpy()
    assert len(t_ns) == TOUCHED.stop - TOUCHED.start and t_ns[0] == TOUCHED.start * 10_000_000


def test_a_sensor_without_static_pressure_stays_whole_and_a_note_names_the_option(shard: Recording) -> None:
    output = slides(slides.params(), shard({"skin": skin(1.0, "count")}))
    assert output.streams["slide"].num_rows == ROWS
    assert len(output.notes) == 1 and "--trigger load" in output.notes[0]
    assert not slides(slides.params(frames=ROWS), shard({"skin": skin(1.0, "count")})).notes
    assert {"trigger", "load_trigger", "rest", "rest_s"}.isdisjoint(to_json(slides.params()))


def test_a_load_that_is_never_reached_is_refused_with_the_largest_one(shard: Recording) -> None:
    with pytest.raises(TacpipeError, match=r"never reaches 900 N; its maximum is 5\d"):
        slides(slides.params(trigger="load", load_trigger=900.0), shard({"skin": skin(1.0, "N")}))
    with pytest.raises(UsageError, match="--trigger load"):
        slides.params(load_trigger=3.0).check()


def looked_at(scale: float, unit: str) -> pa.Table:
    """Return an object 10 mm away that falls by 20 mm, and noise: 8 counts a mm."""
    rng = np.random.default_rng(1)
    fallen = np.clip(np.arange(300) - 150, 0, 20) * 1.0
    columns = {"distance": (1000 + 8 * fallen + rng.normal(0, 0.4, 300)) * scale}
    return stream(columns, {"distance": {"quantity": "proximity", "unit": unit, "stream": "eye"}}, 50)


@pytest.mark.parametrize(("scale", "unit"), [(1 / 8, "mm"), (1 / 8000, "m")])
def test_slips_in_a_unit_of_length_are_those_in_counts(shard: Recording, scale: float, unit: str) -> None:
    counted, measured = (
        slips(slips.params(), shard({"": looked_at(*scale_and_unit)}))
        for scale_and_unit in ((1.0, "count"), (scale, unit))
    )
    assert sum(counted.column("slip").to_pylist()) > 10
    for name in ("slip", "slip_online", "dropped"):
        assert counted.column(name).to_pylist() == measured.column(name).to_pylist()


def test_a_proximity_in_another_unit_is_refused_with_the_line_of_the_layout_file(shard: Recording) -> None:
    with pytest.raises(TacpipeError, match=r"in V.*\[streams\.eye\] columns"):
        slips(slips.params(), shard({"": looked_at(1.0, "V")}))


def test_a_quaternion_whose_columns_declare_no_component_is_interpolated_as_one(shard: Recording) -> None:
    angle = np.linspace(0, 1, ROWS)
    columns = {"qw": np.cos(angle / 2), "qx": np.sin(angle / 2), "qy": 0 * angle, "qz": 0 * angle}
    turned = stream(columns, {key: {"quantity": "orientation", "unit": "1"} for key in columns})
    output = synchronize(synchronize.params(rate_hz=37.0), shard({"skin": skin(1.0, "count"), "arm": turned}))
    parts = {part: output.streams[""].column(f"arm_q{part}").to_numpy() for part in "wxyz"}
    assert np.allclose(sum(values**2 for values in parts.values()), 1)
    time_s = output.streams[""].column("t_ns").to_numpy() / 1e9
    assert np.allclose(2 * np.arctan2(parts["x"], parts["w"]), time_s / time_s[-1] * angle[-1], atol=0.02)


def test_a_quaternion_without_components_names_the_line_of_the_layout_file(shard: Recording) -> None:
    columns = {f"q{n}": np.ones(ROWS) / 2 for n in range(4)}
    odd = stream(columns, {key: {"quantity": "orientation", "unit": "1"} for key in columns})
    with pytest.raises(TacpipeError, match=r"component.*\[streams\.arm\] columns"):
        synchronize(
            synchronize.params(rate_hz=37.0, values="interpolate"), shard({"skin": skin(1.0, "count"), "arm": odd})
        )
