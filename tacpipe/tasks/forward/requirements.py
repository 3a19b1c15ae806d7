"""State the streams and labels that recordings need for the task ``forward``."""

from __future__ import annotations

from tacpipe.channels import pose
from tacpipe.plugins.requirements import Channels, Label, Requirements

REQUIREMENTS = Requirements(
    "forward",
    stages=("synchronize", "segment contacts"),
    optional_stages=("compress pca or compress autoencoder: a model of latents",),
    roles="one recording or more with the role train, and one or more with val",
    channels=(
        Channels(
            "tactile",
            (),
            "1 or more columns of one or more streams, any number of taxels and axes; {taxel} and {axis} in the rule of a "
            "column state where it lies, and then the model reads taxel by taxel",
        ),
        Channels(
            pose.POSITION,
            tuple(pose.METRES),
            "x, y and z of the hand, in one stream (--arm names it where several have a position)",
            "train with --actions none",
        ),
        Channels(
            pose.ORIENTATION,
            ("1",),
            "the quaternion x, y, z, w of the hand, in the stream of the position",
            "the hand is taken to keep its orientation",
        ),
        Channels(
            "joint_position",
            ("rad",),
            "7 angles in the stream of the position, with as many of joint_velocity [rad/s]",
            "velocities are differences of the pose, as with any arm but a Franka",
        ),
        Channels(pose.WIDTH, tuple(pose.METRES), "the width between the fingers, 1 column", "it counts as constant"),
    ),
    labels=(Label("object", "what is held, any value", "known and novel objects are not reported apart"),),
)
