"""Plant, law, loop, S and T of a scenario as `control.StateSpace`, for Bode, Nyquist and margins.

All are sampled with the controller's period dt. Errors are [pose error; rate error], and where the
law integrates, the integral of the pose error, in the order and the units of `signals`. With
u_k the torques that the law sends and v_k those that the motors take, cut in between,

    plant  P: v -> e,  e_{k+1} = A e_k + B_old v_{k-mu-1} + B_new v_{k-mu}     (32), the true delay
    law    F: e -> u,  u_k = -K [e_k; u_{k-L} ... u_{k-1}]                     (law), the believed
    loop   L = -F P,   S = (1 + L)^-1,   T = L (1 + L)^-1 = 1 - S.

So L is that of a negative feedback, as `control.feedback(L, identity)`, `nyquist_plot` and
`disk_margins` take it: u = -L v, the minus of F is not in it. S is the way from a torque added at
the motors to the torque that acts. What Drake calls a linear system, y = C x + D u, is the same.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.delay_model import chain
from stewart_drake.law.linear_loop import LinearLoop
from stewart_drake.loop.controller_margin import controller_margin, loop_at
from stewart_drake.loop.experiment import prepare
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import as_scenario
from stewart_drake.scenario.signals import COORDINATES, LEGS, NUM_TORQUES, STATE
from stewart_drake.types import Array


class LinearModels(NamedTuple):
    """`control.StateSpace` systems; see the module. `time` in s is where they are linearised."""

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
        """The loop (1 x 1) cut at one motor only, from 1, with all others closed.

        S_ii = 1 / (1 + L_i). Of one input and output, so that `bode_plot`,
        `nyquist_plot` and `disk_margins` take it as it is; of the whole loop `disk_margins` needs
        the package slycot.

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
    """The loop of a scenario, linearised about its moving reference as if that stood still.

    An estimator, a tuner and torque limits are left out, see `controller_margin`.

    Args:
        scenario: or a shipped name or a path.
        time: s; None is where the loop is worst.

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
    """The same of a loop that is linear already, with any numbers of states and inputs."""
    import control  # slow

    plant, law = _plant(loop), _law(loop)
    n, m = plant[2].shape[0], plant[1].shape[1]
    torques = [f"torque_{leg}" for leg in LEGS] if m == NUM_TORQUES else m
    errors: Any = [f"error_{name}" for name in STATE]
    if loop.integral:
        errors += [f"integral_{name}" for name in COORDINATES]
    if n != len(errors) or m != NUM_TORQUES:
        errors = n

    def system(name: str, matrices: tuple[Array, ...], inputs: Any, outputs: Any) -> Any:
        return control.ss(*matrices, loop.period, name=name, inputs=inputs, outputs=outputs)

    (A_p, B_p, C_p, _), (A_f, B_f, C_f, D_f) = plant, law
    # L = -F P: the plant's outputs drive the law. P has no direct way through, so neither has L.
    A = np.block([[A_p, np.zeros((len(A_p), len(A_f)))], [B_f @ C_p, A_f]])
    B = np.vstack([B_p, np.zeros((len(A_f), m))])
    C = -np.hstack([D_f @ C_p, C_f])
    none, one = np.zeros((m, m)), np.eye(m)
    return LinearModels(
        system("plant", plant, torques, errors),
        system("law", law, errors, torques),
        system("loop", (A, B, C, none), torques, torques),
        system("S", (A - B @ C, B, -C, one), torques, torques),
        system("T", (A - B @ C, B, C, none), torques, torques),
        time,
    )


def _plant(loop: LinearLoop) -> tuple[Array, Array, Array, Array]:
    """Over [e; the torques under way, oldest first], of which e is seen."""
    model = loop.sampled()
    line, (n, m) = chain(model), model.B_new.shape
    return line.A, line.B, np.eye(n, len(line.A)), np.zeros((n, m))


def _law(loop: LinearLoop) -> tuple[Array, Array, Array, Array]:
    """Over its own last L torques, oldest first."""
    K, m = loop.K, len(loop.K)
    n = loop.plant.A.shape[0] + (loop.plant.C.shape[0] if loop.integral else 0)
    size = K.shape[1] - n
    A, B = np.zeros((size, size)), np.zeros((size, n))
    if size:
        A[:-m, m:] = np.eye(size - m)
        A[-m:], B[-m:] = -K[:, n:], -K[:, :n]
    return A, B, -K[:, n:], -K[:, :n]
