"""Simulate a gel with printed markers in each finger of the pick-and-move rig, and the camera behind it.

The markers replace the taxels of `tacpipe.simulation.taxels`: the pressure on each, its part of the shear up to the
friction limit, and the bulge. A marker is displaced by its force divided by the stiffness of the gel below it, and
displaces its neighbours. The image has dark dots at the displaced positions on a gel that three lights make brighter or
darker where an object dents it, with camera noise. Frames are JPEG images, as from cameras. PyAV is imported for
encoding.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bytes, Floats, Times
from tacpipe.channels import schema
from tacpipe.plugins import extras
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.simulation import faults, handling, pick_and_move
from tacpipe.simulation.pick_and_move import PickRig, PickScene
from tacpipe.video.encoding import ENCODED_BY, encode_images, jpeg_format
from tacpipe.video.files import packet_stream

FINGERS = ("gel1", "gel2")
HEIGHT_PX, WIDTH_PX = 240, 320
CENTRE_PX = np.array([(WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2])  # x and y
ROWS, COLUMNS = 7, 9  # markers, as in a GelSight Mini
PITCH_PX = 32.0  # distance of markers in the image
PX_M = 17_200.0  # pixels per metre of gel: 320 pixels show 18.6 mm
STIFFNESS_N_M = 9000.0  # shear stiffness of the whole gel
NEIGHBOUR_PX = 24.0  # distance over which a displaced marker draws others along (standard deviation)
MARKER_PX, EDGE_PX, MARKER_DARKNESS = 5.0, 0.7, 0.6  # radius, softness of the edge, fraction of light that is lost
PATCH_PX = 9  # half the side of the square in which a marker is drawn
BRIGHTNESS = np.array([110.0, 120.0, 135.0], np.float32)  # red, green, blue grey levels of the untouched gel
# direction of the light of each colour (colour, xy)
LIGHTS = np.array([[1.0, 0.0], [-0.5, 0.87], [-0.5, -0.87]], np.float32)
DENT_N, SHADE = 1 / 8.0, 900.0  # dent in image units per newton, and grey levels per unit of slope
NOISE = 1.5  # standard deviation of a pixel, grey levels
NOISE_IMAGES, NOISE_STEP = 4, 256_889  # number of images for which noise is drawn; offset of their parts, a prime
CAMERA_STREAM = 2  # part of the random seed of the cameras; the rig's devices have other numbers


def rest_places_px() -> Floats:
    """Return the places of the untouched markers in the image (marker, xy), row by row."""
    row, column = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    offsets = np.column_stack([column - (COLUMNS - 1) / 2, row - (ROWS - 1) / 2]) * PITCH_PX
    places: Floats = offsets + CENTRE_PX
    return places


@dataclass(frozen=True)
class GelStates:
    """Markers and pressure on a gel over time."""

    displacement_px: Floats  # (time, marker, xy), along the image's x and y
    force_n: Floats  # (time,), normal force
    centre_px: Floats  # (time, xy), centre of the pressure in the image
    sigma_px: float  # standard deviation of the pressure's Gaussian


def gel_states(scene: PickScene, finger: int, true_ns: Times) -> GelStates:
    """Return the gel of finger 0 or 1 at ``true_ns`` (time,). The image's x is the hand's x, its y points down."""
    rest_px = rest_places_px()
    places_m = (rest_px - CENTRE_PX) * [1, -1] / PX_M  # positions of the markers along the hand's x and z
    force_n = pick_and_move.touch(scene, finger, true_ns, places_m=places_m)  # (time, marker, axis)
    distance2 = ((rest_px[:, None] - rest_px) ** 2).sum(axis=2)
    coupling = np.exp(-distance2 / (2 * NEIGHBOUR_PX**2))
    coupling /= coupling.sum(axis=0)  # the contributions of a marker add up to its force
    marker_stiffness_n_m = STIFFNESS_N_M / len(rest_px)
    moved_m = np.einsum("mn,tna->tma", coupling, force_n[:, :, :2]) / marker_stiffness_n_m
    pressed = force_n[:, :, 2]
    total = pressed.sum(axis=1)
    centre = pressed @ rest_px / np.maximum(total, 1e-12)[:, None]
    return GelStates(moved_m * [1, -1] * PX_M, total, centre, scene.skins[finger].sigma_m * PX_M)


class GelCamera:
    """Draws images. The noise of each is a part of random numbers that are drawn once, other parts in turn."""

    def __init__(self, rng: np.random.Generator, noise_scale: float = 1.0) -> None:
        self._size = HEIGHT_PX * WIDTH_PX * len(BRIGHTNESS)
        self._noise = noise_scale * NOISE * rng.standard_normal(NOISE_IMAGES * self._size).astype(np.float32)

    def render(self, states: GelStates, row: int, number: int) -> Bytes:
        """Return the image of one row of ``states``, uint8 (height, width, rgb). ``number`` chooses its noise."""
        x, y = np.arange(WIDTH_PX), np.arange(HEIGHT_PX)
        along_x, along_y = (
            (axis - centre) / states.sigma_px for axis, centre in zip((x, y), states.centre_px[row], strict=True)
        )
        bell_x, bell_y = np.exp(-(along_x**2) / 2), np.exp(-(along_y**2) / 2)
        # slope of the dent: the product of this, the distance from its centre and the bell of each axis
        shade = -SHADE * DENT_N * states.force_n[row] / states.sigma_px
        fall_off = 1.15 - 0.3 * x / WIDTH_PX  # the gel is brighter at the left
        rows = np.column_stack([np.ones(HEIGHT_PX), shade * bell_y, shade * along_y * bell_y])  # (height, 3)
        columns = np.stack(
            [np.outer(fall_off, BRIGHTNESS), np.outer(along_x * bell_x, LIGHTS[:, 0]), np.outer(bell_x, LIGHTS[:, 1])]
        )  # (3, width, rgb)
        image = (rows.astype(np.float32) @ columns.reshape(3, -1).astype(np.float32)).reshape(HEIGHT_PX, WIDTH_PX, -1)
        for marker_x, marker_y in rest_places_px() + states.displacement_px[row]:
            left, top = max(0, round(marker_x) - PATCH_PX), max(0, round(marker_y) - PATCH_PX)
            near_x = x[left : max(0, round(marker_x) + PATCH_PX + 1)]
            near_y = y[top : max(0, round(marker_y) + PATCH_PX + 1)]
            distance = np.hypot(near_x - marker_x, (near_y - marker_y)[:, None])
            covered = 1 / (1 + np.exp((distance - MARKER_PX) / EDGE_PX))
            patch = image[top : top + len(near_y), left : left + len(near_x)]
            patch *= (1 - MARKER_DARKNESS * covered)[..., None]
        first = number * NOISE_STEP % (len(self._noise) - self._size)
        image += self._noise[first : first + self._size].reshape(image.shape)
        return np.clip(np.rint(image, out=image), 0, 255, out=image).astype(np.uint8)


@dataclass(frozen=True)
class GelRig:
    """The trials and the cameras. The fields are those of the stage's params."""

    duration_s: float = 12.0
    effort: float = 0.0
    friction_scale: float = 1.0
    grip_loss_probability: float = 0.0
    handling: str = handling.PLANNED
    frame_rate_hz: int = 25
    drop_probability: float = 0.002
    noise_scale: float = 1.0
    jitter_ms: float = 2.0


