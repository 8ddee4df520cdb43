"""Families of conditions that a tuner is trained and evaluated on.

Each condition is a scenario that is run with every fixed gain of its family:

- `paper`, the paper's grid: 5 delays and 4 frequencies, each with nine pairs of weights;
- `disturbed`: drawn delays, motions and disturbances of a scenario, with the same pairs;
- T and N2: drawn motions of the scenario `paper` with one fault each, with 13 ratios of weights.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.random import Generator

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.startup import reference_torque
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.reference_config import SineConfig
from stewart_drake.scenario.timing import METRIC_PERIOD, Delay
from stewart_drake.studies.uncertainty import (
    Draw,
    Model,
    Quantity,
    Variant,
    add_noise,
    add_payload,
    add_to,
    apply_draw,
    draw_from,
    draw_seed,
    seed_noise,
)
from stewart_drake.tuner.source import weights_of

Purpose = Literal["training", "evaluation"]
"""Draws for training and for evaluation have nothing in common."""

LEVELS: Final = (0.1, 1.0, 4.0)
PAIRS: Final = tuple(itertools.product(LEVELS, LEVELS))
"""The nine (w_Q, w_R). The gain depends on w_Q / w_R alone, so that they are seven gains."""
GAINS: Final = {
    f"{q:g} / {r:g}": (q, r)
    for _, (q, r) in sorted({q / r: (q, r) for q, r in reversed(PAIRS)}.items())
}
"""The seven gains of the nine pairs by name, the gentlest first: one pair of each ratio."""
DELAYS: Final = (0, 5, 10, 20, 30)
FREQUENCIES: Final = (0.5, 2.0, 4.0, 6.0)
"""rad/s."""
SAMPLES: Final = 100
"""Number of samples of each run that are kept, k = 0 ... 99."""

RATIOS: Final = np.linspace(-4.0, 2.0, 13)
"""log10(w_Q / w_R) of the fixed gains of T and N2."""
FIXED: Final[dict[str, tuple[float, float]]] = {
    f"{ratio:+.1f}": tuple(weights_of(ratio).tolist()) for ratio in RATIOS
}
FAULTS: Final = ("offset", "jitter", "friction", "noise")
LEAST_TORQUE: Final = 0.3
"""Least effort of a motion, as a share of the standard torque."""
NOISE: Final = (1e-4, 1e-3)
"""Share of the amplitudes."""
NOISY: Final = 10.0
"""Factor on the noise if noise is the fault."""
BIAS: Final = 0.02
FRICTION: Final = 0.05
"""Largest bias and friction, as shares of the torque of the motion."""
PAYLOAD: Final = 0.1
"""Largest payload, added or missing, as a share of the plate's mass."""


class Condition(NamedTuple):
    """One condition of a family; `disturbance` is the number of its draw, -1 for none."""

    scenario: Scenario
    delay_steps: int
    frequency: float
    disturbance: int = -1


@dataclass(frozen=True)
class Family:
    """Conditions, and the fixed gains that each is run with."""

    name: str  # `paper`, `disturbed`, or one of FAMILIES
    base: Scenario  # scenario that the conditions vary
    conditions: dict[str, Condition]  # by the name of their files
    gains: dict[str, tuple[float, float]]  # w_Q and w_R by name
    seed: int = 0  # of the draws
    draws: list[Draw] = field(default_factory=list)  # one per condition; empty for the paper's grid
    samples: int = SAMPLES  # number of samples that are kept of each run
    # of the scenario `paper` that make the base, for a family with faults
    settings: tuple[str, ...] = ()

    @property
    def has_faults(self) -> bool:
        """Whether the family is one of FAMILIES; its runs record `health`."""
        return self.name in FAMILIES


def with_gain(scenario: Scenario, w_Q: float, w_R: float) -> Scenario:
    return replace(scenario, controller=replace(scenario.controller, w_Q=w_Q, w_R=w_R))


# ---------------------------------------------------------------- drawn quantities


class Faults(NamedTuple):
    """Settings of a family with faults, and sizes of these."""

    settings: tuple[str, ...]  # of the scenario `paper`
    offset: tuple[float, float]  # least and largest, s
    jitter: tuple[float, float]  # least and largest, s
    about: str  # description for a reader
    network: str  # shipped network that was trained for it


_ON_REFERENCE: Final = ("plant.kind=exact", "start=on_reference", "queue=reference")
FAMILIES: Final[dict[str, Faults]] = {
    "T": Faults(_ON_REFERENCE, (2e-3, 12e-3), (2e-3, 10e-3), "with the estimator", "health_T"),
    "N2": Faults(
        (*_ON_REFERENCE, "controller.estimate=[]"),
        (5e-3, 30e-3),
        (3e-3, 15e-3),
        "without an estimator",
        "health_N2",
    ),
}


class About(NamedTuple):
    """Scales of the drawn quantities: those of the motion at 1 rad/s and full amplitude.

    `torque` in N m is the largest that this motion takes; `faults` of a family with faults.
    """

    torque: float
    plate_mass: float
    faults: Faults | None = None


