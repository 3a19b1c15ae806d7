"""Built-in stages, registered through entry points like those of any other plug-in."""

COMMANDS = {  # in the order of `tacpipe --help`; "" if the docstring of the module contains the line
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
