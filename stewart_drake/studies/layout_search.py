"""Search of a layout: problem, trials, judgement of the best, and result.

For every arrangement of the legs (`studies.layout_space`) SciPy's differential evolution looks for
the numbers that make the goal best within the limits. A trial is better than another first by its
reach, then by how far it misses limits, then by the goal: the next is only computed where the one
before is in order, so that most trials cost little. The best few are written as machine files, read
back, measured with the shapes themselves (`loop.clearance`) and run through the scenario.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as checked
from scipy.optimize import Bounds, differential_evolution

from stewart_drake.dynamics.stewart import StewartDynamics, plant_parameters
from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.jsonio import load_json, sealed_json
from stewart_drake.files.resources import resolve
from stewart_drake.files.yamlio import validate, yaml_text
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.clearance import ClearanceScene
from stewart_drake.loop.preparation import Experiment, assemble, check_instants
from stewart_drake.mechanism.files import (
    MechanismSpec,
    build_mechanism,
    load_mechanism,
    mechanism_spec,
)
from stewart_drake.mechanism.geometry import Mechanism, with_rotors
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.studies.clearance import Nearest, clearance_along
from stewart_drake.studies.layout_space import (
    DIGITS,
    MEASURES,
    PARAMETERS,
    Arrangement,
    Motion,
    Space,
    Wish,
    geometry,
    least_reach,
    motion_of,
    own_values,
    peak_torque,
    singular,
    space_around,
    wish_of,
)
from stewart_drake.studies.runs import Outcome, outcome_of
from stewart_drake.types import Array

INSTANTS: Final = 48
"""Of the motion that a trial is looked at, besides those of the largest deflections."""
POPULATION: Final = 8
"""Trials per generation and number that varies."""
_WORSE: Final = 1e9
"""More than any goal's cost; so much for limits that are missed, twice as much for reach."""
_SAME: Final = 0.02
"""Of the bounds; layouts that differ by less in every number are the same."""
_REACH, _APART = 0.05, 0.05
"""Usual limits of reach and clearance, in cranks of the machine the search begins from."""
_USUAL: Final = {"transmission": 0.3, "plate_joint_deg": 45.0, "crank_joint_deg": 45.0}
_MAX_BYTES: Final = 1_000_000
_STRICT: Final = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


@checked(config=_STRICT)
class Found:
    """The end of one search.

    Attributes:
        order, branches: of the arrangement.
        values: of `layout_space.PARAMETERS`.
        measures: by name; empty where the motion is not reached.
        missed: limits that are not kept, by name, and by which share.
        evaluations: how many layouts were tried.
    """

    order: list[int]
    branches: list[int]
    values: list[float]
    measures: dict[str, float]
    missed: dict[str, float]
    evaluations: int


@checked(config=_STRICT)
class Judged:
    measures: dict[str, float]
    nearest: Nearest | None
    outcome: Outcome


class Layout(NamedTuple):
    """A machine, measured and tried."""

    name: str
    """Of its file, without the suffix; of the scenario's own machine its name."""
    mechanism: Mechanism
    order: tuple[int, ...]
    """(6,): the plate's joint that each leg takes."""
    values: Array
    """Of `layout_space.PARAMETERS`."""
    measures: dict[str, float]
    """At all instants that are checked, with the shapes themselves; without reach only this."""
    missed: dict[str, float]
    nearest: Nearest | None
    """The two links that come nearest."""
    outcome: Outcome
    """Of the scenario with this machine."""

    @property
    def summary(self) -> dict[str, Any]:
        pattern = dict(zip(PARAMETERS, self.values.tolist(), strict=True))
        return {
            "name": self.name,
            "parameters": pattern,
            "plate_order": list(self.order),
            "branches": self.mechanism.branches.tolist(),
            "measures": self.measures,
            "missed": self.missed,
            "nearest": None if self.nearest is None else self.nearest.summary,
            "run": dataclasses.asdict(self.outcome),
        }


