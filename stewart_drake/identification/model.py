"""The machine with its numbers as unknowns, and its trajectories with their sensitivities.

With the residual F = M nu_dot + h - B tau of the equations of motion, zero for the accelerations a
that a torque gives, every derivative at constant a is that of a itself by

    da/dz = -(M N)^-1 dF/dz,   nu_dot = N a + ...,

for z the state, parameters of the dynamics, or numbers of a leg.

A log is cut into segments, each with a free first state, which are integrated side by side under
held torques with a delay. With x_dot = f(x, T; p) the sensitivity S = dx/d[x_0; p; delay] obeys

    S_dot = A S + df/dp,   S = [1, 0, 0] at the start,

and at an instant t_k + delay at which the torque changes from T to T+, which moves with the delay,
x stays and S jumps in the delay's column by f(x, T) - f(x, T+), the effect of holding the old
torque longer. That is exact for any instant, so that the delay need not be a whole number of
samples. Both equations are integrated by the classical Runge-Kutta method (core/shooting.h).
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.layout import LEG_NUMBERS
from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import plant_parameters
from stewart_drake.identification.logs import Log
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import Legs, angle_rate_map, dot, legs_along, rotation
from stewart_drake.scenario.signals import (
    ANGLES,
    NUM_CONSTANTS,
    NUM_COORDINATES,
    NUM_LEGS,
    NUM_STATE,
)
from stewart_drake.types import Array

LEG_PLACES: Final = (0, 1, 12, 13, 14, 15, 16, 17)
"""In a leg's numbers (`Mechanism.numbers`): crank, rod, plate joint, shaft; m."""
PER_LEG: Final = len(LEG_PLACES)
NUM_GEOMETRY: Final = NUM_LEGS * PER_LEG
NUM_DYNAMIC: Final = NUM_CONSTANTS  # parameters of the dynamics; a log has no wrench
_INSTANT: Final = 1e-9  # s; events closer to each other are one
_ROUNDING: Final = 1e-9  # excess of a number of steps that is rounded down
# Columns of S: first state, parameters of the dynamics and numbers of the legs, and last the delay
FIRST_COLUMNS: Final = slice(0, NUM_STATE)
PARAMETER_COLUMNS: Final = slice(NUM_STATE, NUM_STATE + NUM_DYNAMIC + NUM_GEOMETRY)
DELAY_COLUMN: Final = -1


class Numbers(NamedTuple):
    parameters: Array  # (NUM_DYNAMIC,) of the dynamics
    legs: Array  # (6, LEG_NUMBERS), see `core.layout`


class MachineModel:
    """Accelerations and crank angles of a machine with any numbers, and their derivatives.

    Bodies, motor frames and branches stay. Gravity is along -z. `free_legs` is whether derivatives
    by the numbers of the legs are wanted, which take most of the time.
    """

    def __init__(self, mechanism: Mechanism, gravity: float, free_legs: bool = True) -> None:
        self.mechanism, self.gravity, self.free_legs = mechanism, gravity, free_legs

    def plant(self, numbers: Numbers) -> tuple[Any, object]:
        """Return a `stewart_plant` with these numbers, and the memory that it uses."""
        geometry, parameters = self.mechanism.numbers.copy(), plant_parameters()
        geometry[: LEG_NUMBERS * NUM_LEGS] = numbers.legs.T.ravel()
        parameters[:NUM_DYNAMIC] = numbers.parameters
        kept = [core().at(one) for one in (geometry, parameters, np.array([self.gravity]))]
        return core().plant(*kept), kept

    def crank_angles(self, poses: Array, numbers: Numbers) -> tuple[Array, Array, Array]:
        """Return angles (..., 6), d/dpose (..., 6, 6) and d/dgeometry (..., 6, NUM_GEOMETRY).

        They are NaN out of reach. With r the rod's direction, t that of the crank's tip, e the
        crank's, u and l the lengths, and Q, W the plate joint and the shaft,

            u r.t d alpha = r.(dQ - dW) - r.e du - dl.
        """
        legs = Legs(
            p_WS=numbers.legs[:, 15:18],
            R_WS=numbers.legs[:, 3:12].reshape(-1, 3, 3).swapaxes(1, 2),
            p_PQ=numbers.legs[:, 12:15],
            crank_lengths=numbers.legs[:, 0],
            rod_lengths=numbers.legs[:, 1],
            branches=numbers.legs[:, 2],
        )
        flat = poses.reshape(-1, NUM_COORDINATES)
        turns = flat[:, ANGLES]
        E = np.array([angle_rate_map(one) for one in turns])
        with np.errstate(all="ignore"):
            at = legs_along(legs, flat)
            lever = (legs.crank_lengths * at.transmission)[..., None]
            by_pose = np.concatenate([np.cross(at.p_PQ_W, at.rod) @ E, at.rod], axis=2) / lever
            stretch = -dot(at.rod, at.crank)[..., None]
            lengths = np.concatenate([stretch, -np.ones_like(stretch)], axis=2)
            of_leg = np.concatenate([lengths, at.rod @ rotation(turns), -at.rod], axis=2) / lever
        by_geometry = np.zeros((len(flat), NUM_LEGS, NUM_LEGS, PER_LEG))
        by_geometry[:, range(NUM_LEGS), range(NUM_LEGS)] = of_leg
        shape = poses.shape[:-1]
        return (
            at.crank_angles.reshape(*shape, NUM_LEGS),
            by_pose.reshape(*shape, NUM_LEGS, NUM_COORDINATES),
            by_geometry.reshape(*shape, NUM_LEGS, NUM_GEOMETRY),
        )


