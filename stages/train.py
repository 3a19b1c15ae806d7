"""Train the model of a task.

One command per installed task, with its options and the options of its architectures. A split states which recordings
train the model and which stop its training; ``calibrate``, ``evaluate`` and ``predict`` work with the model of any task.
A training that was interrupted continues from its last checkpoint.

Example: tacpipe train forward data/segments --split data/split -o models/forward
"""

# A task brings its stage (`tacpipe.tasks.task.Task.train`), so this module holds the help only.
