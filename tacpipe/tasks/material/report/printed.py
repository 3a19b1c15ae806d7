"""What the paper printed, in percent: it is next to our numbers and is never averaged with them."""

from __future__ import annotations

from collections.abc import Mapping

ACCURACIES: Mapping[str, Mapping[str, float]] = {  # Table I
    "X-LSTM": {"biotac": 94.50, "roboskin": 90.00},
    "RAEC independent": {"biotac": 95.31, "roboskin": 91.14},
    "RAEC joint": {"biotac": 96.01, "roboskin": 93.23},
    "mapping to known space": {"biotac": 94.79, "roboskin": 91.67},
}
SWAPPED: Mapping[str, float] = {"biotac": 95.31, "roboskin": 93.23}  # Table II; before are those of RAEC joint
RATIOS = (90, 50, 25, 17, 11)
# Tables III and IV, by the sensor whose slides were reduced: joint BioTac, joint RoboSkin, that sensor independent
REDUCED: Mapping[str, Mapping[int, tuple[float, float, float]]] = {
    "biotac": {
        90: (94.27, 93.75, 93.75),
        50: (90.63, 93.23, 91.67),
        25: (83.33, 93.75, 86.46),
        17: (77.08, 91.67, 78.65),
        11: (70.31, 92.19, 69.79),
    },
    "roboskin": {
        90: (94.27, 91.15, 90.62),
        50: (96.88, 86.98, 82.29),
        25: (96.88, 73.96, 71.35),
        17: (94.28, 58.85, 57.81),
        11: (96.88, 45.31, 46.35),
    },
}
BASIS = (
    "The paper's numbers stand as printed. Nearly all are whole numbers of 192 slides, so one of its runs is uncertain by "
    "about 3 points (two standard errors) at 95 %; those of its reduced sets rest on single runs."
)
