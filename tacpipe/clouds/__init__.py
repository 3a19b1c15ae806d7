"""Clouds of points and the grasps made on them: reading, segmenting, sampling, normalising; open3d is used here alone."""
