"""The streams and labels that recordings must have for the task ``material``."""

from __future__ import annotations

from tacpipe.plugins.requirements import Channels, Label, Requirements
from tacpipe.tasks.material.params import KEY

REQUIREMENTS = Requirements(
    "material",
    stages=("segment slides",),
    optional_stages=(),
    roles="two classes or more with the role train; networks need recordings of each sensor with val too",
    channels=(
        Channels(
            "tactile",
            (),
            "1 or more columns of one stream, any number of taxels and axes, the same in all recordings of a sensor",
        ),
        Channels(
            "vibration",
            (),
            "any number of columns of the same stream, which minirocket and statistics read too",
            "tactile channels alone are read",
        ),
        Channels(
            "static_pressure",
            ("count",),
            "1 column, by which segment slides finds where a slide begins",
            "give segment slides --trigger load, for any sensor, or recordings that are cut alike already",
        ),
        Channels(
            "position",
            ("m", "cm", "mm"),
            "x, y and z of the finger, or velocity [m/s], by which segment slides finds where the finger moves",
            "a slide is all of the contact",
        ),
    ),
    labels=(
        Label(KEY, "the class: a whole number from 0 or any text; --label names another label"),
        Label("sensor", "the product, any text: recordings of one sensor are learned together"),
        Label("rate_hz", "rows a second", "the median step of the time stamps gives it"),
        Label("session", "the day or mounting, any text", "the report cannot distinguish materials from sessions"),
    ),
)
