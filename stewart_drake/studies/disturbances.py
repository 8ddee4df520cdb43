"""Unlike conditions of one scenario, drawn from a seed: delay, motion, plant and sensor.

Every draw is relative to the machine and its motion, so that the same shares suit any mechanism.
"""

import copy
from typing import Final, Literal, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.startup import reference_torque
from stewart_drake.loop.experiment import motion_scale, prepare
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.reference_config import SineConfig

DELAYS: Final = (0, 15)
"""Whole periods, uniform, both included."""
FREQUENCIES: Final = (0.5, 3.0)
"""rad/s, uniform in the logarithm."""
AMPLITUDES: Final = (0.3, 1.0)
"""Share of the scenario's own amplitudes, uniform."""
BIAS: Final = 4e-3
"""Standard deviation of each motor's torque bias, as a share of the largest torque that the
scenario's motion takes at 1 rad/s and full amplitude."""
PAYLOAD: Final = 0.1
"""Largest payload as a share of the plate's mass, uniform from 0."""
NOISE: Final = (1e-4, 3e-3)
"""Standard deviation of pose (rates: per second), as a share of the amplitudes, uniform in the
logarithm."""

_STREAMS: Final = {"training": 0, "evaluation": 1}


class Disturbance(NamedTuple):
    """What is unlike in one scenario; bias, payload and noise are each absent in half of the draws.

    Attributes:
        delay_steps: whole periods.
        frequency: of the sine, rad/s.
        amplitude: share of the scenario's own.
        torque_bias: (6,) N m.
        payload_mass: kg.
        noise: share of the amplitudes.
        seed: of the noise.
    """

    delay_steps: int
    frequency: float
    amplitude: float
    torque_bias: tuple[float, ...]
    payload_mass: float
    noise: float
    seed: int


def sine_of(scenario: Scenario) -> SineConfig:
    """The scenario's reference, which has a frequency and an amplitude.

    Raises:
        ConfigError: it is not a sine.
    """
    if not isinstance(scenario.reference, SineConfig):
        raise ConfigError(
            f"reference.kind: got {scenario.reference.kind!r}; expected 'sine', whose frequency "
            "and amplitude are varied"
        )
    return scenario.reference


def draw(
    scenario: Scenario, number: int, seed: int, purpose: Literal["training", "evaluation"]
) -> list[Disturbance]:
    """So many draws; the first ones stay the same when more are asked for.

    Args:
        scenario: whose machine and motion give the scales.
        number: of draws.
        seed: of all draws.
        purpose: draws for training and for evaluation have nothing in common.

    Raises:
        ConfigError: the scenario cannot be prepared, or its reference is not a sine.
    """
    standard = _with_motion(scenario, 1.0, 1.0)
    experiment = prepare(standard)
    torque = reference_torque(experiment.nominal, experiment.reference, standard.duration)
    mass = experiment.mechanism.plate.mass
    draws = []
    for index in range(number):
        rng = np.random.default_rng([seed, _STREAMS[purpose], index])
        biased, loaded, noisy = rng.integers(2, size=3)
        draws.append(
            Disturbance(
                delay_steps=int(rng.integers(DELAYS[0], DELAYS[1] + 1)),
                frequency=float(np.exp(rng.uniform(*np.log(FREQUENCIES)))),
                amplitude=float(rng.uniform(*AMPLITUDES)),
                torque_bias=tuple(map(float, biased * BIAS * torque * rng.standard_normal(6))),
                payload_mass=float(loaded * rng.uniform(0.0, PAYLOAD * mass)),
                noise=float(noisy * np.exp(rng.uniform(*np.log(NOISE)))),
                seed=int(rng.integers(2**31)),
            )
        )
    return draws


def disturbed(scenario: Scenario, disturbance: Disturbance) -> Scenario:
    """A copy of the scenario under a disturbance."""
    d = disturbance
    result = _with_motion(scenario, d.frequency, d.amplitude)
    result.delay.steps = d.delay_steps
    result.plant.torque_bias = list(d.torque_bias)
    result.plant.payload_mass = d.payload_mass
    scale = np.tile(motion_scale(prepare(result)), 2)
    result.sensor.noise_std = [float(std) for std in d.noise * scale]
    result.sensor.seed = d.seed
    return result


def with_gain(scenario: Scenario, w_Q: float, w_R: float) -> Scenario:
    """A copy of the scenario with these fixed weights."""
    result = copy.deepcopy(scenario)
    result.controller.w_Q, result.controller.w_R = w_Q, w_R
    return result


def _with_motion(scenario: Scenario, frequency: float, share: float) -> Scenario:
    result = copy.deepcopy(scenario)
    sine = sine_of(result)
    sine.frequency, sine.frequency_unit = frequency, "rad/s"
    sine.amplitude = [share * a for a in sine.amplitude]
    return result
