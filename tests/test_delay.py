"""The delay as a value: its length and the torques in flight, by counting."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stewart_drake.scenario.config import ControllerConfig, DelayConfig, Scenario
from stewart_drake.scenario.delay import Delay


@given(
    steps=st.integers(0, 1000),
    parts=st.integers(0, 15),
    period=st.sampled_from([0.5, 0.25, 0.0625]),
)
def test_torques_in_flight_are_those_that_still_have_to_act(steps, parts, period):
    # Sixteenths and powers of two: every instant is exact.
    delay = Delay(steps, parts / 16)
    eta = delay.eta(period)
    assert eta == sum([period] * steps) + parts / 16 * period
    # The torque of sample -k acts for one period from eta - k dt on. In flight at 0 are those of
    # earlier samples that still act then, or will.
    waiting = [k for k in range(1, steps + 3) if eta - k * period + period > 0]
    assert delay.queue_length == len(waiting)


@pytest.mark.parametrize("wrong", [(-1, 0.0), (2, -0.1), (2, 1.0)])
def test_what_is_no_delay_is_refused(wrong):
    with pytest.raises(ValueError, match="0 <= fraction < 1"):
        Delay(*wrong)


def test_the_true_delay_of_a_scenario():
    scenario = Scenario(
        delay=DelayConfig(steps=3, fraction=0.5), controller=ControllerConfig(period=0.25)
    )
    assert scenario.true_delay == Delay(3, 0.5)
    assert scenario.eta == 0.875
