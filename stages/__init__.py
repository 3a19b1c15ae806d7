"""The built-in stages: the first plug-in, found through entry points like any other."""

COMMANDS = {  # help lines of groups, in the order of `tacpipe --help`; "" for a stage, whose docstring has its own
    "ingest": "Read recordings of files into a dataset.",
    "simulate": "Simulate recordings of a rig, with ground truth.",
    "extract": "Compute tactile channels from the frames of cameras.",
    "synchronize": "",
    "segment": "Mark contacts and slips, or cut out slides and grasps.",
    "split": "",
    "compress": "Compress tactile channels to a few latents.",
    "train": "Train the model of a task.",
    "calibrate": "",
    "evaluate": "",
    "predict": "",
    "report": "",
    "export": "Write recordings in the formats of other tools.",
}
