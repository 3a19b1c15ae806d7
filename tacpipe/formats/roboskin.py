"""Slides of an iCub's forearm, RoboSkin, over the same twenty materials as the BioTac slides (IROS 2020).

Published in dexrob/BioTac_slide_20_50 as arrays (slide, triangle, taxel, time) of 200 slides, one file per fold with a
file of labels each. The published axes result from a wrong reshape; the arrangement of a file is detected from its
values. The rate is not published.

Time is the axis with the highest autocorrelation. Each slide was written as (taxel, time, triangle) and then read as
(triangle, taxel, time) without moving its axes: ``X[r, c, j] = U[(T r + j) mod 6, c, floor((T r + j) / 6)]`` for slides
of T frames and 6 triangles, where U is the measured slide. This is a permutation, so it can be undone exactly.
"""

from __future__ import annotations

import ast
import functools
import io
import math
import os
import re
import tokenize
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tacpipe.errors import TacpipeError
from tacpipe.formats import published
from tacpipe.formats.faults import explaining
from tacpipe.io import regular
from tacpipe.io.files import walk
from tacpipe.plugins.constraints import Rate
from tacpipe.plugins.stage import Attribute, Discovery, Files, RecordingOutput, stage
from tacpipe.plugins.stream_selection import StreamSelection
from tacpipe.printable import excerpt

if TYPE_CHECKING:
    from tacpipe.arrays import AnyArray, Float32s

BLOCK = re.compile(r"icub_(?:(?:fold|val)_(\d+)|(test))\.npy")
PLACE = re.compile(r"(.+\.npy)\[(\d+)\]")
MAX_READING = 255.0  # readings have eight bits, with temperature compensation
# lag-1 autocorrelation: published slides have 0.92 or more along time and 0.82 or less along other axes
ALONG_TIME = 0.85
UNREADABLE = (
    *(ValueError, EOFError, SyntaxError, LookupError, TypeError, RecursionError, OverflowError),
    tokenize.TokenError,
)
MADE = "from nominal rate"
MAX_LABEL = 10_000  # maximum number of materials
MAX_HEADER_BYTES = 10_000  # maximum header size, as in numpy
KIND = re.compile(r"[<>|=]?[bfiu](\d)")  # numeric dtype with its size in bytes


@dataclass(frozen=True)
class Params(StreamSelection):
    """How slides are read."""

    rate_hz: Rate = 50.0  # frames per second of the time stamps; nominal, because the set does not state it
    # time: frames in order of time; authors: in the published order, for comparisons
    layout: Literal["time", "authors"] = "time"


def discover(params: Params, source: Path) -> dict[str, dict[str, Path]]:
    """Return the block and its labels, each with the slide's index in it, by recording name.

    A block is ``icub_fold_0.npy`` (published as ``icub_val_0.npy``) or ``icub_test.npy``, and its labels are
    ``labels_fold_0.npy`` and so on in the same folder. Folders below one with blocks are not searched. Raises
    `TacpipeError` if ``source`` is not a folder, contains no block or one twice, if labels are missing, or if a block
    is not an array of slides.
    """
    if not source.is_dir():
        raise TacpipeError(f"{source} is not a folder; give the folder that holds icub_fold_0.npy and so on.")
    blocks: dict[str, Path] = {}
    for name, path in _find_blocks(source):
        if name in blocks:
            raise TacpipeError(f"{blocks[name]} and {path} are the same block. Give the folder that holds one of them.")
        blocks[name] = path
    if not blocks:
        raise TacpipeError(
            f"{source} holds no block of slides: no file in it is named as icub_fold_0.npy. Give the folder of the "
            f"unpacked data set."
        )
    files_by_slide: dict[str, dict[str, Path]] = {}
    for name, path in sorted(blocks.items()):
        labels = path.with_name(path.name.replace("icub", "labels", 1))
        if not labels.is_file():
            raise TacpipeError(f"{path} has no labels: {labels.name} is not next to it. Copy both files.")
        for slide in range(_count_slides(path)):
            files_by_slide[f"roboskin-{name}-{slide:03d}"] = {f"{file.name}[{slide}]": file for file in (path, labels)}
    return files_by_slide


