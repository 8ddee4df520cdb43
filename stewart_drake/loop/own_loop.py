"""Loop of a user's controller: its torque and discrete state, linearised by differences.

With y its measurement, c its discrete state and u its torque, each less its value where the plate
is on the reference,

    c_{k+1} = F c_k + G y_k,    u_k = H c_k + D y_k.                                      (own)

The controller starts in its own initial state and is fed with the reference as its measurement. The
loop is that of `law.stability` for a plant with the states [e; c] and the gain K = -[D H].
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from pydrake.systems.framework import System

from stewart_drake.law.delay_model import DelayedModel
from stewart_drake.law.stability import LinearLoop
from stewart_drake.loop.preparation import Experiment
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES
from stewart_drake.types import Array

_STEP: Final = 1e-6
"""Difference of a measurement in rad, m and per s, and of a state as a share, at least of 1."""


class UnjudgedError(Exception):
    """Reason why a controller has no linear model."""


@dataclass(frozen=True)
class OwnLoop(LinearLoop):
    """True plant with (own)."""

    F: Array
    G: Array

    def sampled(self, longer: float = 0.0, step: float | None = None) -> DelayedModel:
        """Return the plant with the states [e; c]; arguments as of `LinearLoop.sampled`."""
        plant, own = super().sampled(longer, step), len(self.F)
        return replace(
            plant,
            A=np.block([[plant.A, np.zeros((len(plant.A), own))], [self.G, self.F]]),
            B_old=np.pad(plant.B_old, ((0, own), (0, 0))),
            B_new=np.pad(plant.B_new, ((0, own), (0, 0))),
            C=np.pad(plant.C, ((0, 0), (0, own))),
        )


def linearised(system: System, experiment: Experiment, times: Array) -> list[Array]:
    """Return [D H; G F] of a controller at the samples next to `times`.

    Raises:
        UnjudgedError: state that is not discrete, or not in the Context; other periods.
        Exception: one of the controller.
    """
    context: Any = system.CreateDefaultContext()
    groups = range(context.num_discrete_state_groups())
    sizes = [context.get_discrete_state(i).size() for i in groups]
    if context.num_continuous_states() or context.num_abstract_states():
        raise UnjudgedError("its controller has continuous or abstract state")
    period = experiment.scenario.controller.period
    if sizes:
        every = system.GetUniquePeriodicDiscreteUpdateAttribute()
        if every is None or not np.isclose(every.period_sec(), period, rtol=1e-9):
            raise UnjudgedError(f"its controller does not update once every {period:g} s")

    def step(inputs: Array) -> Array:
        """Return [torque; next state] for [measurement; state]."""
        system.GetInputPort("measurement").FixValue(context, inputs[:NUM_STATE])
        for i, part in zip(
            groups, np.split(inputs[NUM_STATE:], np.cumsum(sizes)[:-1]), strict=False
        ):
            context.SetDiscreteState(i, part)
        torque = system.GetOutputPort("torque").Eval(context)
        if not sizes:
            return np.array(torque)
        new = system.EvalUniquePeriodicDiscreteUpdate(context)
        return np.concatenate([torque, *(new.value(i) for i in groups)])

    chosen, found = [round(t / period) for t in times], dict[int, Array]()
    own = [np.array(context.get_discrete_state(i).value()) for i in groups]
    state = np.concatenate([*own, []])
    for k in range(max(chosen) + 1) if sizes else sorted(set(chosen)):
        row = evaluate(experiment.reference, k * period)
        context.SetTime(k * period)
        if system.HasInputPort("reference"):
            system.GetInputPort("reference").FixValue(context, row)
        at = np.concatenate([row[:NUM_STATE], state])
        here = step(at)
        if k in chosen:
            steps = _STEP * np.maximum(np.abs(at), 1.0)
            columns = [(step(at + h) - step(at - h)) / (2 * h.max()) for h in np.diag(steps)]
            if not (np.isfinite(columns).all() and np.array_equal(step(at), here)):
                raise UnjudgedError(
                    "its controller's torque is not finite, or not a function of "
                    "its inputs and its Context"
                )
            found[k] = np.array(columns).T
        state = here[NUM_TORQUES:]
    return [found[k] for k in chosen]
