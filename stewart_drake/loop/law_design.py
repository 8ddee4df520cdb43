"""The control law without a scenario: for a diagram of one's own."""

import dataclasses
import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import validate
from stewart_drake.law.delay_observer import DelayObserver
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.controller import DelayLqiController
from stewart_drake.loop.experiment import (
    Experiment,
    calibration_of,
    control_law,
    first_queue,
)
from stewart_drake.loop.own import Own
from stewart_drake.loop.own_motion import own_motion
from stewart_drake.loop.reference import Reference
from stewart_drake.scenario.config import ControllerConfig, Scenario
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import NUM_STATE, POSE
from stewart_drake.scenario.trajectories import evaluate, moved
from stewart_drake.types import Array

_HORIZON = 10.0
"""s of a reference without an end that weights and steps are chosen by."""


class DesignedLaw:
    """What `design_law` returns; a law can be added to several diagrams.

    Attributes:
        law: the control law as a pure function, memory in, memory out.
        reference: what it was designed for, a trajectory (6, 1).
        planned: what it follows: the reference, or the way onto it and then the reference.
        queue: (L, 6) torques in flight at t = 0 in N m, oldest first, as it believes.
        weights: (2,) w_Q and w_R.
    """

    def __init__(
        self,
        law: PredictiveLqi,
        reference: Trajectory,
        planned: Trajectory,
        queue: Array,
        weights: Array,
    ) -> None:
        self.law, self.reference, self.planned = law, reference, planned
        self.queue, self.weights = queue, weights

    def __repr__(self) -> str:
        timeline, dynamics = self.law.timeline, self.law.plant.dynamics
        return f"DesignedLaw(every {timeline.period:g} s, delay {timeline.eta:g} s, {dynamics})"

    def controller(self) -> DelayLqiController:
        """The law alone as a LeafSystem, whose `preview` and `weights` are the caller's."""
        known = isinstance(self.law.observer, DelayObserver)
        motion = (self.planned, self.reference) if known else None
        return DelayLqiController(self.law, self.queue, motion)

    def AddToBuilder(self, builder: DiagramBuilder, name: str = "delay_lqi") -> DelayLqiController:
        """Add the law with its reference and weights, which are connected.

        Args:
            builder: of the diagram.
            name: of the controller; its reference is `NAME_reference`, its weights `NAME_weights`.

        Returns:
            The controller, of which `measurement` (12) is to be connected, and `torque` (6), which
            is to be read at its samples: by what holds and delays it, at multiples of its period
            (`scenario.timing.event_time`) and not later.
        """
        controller = builder.AddNamedSystem(name, self.controller())
        reference = builder.AddNamedSystem(
            f"{name}_reference", Reference(self.reference, self.planned, self.law.preview_times)
        )
        weights = builder.AddNamedSystem(f"{name}_weights", ConstantVectorSource(self.weights))
        builder.Connect(reference.GetOutputPort("preview"), controller.GetInputPort("preview"))
        builder.Connect(weights.get_output_port(), controller.GetInputPort("weights"))
        return controller


def design_law(
    dynamics: StewartDynamics,
    reference: Trajectory,
    period: float,
    delay: float,
    *,
    start: ArrayLike | None = None,
    queue: Literal["zero", "equilibrium", "reference"] | None = None,
    noise_std: ArrayLike = (0.0,) * NUM_STATE,
    torque_limit: float | None = None,
    horizon: float | None = None,
    options: ControllerConfig | None = None,
) -> DesignedLaw:
    """The delayed LQI law for a machine and a motion.

    Args:
        dynamics: the machine as the law knows it.
        reference: 6 x 1 trajectory of the pose, rad and m, with derivatives of order 1 and 2. It is
            held where it ends.
        period: between two torques, s.
        delay: between computing a torque and feeling it, s, as the law believes.
        start: (12,) pose and rates at t = 0 from which a way onto the reference is planned; None is
            on the reference.
        queue: torques in flight at t = 0, as a scenario's `queue`; None is `zero` without gravity
            and `equilibrium` with it, where the plate would otherwise fall during the first delay.
        noise_std: (12,) of the measurement, rad, m and per s.
        torque_limit: of each motor, N m; None is the mechanism's, if it has one.
        horizon: s of the reference that weights and steps are chosen by; None is its end, or 10 s.
        options: all others, as a scenario's `controller`; its period and delay are not used.

    Raises:
        ConfigError: one line.
    """
    if not (math.isfinite(delay) and delay >= 0):
        raise ConfigError(f"delay: got {delay!r}; expected a number of seconds, 0 or more")
    if not (math.isfinite(period) and period > 0):
        raise ConfigError(f"period: got {period!r}; expected a number of seconds above 0")
    chosen = dataclasses.asdict(ControllerConfig() if options is None else options)
    if horizon is None:
        horizon = reference.end_time() if math.isfinite(reference.end_time()) else _HORIZON
    believed = Delay.of(delay, period)
    sections = {
        "duration": horizon,
        "start": "on_reference" if start is None else "rest",
        "queue": ("zero" if dynamics.gravity == 0 else "equilibrium") if queue is None else queue,
        "plant": {"kind": "exact", "gravity": dynamics.gravity != 0},
        "delay": dataclasses.asdict(believed),
        "controller": chosen
        | {"period": period, "delay_steps": believed.steps, "delay_fraction": believed.fraction},
        "actuator": {"torque_limit": torque_limit},
        "sensor": {"noise_std": np.asarray(noise_std, dtype=float).tolist()},
    }
    scenario = validate(Scenario, sections, "design_law")
    scenario.check("design_law")
    motion = own_motion(reference, horizon)
    first = evaluate(motion, 0.0)[:NUM_STATE]
    at = first if start is None else np.array(start, dtype=np.float64)
    if at.shape != (NUM_STATE,):
        raise ConfigError(f"start: got shape {at.shape}; expected ({NUM_STATE},), pose and rates")
    dynamics.equilibrium_torque(at[POSE])  # or it is out of reach
    experiment = Experiment(
        scenario=scenario,
        mechanism=dynamics.mechanism,
        truth=dynamics.mechanism,
        reference=motion,
        peak_to_peak=moved(motion, horizon),
        nominal=dynamics,
        start=at,
        network=None,
        own=Own(reference=reference),
        calibration=calibration_of(scenario, dynamics.mechanism),
    )
    law, planned, _ = control_law(experiment)
    c = scenario.controller
    flying = first_queue(experiment, law)
    return DesignedLaw(law, motion, planned, flying, np.array([c.w_Q, c.w_R]))
