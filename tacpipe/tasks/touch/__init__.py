"""Predict the tactile reading of a grasp from a point cloud of the object and the two contact points of the fingers.

A grasp is a recording with a ``cloud``, a ``grasp`` and a ``reading`` of two BioTac SP sensors. There are four targets:
the fluid pressure and the 24 electrodes of the thumb and of the middle finger.
"""
