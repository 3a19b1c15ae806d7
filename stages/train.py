"""Train the model of a task.

One command per installed task, with its options and the options of its architectures. A split determines which
recordings are for training and which for early stopping; ``calibrate``, ``evaluate`` and ``predict`` work with the
model of any task. An interrupted training run continues from its last checkpoint.

Example: tacpipe train forward data/segments --split data/split -o models/forward
"""

# Each task defines its own stage (`tacpipe.tasks.task.Task.train`), so this module contains only the help.
