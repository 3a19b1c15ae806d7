"""Read, segment, sample and normalise point clouds and the grasps on them. Only this package imports open3d."""
