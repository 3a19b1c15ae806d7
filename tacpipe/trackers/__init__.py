"""Experiment trackers: TensorBoard, MLflow, Weights & Biases, and those of plug-ins."""
