"""Plant, law, loop, S and T of a scenario as `control.StateSpace`, for Bode, Nyquist and margins.

All are sampled with the controller's period dt. Errors are [pose error; rate error] and, if the
law integrates, the integral of the pose error, in the order and the units of `signals`. The loop is
cut between the torques u_k of the law and the torques v_k of the motors:

    plant  P: v -> e,  e_{k+1} = A e_k + B_old v_{k-mu-1} + B_new v_{k-mu}     (32), the true delay
    law    F: e -> u,  u_k = -K [e_k; u_{k-L} ... u_{k-1}]                     (law), the believed
    loop   L = -F P,   S = (1 + L)^-1,   T = L (1 + L)^-1 = 1 - S.

L is the loop of a negative feedback, u = -L v, as `control.feedback(L, identity)`, `nyquist_plot`
and `disk_margins` expect. S leads from a torque added at the motors to the torque that acts.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.delay_model import chain
from stewart_drake.law.stability import LinearLoop
from stewart_drake.loop.controller_margin import controller_margin, loop_at
from stewart_drake.loop.experiment import prepare
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import as_scenario
from stewart_drake.scenario.signals import COORDINATES, LEGS, NUM_TORQUES, STATE


class LinearModels(NamedTuple):
    """`control.StateSpace` systems, linearised at `time` in s; see the module."""

    plant: Any
    """P, torques (6) to errors (12 or 18)."""
    law: Any
    """F, errors to torques."""
    loop: Any
    """L (6 x 6), cut at the motors, for negative feedback."""
    S: Any
    """Sensitivity (6 x 6)."""
    T: Any
    """Complementary sensitivity (6 x 6)."""
    time: float

    def one_motor(self, leg: int) -> Any:
        """Return the loop (1 x 1) cut at one motor, from 1, with all others closed.

        S_ii = 1 / (1 + L_i). It has one input and output, as `bode_plot`, `nyquist_plot` and
        `disk_margins` expect. `disk_margins` of the whole loop needs the package slycot.

        Raises:
            ConfigError: no such motor.
        """
        import control  # slow

        L = self.loop
        if leg not in range(1, L.ninputs + 1):
            raise ConfigError(f"leg: got {leg!r}; expected 1 to {L.ninputs}")
        own = np.arange(L.ninputs) == leg - 1
        A = L.A - L.B[:, ~own] @ L.C[~own]
        name = [f"torque_{leg}"]
        return control.ss(A, L.B[:, own], L.C[own], 0, L.dt, inputs=name, outputs=name)

    def __repr__(self) -> str:
        return (
            f"LinearModels(at t = {self.time:.3g} s, loop of {self.loop.nstates} states every "
            f"{self.loop.dt:g} s)"
        )


def linear_models(scenario: Scenario | str | Path, time: float | None = None) -> LinearModels:
    """Return the loop of a scenario, linearised about its moving reference as if that stood still.

    An estimator, a tuner and torque limits are left out, see `controller_margin`.

    Args:
        scenario: or a shipped name or a path.
        time: s; None is that of the largest spectral radius.

    Raises:
        ConfigError: bad input, an unreachable reference; no time, and a loop that was not judged.
    """
    loaded = as_scenario(scenario)
    experiment = prepare(loaded)
    if time is None:
        margin = controller_margin(experiment)
        if margin.problem:
            raise ConfigError(f"time: got None, but {margin.problem}; expected a time in s")
        time = margin.time
    elif not 0 <= time <= loaded.duration:
        raise ConfigError(f"time: got {time!r}; expected 0 to {loaded.duration:g} s")
    return state_spaces(loop_at(experiment, time), time)


def state_spaces(loop: LinearLoop, time: float = 0.0) -> LinearModels:
    """Return the systems of a linear loop with any numbers of states and inputs."""
    import control  # slow

    m = len(loop.K)
    one = np.eye(m)
    torques = [f"torque_{leg}" for leg in LEGS] if m == NUM_TORQUES else m
    errors: Any = [f"error_{name}" for name in STATE]
    if loop.integral:
        errors += [f"integral_{name}" for name in COORDINATES]

    def named(system: Any, name: str, inputs: Any, outputs: Any) -> Any:
        return control.ss(system, name=name, inputs=inputs, outputs=outputs)

    plant, law = _plant(loop), _law(loop)
    n = plant.noutputs
    if n != len(errors) or m != NUM_TORQUES:
        errors = n
    L = -law * plant
    return LinearModels(
        named(plant, "plant", torques, errors),
        named(law, "law", errors, torques),
        named(L, "loop", torques, torques),
        named(control.feedback(one, L), "S", torques, torques),
        named(control.feedback(L, one), "T", torques, torques),
        time,
    )


def _plant(loop: LinearLoop) -> Any:
    """Return P with the states [e; torques under way, oldest first]."""
    import control  # slow

    model = loop.sampled()
    line, n = chain(model), len(model.A)
    return control.ss(line.A, line.B, np.eye(n, len(line.A)), 0, loop.period)


def _law(loop: LinearLoop) -> Any:
    """Return F with its last L torques, oldest first, as states."""
    import control  # slow

    K, m = loop.K, len(loop.K)
    n = loop.plant.A.shape[0] + (loop.plant.C.shape[0] if loop.integral else 0)
    size = K.shape[1] - n
    A, B = np.zeros((size, size)), np.zeros((size, n))
    if size:
        A[:-m, m:] = np.eye(size - m)
        A[-m:], B[-m:] = -K[:, n:], -K[:, :n]
    return control.ss(A, B, -K[:, n:], -K[:, :n], loop.period)