class Segment(NamedTuple):
    """Stretch of a log that is integrated from a free first state."""

    log: Log
    start: float  # s
    rows: NDArray[np.intp]  # of the log's samples, in order


class Steps(NamedTuple):
    """Steps (m,) of a segment."""

    h: Array  # s
    torques: Array  # (m, 6) during a step
    after: Array  # (m, 6) after it
    sample: NDArray[np.intc]  # number of the segment's sample at the end of a step, or -1


def plan_steps(segment: Segment, delay: float, longest_step: float) -> Steps:
    """Return the steps from sample to sample and from torque to torque; times in s."""
    log, start = segment.log, segment.start
    samples = log.times[segment.rows]
    arrivals = log.sent + delay
    inner = arrivals[(arrivals > start + _INSTANT) & (arrivals < samples[-1] + _INSTANT)]
    events = np.sort(np.concatenate([samples, inner]))
    events = events[np.diff(events, prepend=-np.inf) > _INSTANT]
    gaps = np.diff(events, prepend=start)
    parts = np.maximum(1, np.ceil(gaps / longest_step - _ROUNDING)).astype(int)
    ends = np.cumsum(parts) - 1
    sample = np.full(ends[-1] + 1, -1, np.intc)
    sample[ends[np.searchsorted(events, samples - _INSTANT)]] = np.arange(len(samples))
    # Torque in the middle of each gap. An arrival within _INSTANT of the start counts as before it,
    # so look just behind.
    middle = np.repeat(np.maximum(events - gaps / 2, start + 2 * _INSTANT), parts)
    torques = log.applied_torque(middle, delay)
    after = np.vstack([torques[1:], log.applied_torque(samples[-1:] + 2 * _INSTANT, delay)])
    return Steps(np.repeat(gaps / parts, parts), torques, after, sample)


def integrate(
    model: MachineModel, numbers: Numbers, first: Array, steps: list[Steps], sensitive: bool
) -> tuple[Array, Array]:
    """Integrate n segments from their first states (n, 12); return what is at their samples.

    These are states (m, n, 12), NaN where a segment has no sample, and sensitivities
    (m, n, 12, columns), 0 there. A state that grows beyond all bounds ends as NaN or infinity,
    without a warning.
    """
    c, n, count = core(), len(first), 1 + max(int(one.sample.max()) for one in steps)
    (plant, _kept), legs = model.plant(numbers), NUM_GEOMETRY * model.free_legs
    states = np.full((n, count, NUM_STATE), np.nan)
    columns = NUM_STATE + NUM_DYNAMIC + legs + 1 if sensitive else 0
    found = np.zeros((n, count, NUM_STATE, columns))
    for k, one in enumerate(steps):
        arrays = (np.ascontiguousarray(part) for part in (*one, first[k]))
        slopes = found[k] if sensitive else None
        given = map(c.at, (*arrays, states[k], slopes))
        c.lib.stewart_shoot(plant, legs > 0, len(one.h), *given)
    sensitivities = np.zeros((count, n, NUM_STATE, PARAMETER_COLUMNS.stop + 1 if sensitive else 0))
    if sensitive:
        sensitivities[..., : columns - 1] = found[..., :-1].swapaxes(0, 1)
        sensitivities[..., DELAY_COLUMN] = found[..., -1].swapaxes(0, 1)
    return states.swapaxes(0, 1), sensitivities
