"""The delayed LQI control law as a pure function: (memory, measurement, preview) -> memory.

At t = k dt the torques in flight are known, so the state at the instant from which the next torque
acts is predicted, and (42) is applied there:

    T_k = T_ff - K [e; z; ...],   e = predicted pose and rate error, z = predicted integral,

with K from `design.riccati.reduced_gain` and T_ff the feedforward of the hold interval
[t + eta, t + eta + dt), see `design.holds`. Linear prediction multiplies [e_k; z_k; queue] by
`prediction_matrix`, which is the paper's K_aug e_dis; nonlinear prediction integrates the exact
dynamics through the queue. Torques enter the linear parts as deviations from their feedforward.
"""

import time

import numpy as np
from numpy.typing import NDArray

from stewart_drake.design import estimator
from stewart_drake.design.delay_model import delayed_model
from stewart_drake.design.error_model import ContinuousModel, double_integrators, linear_model
from stewart_drake.design.estimator import Estimate, Period
from stewart_drake.design.holds import (
    GAUSS_NODES,
    held_torques,
    means_and_changes,
    rates_at_samples,
    state_within_hold,
)
from stewart_drake.design.law_types import Counts, LawOptions, Memory
from stewart_drake.design.riccati import prediction_matrix, reduced_gain
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.mechanism.torque_map import torque_map
from stewart_drake.plant.dynamics import StewartDynamics
from stewart_drake.plant.equations import DEAD_CENTRE_SINE
from stewart_drake.plant.workspace import standing
from stewart_drake.signals import (
    ACCELERATIONS,
    NUM_COORDINATES,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
)

Array = NDArray[np.float64]


