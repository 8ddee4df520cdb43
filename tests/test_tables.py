"""Results as tables of pandas and xarray."""

import io

import numpy as np
import pandas
import pytest

import stewart_drake as sd
from stewart_drake.reporting.csv_file import signals_csv

SHORT = ("plant.kind=exact", "duration=2")


@pytest.fixture(scope="module")
def compared():
    return sd.compare("paper", SHORT, controllers=["predictor_lqi", "lqr"])


def test_a_run_as_a_table_has_the_columns_of_its_csv(compared):
    run = compared["predictor_lqi"]
    table = run.to_pandas()
    read = pandas.read_csv(io.StringIO(signals_csv(run.signals)), index_col="time[s]")
    assert [*table.columns] == [*read.columns] and table.index.name == "time[s]"
    np.testing.assert_allclose(table, read, rtol=1e-11)
    assert np.array_equal(table["pose_z[m]"], run.signals.pose[:, 5])


def test_a_run_as_a_dataset_is_a_copy(compared):
    run = compared["predictor_lqi"]
    copy = run.to_xarray()
    assert copy.identical(run.signals)
    copy.pose[:] = 0.0
    assert run.signals.pose.values.any()


def test_a_comparison_has_a_row_per_controller(compared):
    table = compared.to_pandas()
    assert [*table.index] == ["predictor_lqi", "lqr"] and table.index.name == "controller"
    for name, run in compared.items():
        row = table.loc[name]
        assert row["status"] == run.status
        assert row["peak_torque"] == run.summary["peak_torque"]
        assert row["counts.saturated_steps"] == run.summary["counts"]["saturated_steps"]
        assert row["peak_error.5"] == run.summary["peak_error"][5]
    assert not [column for column in table if column.startswith(("scenario", "versions"))]
    assert table["status"]["lqr"] == "left_workspace"


def test_a_comparison_as_a_dataset_has_nan_after_the_end_of_a_run(compared):
    whole = compared.to_xarray()
    assert [*whole.controller.values] == ["predictor_lqi", "lqr"]
    for name, run in compared.items():
        one = whole.sel(controller=name)
        kept = one.sel(time=run.signals.time)
        assert np.array_equal(kept.pose, run.signals.pose, equal_nan=True)
        after = one.pose[len(run.signals.time) :]
        assert np.isnan(after).all() and len(after) == len(whole.time) - len(run.signals.time)
    assert whole.pose.sel(controller="lqr").isnull().any()
