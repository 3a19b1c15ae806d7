"""HDF5 files, as h5py, robomimic and ALOHA write them."""

from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.formats.arrays import container
from tacpipe.formats.table import layout
from tacpipe.formats.table.contained import LayoutCommand, Params
from tacpipe.io.parquet import to_parquet
from tacpipe.plugins import registry
from tacpipe.plugins.stage import RecordingOutput
from tests.formats.arrays import files
from tests.formats.builders import about, layout_params
from tests.formats.table import labs

NONE = Params()
HDF5 = LayoutCommand("hdf5")
hdf5 = registry.load("ingest.hdf5")


def read(folder: Path, params: Params = NONE) -> dict[str, RecordingOutput]:
    sources = HDF5.discover(params, folder)
    return {name: hdf5(params, value.files, value.values) for name, value in sources.items()}


def test_each_demonstration_of_robomimic_is_a_recording_at_the_rate_of_its_controller(tmp_path: Path) -> None:
    files.robomimic(tmp_path / "lift.hdf5", demos=11)
    result = read(tmp_path)
    assert set(result) == {f"lift-demo_{number}" for number in range(11)}
    obs = result["lift-demo_10"].streams["obs"]
    assert obs.column("t_ns").to_pylist() == [row * 50_000_000 for row in range(20)]
    expected = files.values(20, 3, seed=10)
    assert obs.column("robot0_eef_pos_y").to_pylist() == expected[:, 1].tolist()
    assert about(obs, "robot0_eef_pos_y") == {"quantity": "position", "unit": "m", "component": "y"}
    assert about(obs, "tactile_3_2") == {"quantity": "tactile", "unit": "count", "taxel": "4", "axis": "z"}
    assert obs.schema.field("tactile_3_2").type == pa.uint16()
    assert "unit" not in about(obs, "robot0_gripper_qpos_0")
    assert result["lift-demo_10"].attributes["env_args.env_name"] == "Lift"
    assert result["lift-demo_10"].attributes["num_samples"] == 20
    assert [result[f"lift-demo_{number}"].attributes["mask.train"] for number in (9, 10)] == [False, True]


def test_what_is_left_out_is_named_with_its_reason(tmp_path: Path) -> None:
    files.robomimic(tmp_path / "lift.hdf5", demos=1)
    (result,) = read(tmp_path).values()
    notes = " ".join(result.notes)
    assert all(part in notes for part in ("next_obs", "model_file", "800"))
    assert "next_obs" in str(result.attributes["skipped"])


def test_frames_of_aloha_are_kept_as_they_were_encoded(tmp_path: Path) -> None:
    files.aloha(tmp_path / "episode_0.hdf5")
    layout = """
    [streams.arms]
    source = "observations"
    time = { rate_hz = 50 }
    [streams.camera]
    source = "observations/images/cam_high"
    time = { rate_hz = 50 }
    """
    (result,) = read(tmp_path, layout_params(layout)).values()
    assert result.streams["camera"].column("data").to_pylist() == files.pictures(8)
    assert about(result.streams["camera"], "data") == {"quantity": "image", "encoding": "jpeg"}
    assert about(result.streams["arms"], "qpos_5") == {"quantity": "joint_position", "unit": "rad"}
    assert about(result.streams["arms"], "qpos_6") == {"quantity": "state", "unit": "1"}
    assert result.streams["arms"].column("t_ns").to_pylist()[1] == 20_000_000


def test_decoded_frames_of_aloha_are_packets_of_raw_pixels(tmp_path: Path) -> None:
    files.aloha(tmp_path / "episode_0.hdf5", compressed=False)
    layout = '[streams.camera]\nsource = "observations/images/cam_high"\ntime = { rate_hz = 50 }'
    (result,) = read(tmp_path, layout_params(layout)).values()
    assert result.streams["camera"].column("packet").to_pylist() == [bytes(48 * 64 * 3)] * 8
    assert about(result.streams["camera"], "packet")["codec"] == "rawvideo"


