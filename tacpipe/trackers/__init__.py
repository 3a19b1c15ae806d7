"""Trackers of experiments, each a product: TensorBoard, MLflow, Weights & Biases. Third parties add theirs."""
