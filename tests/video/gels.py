"""Draw gels with printed markers at known places."""

import numpy as np

from tacpipe.arrays import Bytes, Floats

HEIGHT, WIDTH = 240, 320
ERROR_PX = 0.2  # largest error that is promised
RADIUS_PX, PITCH_PX = 5.0, 32.0


def places(rows: int = 7, columns: int = 9, angle_deg: float = 0.0) -> Floats:
    """Places (marker, xy) of a grid about the centre of the image, row by row, turned by an angle."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    offsets = np.column_stack([column - (columns - 1) / 2, row - (rows - 1) / 2]) * PITCH_PX
    angle = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centred: Floats = offsets @ turn.T + [WIDTH / 2 + 0.3, HEIGHT / 2 - 0.4]
    return centred


def image(places_px: Floats, seed: int = 0) -> Bytes:
    """An image (height, width, rgb) of dark dots with soft edges on a gel that is lit from the left, with noise."""
    y, x = np.indices((HEIGHT, WIDTH))
    brightness = 110 + 60 * (1 - x / WIDTH) + 20 * y / HEIGHT
    for place in places_px:
        distance = np.hypot(x - place[0], y - place[1])
        brightness = brightness * (1 - 0.6 / (1 + np.exp(np.clip((distance - RADIUS_PX) / 0.7, -50, 50))))
    noise = np.random.default_rng(seed).normal(0, 2, (HEIGHT, WIDTH))
    return np.repeat(np.clip(brightness + noise, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def press(places_px: Floats, depth: float) -> Floats:
    """Displace markers as an object does that presses at the centre and shears to the right; ``depth`` is at most 1."""
    offsets = places_px - [WIDTH / 2, HEIGHT / 2]
    near = np.exp(-(offsets**2).sum(axis=1) / (2 * 60.0**2))[:, None]
    displaced: Floats = places_px + depth * (near * offsets * 0.15 + near * np.array([13.0, 6.0]))
    return displaced
