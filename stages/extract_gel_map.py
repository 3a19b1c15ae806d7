"""Read presses of balls into a gel, and fit the map from colour changes to slopes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.constraints import NonNegativeFloat, PositiveInt, Unit
from tacpipe.plugins.file_params import pin_file
from tacpipe.plugins.rows import RowCounts, count_rows
from tacpipe.plugins.stage import Result, stage
from tacpipe.plugins.stream_selection import StreamSelection
from tacpipe.printable import listed

if TYPE_CHECKING:
    from tacpipe.arrays import Bytes, Floats
    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.video.gel_presses import GelFit, Press

ERRORS = "errors.json"  # file with circle and errors of each press
DIAMETER = "diameter_mm"  # label with the diameter of the ball


@dataclass(frozen=True)
class Params(StreamSelection):
    """The balls, the size of a pixel, and the untouched gel."""

    mm_per_px: Annotated[NonNegativeFloat, Unit("mm")] = 0.0  # required: width of a pixel on the gel
    # diameter of the ball; 0: the label diameter_mm of each recording
    diameter_mm: Annotated[NonNegativeFloat, Unit("mm")] = 0.0
    background: str = ""  # JPEG or PNG image of the untouched gel; empty: the first frames of each recording
    background_sha256: str = ""  # sha256 of that image; computed if omitted
    reference_frames: PositiveInt = 5  # number of first frames that show the untouched gel, without a background

    def __post_init__(self) -> None:
        """Compute the digest of the background. Raises the errors of `pin_file`."""
        digest = pin_file("background", self.background, self.background_sha256)
        object.__setattr__(self, "background_sha256", digest)


@stage(version=1, reads=(DIAMETER,))
def gel_map(params: Params, presses: Dataset) -> Result:
    """Fit the map from colour changes of a gel to slopes.

    Each recording is a press of a ball of known diameter into the gel, an image or a video, of which the frame with the
    largest change is used. Press at many places of the gel, with balls of different sizes and all about as deep as later
    contacts. `tacpipe extract depth` reads the map.

    The untouched gel is the image --background, or the first frames of each recording. The contact of each ball is found as
    the circle in which the gel has its shape. A press in which none is found is left out with a note. The notes also state
    the error of slopes, radius and depth in each press with the map of the other presses, and where the map is a guess.

    The size of a pixel on the gel cannot be found from presses: a larger pixel and larger slopes explain the same images.
    Measure it with a ruler on the gel, or take it from the data sheet.

    Example: tacpipe extract gel-map data/presses --background background.png --mm-per-px 0.0634 -o data/gel
    """
    import numpy as np

    from tacpipe.video.gel_map import FILE, GelMap
    from tacpipe.video.gel_presses import fit_presses

    if not params.mm_per_px:
        raise UsageError(
            "mm_per_px is 0. Give the width of a pixel on the gel with --mm-per-px: 0.0634 for a GelSight Mini with images "
            "of 320 x 240 pixels."
        )
    background = _read_image(params.background) if params.background else None
    images = {name: _read_press(params, recording, background) for name, recording in presses.recordings.items()}
    sizes = sorted({press.size_px for press in images.values()})
    if len(sizes) != 1:
        raise TacpipeError(f"The presses have images of the sizes {listed(sizes)} pixels. Give those of one camera.")
    (width_px, height_px) = sizes[0]
    untouched = np.mean([press.untouched for press in images.values()], axis=0)
    fit = fit_presses(
        {name: press.press for name, press in images.items()}, params.mm_per_px * width_px / untouched.shape[1]
    )
    fitted = GelMap(
        width_px, height_px, params.mm_per_px, untouched, fit.weights, fit.is_covered, fit.max_sine, fit.rim_ratio
    )
    errors = {
        name: {**asdict(error), "circle": fit.circles[name].round(2).tolist()} for name, error in fit.errors.items()
    }
    report = json.dumps({"refused": fit.refused, "presses": errors}, indent=1)
    return Result(files={FILE: fitted.to_bytes(), ERRORS: report.encode()}, notes=list(_notes(fit)))


@dataclass(frozen=True)
class _PressImages:
    """The colours of a press and of the untouched gel, averaged on the grid of the map."""

    press: Press
    untouched: Floats  # (row, column, colour), grey levels
    size_px: tuple[int, int]  # width and height of the frames


def _read_press(params: Params, recording: Recording, background: Bytes | None) -> _PressImages:
    """Return the frame of a recording that differs most from the untouched gel, and count its frames.

    Raises `TacpipeError` if the recording has no diameter, not one stream of frames, or no sound frame.
    """
    import numpy as np

    from tacpipe.video.channels import UntouchedGel
    from tacpipe.video.decoding import cell_means, decode_frames, read_batches
    from tacpipe.video.gel_map import grid_shape, relative_change
    from tacpipe.video.gel_presses import Press
    from tacpipe.video.stream import read_format

    recording = params.narrow(recording)
    diameter_mm = params.diameter_mm or recording.attributes.get(DIAMETER)
    if not isinstance(diameter_mm, int | float) or not 0 < diameter_mm < np.inf:
        raise TacpipeError(
            f"Recording {recording.name} has no label {DIAMETER} above 0. Give the diameter of the ball with --diameter-mm, "
            f"or label the recording: tacpipe label DATASET {recording.name} --label {DIAMETER}=6.31."
        )
    columns_by_stream = {stream: recording.columns(stream) for stream in recording.streams}
    cameras = {stream: columns for stream, columns in columns_by_stream.items() if read_format(columns)}
    if len(cameras) != 1:
        raise TacpipeError(
            f"Recording {recording.name} has {len(cameras)} streams of frames; a press has one. Its streams are "
            f"{listed(recording.streams)}. Select one with --streams."
        )
    ((stream, columns),) = cameras.items()
    video_format = read_format(columns)
    assert video_format is not None
    size_px = (video_format.width_px, video_format.height_px)
    if background is not None and background.shape[1::-1] != size_px:
        raise TacpipeError(
            f"Recording {recording.name} has frames of {size_px[0]} x {size_px[1]} pixels, and the background has "
            f"{background.shape[1]} x {background.shape[0]}. Give an image of the same camera."
        )
    grid = grid_shape(video_format.height_px, video_format.width_px)
    untouched_gel = UntouchedGel(params.reference_frames, f"Recording {recording.name}, stream {stream}")
    untouched = np.zeros(0) if background is None else cell_means(background, *grid)
    change, sound = np.zeros((*grid, 3)), 0
    for _, image in decode_frames(video_format, read_batches(columns)):
        if image is None:
            continue
        means = cell_means(image, *grid)
        if background is None:
            untouched = untouched_gel.update(means)
        change = max(change, relative_change(means, untouched), key=lambda part: float(np.abs(part).mean()))
        sound += 1
    count_rows(recording.name, stream, RowCounts.some_used(columns.num_rows, sound, "damaged"))
    if not sound:
        raise TacpipeError(f"Recording {recording.name} has no frame that can be decoded. Leave it out.")
    return _PressImages(Press(float(diameter_mm), change), untouched, size_px)


def _read_image(path: str) -> Bytes:
    """Return an image (height, width, rgb). Raises `UsageError` for a file that is not a complete JPEG or PNG image."""
    from tacpipe.video.channels import IntraDecoder
    from tacpipe.video.images import image_format

    content = Path(path).read_bytes()
    video_format = image_format(content)
    image = IntraDecoder(video_format, grey=False).decode(content) if video_format else None
    if image is None:
        raise UsageError(
            f"The background {path} is not a complete JPEG or PNG image. Give an image of the untouched gel."
        )
    return image


def _notes(fit: GelFit) -> Iterator[str]:
    """Yield sentences on presses that were left out, on the errors of the others, and on the limits of the map."""
    import numpy as np

    for reason in sorted(set(fit.refused.values())):
        names = [name for name, refusal in fit.refused.items() if refusal == reason]
        yield f"{len(names)} of {len(fit.refused) + len(fit.errors)} presses left out, because {reason}: {listed(names)}."
    columns = zip(*((e.slope_deg, e.radius_mm, e.depth_mm, e.true_depth_mm) for e in fit.errors.values()), strict=True)
    slope, radius, depth, true_depth = (float(np.sqrt(np.nanmean(np.square(column)))) for column in columns)
    yield (
        f"Root mean square error in a press with the map of the {len(fit.errors) - 1} others: slope {slope:.1f} degrees, "
        f"radius of the ball {radius:.3f} mm, depth {depth:.3f} mm of {true_depth:.3f} mm."
    )
    if cut := [name for name, error in fit.errors.items() if np.isnan(error.depth_mm)]:
        yield f"The depth of {len(cut)} presses has no error, because their centre is outside of the image: {listed(cut)}."
    yield (
        f"The presses have slopes up to {np.degrees(np.arcsin(fit.max_sine)):.0f} degrees and touch "
        f"{100 * fit.is_covered.mean():.0f} % of the image. Elsewhere the map is a guess."
    )