@stage(version=2, source=Discovery(discover))
def roboskin(params: Params, files: Files) -> RecordingOutput:
    """Read published slides of an iCub RoboSkin.

    Each recording has the stream roboskin: 60 columns, triangle by triangle, and one row per frame. Time stamps follow
    from the mean rate.
    """
    import numpy as np

    from tacpipe.channels import schema
    from tacpipe.signals.resampling import uniform_grid

    (block, index), (labels, _) = sorted((path, _slide_number(name)) for name, path in files.items())
    slide = _read_slide(block, index)  # (triangle, taxel, time)
    if params.layout == "authors":
        slide = scramble(slide)
    frames = slide.shape[-1]
    t_ns = uniform_grid(0, round((frames - 1) * 1e9 / params.rate_hz), params.rate_hz)
    columns = np.reshape(slide, (-1, frames))
    material = _read_label(block, labels, index) + 1
    return RecordingOutput(
        {"roboskin": schema.stream(t_ns, columns, schema.roboskin_fields(), MADE)},
        {
            "sensor": "roboskin",
            "material": material,
            "trial": index,
            "session": f"roboskin-m{material:02d}",
            "rate_hz": params.rate_hz,
            "layout": params.layout,
            **published.published_attribute("roboskin"),
            **_role_attribute(block),
        },
        rows={},
    )


def _find_blocks(source: Path) -> list[tuple[str, Path]]:
    """Return the blocks below a folder as pairs of name and path."""
    blocks = []
    for folder, subfolders, names in walk(source):
        for name in sorted(names):
            match = BLOCK.fullmatch(name)
            if match is not None:
                blocks.append((match[2] or f"fold{int(match[1])}", Path(folder) / name))
                subfolders.clear()  # subfolders of the published folder contain arrays derived from these
    return blocks


def _count_slides(path: Path) -> int:
    """Return the number of slides in a block from its header only; loading numpy would take longer than a cache hit.

    Raises `TacpipeError` if it is not an array of numbers (slide, triangle, taxel, time) of the declared size.
    """
    with _refusing_damage(path):
        with regular.failing(path), regular.opened(path) as file:
            if file.read(6) != b"\x93NUMPY":
                raise ValueError("it does not begin as an array of numpy does")
            is_long = file.read(2)[0] > 1
            header_bytes = int.from_bytes(file.read(4 if is_long else 2), "little")
            if header_bytes > MAX_HEADER_BYTES:
                raise ValueError(f"its head has {header_bytes} bytes, {MAX_HEADER_BYTES} are allowed")
            header = ast.literal_eval(file.read(header_bytes).decode())
            available = os.fstat(file.fileno()).st_size - file.tell()
        shape, kind = header["shape"], KIND.fullmatch(header["descr"])
    if not (isinstance(shape, tuple) and len(shape) == 4 and all(type(size) is int and size > 0 for size in shape)):
        raise TacpipeError(
            f"{path} has the shape {excerpt(shape)}; it must be (slide, triangle, taxel, time). Give the set's own files."
        )
    if kind is None:
        described = excerpt(header["descr"])
        raise TacpipeError(
            f"{path} cannot be read as an array of numbers: it holds {described}. Copy it again from its source."
        )
    if math.prod(shape) * int(kind[1]) > available:
        raise TacpipeError(
            f"{path} cannot be read as an array of numbers: it declares {excerpt(shape)} numbers of {kind[1]} bytes, and "
            f"{available} bytes follow. Copy it again from its source."
        )
    return int(shape[0])


def _slide_number(name: str) -> int:
    match = PLACE.fullmatch(name)
    assert match is not None
    return int(match[2])


