"""Forecasts next to what was measured."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import biotac_sp, schema
from tacpipe.traces import predictions as forecasts
from tacpipe.traces import taxels
from tacpipe.traces.predictions import classification_from_row
from tests.viewer import hand


def predictions(measured: taxels.Taxels, steps: tuple[int, ...], off: float) -> pa.Table:
    """Return a table as `tacpipe predict` writes it: what comes ``step`` rows later, plus ``off``."""
    rows = len(measured.t_ns) - max(steps)
    flat = measured.change.reshape(len(measured.t_ns), -1)
    fields, columns = [pa.field("t_ns", pa.int64())], [pa.array(measured.t_ns[:rows])]
    for place, channel in enumerate(measured.channels):
        for step in steps:
            about = {"quantity": "prediction", "step": str(step)}
            fields.append(pa.field(f"{measured.stream}_{channel}_t{step}", pa.float64(), metadata=about))
            columns.append(pa.array(flat[step : step + rows, place] + off))
    return pa.Table.from_arrays(columns, schema=pa.schema(fields))


def test_a_forecast_stands_at_the_time_that_it_is_of() -> None:
    (measured,) = taxels.taxels_from_table("xela1", hand.finger(hand.pressed()))
    steps_ahead = forecasts.forecasts_from_table(predictions(measured, (1, 10), off=4.0), [measured])

    assert [forecast.step for forecast in steps_ahead] == [1, 10]
    for forecast in steps_ahead:
        rows = np.searchsorted(measured.t_ns, forecast.predicted.t_ns)
        assert rows[0] == forecast.step
        np.testing.assert_allclose(forecast.measured.change, measured.change[rows])
        np.testing.assert_allclose(forecast.predicted.change, measured.change[rows] + 4)
        np.testing.assert_allclose(forecast.error, 4)
        np.testing.assert_allclose(forecast.residual.change, 4)


def test_a_finger_of_which_a_channel_is_missing_has_no_forecast() -> None:
    (measured,) = taxels.taxels_from_table("xela1", hand.finger(hand.pressed()))
    table = predictions(measured, (1,), 0.0)

    assert forecasts.forecasts_from_table(table.drop_columns(table.column_names[-1]), [measured]) == []
    assert forecasts.forecasts_from_table(hand.arm(), [measured]) == []


def test_the_reading_of_two_fingers_is_compared_electrode_by_electrode() -> None:
    table = schema.stream(np.array([5]), np.arange(58)[:, None], biotac_sp.fields())
    values = {name: 1000.0 + place for place, name in enumerate(biotac_sp.value_columns("e_th"))}

    (forecast,) = forecasts.forecasts_from_values(values, taxels.taxels_from_table("reading", table))

    assert (forecast.step, forecast.measured.finger) == (0, "th")
    np.testing.assert_array_equal(forecast.residual.magnitude, [1000.0 + np.arange(24) - (29 + np.arange(24))])


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
