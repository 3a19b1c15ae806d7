"""What the paper printed: it is next to our numbers and is never averaged with them (RA-L 2020)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

HEADS: Mapping[object, tuple[float, float]] = {  # Table I
    "fc1": (0.02598, 0.00043),
    "fc2": (0.02586, 0.00084),
    "fc3": (0.02570, 0.00076),
    "fc4": (0.02744, 0.00069),
    "fc5": (0.02652, 0.00092),
    "fc6": (0.02660, 0.00062),
}
POINTS: Mapping[object, tuple[float, float]] = {  # Table II
    250: (0.03010, 0.00105),
    500: (0.02790, 0.00115),
    750: (0.02717, 0.00134),
}
EPOCH_S: Mapping[object, int] = {250: 8, 500: 14, 750: 21}  # Table II: seconds per epoch
NORMALISATIONS: Mapping[object, tuple[float, float]] = {  # Table III
    "none": (0.01859, 0.00065),
    "sphere": (0.01183, 0.00073),
    "minmax": (0.01141, 0.00076),
    "wrist": (0.02260, 0.00100),
}
ROTATIONS: Mapping[object, tuple[float, float]] = {  # Table IV
    0: (0.01141, 0.00076),
    45: (0.02026, 0.00073),
    90: (0.02545, 0.00094),
    135: (0.02788, 0.00109),
    180: (0.02671, 0.00073),
}
EPOCHS, BATCH, LEARNING_RATE = 250, 10, 0.01  # of all tables; 1,000 epochs in Figure 8


@dataclass(frozen=True)
class Final:
    """RMSE on the test set and on novel objects, as fractions of the target's range and in device counts."""

    test: float
    test_counts: int
    novel: float
    novel_counts: int
    change: int  # percent


FINAL: Mapping[str, Final] = {  # Figures 10 and 11
    "pdc_th": Final(0.05496, 49, 0.08289, 74, 51),
    "pdc_mf": Final(0.06170, 43, 0.10650, 74, 73),
    "e_th": Final(0.06099, 213, 0.08724, 305, 43),
    "e_mf": Final(0.05922, 195, 0.10317, 340, 74),
}
FOUND_ON = (
    "The paper's columns are of RGBPose, trained on 9,000 grasps of its 12 objects (12,000 for novel ones), ours of what "
    "these runs read and were trained on, and a constant's error on the two sets differs."
)
SCALES = (
    "The paper's RMSE of one network on the thumb's pressure is 0.01141 in cross-validation (Tables III and IV) and "
    "0.05496 in testing (Figure 10), which cannot be on one scale: as a fraction of the largest reading, 3,400 "
    "counts, the former is 39 counts, as a fraction of the range of 900 it is 10, and the latter is 49. Tables I to "
    "IV stand as printed; our errors are fractions of the range."
)