def sine_of(scenario: Scenario) -> SineConfig:
    """Return the scenario's reference, which has a frequency and an amplitude."""
    if scenario.reference.kind != "sine":
        raise ConfigError(
            f"reference.kind: got {scenario.reference.kind!r}; expected 'sine', whose frequency "
            "and amplitude are varied"
        )
    return scenario.reference


def _about(scenario: Scenario, faults: Faults | None = None) -> About:
    slow = replace(sine_of(scenario), frequency=1.0, frequency_unit="rad/s")
    experiment = prepare(replace(scenario, reference=slow))
    torque = reference_torque(experiment.nominal, experiment.reference, scenario.duration)
    return About(torque, experiment.mechanism.plate.mass, faults)


def _logarithmic(low: float, high: float) -> Callable[[Generator, Any], float]:
    return lambda rng, _: float(np.exp(rng.uniform(*np.log((low, high)))))


def _draw_bias(rng: Generator, about: About) -> tuple[float, ...]:
    """Draw a bias of random size for the standard motion."""
    size, direction = BIAS * about.torque * rng.uniform(), rng.standard_normal(6)
    return tuple((size * direction / np.sqrt(np.mean(direction**2))).tolist())


def _draw_fault(rng: Generator, about: About) -> tuple[float, ...]:
    """Draw one of FAULTS: offset, jitter in s; friction in N m; factor on the noise."""
    kind, sign, size = int(rng.integers(4)), float(rng.choice([-1.0, 1.0])), rng.uniform()
    assert about.faults is not None
    offset, jitter = (low + (high - low) * size for low, high in about.faults[1:3])
    sizes = (sign * float(offset), float(jitter), FRICTION * about.torque * float(size), NOISY)
    return tuple(value if i == kind else float(i == 3) for i, value in enumerate(sizes))


def _effort(variant: Variant) -> float:
    """Return the torque of the drawn motion over that of the standard one."""
    base, now = variant.scenario.reference, variant.fields["reference"]
    assert base.kind == "sine"
    share = max(abs(a / b) for a, b in zip(now["amplitude"], base.amplitude, strict=True) if b != 0)
    return max(LEAST_TORQUE, share * now["frequency"] ** 2)


def _set_known_delay(variant: Variant, steps: int) -> None:
    variant.fields["delay"]["steps"] = steps
    variant.fields["controller"] |= {"delay_steps": steps, "delay_fraction": 0.0}


def _set(section: str, field: str) -> Callable[[Variant, Any], None]:
    """Return a function that sets a field of the scenario."""
    return lambda variant, value: variant.fields[section].update({field: value})


def _set_frequency(variant: Variant, frequency: float) -> None:
    variant.fields["reference"] |= {"frequency": frequency, "frequency_unit": "rad/s"}


def _set_amplitude(variant: Variant, share: float) -> None:
    reference = variant.fields["reference"]
    reference["amplitude"] = [share * a for a in reference["amplitude"]]


_add_bias: Final = add_to("plant", "torque_bias")


def _add_scaled_bias(variant: Variant, bias: tuple[float, ...]) -> None:
    _add_bias(variant, tuple(_effort(variant) * b for b in bias))


def _set_fault(variant: Variant, fault: tuple[float, ...]) -> None:
    offset, jitter, friction, noise = fault
    delay, period = variant.fields["delay"], variant.scenario.controller.period
    late = Delay.of(max(0.0, delay["steps"] * period + offset), period)
    delay |= {"steps": late.steps, "fraction": late.fraction, "jitter_std": jitter}
    variant.fields["plant"]["coulomb_friction"] += _effort(variant) * friction
    std = variant.fields["sensor"]["noise_std"]
    variant.fields["sensor"]["noise_std"] = [noise * s for s in std]


DISTURBED: Final[Model] = {
    # Whole periods, 0 and 15 included, known to the controller.
    "delay_steps": Quantity(lambda rng, _: int(rng.integers(0, 16)), _set("delay", "steps")),
    # rad/s of the sine.
    "frequency": Quantity(_logarithmic(0.5, 3.0), _set_frequency),
    # Share of the scenario's own amplitudes.
    "amplitude": Quantity(lambda rng, _: float(rng.uniform(0.3, 1.0)), _set_amplitude),
    # Of each motor; the standard deviation is a share of the standard torque.
    "torque_bias": Quantity(
        lambda rng, a: tuple((4e-3 * a.torque * rng.standard_normal(6)).tolist()),
        _add_bias, sometimes=True,
    ),
    # kg, up to a tenth of the plate's.
    "payload_mass": Quantity(
        lambda rng, a: float(rng.uniform(0.0, 0.1 * a.plate_mass)), add_payload, sometimes=True
    ),
    # Standard deviation of pose (rates: per second), share of the amplitudes.
    "noise": Quantity(_logarithmic(1e-4, 3e-3), add_noise, sometimes=True),
    "seed": Quantity(draw_seed, seed_noise),
}  # fmt: skip
"""Quantities of a disturbed condition; the order is that of the random numbers."""