def _role_attribute(block: Path) -> dict[str, Attribute]:
    """Return the attribute with the authors' role of a block."""
    match = BLOCK.fullmatch(block.name)
    assert match is not None
    return {"authors_role": "test"} if match[2] else {"authors_fold": int(match[1])}


def _read_slide(path: Path, index: int) -> Float32s:
    """Return a measured slide (triangle, taxel, time) as float32, with its values checked.

    If a slide has too little contact to reveal its time axis, the axis of its block is used. Raises `TacpipeError` for
    invalid readings, or if the time axis cannot be found.
    """
    import numpy as np

    from tacpipe.channels.schema import TRIANGLE_TAXELS, TRIANGLES

    block = _cached_array(path)
    if block.dtype.kind not in "fiu" or block.shape[1:3] != (TRIANGLES, TRIANGLE_TAXELS) or block.shape[3] < 2:
        raise TacpipeError(
            f"{path} is an array of {block.dtype} of the shape {block.shape}; it must hold numbers, and be (slide, "
            f"{TRIANGLES} triangles, {TRIANGLE_TAXELS} taxels, two or more frames)."
        )
    slide = np.array(block[index], dtype=np.float32)  # (triangle, taxel, time)
    if not np.isfinite(slide).all():
        raise TacpipeError(f"{path}, slide {index} holds values that are not finite. Copy the file again.")
    if slide.min() < 0 or slide.max() > MAX_READING:
        raise TacpipeError(
            f"{path}, slide {index} holds values from {slide.min():g} to {slide.max():g}; readings lie from 0 to "
            f"{MAX_READING:g}. It looks like 8-bit numbers that wrapped. Copy the file again, or leave the slide out."
        )
    for evidence in (slide, block):
        if is_time(evidence, -1, ALONG_TIME):
            return slide
        if is_time(unscramble(evidence), -1, ALONG_TIME):
            return unscramble(slide)
    raise TacpipeError(
        f"{path}, slide {index}: neither as it stands nor unscrambled is its last axis time. Neighbours along it "
        f"correlate by {lag_one(slide, -1):.2f} and {lag_one(unscramble(slide), -1):.2f}; along time it is {ALONG_TIME} or "
        f"more, and more than along other axes. Check how the array was made."
    )


def _read_label(block: Path, path: Path, index: int) -> int:
    """Return the label of slide ``index`` (from 0) of a block; ``path`` has one label per slide.

    Raises `TacpipeError` if the labels are not one integer per slide.
    """
    import numpy as np

    labels, slides = np.atleast_1d(_cached_array(path)).ravel(), len(_cached_array(block))
    if len(labels) != slides:
        raise TacpipeError(f"{path} has {len(labels)} labels and {block.name} {slides} slides; copy both files again.")
    label = labels[index]
    if labels.dtype.kind not in "fiu" or not (0 <= label <= MAX_LABEL and label == np.rint(label)):
        raise TacpipeError(
            f"{path}, label {index} is {excerpt(label)}; it must be a whole number from 0 to {MAX_LABEL}. Copy the "
            f"file again."
        )
    return int(label)


def _cached_array(path: Path) -> AnyArray:
    """Return an array. Raises `TacpipeError` if the file is not an array; pickles are never loaded."""
    with regular.failing(path):
        stat = path.stat()
    return _load_array(path, stat.st_size, stat.st_mtime_ns)


