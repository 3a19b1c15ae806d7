"""Change structures of containers and run the chain: of each the values are those of the sound file, or it is named.

A mutant is refused with a sentence, or marked: a note names the damage, and damaged rows are null. Otherwise each row of
the result equals a row of the sound file. What a mutant merely declares otherwise, such as a rate, is no damage.
"""

import re
import resource
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.csv as pc
import pytest

import tacpipe
from tacpipe.arrays import Bytes, Floats
from tacpipe.plugins.failures import DEFECT
from tests.conftest import Lab
from tests.formats import video_files
from tests.formats.lerobot import files as lerobot_files
from tests.promises import structures
from tests.promises.counts import count
from tests.promises.limits import bound_memory, is_sentence
from tests.video import videos

MAX_S = 20
TOLERANCE = 1e-3  # values are written to CSV as float32; a grey level in a cell of 64 pixels is 0.016
BASE_BYTES, BYTES_PER_BYTE = (
    300_000_000,
    40,
)  # memory of a chain: what it has at most, whatever the source, and per byte
MARKED = re.compile(r"damaged|is cut|left out|missing|without an image")
DECLARED_FEWER = re.compile("drop|number")  # changes after which a file can state fewer rows
VIDEO_LAYOUT = '[streams.gel]\nfiles = "{trial}.%s"\nformat = "video"\n'
SHEET_LAYOUT = """
[streams.a]
files = "{trial}.xlsx"
time = { column = "t", origin = "start" }
columns = [{ match = "force*", unit = "N", quantity = "tactile" }, { match = "note", type = "text" }]
"""
STATES = ("held", "gap", "ns", "arrival", "seq")  # ends of names of columns that are not values


@dataclass(frozen=True)
class Container:
    """A source in a folder, the file of it that is mutated, its mutants, and what is run."""

    write: Callable[[Path], Path]
    mutants: Callable[[bytes, int], Iterator[tuple[str, bytes]]]
    ingest: str
    layout: str = ""
    count: int = 100
    has_video: bool = True


def _video(ending: str, encoder: str) -> Callable[[Path], Path]:
    return lambda folder: videos.write_images(folder / f"a.{ending}", encoder, _textured_images(13))


def _textured_images(number: int) -> Bytes:
    """Images whose packets are longer than a lost block, (frame, row, column, rgb)."""
    noise = np.random.default_rng(0).integers(0, 60, (number, 12, 16, 3), np.uint8)
    return videos.images(number) // 2 + np.kron(noise, np.ones((1, 4, 4, 1), np.uint8))


def _slip(folder: Path) -> Path:
    return videos.write_images(
        video_files.write_gelsight(folder) / "camera_0.avi", "mjpeg", _textured_images(video_files.FRAMES + 1)
    )


def _episode(folder: Path) -> Path:
    lerobot_files.write_v2(folder, episodes=1)
    path = folder / "videos/chunk-000/observation.images.top/episode_000000.mp4"
    path.parent.mkdir(parents=True)
    videos.write(path, "mpeg4", lerobot_files.LENGTHS[0])
    return folder / "meta" / "info.json"


def _workbook(folder: Path) -> Path:
    """Write a workbook whose texts are shared, as Excel writes it."""
    book = openpyxl.Workbook()
    for row in (["t", "force_x", "force_y", "note"], *([n / 50, n * n, -n, f"word{n % 3}"] for n in range(20))):
        book.worksheets[0].append(row)
    book.create_sheet("other").append(["t", "force_x", "force_y", "note"])
    book.save(folder / "inline.xlsx")
    texts: list[str] = []

    def share(match: re.Match[str]) -> str:
        texts.append(match[1])
        return f't="s"><v>{len(texts) - 1}</v>'

    kind = "application/vnd.openxmlformats-officedocument.spreadsheetml.sharedStrings+xml"
    place = f'<Override PartName="/xl/sharedStrings.xml" ContentType="{kind}"/></Types>'
    with zipfile.ZipFile(folder / "inline.xlsx") as inline, zipfile.ZipFile(folder / "a.xlsx", "w") as archive:
        for name in inline.namelist():
            content = inline.read(name).decode().replace("</Types>", place)
            archive.writestr(name, re.sub('t="inlineStr"><is><t>([^<]*)</t></is>', share, content))
        shared = "".join(f"<si><t>{text}</t></si>" for text in texts)
        space = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
        archive.writestr("xl/sharedStrings.xml", f'<sst xmlns="{space}" count="{len(texts)}">{shared}</sst>')
    (folder / "inline.xlsx").unlink()
    return folder / "a.xlsx"


def _of(grammar: structures.Grammar) -> Callable[[bytes, int], Iterator[tuple[str, bytes]]]:
    return lambda content, number: structures.mutants(content, grammar, number)


TABLE = "ingest table source --layout layout.toml"
# Matroska does not count frames: a frame of MPEG-4 that is removed from it as a whole changes those after it unseen
CONTAINERS = {
    "MP4, MJPEG": Container(_video("mp4", "mjpeg"), _of(structures.BOXES), TABLE, VIDEO_LAYOUT % "mp4"),
    "MP4, MPEG-4": Container(_video("mp4", "mpeg4"), _of(structures.BOXES), TABLE, VIDEO_LAYOUT % "mp4"),
    "Matroska, MJPEG": Container(_video("mkv", "mjpeg"), _of(structures.ELEMENTS), TABLE, VIDEO_LAYOUT % "mkv"),
    "AVI, MJPEG": Container(_slip, _of(structures.CHUNKS), "ingest gelsight-slip source"),
    "AVI, MPEG-4": Container(_video("avi", "mpeg4"), _of(structures.CHUNKS), TABLE, VIDEO_LAYOUT % "avi"),
    "XLSX": Container(_workbook, structures.workbook_mutants, TABLE, SHEET_LAYOUT, has_video=False),
    "LeRobot": Container(
        _episode,
        lambda content, number: structures.json_mutants(content.decode(), number),
        "ingest lerobot source",
    ),
}


