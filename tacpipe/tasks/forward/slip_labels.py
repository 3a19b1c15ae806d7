"""Read where an object slips in the gripper, as a recording states it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Bools

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.columns import Columns

# a label, of `segment slips` or of a person; that of a stream of labels, as a published set has it; the simulator's truth
COLUMNS = ("slip", "slip_slip", "gt_slip")


def slips_of(table: pa.Table | Columns) -> Bools | None:
    """Return where the object slips (time,), by label or the simulator's truth; None where nothing states that."""
    for name in COLUMNS:
        if name in table.column_names:
            return np.asarray(table.column(name).to_numpy()) > 0
    return None
