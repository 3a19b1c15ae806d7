"""What would a grasp feel like? Told from a point cloud of the object and the two points where fingers are to close.

A grasp is a recording with a ``cloud``, a ``grasp`` and a ``reading`` of two BioTac SP. Four targets are foretold: the
pressure of the fluid and 24 electrodes of thumb and middle finger each.
"""
