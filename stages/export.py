"""Write recordings in the formats of other tools.

One command per format. Each lists what its format cannot represent, and the README of an export contains commands to
read it.

Example: tacpipe export csv data/recordings -o exports/csv
"""

# Each format defines its own stage (`tacpipe/exports/csv.py` and so on), so this module contains only the help.
