"""Train and evaluate the model of each task; one module or package per task."""
