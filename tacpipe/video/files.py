"""Read video files as streams of frames and write streams as video files; packets are copied, never re-encoded."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Int64s, Times
from tacpipe.channels.schema import DAMAGED
from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.plugins import extras
from tacpipe.plugins.video_checks import video_checks
from tacpipe.printable import plain
from tacpipe.video import lengths
from tacpipe.video.decoding import NEEDED_BY, damaged_frames, error_messages, open_decoder
from tacpipe.video.stream import (
    BATCH_ROWS,
    DTS,
    KEY_FRAME,
    MAX_PIXELS,
    PACKET,
    PTS,
    VideoFormat,
    damage_field,
    describe_damage,
    in_decode_order,
    reorder_frames,
)

if TYPE_CHECKING:
    import pyarrow as pa

DEMUXERS = {  # FFmpeg's demuxer by extension; the content does not choose it, because a playlist could open other files
    ".avi": "avi",
    ".m4v": "mp4",
    ".mjpeg": "mjpeg",
    ".mjpg": "mjpeg",
    ".mkv": "matroska",
    ".mov": "mp4",
    ".mp4": "mp4",
    ".webm": "matroska",
}
IMAGE_CODECS = {".jpeg": "mjpeg", ".jpg": "mjpeg", ".png": "png", ".webp": "webp"}  # file extension -> FFmpeg's codec
IMAGE_DEMUXERS = {"mjpeg": "jpeg_pipe", "png": "png_pipe", "webp": "webp_pipe"}
MICROSECOND = Fraction(1, 10**6)  # unit of the presentation times of images
MAX_STREAMS = 16  # number of streams of a file to which limits apply
UNCHECKED = ("vp8",)  # codecs whose decoders do not notice damage
WITHOUT_PTS = ("avi", "mjpeg")  # demuxers of files without presentation times
NOMINAL = "from nominal rate"  # origin of timestamps computed from a file's frame rate
FROM_PTS = "from presentation times"  # origin of timestamps computed from a file's presentation times
# tolerance of times relative to the grid of the nominal rate, in frames, in addition to one tick
FRAME_TOLERANCE = 1e-6


@dataclass(frozen=True)
class VideoScan:
    """The frames of a video file without their packets, in presentation order."""

    video_format: VideoFormat
    pts: Int64s  # (frame,)
    dts: Int64s  # (frame,)
    key_frame: Bools  # (frame,)
    packet_index: Int64s  # (frame,), position in the file
    bytes: int  # size of all packets
    suspect: Bools  # (frame,), whether the file is damaged next to the packet
    cut_frames: int = 0  # number of frames that the file states and does not hold

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.pts)

    def times_ns(self) -> Times:
        """Return the time of each frame in ns since the first, rounded, shape (frame,)."""
        step_ns = self.video_format.time_base * 10**9
        numerator, denominator = step_ns.numerator, step_ns.denominator
        ticks = (self.pts - self.pts[:1]).tolist()
        return np.array([(tick * numerator * 2 + denominator) // (2 * denominator) for tick in ticks], np.int64)

    def counter(self) -> Int64s | None:
        """Return the number of each frame, shape (frame,), with gaps for missing frames.

        Returns None if frames have no common rate.
        """
        rate = self.video_format.nominal_rate_hz
        return None if rate is None else _grid(self.pts, self.video_format.time_base, rate)

    def stamp_origin(self) -> str:
        """Return the origin of the timestamps: the nominal rate, or times in the file."""
        return NOMINAL if self.video_format.nominal_rate_hz is not None else FROM_PTS


def scan(path: Path) -> VideoScan:
    """Return timestamps, order and format of the frames in a file's first video stream.

    If a file has no presentation times and its codec may reorder frames, the frames are decoded once to find their
    order. Raises `TacpipeError` with the file's name if it cannot be read, or is shorter than it states, unless
    `video_checks` accepts that.
    """
    with error_messages() as messages, _open_input(path) as container:
        video = _video_stream(path, container)
        packets, suspect = _read_packets(container, video, is_after_damage=bool(messages))
        if not packets:
            raise TacpipeError(f"{path} has no frame. Copy it again from its source, or leave it out.")
        video_format = _read_video_format(path, video)
        rates = (video.base_rate, video.average_rate)
        delayed = bool(video.codec_context.has_b_frames)
        has_sound = len(container.streams) > len(container.streams.video)  # it can be longer than the video
        stated = _StatedLength(
            video.frames,
            0.0 if has_sound else (container.duration or 0) / 10**6,
            float(video.average_rate or 0),
            float(video.time_base),
        )
    pts, dts, is_key_frame, sizes = (list(column) for column in zip(*packets, strict=True))
    cut_frames = _cut_frames(path, pts, dts, stated)
    if None in pts or len(set(pts)) < len(pts) or (delayed and DEMUXERS[path.suffix.lower()] in WITHOUT_PTS):
        order = _presentation_order(path, video_format) if delayed else list(range(len(packets)))
        dts = _increasing(dts)
        delay = max(dts[position] - dts[rank] for rank, position in enumerate(order))
        pts = [stamp for _, stamp in sorted((position, dts[rank] + delay) for rank, position in enumerate(order))]
    elif None in dts or not _increases(dts):
        sorted_pts = sorted(pts)
        delay = max(early - late for early, late in zip(sorted_pts, pts, strict=True))
        dts = [stamp - delay for stamp in sorted_pts]
    order_by_pts = np.argsort(np.array(pts, np.int64), kind="stable")
    all_pts, all_dts = np.array(pts, np.int64)[order_by_pts], np.array(dts, np.int64)[order_by_pts]
    rate = next((rate for rate in rates if rate and _grid(all_pts, video_format.time_base, rate) is not None), None)
    return VideoScan(
        replace(
            video_format,
            nominal_rate_hz=None if rate is None else Fraction(rate),
            reorder_frames=reorder_frames(all_dts),
        ),
        all_pts,
        all_dts,
        np.array(is_key_frame, bool)[order_by_pts],
        order_by_pts.astype(np.int64),
        sum(sizes),
        np.array(suspect, bool)[order_by_pts],
        cut_frames,
    )


def _read_packets(
    container: Any, video: Any, *, is_after_damage: bool
) -> tuple[list[tuple[int | None, int | None, bool, int]], list[bool]]:
    """Return times, key flag and size of each packet of a stream, and whether it is next to damage of the file.

    Where FFmpeg finds something else than a packet, it skips to the next, and packets may be lost in between.
    ``is_after_damage``: whether it reported damage when it opened the file, for which it reads the first packets.
    """
    packets: list[tuple[int | None, int | None, bool, int]] = []
    suspect: list[bool] = []
    demuxed = container.demux(video)
    while True:
        with error_messages() as messages:
            packet = next(demuxed, None)
        if messages:
            is_after_damage = True
            suspect[-1:] = [True] * len(suspect[-1:])
        if packet is None:
            return packets, suspect
        if packet.size:
            packets.append((packet.pts, packet.dts, packet.is_keyframe, packet.size))
            suspect.append(is_after_damage or packet.is_corrupt)
            is_after_damage = False


@dataclass(frozen=True)
class _StatedLength:
    """The length of a video according to its file; 0 where the file states none."""

    frames: int
    duration_s: float
    rate_hz: float
    time_base_s: float


def _cut_frames(path: Path, pts: Sequence[int | None], dts: Sequence[int | None], stated: _StatedLength) -> int:
    """Return the number of frames that a file states and does not hold, at least 1 if its end is missing.

    ``pts`` and ``dts`` are the times of its packets. Raises `TacpipeError` if there are any, unless `video_checks`
    accepts them.
    """
    demuxer, count = DEMUXERS[path.suffix.lower()], len(pts)
    stated_frames = stated.frames
    if demuxer == "avi":  # decoding times count frames, including those without a packet
        stated_frames = max(stated_frames, lengths.avi_frames(path))
        count = max(count, (dts[-1] or 0) - (dts[0] or 0) + 1)
    stamps = sorted(stamp for stamp in pts if stamp is not None)
    steps_s = [1 / stated.rate_hz if stated.rate_hz else 0.0, *(np.diff(stamps) * stated.time_base_s)]
    last_s = stamps[-1] * stated.time_base_s if stamps else stated.duration_s
    lost_bytes = lengths.missing_bytes(path, demuxer)
    is_short = stated.duration_s - last_s > 2 * max(steps_s)
    if stated_frames <= count and not lost_bytes and not is_short:
        return 0
    of_frames = max(stated_frames, round(stated.duration_s * stated.rate_hz))
    if not video_checks().accept_cut:
        total = f"{of_frames:,}" if of_frames > count else "an unknown number"
        end = f", and {lost_bytes:,} bytes at its end are missing" if lost_bytes else ""
        raise TacpipeError(
            f"{path} is cut after frame {count:,} of {total}{end}. Copy it again from its source, leave it out with "
            f"--skip-bad, or read what there is with --accept-cut."
        )
    return max(1, of_frames - count)


def scan_images(paths: Sequence[Path]) -> VideoFormat:
    """Return the format of a stream whose packets are image files, each a key frame.

    Raises `TacpipeError` with the file's name if it is not an image or differs from the first in kind or size, and if
    there are no files.
    """
    first: VideoFormat | None = None
    for path in paths:
        codec = IMAGE_CODECS[path.suffix.lower()]
        with _open_input(path, IMAGE_DEMUXERS[codec]) as container:
            image_format = replace(_read_video_format(path, _video_stream(path, container)), time_base=MICROSECOND)
        first = first or replace(image_format, codec=codec)
        size = (codec, image_format.width_px, image_format.height_px)
        if size != (first.codec, first.width_px, first.height_px):
            raise TacpipeError(
                f"{path} is {codec} of {size[1]} x {size[2]} pixels, and {paths[0]} is {first.codec} of {first.width_px} x "
                f"{first.height_px}. The images of a stream have one kind and size: put others into another folder."
            )
    if first is None:
        raise TacpipeError("There is no image. Give a folder with JPEG, PNG or WebP files.")
    return first


def read_images(paths: Sequence[Path], t_ns: Times, stamp_origin: str | None, notes: list[str]) -> pa.RecordBatchReader:
    """Return a stream of frames from image files, read on demand; ``t_ns`` (frame,) are the timestamps.

    Presentation times are distinct microseconds since the first frame. ``stamp_origin`` is the origin of timestamps
    that do not come from a clock. A note on damaged images is added to ``notes``. Raises `TacpipeError` as `scan_images`
    does.
    """
    video_format = scan_images(paths)
    index = np.arange(len(paths))
    pts = np.maximum.accumulate((t_ns - t_ns[:1]) // 1000 - index) + index
    clocks = (pts, pts, np.ones(len(paths), bool))

    def read(damaged: Bools | None) -> pa.RecordBatchReader:
        return packet_stream(video_format, map(regular.source, paths), clocks, t_ns, None, stamp_origin, damaged)

    return _verified(read, video_format, np.zeros(len(paths), bool), paths[0].parent, notes)


def read_packets(path: Path, frames: VideoScan) -> Iterator[bytes]:
    """Yield the packets of a file in presentation order, given its `scan`; at most ``reorder_frames`` + 1 are buffered.

    Raises `TacpipeError` if the file has changed since.
    """
    rows = np.argsort(frames.packet_index).tolist()  # rows in the order of the file
    early_packets: list[tuple[int, bytes]] = []
    next_row = 0
    with _open_input(path) as container:
        packets = (packet for packet in container.demux(_video_stream(path, container)) if packet.size)
        for row, packet in zip(rows, packets, strict=False):
            heapq.heappush(early_packets, (row, bytes(packet)))
            while early_packets and early_packets[0][0] == next_row:
                yield heapq.heappop(early_packets)[1]
                next_row += 1
    if next_row != len(frames):
        raise TacpipeError(f"{path} changed while it was read. Run the command again.")


def read_stream(
    path: Path, frames: VideoScan, t_ns: Times, stamp_origin: str | None, notes: list[str]
) -> pa.RecordBatchReader:
    """Return the stream of frames of a file, read on demand; ``t_ns`` (frame,) are the timestamps.

    ``stamp_origin`` is the origin of timestamps that do not come from a clock. Notes on damaged frames, and on those
    that the file does not hold, are added to ``notes``. Raises `TacpipeError` if the file cannot be read, also while the
    stream is read.
    """
    clocks, counter = (frames.pts, frames.dts, frames.key_frame), frames.counter()

    def read(damaged: Bools | None) -> pa.RecordBatchReader:
        packets = read_packets(path, frames)
        return packet_stream(frames.video_format, packets, clocks, t_ns, counter, stamp_origin, damaged)

    if frames.cut_frames:
        notes.append(
            f"{path} is cut after frame {len(frames):,} of {len(frames) + frames.cut_frames:,}; the rest is missing."
        )
    if DEMUXERS[path.suffix.lower()] == "matroska" and (lost_bytes := lengths.foreign_bytes(path)):
        notes.append(f"{path} is damaged: {lost_bytes:,} bytes are not Matroska, and frames in them are missing.")
    return _verified(read, frames.video_format, frames.suspect, path, notes)


def _verified(
    read: Callable[[Bools | None], pa.RecordBatchReader],
    video_format: VideoFormat,
    suspect: Bools,
    path: Path,
    notes: list[str],
) -> pa.RecordBatchReader:
    """Return the stream that ``read`` returns for the mask of damaged frames (frame,), or None if there are none.

    ``suspect`` are the frames next to damage of the file. Raises the errors of `find_damage`.
    """
    damaged = find_damage(read(None), video_format, suspect, path, notes)
    return read(damaged if damaged.any() else None)


def find_damage(
    stream: Iterable[pa.RecordBatch], video_format: VideoFormat, suspect: Bools, path: Path, notes: list[str]
) -> Bools:
    """Return which frames of a stream are damaged (frame,), none if `video_checks` does not verify videos.

    ``suspect`` are the frames next to damage of the file. A note about damaged frames is added to ``notes``. Raises
    `TacpipeError` if all are.
    """
    import pyarrow as pa

    if not video_checks().verify_video:
        return np.zeros(len(suspect), bool)
    damaged = damaged_frames(video_format, (pa.Table.from_batches([batch]) for batch in stream), suspect)
    if damaged.all() and len(damaged):
        raise TacpipeError(
            f"{path}: none of the {len(damaged):,} frames can be decoded as {plain(video_format.codec)}. Copy it again from "
            f"its source, or leave it out."
        )
    if damaged.any():
        notes.append(f"{path}: {describe_damage(damaged)}.")
    if video_format.codec in UNCHECKED:
        notes.append(f"{path} is {plain(video_format.codec)}, whose frames carry no check: damage to them is not seen.")
    return damaged


def packet_stream(
    video_format: VideoFormat,
    packets: Iterable[bytes],
    clocks: tuple[Int64s, Int64s, Bools],
    t_ns: Times,
    seq: Int64s | None,
    stamp_origin: str | None,
    damaged: Bools | None = None,
) -> pa.RecordBatchReader:
    """Return a stream of frames from packets in presentation order, taken on demand.

    ``clocks`` are ``pts``, ``dts`` and ``key_frame`` of each packet, each (frame,). ``seq`` counts frames, None without
    a counter. ``damaged`` (frame,) becomes a column; None if no frame is known to be damaged.
    """
    import pyarrow as pa

    schema = video_format.schema(stamp_origin, counted=seq is not None)
    pts, dts, key_frame = clocks
    columns: dict[str, AnyArray] = {"t_ns": t_ns, PTS: pts, DTS: dts, KEY_FRAME: key_frame}
    if seq is not None:
        columns["seq"] = seq
    if damaged is not None:
        schema, columns[DAMAGED] = schema.append(damage_field()), damaged

    def batches() -> Iterator[pa.RecordBatch]:
        source = iter(packets)
        for first in range(0, len(t_ns), BATCH_ROWS):
            stop = min(first + BATCH_ROWS, len(t_ns))
            content = [next(source) for _ in range(first, stop)]
            arrays = [
                pa.array(content, pa.binary()) if field.name == PACKET else pa.array(columns[field.name][first:stop])
                for field in schema
            ]
            yield pa.RecordBatch.from_arrays(arrays, schema=schema)

    return pa.RecordBatchReader.from_batches(schema, batches())


def write_file(path: Path, video_format: VideoFormat, batches: Iterable[pa.Table]) -> None:
    """Write rows of a stream of frames, starting at a key frame, to the video file ``path`` of any supported extension.

    Packets are copied. Times start at 0. Raises `TacpipeError` if the kind of file does not support the codec, and
    `MissingModuleError` if PyAV is not installed.
    """
    with extras.explain_missing("Writing video"):
        import av
    try:
        with av.open(str(path), "w") as container:
            stream = add_stream(container, video_format)
            start_pts = None
            for packet, columns in decode_order_packets(video_format, batches):
                start_pts = packet.pts if start_pts is None else start_pts
                packet.pts, packet.dts = columns[PTS] - start_pts, columns[DTS] - start_pts
                packet.stream = stream
                container.mux_one(packet)
    except (av.error.FFmpegError, ValueError) as error:
        raise TacpipeError(
            f"{path} cannot be written: a {path.suffix} file does not hold {plain(video_format.codec)} as it was recorded "
            f"({plain(str(error), 100)}). Give a name that ends in .mkv or .mp4."
        ) from error


def add_stream(container: Any, video_format: VideoFormat) -> Any:
    """Return a stream of a PyAV output file that accepts packets of this format unchanged."""
    import av

    with av.open("/dev/null", "w", format="nut") as scratch:
        template = scratch.add_stream(video_format.codec, rate=video_format.nominal_rate_hz or 1)
        stream = container.add_stream_from_template(template, opaque=True)
    context = stream.codec_context
    context.width, context.height = video_format.width_px, video_format.height_px
    if video_format.pixel_format:
        context.pix_fmt = video_format.pixel_format
    context.extradata = video_format.extradata or None
    context.framerate = video_format.nominal_rate_hz or Fraction(0)
    stream.time_base = video_format.time_base
    return stream


def decode_order_packets(
    video_format: VideoFormat, batches: Iterable[pa.Table]
) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Yield PyAV packets with their times, and the columns of their rows, in decoding order, without empty packets."""
    import av

    frame_ticks = 1
    if video_format.nominal_rate_hz:
        frame_ticks = max(1, round(1 / (video_format.nominal_rate_hz * video_format.time_base)))
    for _, columns in in_decode_order(video_format, batches):
        if not columns[PACKET]:
            continue
        packet = av.Packet(columns[PACKET])
        packet.time_base, packet.duration = video_format.time_base, frame_ticks
        packet.pts, packet.dts = int(columns[PTS]), int(columns[DTS])
        packet.is_keyframe = bool(columns[KEY_FRAME])
        yield packet, columns