@dataclass(frozen=True)
class Problem:
    """Problem of a search; it is sent to other processes.

    Attributes:
        scenario: whose motion it is.
        space: of layouts.
        motion: home and the reference at `INSTANTS`.
        wish: limits and goal.
    """

    scenario: Scenario
    space: Space
    motion: Motion
    wish: Wish

    def trial(self, values: Sequence[float] | Array, arrangement: Arrangement) -> dict[str, float]:
        """Measures of a layout, as far as the limits before them are kept."""
        legs = self.space.legs(values, arrangement)
        # A crank as long as its rod cannot turn.
        spare = float((legs.rod_lengths - legs.crank_lengths).min())
        reach = min(least_reach(legs, self.motion), spare)
        if reach <= 0:
            return {"reach": reach}
        found = geometry(legs, self.motion)
        if self.wish.missed(found) or singular(found) or not self._asks("torque"):
            return found
        machine = build_mechanism(self.space.machine(values, arrangement, "trial"))
        return found | {"torque": peak_torque(_nominal(machine, self.scenario), self.motion)}

    def cost(self, found: Mapping[str, float]) -> float:
        """Less is better: reach first, then limits, then the goal."""
        if "condition" not in found:
            return 2 * _WORSE * (1 - found["reach"] / self.length)
        missed = sum(self.wish.missed(found).values()) + singular(found)
        if missed > 0:
            share = missed / (1 + missed)
            return _WORSE * (1 + share / 2 if "torque" not in found else (1 + share) / 2)
        return self.wish.cost(found)

    @property
    def length(self) -> float:
        """m, that of a rod, against which missing reach is small or large."""
        return float(own_values(self.space.spec)[PARAMETERS.index("rod")])

    def _asks(self, name: str) -> bool:
        return name in self.wish.limits or name == self.wish.goal

    @property
    def summary(self) -> dict[str, Any]:
        """Return what all searches depend on, plain data."""
        return {
            "scenario": scenario_to_dict(self.scenario),
            "machine": _plain(self.space.spec),
            "bounds": {name: list(pair) for name, pair in self.space.bounds.items()},
            "offset_from_centre": self.space.offset_from_centre,
            "kept": list(self.space.kept),
            "limits": self.wish.limits,
            "goal": self.wish.goal,
        }


@dataclass(frozen=True)
class LayoutStudy:
    """Result of `layout`.

    Attributes:
        problem: what was searched for.
        seed, starts, generations: how.
        searches: the end of each, by its key.
        before: the scenario's own machine.
        layouts: the best few, the best first.
    """

    problem: Problem
    seed: int
    starts: int
    generations: int
    searches: dict[str, Found]
    before: Layout
    layouts: list[Layout]

    @property
    def evaluations(self) -> int:
        return sum(found.evaluations for found in self.searches.values())

    @property
    def files(self) -> list[str]:
        """Names of the files and folders of the study."""
        return [*(f"{one.name}.yaml" for one in self.layouts), "searches/", "judged/"]

    @property
    def verdict(self) -> str:
        tried = f"of {self.evaluations} layouts in {len(self.searches)} searches"
        if not self.layouts:
            least = min(self.searches.values(), key=self._distance)
            missing = ", ".join(f"{name} by {100 * s:.3g} %" for name, s in least.missed.items())
            return f"no: {tried} none keeps the limits; the nearest misses {missing}"
        best, goal = self.layouts[0], self.problem.wish.goal
        told = f"no {goal} at every instant"
        if goal in best.measures:
            value = f"{MEASURES[goal].factor * best.measures[goal]:.3g} {MEASURES[goal].shown}"
            told = f"a {goal} of {value.rstrip(' -')}"
        done = sum(one.outcome.status == "completed" for one in self.layouts)
        count = len(self.layouts)
        run = (
            "it completes"
            if count == done == 1
            else "all of them complete"
            if done == count
            else f"{done} of {count} complete"
        )
        opening = (
            "yes" if done == count and not any(one.missed for one in self.layouts) else "partly"
        )
        return f"{opening}: {tried} the best has {told}; {run} the scenario"

    def _distance(self, found: Found) -> float:
        return self.problem.cost(found.measures)

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "verdict": self.verdict,
            **self.problem.summary,
            "seed": self.seed,
            "starts": self.starts,
            "generations": self.generations,
            "evaluations": self.evaluations,
            "searches": {
                key: {"measures": one.measures, "missed": one.missed}
                for key, one in self.searches.items()
            },
            "before": self.before.summary,
            "layouts": [one.summary for one in self.layouts],
        }