@functools.lru_cache(maxsize=2)  # a block and its labels, because the slides of a block are read one after another
def _load_array(path: Path, size: int, t_ns: int) -> AnyArray:
    """Return the array in a file; the result is cached until size or modification time change.

    The file is not memory-mapped, because a disk error would then end the process with SIGBUS.
    """
    import numpy as np

    content = regular.source(path)
    with _refusing_damage(path):
        file = io.BytesIO(content)
        is_long = np.lib.format.read_magic(file) != (1, 0)
        read_header = np.lib.format.read_array_header_2_0 if is_long else np.lib.format.read_array_header_1_0
        shape, _, kind = read_header(file)
        if math.prod(shape) * kind.itemsize > len(content):  # checked before np.load, which allocates the array
            raise ValueError(f"its head declares {math.prod(shape)} numbers, and it has {len(content)} bytes")
        array: AnyArray = np.load(io.BytesIO(content), allow_pickle=False)
    array.flags.writeable = False
    return array


def _refusing_damage(path: Path) -> AbstractContextManager[None]:
    """Raise errors of a damaged array in the block as a `TacpipeError`."""
    advice = ". Copy it again from its source."
    return explaining(UNREADABLE, f"{path} cannot be read as an array of numbers: ", advice)


MIN_AUTOCORRELATION = 0.5  # minimum lag-1 autocorrelation along the time axis


def lag_one(values: AnyArray, axis: int) -> float:
    """Return the lag-1 autocorrelation of ``values`` along ``axis``, or NaN if it is not defined.

    >>> import numpy as np
    >>> round(lag_one(np.array([[0.0, 1.0, 2.0, 3.0], [9.0, 8.0, 7.0, 6.0]]), axis=1), 1)
    1.0
    """
    import numpy as np

    series = np.moveaxis(np.asarray(values, dtype=np.float64), axis, 0)
    earlier, later = series[:-1].ravel(), series[1:].ravel()
    if not earlier.size or not np.isfinite(series).all():
        return float("nan")
    earlier, later = earlier - earlier.mean(), later - later.mean()
    spread = float(np.sqrt((earlier @ earlier) * (later @ later)))
    return float(earlier @ later) / spread if spread > 0 else float("nan")


def is_time(values: AnyArray, axis: int, lowest: float = MIN_AUTOCORRELATION) -> bool:
    """Return whether ``axis`` can be time: its lag-1 autocorrelation is the highest of all axes and at least ``lowest``.

    Returns False if nothing varies along it.
    """
    import numpy as np

    candidate = axis % values.ndim
    along = [lag_one(values, index) for index in range(values.ndim)]
    other_axes = [
        correlation for index, correlation in enumerate(along) if index != candidate and np.isfinite(correlation)
    ]
    return along[candidate] >= lowest and all(along[candidate] > correlation for correlation in other_axes)


def scramble(slides: AnyArray) -> AnyArray:
    """Return ``slides`` (…, triangle, taxel, time) in the published arrangement, with the same shape.

    >>> import numpy as np
    >>> measured = np.array([[[0, 1, 2, 3]], [[10, 11, 12, 13]]])  # (triangle, taxel, time)
    >>> scramble(measured).tolist()
    [[[0, 10, 1, 11]], [[2, 12, 3, 13]]]
    """
    import numpy as np

    triangles, taxels, frames = slides.shape[-3:]
    in_turn = np.moveaxis(slides, -3, -1)  # (…, taxel, time, triangle)
    rows = in_turn.reshape(*slides.shape[:-3], taxels, triangles, frames)
    return np.ascontiguousarray(np.swapaxes(rows, -3, -2))


def unscramble(published: AnyArray) -> AnyArray:
    """Return measured slides (…, triangle, taxel, time) from the published arrangement; the inverse of `scramble`.

    >>> import numpy as np
    >>> unscramble(np.array([[[0, 10, 1, 11]], [[2, 12, 3, 13]]])).tolist()
    [[[0, 1, 2, 3]], [[10, 11, 12, 13]]]
    """
    import numpy as np

    triangles, taxels, frames = published.shape[-3:]
    rows = np.swapaxes(published, -3, -2)  # (…, taxel, row, column)
    in_turn = rows.reshape(*published.shape[:-3], taxels, frames, triangles)
    return np.ascontiguousarray(np.moveaxis(in_turn, -1, -3))