@contextmanager
def _open_input(path: Path, demuxer: str = "") -> Iterator[Any]:
    """Yield a video file opened by PyAV, with the ``demuxer`` or that of its extension.

    Raises `TacpipeError` with the file's name for errors of FFmpeg, also within the block.
    """
    with extras.explain_missing(NEEDED_BY):
        import av
    if not demuxer and path.suffix.lower() not in DEMUXERS:
        raise TacpipeError(
            f"{path} cannot be read as a video: its name must end in {', '.join(DEMUXERS)}. Convert it, or leave it out."
        )
    with regular.failing(path), regular.opened(path) as file:
        if not path.stat().st_size:
            raise TacpipeError(f"{path} is empty. Copy it again from its source, or leave it out.")
        try:
            # opening decodes the first frames of some codecs
            limits: Any = [{"max_pixels": str(MAX_PIXELS)}] * MAX_STREAMS
            with av.open(file, format=demuxer or DEMUXERS[path.suffix.lower()], stream_options=limits) as container:
                yield container
        except (av.error.FFmpegError, ValueError) as error:
            reason = plain(str(getattr(error, "strerror", None) or error), 100)
            raise TacpipeError(
                f"{path} cannot be read as a video: {reason}. Copy it again from its source, or leave it out."
            ) from error