class DelayLqi:
    """The control law for one machine, with everything that does not change while it runs.

    Args:
        options: what it is and believes.
        dynamics: the nominal plant; parameters are its prior knowledge.
    """

    def __init__(self, options: LawOptions, dynamics: StewartDynamics) -> None:
        self.options = options
        self.dynamics = dynamics
        o = options
        ahead = o.steps if o.prediction == "nonlinear" else 0
        self._samples = o.period * np.arange(1.0, ahead + 1)
        # Intervals whose feedforward is needed: of the torque to be computed, of those in the queue
        # that enter linearly, and of one neighbour at each end.
        eta = (o.steps + o.fraction) * o.period
        linear = o.queue_length if o.prediction == "linear" else o.queue_length - o.steps
        self._holds = eta + o.period * np.arange(-linear - 1, 2)
        nodes = (self._holds[:, None] + o.period * GAUSS_NODES).ravel()
        self.preview_times: Array = np.concatenate([[0.0], self._samples, nodes])
        """Times from now, s, at which the reference must be known; some may be negative."""
        scale = [o.error_weights, o.integral_weights] if o.integral else [o.error_weights]
        self._Q, self._R = np.diag(np.concatenate(scale)), np.diag(o.torque_weights)
        self._compile()

    def _compile(self) -> None:
        """Take two samples at home, so that no later one waits for functions to be compiled."""
        home = np.concatenate([self.dynamics.mechanism.home, np.zeros(NUM_COORDINATES)])
        preview = np.zeros((len(self.preview_times), NUM_REFERENCE))
        preview[:, :NUM_STATE] = home
        for torque in (0.0, 2 * self.options.gentle_torque):
            queue = np.full((self.options.queue_length, NUM_TORQUES), torque)
            memory = self.initial_memory(queue)
            for _ in range(2):
                memory = self.step(memory, home, preview, np.ones(2))

    def initial_memory(self, queue: Array) -> Memory:
        """Before the first sample, with torques (L, 6) in flight, oldest first."""
        nothing = np.zeros(NUM_TORQUES)
        return Memory(
            in_flight=np.vstack([nothing, queue]),
            state=np.full(NUM_STATE, np.nan),
            error=np.zeros(NUM_COORDINATES),
            integral=np.zeros(NUM_COORDINATES),
            gain=None,
            estimate=None,
            torque=queue[-1] if len(queue) else nothing,
            weights=np.full(2, np.nan),
            counts=Counts(),
            seconds=0.0,
        )

    @np.errstate(over="ignore", invalid="ignore")  # its outcome is checked and counted instead
    def step(self, memory: Memory, measurement: Array, preview: Array, weights: Array) -> Memory:
        """One sample.

        Args:
            memory: after the last sample.
            measurement: (12,) pose and rates; non-finite values are survived.
            preview: (p, 18) reference at `preview_times` from now.
            weights: (2,) w_Q and w_R.

        Returns:
            The new memory; its torque (6,) is finite and within the limit.
        """
        started = time.perf_counter()
        estimate, x, bad = self._observe(memory, measurement, preview[0, :NUM_STATE])
        theta = self.dynamics.parameters if estimate is None else estimate.parameters
        error = x[POSE] - preview[0, POSE]
        integral = self._integrate(memory, error)
        changes, feedforward = self._feedforward(preview, theta)
        queue = memory.in_flight[1:]
        point, error_ahead, integral_ahead = self._ahead(x, integral, queue, preview, theta)
        gain, failed = None, False
        try:
            model = self._model(point, feedforward[-1], theta)
            if self.options.feedforward == "inverse_dynamics":
                error_ahead -= self._offset(changes, model.B[RATES])
            gain = self._gain(model, weights)
        except UnreachablePoseError:
            failed = True  # nothing to regulate: the feedforward goes on alone
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            gain, failed = memory.gain, True
        pending = (queue[len(queue) - len(feedforward) + 1 :] - feedforward[:-1]).ravel()
        torque = feedforward[-1]
        if gain is not None:
            torque = torque - gain @ np.concatenate([error_ahead, integral_ahead, pending])
        if not np.all(np.isfinite(torque)):
            torque, failed = memory.torque, True
        limited = self._limit(torque)
        counts = Counts(
            memory.counts.riccati_failures + failed,
            memory.counts.bad_measurements + bad,
            memory.counts.saturated_steps + bool(np.any(limited != torque)),
        )
        return Memory(
            in_flight=np.vstack([memory.in_flight[1:], limited]),
            state=x,
            error=error,
            integral=integral,
            gain=memory.gain if gain is None else gain,
            estimate=estimate,
            torque=limited,
            weights=np.array(weights),
            counts=counts,
            seconds=time.perf_counter() - started,
        )

    def _acting(self, in_flight: Array) -> tuple[Array, Array]:
        """Torques (n, 6) and durations (n,) of all whole periods that `in_flight` covers."""
        o = self.options
        if o.fraction == 0:
            return in_flight, np.full(len(in_flight), o.period)
        # Each torque acts for the end of one period and the beginning of the next.
        split = np.array([o.fraction, 1 - o.fraction]) * o.period
        return np.repeat(in_flight, 2, axis=0)[1:-1], np.tile(split, len(in_flight) - 1)

    def _per_period(self) -> int:
        return 1 if self.options.fraction == 0 else 2

    def _observe(
        self, memory: Memory, measurement: Array, planned: Array
    ) -> tuple[Estimate | None, Array, bool]:
        """Estimate, state (12,) and whether the measurement was unusable and the model stood in."""
        o, bad = self.options, not np.all(np.isfinite(measurement))
        first = not np.all(np.isfinite(memory.state))
        if first:
            if bad:  # nothing else to go on with
                return None, planned.copy(), True
            if o.filter is None:
                return None, measurement, False
            return estimator.start(measurement, o.filter), measurement, False
        acting, times = self._acting(memory.in_flight)
        n = self._per_period()
        torques, durations, substeps = acting[:n], times[:n], o.substeps_for(acting[:n])
        if o.filter is not None and memory.estimate is not None:
            # Without a delay the torque that acts next is still to be computed: no change is known.
            following = acting[min(n, len(acting) - 1)]
            period = Period(torques, durations, following, substeps)
            usable = None if bad else measurement
            estimate = estimator.advance(memory.estimate, self.dynamics, period, usable, o.filter)
            return estimate, estimate.state, bad
        if not bad:
            started = None if o.filter is None else estimator.start(measurement, o.filter)
            return started, measurement, False
        return None, self.dynamics.predict(memory.state, torques, durations, substeps)[-1], True

    def _integrate(self, memory: Memory, error: Array) -> Array:
        """z_k = z_{k-1} + dt/2 (e_{k-1} + e_k), but not while a motor is at its limit."""
        if not self.options.integral or not np.all(np.isfinite(memory.state)):
            return memory.integral
        acting, _ = self._acting(memory.in_flight)
        if self._at_limit(acting[: self._per_period()]):
            return memory.integral
        return memory.integral + self.options.period / 2 * (memory.error + error)

    def _feedforward(self, preview: Array, theta: Array) -> tuple[Array, Array]:
        """Changes (h + 2, 6) of the torque over all holds, and the torques (h, 6) to be held."""
        kind, nodes = self.options.feedforward, preview[1 + len(self._samples) :]
        if kind == "none":
            nothing = np.zeros((len(self._holds), NUM_TORQUES))
            return nothing, nothing[1:-1]
        moving = 1.0 if kind == "inverse_dynamics" else 0.0
        torques = [
            self.dynamics.inverse_dynamics(
                node[POSE], moving * node[RATES], moving * node[ACCELERATIONS], theta
            )
            for node in nodes
        ]
        means, changes = means_and_changes(np.reshape(torques, (-1, 2, NUM_TORQUES)))
        if kind == "equilibrium":
            return changes, means[1:-1]
        return changes, held_torques(means, changes)

    def _offset(self, changes: Array, B: Array) -> Array:
        """Where held torques put pose and rates (12,) at the sample whose error is regulated."""
        o = self.options
        if o.fraction > 0:  # between the second hold's ends
            return state_within_hold(changes[1], B, o.period, 1 - o.fraction)
        rates = rates_at_samples(changes[:2], B, o.period)
        return np.concatenate([np.zeros(NUM_COORDINATES), rates])

    def _ahead(
        self, x: Array, integral: Array, queue: Array, preview: Array, theta: Array
    ) -> tuple[Array, Array, Array]:
        """State to linearise at, and the error (12,) and integral that the gain multiplies.

        Nonlinear prediction takes all three mu periods ahead, through the torques in flight; linear
        prediction leaves that to the gain.
        """
        o, each = self.options, self._per_period()
        if not o.integral:
            integral = np.empty(0)
        if o.prediction == "linear" or o.steps == 0:
            return x, x - preview[0, :NUM_STATE], integral
        # The queue ends with the torque that is still to act for eta0 after the last sample.
        torques, durations = self._acting(queue)
        substeps = o.substeps_for(queue)
        ends = self.dynamics.predict(x, torques, durations, substeps, theta)[each - 1 :: each]
        states = np.vstack([x, ends])
        errors = states - preview[: o.steps + 1, :NUM_STATE]
        if o.integral:
            added = o.period / 2 * (errors[:-1, POSE] + errors[1:, POSE])
            held = [self._at_limit(t) for t in torques.reshape(o.steps, -1)]
            integral = integral + added[~np.array(held)].sum(axis=0)
        return states[-1], errors[-1], integral

    def _model(self, point: Array, torque: Array, theta: Array) -> ContinuousModel:
        """The error model at a state; raises UnreachablePoseError where there is none."""
        mechanism = self.dynamics.mechanism
        margins = mechanism.reach_margins(point[POSE])
        if (
            not np.all(margins > 0)
            or standing(mechanism, point[POSE]).sines.min() < DEAD_CENTRE_SINE
        ):
            raise UnreachablePoseError(margins)
        if self.options.model == "paper":
            form = self.options.torque_map
            return double_integrators(torque_map(mechanism, point[POSE], form))
        derivatives = self.dynamics.derivatives(point[POSE], point[RATES], torque, theta)
        return linear_model(derivatives.A, derivatives.B)

    def _gain(self, model: ContinuousModel, weights: Array) -> Array:
        """What the vector [error; integral; pending torques] is multiplied with."""
        o = self.options
        if not np.all(np.isfinite(weights)):
            raise ValueError(f"weights: got {weights}; expected finite numbers")
        delayed = delayed_model(model, o.period, o.steps, o.fraction, integral=o.integral)
        K = reduced_gain(delayed, weights[0] * self._Q, weights[1] * self._R)
        return K @ prediction_matrix(delayed) if o.prediction == "linear" else K

    def _limit(self, torque: Array) -> Array:
        limit = self.options.torque_limit
        return torque if limit is None else np.clip(torque, -limit, limit)

    def _at_limit(self, torques: Array) -> bool:
        limit = self.options.torque_limit
        return limit is not None and bool(np.any(np.abs(torques) >= limit))