def simulate_trial(seed: int, index: int, rig: GelRig = GelRig()) -> RecordingOutput:
    """Return trial ``index``: the videos gel1 and gel2, robot, and as ground truth truth, gel1_truth and gel2_truth.

    The same seed, index and rig give the same values. Raises `TacpipeError` for a trial too short to lift anything,
    `MissingModuleError` without PyAV.
    """
    extras.require(ENCODED_BY, "av")
    pick_rig = PickRig(
        duration_s=rig.duration_s,
        effort=rig.effort,
        friction_scale=rig.friction_scale,
        grip_loss_probability=rig.grip_loss_probability,
        handling=rig.handling,
        drop_probability=rig.drop_probability,
        robot_jitter_ms=rig.jitter_ms / 4,
    )
    trial = pick_and_move.simulate_trial(seed, index, pick_rig)
    scene = pick_and_move.perform(seed, index, pick_rig)
    start_ns = pick_and_move.START_NS + index * pick_and_move.TRIAL_NS
    streams: dict[str, pa.Table | pa.RecordBatchReader] = {}
    for finger, name in enumerate(FINGERS):
        rng = np.random.default_rng([seed, index, CAMERA_STREAM, finger])
        samples = faults.samples(int(scene.path.t_ns[-1]), rig.frame_rate_hz, rig.drop_probability, rng)
        t_ns = start_ns + faults.arrivals(samples.true_ns, rig.jitter_ms * 1e6, rng)
        states = gel_states(scene, finger, samples.true_ns)
        streams[name] = _video(states, samples, t_ns, rig, rng)
        streams[f"{name}_truth"] = _truth(name, states, start_ns + samples.true_ns)
    streams |= {"robot": trial.streams["robot"], "truth": trial.streams["truth"]}
    attributes = {name: value for name, value in trial.attributes.items() if "xela" not in name and "prox" not in name}
    return RecordingOutput(streams, {**attributes, "sensor": "gelsight-mini", "rate_hz": float(rig.frame_rate_hz)})


def _video(
    states: GelStates, samples: faults.LoggedSamples, t_ns: Times, rig: GelRig, rng: np.random.Generator
) -> pa.RecordBatchReader:
    """Return the frames of a camera, which are drawn and encoded on demand."""
    video_format = jpeg_format(WIDTH_PX, HEIGHT_PX, Fraction(rig.frame_rate_hz))
    camera = GelCamera(rng, rig.noise_scale)
    images = (camera.render(states, row, row) for row in range(len(t_ns)))
    pts = samples.true_ns // 1000
    clocks = (pts, pts, np.ones(len(pts), bool))
    return packet_stream(video_format, encode_images(video_format, images), clocks, t_ns, samples.seq, None)


def _truth(name: str, states: GelStates, true_ns: Times) -> pa.Table:
    """Return the displacement of each marker and the normal force when each frame was taken."""
    fields: list[Any] = [schema.float_field(f"gt_{name}_normal_n", "N", "force")]
    for marker in range(ROWS * COLUMNS):
        column = f"gt_{name}_marker{marker // COLUMNS + 1:02d}{marker % COLUMNS + 1:02d}"
        fields += [schema.float_field(f"{column}_{axis}", "px", "position") for axis in "xy"]
    columns = [states.force_n, *states.displacement_px.reshape(len(true_ns), -1).T]
    return schema.stream(true_ns, columns, fields)
