"""Two families of conditions under which the weights matter, drawn from a seed.

Where the timing is as believed and nothing rubs, any weights will do (theory.md, section 23). Half
of the draws here have a timing fault, an offset of the delay that nobody tells the controller or a
jitter, a quarter Coulomb friction, a quarter ten times the noise; each has a motion, a bias and a
payload of its own. Timing faults ask for little feedback, friction for much, by decades.
"""

from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.random import Generator

from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.reference_config import SineConfig
from stewart_drake.studies.disturbances import (
    Standard,
    logarithmic,
    set_amplitude,
    set_frequency,
    standard_of,
)
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

FamilyName = Literal["T", "N2"]
FAULTS: Final = ("offset", "jitter", "friction", "noise")
LEAST_TORQUE: Final = 0.3
"""Of the standard torque: what the slowest motions are taken for."""
NOISE: Final = (1e-4, 1e-3)
"""Share of the amplitudes."""
NOISY: Final = 10.0
"""So many times as much where noise is the fault."""
BIAS: Final = 0.02
FRICTION: Final = 0.05
"""Shares of the torque that the motion takes, at the most."""
PAYLOAD: Final = 0.1
"""Share of the plate, added or missing, at the most."""


class Family(NamedTuple):
    """What is drawn, and for which controller.

    Attributes:
        settings: of the scenario `paper`.
        offset, jitter: least and most, s.
        about: in words.
    """

    settings: tuple[str, ...]
    offset: tuple[float, float]
    jitter: tuple[float, float]
    about: str


_ON_REFERENCE: Final = ("plant.kind=exact", "start=on_reference", "queue=reference")
FAMILIES: Final[dict[str, Family]] = {
    "T": Family(_ON_REFERENCE, (2e-3, 12e-3), (2e-3, 10e-3), "with the estimator"),
    "N2": Family(
        (*_ON_REFERENCE, "controller.estimate=[]"),
        (5e-3, 30e-3),
        (3e-3, 15e-3),
        "without an estimator",
    ),
}


class About(NamedTuple):
    """What a family is drawn with."""

    family: Family
    standard: Standard


def _uniform(low: float, high: float, share: float) -> float:
    return float(low + (high - low) * share)


def _draw_bias(rng: Generator, about: About) -> tuple[float, ...]:
    """Of random size, for the standard motion."""
    size, direction = BIAS * about.standard.torque * rng.uniform(), rng.standard_normal(6)
    return tuple((size * direction / np.sqrt(np.mean(direction**2))).tolist())


def _draw_fault(rng: Generator, about: About) -> tuple[float, ...]:
    """One of FAULTS: offset, jitter, s; friction, N m for the standard motion; noise, times."""
    kind, sign, size = int(rng.integers(4)), float(rng.choice([-1.0, 1.0])), rng.uniform()
    family = about.family
    sizes = (
        sign * _uniform(*family.offset, size),
        _uniform(*family.jitter, size),
        FRICTION * about.standard.torque * float(size),
        NOISY,
    )
    return tuple(value if i == kind else float(i == 3) for i, value in enumerate(sizes))


def _effort(truth: Truth) -> float:
    """Torque of the motion as it is, over that of the standard one."""
    base, now = truth.scenario.reference, truth.fields["reference"]
    assert isinstance(base, SineConfig)
    share = max(abs(a / b) for a, b in zip(now["amplitude"], base.amplitude, strict=True) if b != 0)
    return max(LEAST_TORQUE, share * now["frequency"] ** 2)


def _bias(truth: Truth, bias: tuple[float, ...]) -> None:
    add_bias(truth, tuple(_effort(truth) * b for b in bias))


def _steps(truth: Truth, steps: int) -> None:
    truth.fields["delay"]["steps"] = steps
    truth.fields["controller"] |= {"delay_steps": steps, "delay_fraction": 0.0}


def _fault(truth: Truth, fault: tuple[float, ...]) -> None:
    offset, jitter, friction, noise = fault
    delay, period = truth.fields["delay"], truth.scenario.controller.period
    late = Delay.of(max(0.0, delay["steps"] * period + offset), period)
    delay |= {"steps": late.steps, "fraction": late.fraction, "jitter_std": jitter}
    truth.fields["plant"]["coulomb_friction"] += _effort(truth) * friction
    std = truth.fields["sensor"]["noise_std"]
    truth.fields["sensor"]["noise_std"] = [noise * s for s in std]


def _seed_jitter(truth: Truth, seed: int) -> None:
    truth.fields["delay"]["seed"] = seed


CONDITIONS: Final[Model] = {
    "delay_steps": Quantity(lambda rng, _: int(rng.integers(4, 13)), _steps),
    # rad/s of the sine.
    "frequency": Quantity(logarithmic(0.5, 2.0), set_frequency),
    # Share of the scenario's own amplitudes.
    "amplitude": Quantity(lambda rng, _: float(rng.uniform(0.5, 1.0)), set_amplitude),
    "torque_bias": Quantity(_draw_bias, _bias),
    # kg.
    "payload": Quantity(
        lambda rng, a: float(PAYLOAD * a.standard.plate_mass * rng.uniform(-1, 1)), add_payload
    ),
    "noise": Quantity(logarithmic(*NOISE), add_noise),
    "fault": Quantity(_draw_fault, _fault),
    "seed": Quantity(draw_seed, seed_noise),
    "jitter_seed": Quantity(draw_seed, _seed_jitter),
}
"""The order is that of the random numbers."""


def base_of(name: str, settings: tuple[str, ...] = ()) -> Scenario:
    """The scenario that a family varies.

    Args:
        name: of FAMILIES.
        settings: further ones.
    """
    return load_scenario("paper", None, (*FAMILIES[name].settings, *settings))


def draw_family(
    name: str, number: int, seed: int, purpose: Literal["training", "evaluation"]
) -> list[Draw]:
    """So many draws; the first ones stay the same when more are asked for.

    Args:
        name: of FAMILIES.
        number: of draws, each with a motion of its own.
        seed: of all draws.
        purpose: draws for training and for evaluation have nothing in common.
    """
    about = About(FAMILIES[name], standard_of(base_of(name)))
    stream = 2 * list(FAMILIES).index(name) + (purpose == "evaluation")
    return [
        draw_from(CONDITIONS, np.random.default_rng([seed, stream, i]), about)
        for i in range(number)
    ]


def condition(base: Scenario, one: Draw) -> Scenario:
    """A copy of a family's scenario with what was drawn."""
    return drawn(CONDITIONS, base, load_mechanism(base.mechanism), one).as_scenario()


def fault_of(one: Draw) -> str:
    """Which of FAULTS a draw has."""
    offset, jitter, friction, _ = one["fault"]
    return FAULTS[0 if offset else 1 if jitter else 2 if friction else 3]
