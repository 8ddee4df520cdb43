"""Torques stay what they are: step by step, and around the loop."""

import numpy as np
import pytest

from tests.recorded import runs

RECORDED = runs.load()
FEW = 10
"""Samples; alone, without a plant, the law makes more of any rounding with each further one."""


def test_every_scenario_is_recorded_with_every_controller_on_both_plants():
    assert set(RECORDED) == set(runs.ROWS)


QUICK = [row for row in runs.ROWS if row.startswith("paper/") and row.endswith("/exact")]
"""Every controller once; the other rows are slow."""


@pytest.mark.parametrize(
    "row", [pytest.param(r, marks=() if r in QUICK else pytest.mark.slow) for r in runs.ROWS]
)
def test_torques_are_what_they_were(row):
    """The law's first answers and the loop with its plant, to 1e-9 of the peak torque.

    With other releases or another processor the law's first answers, to 1e-7.
    """
    measurements, torques = RECORDED[row]
    peak = np.abs(torques).max()
    loop = runs.closed_loop(row)
    bound = 1e-9 if runs.same_rounding() else 1e-7
    answers = runs.answers(loop, measurements[:FEW])
    assert np.abs(answers - torques[:FEW]).max() <= bound * peak
    if runs.same_rounding():
        _, found = runs.run(loop)
        assert found.shape == torques.shape
        assert np.abs(found - torques).max() <= 1e-9 * peak