def problem_of(
    scenario: Scenario,
    goal: str,
    limits: Mapping[str, float],
    vary: Mapping[str, tuple[float, float]],
    keep: Sequence[str],
) -> Problem:
    """Return the problem of a search.

    Raises:
        ConfigError: one line.
    """
    for field, value in (
        ("plant.mechanism", scenario.plant.mechanism),
        ("controller.calibration", scenario.controller.calibration),
    ):
        if value is not None:
            raise ConfigError(
                f"{field}: got {value}; expected null, as the machine is searched for"
            )
    experiment, spec = assemble(scenario), mechanism_spec(resolve("mechanism", scenario.mechanism))
    space = space_around(spec, vary, keep)
    crank = float(own_values(spec)[PARAMETERS.index("crank")])
    usual = {"reach": _REACH * crank, "clearance": _APART * crank, **_USUAL}
    if math.isfinite(experiment.torque_limit):
        usual["torque"] = experiment.torque_limit
    motion = motion_of(experiment.mechanism.home, experiment.reference, _instants(experiment))
    return Problem(scenario, space, motion, wish_of(goal, limits, usual))


def _instants(experiment: Experiment) -> Array:
    """Some tens, evenly spaced, and those at which a coordinate is largest or least."""
    duration = experiment.scenario.duration
    every = check_instants(duration)
    poses = np.array([experiment.reference.value(t)[:, 0] for t in every])
    extreme = every[np.concatenate([poses.argmin(axis=0), poses.argmax(axis=0)])]
    return np.unique(np.concatenate([np.linspace(0.0, duration, INSTANTS), extreme]))


def search(
    problem: Problem, arrangement: Arrangement, seed: int, start: int, generations: int
) -> bytes:
    """The best layout of one arrangement, as the file that keeps it."""
    space = problem.space
    low, high = np.array(space.ranges(arrangement)).T
    free = low < high
    # From the machine itself where it is one of these, so that none that is worse is found.
    own = own_values(space.spec)
    is_own = list(arrangement.order) == space.pattern.plate_order
    is_own &= list(arrangement.branches) == space.pattern.branches
    known = start == 0 and is_own and bool(np.all((low <= own) & (own <= high)))

    def whole(some: Array) -> Array:
        values = low.copy()
        values[free] = some
        return values

    stream = [seed, start, *arrangement.order, *(b + 1 for b in arrangement.branches)]

    def cost(some: Array) -> float:
        return problem.cost(problem.trial(whole(some), arrangement))

    found = differential_evolution(
        cost,
        Bounds(low[free], high[free]),
        maxiter=generations,
        popsize=POPULATION,
        seed=np.random.default_rng(stream),
        x0=own[free] if known else None,
        polish=False,
        tol=1e-6,
    )
    values, exact = whole(found.x), problem.trial(whole(found.x), arrangement)
    for digits in (DIGITS, 2 * DIGITS):  # the best lies on limits, which rounding may miss
        values = space.rounded(whole(found.x), digits)
        measures = problem.trial(values, arrangement)
        if _missed(problem, measures).keys() <= _missed(problem, exact).keys():
            break
    return _bytes_of(
        Found(
            list(arrangement.order),
            list(arrangement.branches),
            values.tolist(),
            _finite(measures),
            _missed(problem, measures),
            int(found.nfev),
        )
    )


