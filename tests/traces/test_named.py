"""Names that a model gave a recording, from the rows that `tacpipe evaluate` and `tacpipe predict` write."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
import pytest

from tacpipe.traces.predictions import classification_from_row


def row(**columns: tuple[Any, str]) -> pa.Table:
    """A row of columns, each a value and its quantity."""
    fields = [
        pa.field(name, pa.array([value]).type, metadata={"quantity": quantity} if quantity else None)
        for name, (value, quantity) in columns.items()
    ]
    return pa.Table.from_arrays([pa.array([value]) for value, _ in columns.values()], schema=pa.schema(fields))


SCORES = {"score_03": (0.25, "score"), "score_10": (0.75, "score")}
EVALUATED = {"material": (3, "label"), "mean_level": (3, "prediction"), "model": (10, "prediction")}


def test_an_evaluation_has_its_label_the_model_first_and_other_predictors() -> None:
    naming = classification_from_row(
        row(recording=("trial-0", ""), **EVALUATED, **SCORES, z01=(1.0, "latent")), {"material": 99}
    )
    assert naming is not None
    assert (naming.key, naming.label, naming.model_class) == ("material", "3", "10")
    assert list(naming.predicted.items()) == [("model", "10"), ("mean level", "3")]
    assert naming.leading_scores() == {"10": 0.75, "3": 0.25}


@pytest.mark.parametrize(("attributes", "label"), [({"material": 10}, "10"), ({}, "")])
def test_a_prediction_is_next_to_the_recordings_own_label(attributes: dict[str, Any], label: str) -> None:
    naming = classification_from_row(row(material=(10, "prediction"), **SCORES), attributes)
    assert naming is not None
    assert (naming.model_class, naming.label) == ("10", label)


def test_values_without_names_are_no_names() -> None:
    assert classification_from_row(row(pdc_th=(1.0, "prediction")), {}) is None