def test_frames_of_their_own_length_are_kept(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time_ns"] = files.START_NS + np.arange(3)
        values = file.create_dataset("cam", (3,), dtype=h5py.vlen_dtype(np.uint8))
        for row, frame in enumerate(files.pictures(3)):
            values[row] = np.frombuffer(frame, np.uint8)
    (result,) = read(tmp_path).values()
    assert result.streams["cam"].column("data").to_pylist() == files.pictures(3)
    assert result.streams["cam"].column("t_ns").to_pylist() == [files.START_NS + row for row in range(3)]


def test_without_a_rate_nothing_is_read_and_the_entry_to_write_is_named(tmp_path: Path) -> None:
    files.robomimic(tmp_path / "lift.hdf5", demos=1, rate_hz=None)
    with pytest.raises(TacpipeError, match=r"lift\.hdf5 .*\[streams\.\w+\].*rate_hz"):
        read(tmp_path)


def test_groups_of_a_lab_have_their_own_stamps_units_and_labels(tmp_path: Path) -> None:
    files.lab(tmp_path / "run.h5")
    (result,) = read(tmp_path).values()
    assert set(result.streams) == {"skin", "arm", "gripper"}
    skin, arm, gripper = (result.streams[name] for name in ("skin", "arm", "gripper"))
    assert skin.column("t_ns").to_pylist() == [files.START_NS + row * 10_000_000 for row in range(50)]
    assert skin.column("taxels_3").to_pylist() == list(range(3, 200, 4))
    assert about(arm, "load_2") == {"unit": "N"}
    assert arm.column("t_ns").to_pylist()[4] == files.START_NS + 10**9
    assert gripper.column_names == ["t_ns", "width", "status"]
    assert gripper.column("t_ns").to_pylist() == [row * 100_000_000 for row in range(6)]
    assert gripper.column("status").to_pylist() == ["ok"] * 6
    assert (
        result.attributes["material"] == "cork"
        and result.attributes["trial"] == 3
        and result.attributes["mass"] == 0.25
    )
    assert "calibration" in " ".join(result.notes)


@pytest.mark.parametrize(
    ("name", "stamps", "unit", "second"),
    [
        ("timestamps", [1.7e9, 1.7e9 + 1], None, 1_700_000_001 * 10**9),
        ("t_us", [0, 1_000_000], None, 10**9),
        ("time", [0.0, 0.5], "seconds", 5 * 10**8),
        ("stamp", [1_700_000_000_000, 1_700_000_000_007], None, 1_700_000_000_007 * 10**6),
    ],
)
def test_the_unit_of_stamps_is_that_of_attribute_name_or_size(
    tmp_path: Path, name: str, stamps: list[float], unit: str | None, second: int
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file[name], file["x"] = stamps, [1.0, 2.0]
        if unit:
            file[name].attrs["unit"] = unit
    (result,) = read(tmp_path).values()
    assert result.streams["x"].column("t_ns").to_pylist()[1] == second


def test_stamps_of_no_known_unit_are_not_taken_for_seconds(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"], file["x"] = [0.0, 1.0], [1.0, 2.0]
    with pytest.raises(TacpipeError, match=r"a\.h5 .*rate_hz"):
        read(tmp_path)
    (result,) = read(
        tmp_path, layout_params('[streams.x]\nsource = "x"\ntime = { column = "time", unit = "ms" }')
    ).values()
    assert result.streams["x"].column("t_ns").to_pylist() == [0, 10**6]


@pytest.mark.parametrize(
    "kind", ["int8", "uint8", "int16", ">i4", "uint32", "int64", "uint64", "float32", ">f8", "bool"]
)
def test_values_keep_their_type_and_every_bit(tmp_path: Path, kind: str) -> None:
    values = np.arange(-3, 4).astype(kind)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["rate_hz"], file["x"] = 10, values
    (result,) = read(tmp_path).values()
    column = result.streams["x"].column("x")
    assert column.to_pylist() == values.tolist()
    assert column.type == pa.from_numpy_dtype(np.dtype(kind).newbyteorder("="))


def test_arrays_of_another_length_are_a_stream_of_their_own(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["fps"] = 10
        file["robot/q"], file["robot/dq"], file["robot/slow"] = (
            files.values(9, 7),
            files.values(9, 7),
            files.values(4, 2),
        )
    (result,) = read(tmp_path).values()
    assert {name: value.num_rows for name, value in result.streams.items()} == {"dq": 9, "slow": 4}
    assert len(result.streams["dq"].column_names) == 15


def test_streams_without_stamps_that_have_other_lengths_are_a_note(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["fps"] = 20
        file["actions"], file["states"] = files.values(200, 7), files.values(250, 9)
    (result,) = read(tmp_path).values()
    (note,) = result.notes
    assert "actions 200 rows; states 250 rows" in note and "20 Hz" in note


@pytest.mark.parametrize("fill", [0.0, -1.0, float("nan")])
@pytest.mark.parametrize("start_s", [1.7e9, 0.0])
def test_rows_whose_stamps_were_never_written_are_counted_and_left_out(
    tmp_path: Path, fill: float, start_s: float
) -> None:
    stamps = start_s + np.arange(50) / 8
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time_s"], file["x"] = np.where(np.arange(50) < 40, stamps, fill), np.arange(50.0)
    (result,) = read(tmp_path).values()
    assert result.streams["x"].column("x").to_pylist() == list(range(40))
    assert result.streams["x"].column("t_ns").to_pylist()[-1] == int(start_s) * 10**9 + 4_875_000_000
    assert any("the last 10 of 50 stamps" in note for note in result.notes)


def test_stamps_that_end_at_zero_are_stamps(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time_s"], file["x"] = [-2.0, -1.0, 0.0], [1.0, 2.0, 3.0]
    (result,) = read(tmp_path).values()
    assert (result.streams["x"].num_rows, list(result.notes)) == (3, [])


@pytest.mark.parametrize(
    ("stamps", "part"),
    [([1.7e9] * 3, "timestamp is left out: has 3 stamps.*x is left out: has 5 rows, and timestamp 3")]
    + [
        ([fill] * 5, r"x is left out: has stamps \(timestamp\) that were never written") for fill in (0.0, float("nan"))
    ],
)
def test_stamps_that_are_not_those_of_the_rows_are_named(tmp_path: Path, stamps: list[float], part: str) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["timestamp"], file["x"] = stamps, np.arange(5.0)
    with pytest.raises(TacpipeError, match=part):
        read(tmp_path)


def test_nothing_of_another_file_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "secret.bin", "w") as file:
        file["x"] = np.arange(4.0)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["rate_hz"] = 10
        file["y"] = np.arange(4.0)
        file["linked"] = h5py.ExternalLink(str(tmp_path / "secret.bin"), "/x")
        output = h5py.VirtualLayout(shape=(4,), dtype="f8")
        output[:] = h5py.VirtualSource(str(tmp_path / "secret.bin"), "x", shape=(4,))
        file.create_virtual_dataset("virtual", output)
    (result,) = read(tmp_path).values()
    assert result.streams["y"].column_names == ["t_ns", "y"]
    assert "linked" in " ".join(result.notes) and "virtual" in " ".join(result.notes)


def test_a_group_within_itself_ends(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["rate_hz"] = 10
        file["g/x"] = np.arange(4.0)
        file["g/again"] = file["g"]
    (result,) = read(tmp_path).values()
    assert set(result.streams) == {"g"}


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (lambda content: content[: len(content) // 2], ("cut short",)),
        (lambda content: b"", ("empty",)),
        (lambda content: b"time,x\n" * 100, ("not an HDF5 file",)),
    ],
)
def test_a_damaged_file_is_one_sentence_and_keeps_no_other_from_being_read(
    tmp_path: Path, damage: object, parts: tuple[str, ...]
) -> None:
    assert callable(damage)
    files.lab(tmp_path / "good.h5")
    (tmp_path / "bad.h5").write_bytes(damage((tmp_path / "good.h5").read_bytes()))
    sources = HDF5.discover(NONE, tmp_path)
    assert set(sources) == {"bad", "good"}
    assert hdf5(NONE, sources["good"].files, sources["good"].values).streams
    with pytest.raises(TacpipeError, match=r"bad\.h5") as raised:
        hdf5(NONE, sources["bad"].files, sources["bad"].values)
    assert all(part in str(raised.value) for part in parts)


def test_of_a_file_that_is_cut_short_all_is_read_whose_bytes_are_there_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "lift.hdf5"
    files.robomimic(path, demos=40)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    sources = HDF5.discover(NONE, tmp_path)
    full = 0
    for name, entry in sources.items():
        number = int(name.rpartition("_")[2])
        try:
            output = hdf5(NONE, entry.files, entry.values)
        except TacpipeError as error:
            assert "lift.hdf5" in str(error)
            continue
        expected = files.values(10 + number, 3, seed=number)
        assert output.streams["obs"].column("robot0_eef_pos_x").to_pylist() == expected[:, 0].tolist()
        assert f"{len(content) * 6 // 10:,} bytes" in " ".join(output.notes)
        full += 1
    assert 10 < full < 30


def test_a_damaged_array_is_named_and_costs_its_own_recording(tmp_path: Path) -> None:
    path = tmp_path / "lift.hdf5"
    with h5py.File(path, "w") as file:
        for number in range(2):
            group = file.create_group(f"demo_{number}")
            group.attrs["rate_hz"] = 10
            group.create_dataset("x", data=files.values(4000), compression="gzip", chunks=(4000,))
        place = file["demo_1/x"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[place.byte_offset + 500 : place.byte_offset + 700] = bytes(200)
    path.write_bytes(content)
    sources = HDF5.discover(NONE, tmp_path)
    assert hdf5(NONE, sources["lift-demo_0"].files, sources["lift-demo_0"].values).streams["x"].num_rows == 4000
    with pytest.raises(TacpipeError, match=r"lift\.hdf5: demo_1/x"):
        hdf5(NONE, sources["lift-demo_1"].files, sources["lift-demo_1"].values)


def test_the_layout_that_a_guess_prints_reads_the_same(tmp_path: Path) -> None:
    files.lab(tmp_path / "run.h5")
    (plain,), (laid,) = read(tmp_path).values(), read(tmp_path, layout_params(HDF5.guess(tmp_path))).values()
    assert plain.streams == laid.streams
    for name, table in plain.streams.items():
        assert table.schema.equals(laid.streams[name].schema, check_metadata=True)


def test_a_guess_marks_a_rate_that_no_file_states(tmp_path: Path) -> None:
    files.aloha(tmp_path / "episode_0.hdf5")
    assert 'rate_hz = "?"' in HDF5.guess(tmp_path)


def test_the_same_data_give_the_same_table_from_csv_and_hdf5(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    t_ns, taxels, force = (
        files.START_NS + np.arange(40) * 7_000_000,
        rng.integers(0, 4096, (40, 4)),
        rng.normal(size=40),
    )
    rows = [",".join(["t_ns", *(f"taxel_{at}" for at in range(4)), "fx"])]
    rows += [
        f"{t},{','.join(map(str, taxel_values))},{value!r}"
        for t, taxel_values, value in zip(t_ns, taxels, force.tolist(), strict=True)
    ]
    (tmp_path / "run.csv").write_text("\n".join(rows) + "\n")
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["skin/t_ns"], file["skin/taxel"], file["skin/fx"] = t_ns, taxels.astype(np.uint16), force
    columns = """
    time = { column = "t_ns", unit = "ns" }
    columns = [
        { match = "taxel_{taxel}", quantity = "tactile", unit = "count", type = "uint16" },
        { match = "fx", quantity = "force", unit = "N", component = "x" },
    ]
    """
    text = labs.read_stream_table(
        tmp_path / "run.csv", layout.parse_layout(f'[streams.skin]\nfiles = "run.csv"\n{columns}').streams[0]
    )
    (result,) = read(tmp_path, layout_params(f'[streams.skin]\nsource = "skin"\n{columns}')).values()
    assert to_parquet(result.streams["skin"].select(text.column_names)) == to_parquet(text)


@pytest.mark.parametrize("chunks", [None, 5, 16])
def test_a_stream_of_many_blocks_is_the_one_that_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunks: int | None
) -> None:
    monkeypatch.setattr(container, "BLOCK_BYTES", 400)
    values, pictures = files.values(100, 4), files.pictures(100)
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file.create_dataset("skin/force", data=values, chunks=chunks and (chunks, 4))
        file["skin/label"] = [f"row {row}" for row in range(100)]
        file["skin/t_ns"] = files.START_NS + np.arange(100) * 10**6
        frames = file.create_dataset("camera/frames", (100,), h5py.vlen_dtype(np.uint8))
        for row, picture in enumerate(pictures):
            frames[row] = np.frombuffer(picture, np.uint8)
        file["camera/t_ns"] = files.START_NS + np.arange(100) * 10**6
    (result,) = read(tmp_path).values()
    table = {name: rows.read_all() for name, rows in result.streams.items() if isinstance(rows, pa.RecordBatchReader)}
    assert sorted(table) == ["frames", "skin"]
    assert [table["skin"].column(f"force_{at}").to_pylist() for at in range(4)] == values.T.tolist()
    assert table["skin"].column("label").to_pylist()[99] == "row 99"
    assert table["frames"].column("data").to_pylist() == pictures
    assert about(table["frames"], "data") == {"quantity": "image", "encoding": "jpeg"}


def test_labels_and_clocks_of_a_sensor_are_no_channels_and_time_is_the_longest_dimension(tmp_path: Path) -> None:
    values = np.random.default_rng(3).normal(size=(18, 3, 400)).astype(np.float32)
    slips, seconds = np.arange(400) % 2, 1_700_000_000 + np.arange(400) / 64
    for clock in (True, False):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file["tactile_data"] = values
            if clock:
                file["tactile_slips_label"], file["tactile_timestamps"] = slips, seconds
            else:
                file.attrs["rate_hz"] = 64
        (output,) = read(tmp_path).values()
        (table,) = output.streams.values()
        tactile = [name for name in table.column_names if about(table, name).get("quantity") == "tactile"]
        assert len(tactile) == 54 and table.num_rows == 400
        for taxel in range(18):
            for place, axis in enumerate("xyz"):
                name = next(
                    name
                    for name in tactile
                    if (about(table, name)["taxel"], about(table, name)["axis"]) == (str(taxel + 1), axis)
                )
                assert table.column(name).to_pylist() == values[taxel, place].tolist()
        if clock:
            assert about(table, "tactile_slips_label")["quantity"] == "label"
            assert table.column("t_ns").to_pylist() == [1_700_000_000 * 10**9 + row * 15_625_000 for row in range(400)]
            rules = [line for line in HDF5.guess(tmp_path).splitlines() if 'quantity = "tactile"' in line]
            assert rules and not any("label" in line or "timestamps" in line for line in rules)
