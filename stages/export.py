"""Write recordings in the formats of other tools.

One command per format. Each lists what its format cannot hold, and the README of an export has the commands that read it.

Example: tacpipe export csv data/recordings -o exports/csv
"""

# A format brings its stage (`tacpipe/exports/csv.py` and so on), so this module holds the help only.
