"""The built-in stages: the first plug-in, found through entry points like any other."""

COMMANDS = {  # in the order of `tacpipe --help`; "" where the docstring of the module has the line
    "ingest": "",
    "simulate": "",
    "extract": "",
    "synchronize": "",
    "segment": "Mark contacts and slips, or cut out slides and grasps.",
    "split": "",
    "compress": "",
    "train": "",
    "calibrate": "",
    "evaluate": "",
    "predict": "",
    "report": "",
    "export": "",
}
