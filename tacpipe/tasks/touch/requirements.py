"""The streams and labels that recordings must have for the task ``touch``."""

from __future__ import annotations

from tacpipe.plugins.requirements import Channels, Label, Requirements

REQUIREMENTS = Requirements(
    "touch",
    stages=("segment grasps",),
    optional_stages=("ingest vision2tactile, whose recordings are grasps already",),
    roles="one grasp or more with the role train; val where a network is chosen by it (--select best)",
    channels=(
        Channels(
            "position",
            ("m",),
            "x_m, y_m, z_m of each point of the object's visible side, 3 points or more, in the camera's frame",
            stream="cloud",
        ),
        Channels("colour", ("count",), "red, green, blue of each point", "--inputs xyz reads none", stream="cloud"),
        Channels(
            "grasp",
            ("m",),
            "one row with g1_x_m … g2_z_m, where both fingers are to close, in the frame of the cloud",
            stream="grasp",
        ),
        Channels(
            "wrist",
            ("1",),
            "wrist_x_x … wrist_z_z, the axes of the wrist in the frame of the cloud",
            "the line of sight represents it, or --wrist estimated",
            stream="grasp",
        ),
        Channels(
            "tactile",
            ("count",),
            "one row with mf_electrode01 … th_electrode24 and the fluid's pressure mf_pdc, th_pdc, of two BioTac SP",
            stream="reading",
        ),
    ),
    labels=(
        Label("object", "what is grasped, any text", "the mean of an object is not a baseline, and no object is novel"),
        Label("session", "the day, any text", "days cannot be left out by split"),
    ),
)