@pytest.mark.faults
@pytest.mark.parametrize("name", CONTAINERS)
def test_a_mutant_is_refused_or_marked_or_has_the_values_of_the_sound_file(lab: Lab, name: str) -> None:
    container, source = CONTAINERS[name], lab.folder / "source"
    source.mkdir()
    path = container.write(source)
    (lab.folder / "layout.toml").write_text(container.layout)
    sound = path.read_bytes()
    source_bytes = sum(file.stat().st_size for file in source.rglob("*") if file.is_file())
    outcome, err = run_chain(lab, container)
    assert outcome == "equal", err
    expected = values_by_stream(lab, "frames" if container.has_video else "rec")
    expected_rows = exported_values(lab).num_rows
    wrong, outcomes = list[str](), Counter[str]()
    for words, mutant in container.mutants(sound, container.count):
        path.write_bytes(mutant)
        started_s, most_bytes = time.monotonic(), max(peak_bytes(), resident_bytes() + limit_bytes(source_bytes))
        with bound_memory(ends_s=MAX_S):
            outcome, err = run_chain(lab, container)
        values = None if outcome == "refused" else exported_values(lab)
        lost_rows = outcome == "equal" and values is not None and values.num_rows < expected_rows
        if values is not None and not same_values(values, expected):
            outcome = "wrong"
        if lost_rows and not DECLARED_FEWER.search(words):
            outcome = "wrong"
        if time.monotonic() - started_s > MAX_S or peak_bytes() > most_bytes:
            outcome = "wrong"
        outcomes[outcome] += 1
        wrong += [f"{words}: {err}"] * (outcome == "wrong")
    for event, number in outcomes.items():
        count(f"mutants of {name}: {event}", number)
    assert not wrong, "\n".join(wrong)


def run_chain(lab: Lab, container: Container) -> tuple[str, str]:
    """Run the chain until a command fails; return whether it was refused or marked, and what the commands printed."""
    commands = [f"{container.ingest} -o rec", "synchronize frames -o synced", "export csv synced -o csv"]
    if container.has_video:
        commands.insert(1, "extract difference --reference-frames 1 rec -o frames")
    else:
        commands[1] = "synchronize rec -o synced"
    printed = ""
    for command in commands:
        ran = lab.call(f"{command} --replace --jobs 1")
        assert ran.code in (0, 1, 2, 4) and "Traceback" not in ran.err and DEFECT not in ran.err, ran.err
        printed += ran.err
        if ran.code:
            assert any(is_sentence(line) for line in ran.err.splitlines()), ran.err
            return "refused", ran.err
    return "marked" if MARKED.search(printed) else "equal", printed


def exported_values(lab: Lab) -> pa.Table:
    """Return the values of the CSV file at the end of the chain, without the columns that state times and holds."""
    (path,) = (lab.folder / "csv").rglob("*.csv")
    table = pc.read_csv(path)
    return table.select([name for name in table.column_names if name.rpartition("_")[2] not in STATES])


def values_by_stream(lab: Lab, dataset: str) -> dict[str, pa.Table]:
    """Return the table of each stream of the only recording of a dataset, with the names that `synchronize` gives."""
    (recording,) = tacpipe.open(lab.folder / dataset)
    tables = {stream: recording.table(stream) for stream in recording.streams}
    return {
        stream: table.rename_columns([f"{stream}_{name}" for name in table.column_names])
        for stream, table in tables.items()
    }


def same_values(table: pa.Table, expected: dict[str, pa.Table]) -> bool:
    """Return whether each row of each stream is one of those expected, beside columns of another name and null cells."""
    return all(
        _same_rows([name for name in table.column_names if name in stream.column_names], table, stream)
        for stream in expected.values()
    )


def _same_rows(names: list[str], table: pa.Table, expected: pa.Table) -> bool:
    """Return whether the rows of some columns are among those expected.

    Pixels are compared up to a constant of each channel, because the untouched gel is that of the first frame that is
    there.
    """
    texts = [name for name in names if expected[name].type == pa.string()]
    if any(not set(table[name].to_pylist()) <= {*expected[name].to_pylist(), "", None} for name in texts):
        return False
    numbers = [name for name in names if name not in texts]
    if not numbers:
        return True
    rows, rows_expected = _matrix(table, numbers), _matrix(expected, numbers)
    rows = rows[~np.isnan(rows).all(axis=1)]
    if not len(rows):
        return True
    is_image = "taxel" in numbers[0]
    offsets = rows[0] - rows_expected if is_image else np.zeros((1, len(numbers)))
    return any(all(_is_among(row - offset, rows_expected) for row in rows) for offset in offsets)


def _is_among(row: Floats, rows: Floats) -> bool:
    return bool((np.isnan(row) | (np.abs(rows - row) < TOLERANCE)).all(axis=1).any())


def _matrix(table: pa.Table, names: list[str]) -> Floats:
    columns = [pa.compute.cast(table[name], pa.float64()).to_numpy() for name in names]
    return np.stack(columns, axis=1)


def limit_bytes(source_bytes: int) -> int:
    """Return the memory that a chain may take beside what the process has."""
    return BASE_BYTES + BYTES_PER_BYTE * source_bytes


def peak_bytes() -> int:
    """Return the maximum resident memory of this process until now."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def resident_bytes() -> int:
    """Return the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
