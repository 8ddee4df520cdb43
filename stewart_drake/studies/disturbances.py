"""Unlike conditions for a tuner, drawn from a seed: delay, motion, plant and sensor."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.random import Generator

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.startup import reference_torque
from stewart_drake.loop.experiment import prepare
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.reference_config import SineConfig
from stewart_drake.studies.uncertainty import (
    Draw,
    Model,
    Quantity,
    Truth,
    add_bias,
    add_noise,
    add_payload,
    draw_from,
    draw_seed,
    drawn,
    seed_noise,
)

_STREAMS: Final = {"training": 0, "evaluation": 1}


class Standard(NamedTuple):
    """Of the scenario's motion at 1 rad/s and full amplitude."""

    torque: float
    """Largest that it takes, N m."""
    plate_mass: float


def logarithmic(low: float, high: float) -> Callable[[Generator, Any], float]:
    """Draws a number whose logarithm is uniform."""
    return lambda rng, _: float(np.exp(rng.uniform(*np.log((low, high)))))


def _biases(rng: Generator, standard: Standard) -> tuple[float, ...]:
    return tuple((4e-3 * standard.torque * rng.standard_normal(6)).tolist())


def _delay(truth: Truth, steps: int) -> None:
    truth.fields["delay"]["steps"] = steps


def set_frequency(truth: Truth, frequency: float) -> None:
    """Of a sine, rad/s."""
    truth.fields["reference"] |= {"frequency": frequency, "frequency_unit": "rad/s"}


def set_amplitude(truth: Truth, share: float) -> None:
    """A share of what the reference's amplitudes are."""
    reference = truth.fields["reference"]
    reference["amplitude"] = [share * a for a in reference["amplitude"]]


CONDITIONS: Final[Model] = {
    # Whole periods, 0 and 15 included, which the controller knows.
    "delay_steps": Quantity(lambda rng, _: int(rng.integers(0, 16)), _delay),
    # rad/s of the sine.
    "frequency": Quantity(logarithmic(0.5, 3.0), set_frequency),
    # Share of the scenario's own amplitudes.
    "amplitude": Quantity(lambda rng, _: float(rng.uniform(0.3, 1.0)), set_amplitude),
    # Of each motor; its standard deviation is a share of the standard torque.
    "torque_bias": Quantity(_biases, add_bias, sometimes=True),
    # kg, up to a tenth of the plate's.
    "payload_mass": Quantity(
        lambda rng, standard: float(rng.uniform(0.0, 0.1 * standard.plate_mass)),
        add_payload, sometimes=True,
    ),
    # Standard deviation of pose (rates: per second), share of the amplitudes.
    "noise": Quantity(logarithmic(1e-4, 3e-3), add_noise, sometimes=True),
    "seed": Quantity(draw_seed, seed_noise),
}  # fmt: skip
"""What is unlike; uniform, what covers decades in the logarithm."""


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
) -> list[Draw]:
    """So many draws of CONDITIONS; the first ones stay the same when more are asked for.

    Args:
        scenario: whose machine and motion give the scales.
        number: of draws.
        seed: of all draws.
        purpose: draws for training and for evaluation have nothing in common.

    Raises:
        ConfigError: the scenario cannot be prepared, or its reference is not a sine.
    """
    standard = standard_of(scenario)
    streams = (np.random.default_rng([seed, _STREAMS[purpose], i]) for i in range(number))
    return [draw_from(CONDITIONS, rng, standard) for rng in streams]


def standard_of(scenario: Scenario) -> Standard:
    """What shares are taken of.

    Raises:
        ConfigError: the scenario cannot be prepared, or its reference is not a sine.
    """
    slow = replace(sine_of(scenario), frequency=1.0, frequency_unit="rad/s")
    experiment = prepare(replace(scenario, reference=slow))
    torque = reference_torque(experiment.nominal, experiment.reference, scenario.duration)
    return Standard(torque, experiment.mechanism.plate.mass)


def disturbed(scenario: Scenario, one: Draw) -> Scenario:
    """A copy of the scenario under conditions that were drawn.

    Raises:
        ConfigError: the motion leaves the workspace.
    """
    result = drawn(CONDITIONS, scenario, load_mechanism(scenario.mechanism), one).as_scenario()
    prepare(result)
    return result


def with_gain(scenario: Scenario, w_Q: float, w_R: float) -> Scenario:
    """A copy of the scenario with these fixed weights."""
    return replace(scenario, controller=replace(scenario.controller, w_Q=w_Q, w_R=w_R))