def _video_stream(path: Path, container: Any) -> Any:
    if not container.streams.video:
        raise TacpipeError(f"{path} has no video in it. Give a file with a video, or leave it out.")
    return container.streams.video[0]


def _read_video_format(path: Path, video: Any) -> VideoFormat:
    """Return the format of a file's video stream. Raises `TacpipeError` without a known codec or the size of frames."""
    context = video.codec_context
    if context is None:
        raise TacpipeError(
            f"{path} has a video of a codec that cannot be decoded. Copy it again from its source, or leave it out."
        )
    if not (context.width and context.height and video.time_base):
        raise TacpipeError(
            f"{path} does not state the size of its frames, or they have more than {MAX_PIXELS:,} pixels. Copy it again "
            f"from its source, reduce it, or leave it out."
        )
    return VideoFormat(
        context.codec.canonical_name,
        context.width,
        context.height,
        context.pix_fmt or "",
        Fraction(video.time_base),
        extradata=context.extradata or b"",
    )


def _presentation_order(path: Path, video_format: VideoFormat) -> list[int]:
    """Return the file positions of frames in presentation order, found by decoding; those never presented follow.

    Raises `TacpipeError` if several frames are decoded from one packet.
    """
    order: list[int] = []
    position = 0
    with _open_input(path) as container:
        decoder = open_decoder(replace(video_format, reorder_frames=1))
        for packet in container.demux(_video_stream(path, container)):
            if packet.size:
                packet.pts = packet.dts = position
                position += 1
                order += [int(frame.pts) for frame in decoder.decode(packet)]
        order += [int(frame.pts) for frame in decoder.decode(None)]
    if len(set(order)) < len(order):
        raise TacpipeError(
            f"{path} has a packet from which several frames are decoded. Copy it again from its source, or leave it out."
        )
    return order + sorted(set(range(position)) - set(order))


