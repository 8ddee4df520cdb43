"""The runs that a tuner's data set is made of: the paper's grid, and disturbed ones."""

import itertools
from dataclasses import replace
from typing import Final, NamedTuple

from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.timing import METRIC_PERIOD
from stewart_drake.studies.disturbances import disturbed, sine_of, with_gain
from stewart_drake.studies.uncertainty import Draw

LEVELS: Final = (0.1, 1.0, 4.0)
PAIRS: Final = tuple(itertools.product(LEVELS, LEVELS))
"""The nine (w_Q, w_R). The gain depends on w_Q / w_R alone, so that they are seven gains."""
DELAYS: Final = (0, 5, 10, 20, 30)
FREQUENCIES: Final = (0.5, 2.0, 4.0, 6.0)
"""rad/s."""
SAMPLES: Final = 100
"""Of each run, k = 0 ... 99."""


class Run(NamedTuple):
    """One run to make: its conditions and its scenario. `disturbance` is -1 for none."""

    w_Q: float
    w_R: float
    delay_steps: int
    frequency: float
    disturbance: int
    scenario: Scenario


def paper_runs(scenario: Scenario) -> dict[str, Run]:
    """The paper's grid: 9 pairs of weights, 5 delays, 4 frequencies.

    Raises:
        ConfigError: the scenario's reference is not a sine, or it is too short for 100 samples.
    """
    check(scenario)
    runs: dict[str, Run] = {}
    for steps, frequency in itertools.product(DELAYS, FREQUENCIES):
        cell = replace(
            scenario,
            delay=replace(scenario.delay, steps=steps),
            reference=replace(sine_of(scenario), frequency=frequency, frequency_unit="rad/s"),
        )
        runs |= _pairs(cell, f"delay{steps:02d}_frequency{frequency:g}", steps, frequency, -1)
    return runs


def disturbed_runs(scenario: Scenario, draws: list[Draw]) -> dict[str, Run]:
    """Nine runs for each disturbance, which brings its own delay and frequency.

    Raises:
        ConfigError: as `paper_runs`, or a disturbed motion leaves the workspace.
    """
    check(scenario)
    runs: dict[str, Run] = {}
    for number, one in enumerate(draws):
        cell = disturbed(scenario, one)
        runs |= _pairs(cell, f"disturbed{number:04d}", one["delay_steps"], one["frequency"], number)
    return runs


def check(scenario: Scenario) -> None:
    """Refuse a scenario from which no data set can be made.

    Raises:
        ConfigError: its reference is not a sine, it is too short for 100 samples, or its period is
            not on the grid on which a run is recorded.
    """
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


def _pairs(
    cell: Scenario, name: str, steps: int, frequency: float, disturbance: int
) -> dict[str, Run]:
    return {
        f"{name}_wQ{q:g}_wR{r:g}": Run(q, r, steps, frequency, disturbance, with_gain(cell, q, r))
        for q, r in PAIRS
    }
