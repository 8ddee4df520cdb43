"""Where a closed loop starts when nobody says anything."""

import warnings

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

import stewart_drake as sd

MOVING = ("start=on_reference", "queue=reference")


def loop_of(*settings):
    return sd.build_closed_loop(sd.load_scenario("paper", settings=settings))


def state(loop, context):
    return loop.GetOutputPort("state").Eval(context)


@pytest.mark.parametrize("kind", ["exact", "multibody"])
@pytest.mark.parametrize("start", [(), MOVING])
def test_default_context_is_the_start_of_the_scenario(kind, start):
    loop = loop_of(f"plant.kind={kind}", *start)
    context = loop.CreateDefaultContext()
    np.testing.assert_allclose(state(loop, context), loop.experiment.start, atol=1e-13)
    assert bool(loop.experiment.start[6:].any()) == bool(start)


@pytest.mark.parametrize("settings", [("plant.kind=exact", *MOVING), ("plant.kind=multibody",)])
def test_a_simulator_of_the_loop_alone_starts_there_too(settings):
    loop = loop_of(*settings)
    simulator = Simulator(loop)
    np.testing.assert_allclose(
        state(loop, simulator.get_context()), loop.experiment.start, atol=1e-13
    )


def test_a_moving_start_that_a_simulator_cannot_know_of_is_told():
    loop = loop_of("plant.kind=multibody", *MOVING)
    with pytest.warns(UserWarning, match="loop.CreateDefaultContext"):
        Simulator(loop).Initialize()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulator(loop, loop.CreateDefaultContext()).Initialize()
