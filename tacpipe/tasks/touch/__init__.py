"""The tactile reading of a grasp, predicted from a point cloud of the object and the two points where fingers close.

A grasp is a recording with a ``cloud``, a ``grasp`` and a ``reading`` of two BioTac SP. Four targets are predicted: the
pressure of the fluid and 24 electrodes of thumb and middle finger each.
"""