def judge(problem: Problem, machine: str) -> bytes:
    """Measure a machine, by name or file, at all instants, and run it."""
    scenario = dataclasses.replace(problem.scenario, mechanism=machine)
    experiment = assemble(scenario)
    mechanism, time = experiment.mechanism, check_instants(scenario.duration)
    motion = motion_of(mechanism.home, experiment.reference, time)
    links, measures = (
        ClearanceScene(mechanism, base=False),
        {"reach": least_reach(mechanism, motion)},
    )
    least = clearance_along(links, mechanism, time, motion.wanted[:, :6]).least(fixed=False)
    if measures["reach"] > 0 and least is not None:
        measures = geometry(mechanism, motion)
        if not singular(measures):
            measures["torque"] = peak_torque(experiment.nominal, motion)
        measures["clearance"] = least.distance
    try:
        outcome = outcome_of(run_in_bulk(scenario))
    except ConfigError as error:
        outcome = Outcome("refused", str(error), time=0.0)
    return _bytes_of(Judged(_finite(measures), least, outcome))


def best_of(problem: Problem, found: list[Found], best: int) -> list[Found]:
    """Those that keep the limits and differ, the best first."""
    spans = np.array([max(high - low, 1e-12) for low, high in problem.space.bounds.values()])
    chosen: list[Found] = []
    for one in sorted(found, key=lambda one: problem.cost(one.measures)):
        alike = any(
            (one.order, one.branches) == (other.order, other.branches)
            and np.all(np.abs(np.subtract(one.values, other.values)) <= _SAME * spans)
            for other in chosen
        )
        if not one.missed and not alike and len(chosen) < best:
            chosen.append(one)
    return chosen


def remove_more(folder: Path, number: int) -> None:
    """Machines that an earlier start has left beyond so many."""
    number += 1
    while (old := folder / f"layout_{number}.yaml").exists():
        old.unlink()
        number += 1


def layout(
    problem: Problem,
    name: str,
    machine: str,
    order: Sequence[int],
    values: Sequence[float] | Array,
    judged: Judged,
) -> Layout:
    return Layout(
        name=name,
        mechanism=load_mechanism(machine),
        order=tuple(order),
        values=np.array(values),
        measures=judged.measures,
        missed=_missed(problem, judged.measures),
        nearest=judged.nearest,
        outcome=judged.outcome,
    )


def _missed(problem: Problem, measures: Mapping[str, float]) -> dict[str, float]:
    """Limits that are not kept, by which share; `reach` and `parallel` count without a limit."""
    if "condition" not in measures:
        return {"reach": 1 - measures["reach"] / problem.length}
    off = singular(measures) / SINGULARITY_LIMIT
    return problem.wish.missed(measures) | ({"parallel": off} if off else {})


def _nominal(mechanism: Mechanism, scenario: Scenario) -> StewartDynamics:
    """The plant that the controller knows, as `assemble` makes it."""
    return StewartDynamics(
        with_rotors(mechanism, scenario.actuator.reflected_inertia),
        scenario.plant.gravity,
        plant_parameters(),
    )


def text(problem: Problem, found: Found, name: str) -> str:
    arrangement = Arrangement(tuple(found.order), tuple(found.branches), 0.0)
    return yaml_text(_plain(problem.space.machine(found.values, arrangement, name)))


def _plain(spec: MechanismSpec) -> dict[str, Any]:
    """The contents of a file; what is null is left out."""
    whole = dataclasses.asdict(spec)
    return {key: value for key, value in whole.items() if value is not None}


def _finite(measures: Mapping[str, float]) -> dict[str, float]:
    """Return finite measures; an infinite condition number is a motion through a singularity."""
    return {name: float(value) for name, value in measures.items() if math.isfinite(value)}


def _bytes_of(kept: Found | Judged) -> bytes:
    return sealed_json(dataclasses.asdict(kept))


def read_found(path: Path) -> Found:
    return validate(Found, _load(path, "the file of a search"), str(path))


def read_judged(path: Path) -> Judged:
    return validate(Judged, _load(path, "the file of a judgement"), str(path))


def _load(path: Path, expected: str) -> dict[str, Any]:
    return load_json(path, _MAX_BYTES, expected, sealed=True)