FAULTY: Final[Model] = {
    "delay_steps": Quantity(lambda rng, _: int(rng.integers(4, 13)), _set_known_delay),
    # rad/s of the sine.
    "frequency": Quantity(_logarithmic(0.5, 2.0), _set_frequency),
    # Share of the scenario's own amplitudes.
    "amplitude": Quantity(lambda rng, _: float(rng.uniform(0.5, 1.0)), _set_amplitude),
    "torque_bias": Quantity(_draw_bias, _add_scaled_bias),
    # kg.
    "payload": Quantity(
        lambda rng, a: float(PAYLOAD * a.plate_mass * rng.uniform(-1, 1)), add_payload
    ),
    "noise": Quantity(_logarithmic(*NOISE), add_noise),
    "fault": Quantity(_draw_fault, _set_fault),
    "seed": Quantity(draw_seed, seed_noise),
    "jitter_seed": Quantity(draw_seed, _set("delay", "seed")),
}
"""Quantities of a condition of T or N2; the order is that of the random numbers."""


def fault_of(one: Draw) -> str:
    """Return which of FAULTS a draw of FAULTY has."""
    offset, jitter, friction, _ = one["fault"]
    return FAULTS[0 if offset else 1 if jitter else 2 if friction else 3]


def vary(model: Model, base: Scenario, one: Draw) -> Scenario:
    """Return a scenario with a draw, applied in the order of the model."""
    in_order = {name: one[name] for name in model}
    return apply_draw(model, base, load_mechanism(base.mechanism), in_order).as_scenario()


# ---------------------------------------------------------------- the families


def paper_grid(scenario: Scenario) -> Family:
    """Return the paper's grid: 5 delays and 4 frequencies, each with 9 pairs of weights."""
    _check_samples(scenario)
    conditions = {
        f"delay{steps:02d}_frequency{frequency:g}": Condition(
            replace(
                scenario,
                delay=replace(scenario.delay, steps=steps),
                reference=replace(sine_of(scenario), frequency=frequency, frequency_unit="rad/s"),
            ),
            steps,
            frequency,
        )
        for steps, frequency in itertools.product(DELAYS, FREQUENCIES)
    }
    return Family("paper", scenario, conditions, _pairs())


def disturbed_family(scenario: Scenario, number: int, seed: int, purpose: Purpose) -> Family:
    """Draw disturbed conditions of a scenario: nine pairs to train on, seven gains to evaluate.

    The scenario's machine and motion give the scales. A larger number of conditions keeps the first
    ones.
    """
    for_training = purpose == "training"
    if for_training:
        _check_samples(scenario)
    about, seeds = _about(scenario), [seed, int(not for_training)]
    draws, conditions = _drawn("disturbed{:04d}", DISTURBED, scenario, about, number, seeds)
    for one in conditions.values():
        prepare(one.scenario)  # refuses a motion that leaves the workspace
    gains = _pairs() if for_training else GAINS
    return Family("disturbed", scenario, conditions, gains, seed, draws)


def faulty_family(
    name: str, number: int, seed: int, purpose: Purpose, settings: tuple[str, ...] = ()
) -> Family:
    """Draw conditions of one of FAMILIES, each with its own motion and fault.

    A larger number of conditions keeps the first ones. `settings` are further ones of the scenario.
    """
    faults = FAMILIES[name]
    base = load_scenario("paper", None, (*faults.settings, *settings))
    about = _about(load_scenario("paper", None, faults.settings), faults)
    stream = 2 * list(FAMILIES).index(name) + (purpose == "evaluation")
    draws, conditions = _drawn("{:05d}", FAULTY, base, about, number, [seed, stream])
    samples = round(base.duration / base.controller.period)
    return Family(name, base, conditions, FIXED, seed, draws, samples, settings)


def _drawn(
    name: str, model: Model, base: Scenario, about: About, number: int, seed: list[int]
) -> tuple[list[Draw], dict[str, Condition]]:
    draws = [draw_from(model, np.random.default_rng([*seed, i]), about) for i in range(number)]
    return draws, {
        name.format(i): Condition(vary(model, base, one), one["delay_steps"], one["frequency"], i)
        for i, one in enumerate(draws)
    }


def _pairs() -> dict[str, tuple[float, float]]:
    return {f"wQ{q:g}_wR{r:g}": (q, r) for q, r in PAIRS}


def _check_samples(scenario: Scenario) -> None:
    """Refuse a scenario that does not give 100 samples on the grid of the record."""
    sine_of(scenario)
    every = scenario.controller.period / METRIC_PERIOD
    if round(every) < 1 or abs(every - round(every)) > 1e-9:
        raise ConfigError(
            f"controller.period: got {scenario.controller.period!r}; expected a multiple of "
            f"{METRIC_PERIOD} s, the grid on which a run is recorded"
        )
    least = (SAMPLES - 1) * scenario.controller.period
    if scenario.duration < least:
        raise ConfigError(
            f"duration: got {scenario.duration!r}; expected at least {least:g} s, the {SAMPLES} "
            "samples of a run"
        )