def _increasing(dts: Sequence[int | None]) -> list[int]:
    """Return strictly increasing decoding times: those of the file, or indices if it has none."""
    stamps = [stamp for stamp in dts if stamp is not None]
    return stamps if len(stamps) == len(dts) and _increases(stamps) else list(range(len(dts)))


def _increases(stamps: Sequence[int | None]) -> bool:
    return all(early is not None and late is not None and early < late for early, late in itertools.pairwise(stamps))


def _grid(pts: Int64s, time_base: Fraction, rate: Fraction) -> Int64s | None:
    """Return the number of each frame at a common rate, (frame,), from 0, or None if the times do not fit the rate.

    They do not fit either if most frames would be missing, because FFmpeg guesses such rates for irregular times.
    """
    per_tick = Fraction(rate) * time_base
    frames = (pts - pts[0]).astype(np.float64) * float(per_tick)
    numbers = np.rint(frames).astype(np.int64)
    tolerance = min(0.25, (0.0 if per_tick == 1 else float(per_tick)) + FRAME_TOLERANCE)
    fits = bool((np.abs(frames - numbers) <= tolerance).all()) and bool((np.diff(numbers) > 0).all())
    return numbers if fits and np.median(np.diff(numbers, append=numbers[-1] + 1)) == 1 else None
