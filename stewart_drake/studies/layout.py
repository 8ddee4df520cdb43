"""Search of the layout and the lengths of a machine for a motion.

For every arrangement of the legs (`studies.layout_space`) SciPy's differential evolution looks for
the numbers that make the goal best within the limits. Trials are compared first by reach, then by
the limits that they miss, then by the goal. Each is only computed if the one before is in order, so
that most trials cost little. The best few are written as machine files, read back, measured with
the shapes themselves (`loop.clearance`) and run through the scenario.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic.dataclasses import dataclass as checked
from scipy.optimize import Bounds, differential_evolution

from stewart_drake.dynamics.stewart import StewartDynamics, plant_parameters
from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.files.jsonio import sealed_json
from stewart_drake.files.resources import resolve
from stewart_drake.files.yamlio import yaml_text
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.clearance import ClearanceScene
from stewart_drake.loop.preparation import Experiment, check_instants, prepare_unchecked
from stewart_drake.mechanism.files import (
    MechanismSpec,
    build_mechanism,
    load_mechanism,
    mechanism_spec,
)
from stewart_drake.mechanism.geometry import Mechanism, with_rotors
from stewart_drake.mechanism.trajectories import poses_along
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.field_types import STRICT
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.studies.clearance import Nearest, clearance_along
from stewart_drake.studies.jobs import Progress, part_of, run_jobs
from stewart_drake.studies.layout_space import (
    DIGITS,
    MEASURES,
    PARAMETERS,
    Arrangement,
    Motion,
    Requirements,
    Space,
    geometry,
    least_reach,
    motion_of,
    own_numbers,
    own_values,
    peak_torque,
    requirements,
    singular,
    space_around,
)
from stewart_drake.studies.options import refuse
from stewart_drake.studies.runs import Outcome, outcome_of, read_kept
from stewart_drake.studies.study_options import LayoutOptions
from stewart_drake.types import Array

INSTANTS: Final = 48
"""Instants of the motion at which a trial is measured, in addition to those of its extremes."""
POPULATION: Final = 8
"""Trials per generation and number that varies."""
_PENALTY: Final = 1e9
"""Cost above any goal's: once for missed limits, twice for missing reach."""
_SAME: Final = 0.02
"""Layouts that differ by less in every number, as a share of the bounds, are the same."""
_REACH, _APART = 0.05, 0.05
"""Usual limits of reach and clearance, in cranks of the machine the search begins from."""
_USUAL: Final = {"transmission": 0.3, "plate_joint_deg": 45.0, "crank_joint_deg": 45.0}


@checked(config=STRICT)
class Found:
    """Result of one search, as its file keeps it."""

    order: list[int]  # of the arrangement
    branches: list[int]  # of the arrangement
    values: list[float]  # of `layout_space.PARAMETERS`
    measures: dict[str, float]  # by name; empty if the motion is out of reach
    missed: dict[str, float]  # limits that are not kept, by name, and by which share
    evaluations: int


@checked(config=STRICT)
class Judged:
    """Measures and run of a machine, as their file keeps them."""

    measures: dict[str, float]
    nearest: Nearest | None
    outcome: Outcome


class Layout(NamedTuple):
    name: str  # of its file, without the suffix; of the scenario's own machine its name
    mechanism: Mechanism
    order: tuple[int, ...]  # (6,): joint of the plate that each leg takes
    values: Array  # of `layout_space.PARAMETERS`
    # at all instants that are checked, with the shapes themselves; only the reach if a pose is out
    # of reach
    measures: dict[str, float]
    missed: dict[str, float]  # limits that are not kept, by name, and by which share
    nearest: Nearest | None  # the two links at their least distance
    outcome: Outcome  # of the scenario with this machine

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "parameters": dict(zip(PARAMETERS, self.values.tolist(), strict=True)),
            "plate_order": list(self.order),
            "branches": self.mechanism.branches.tolist(),
            "measures": self.measures,
            "missed": self.missed,
            "nearest": None if self.nearest is None else self.nearest.summary,
            "run": dataclasses.asdict(self.outcome),
        }


@dataclass(frozen=True)
class Problem:
    """Problem of a search; it is sent to other processes."""

    scenario: Scenario  # with the motion
    space: Space  # of layouts
    motion: Motion  # home and the reference at `INSTANTS`
    requirements: Requirements  # limits and goal

    def trial(self, values: Sequence[float] | Array, arrangement: Arrangement) -> dict[str, float]:
        """Return the measures of a layout, as far as the limits before them are kept."""
        legs = self.space.legs(values, arrangement)
        # A crank as long as its rod cannot turn.
        spare = float((legs.rod_lengths - legs.crank_lengths).min())
        reach = min(least_reach(legs, self.motion), spare)
        if reach <= 0:
            return {"reach": reach}
        found, wanted = geometry(legs, self.motion), self.requirements
        asks_torque = "torque" in wanted.limits or wanted.goal == "torque"
        if wanted.missed(found) or singular(found) or not asks_torque:
            return found
        machine = build_mechanism(self.space.machine(values, arrangement, "trial"))
        whole = with_rotors(machine, self.scenario.actuator.reflected_inertia)
        plant = StewartDynamics(whole, self.scenario.plant.gravity, plant_parameters())
        return found | {"torque": peak_torque(plant, self.motion)}

    def cost(self, found: Mapping[str, float]) -> float:
        """Return the cost of a trial: reach first, then limits, then the goal."""
        if "condition" not in found:
            return 2 * _PENALTY * (1 - found["reach"] / self.rod)
        missed = sum(self.requirements.missed(found).values()) + singular(found)
        if missed > 0:
            share = missed / (1 + missed)
            return _PENALTY * (1 + share / 2 if "torque" not in found else (1 + share) / 2)
        return self.requirements.cost(found)

    def missed(self, measures: Mapping[str, float]) -> dict[str, float]:
        """Return limits that are not kept; `reach` and `parallel` count without a limit too."""
        if "condition" not in measures:
            return {"reach": 1 - measures["reach"] / self.rod}
        off = singular(measures) / SINGULARITY_LIMIT
        return self.requirements.missed(measures) | ({"parallel": off} if off else {})

    @property
    def rod(self) -> float:
        """Length of a rod in m, the scale of missing reach."""
        return own_numbers(self.space.spec)["rod"]

    @property
    def summary(self) -> dict[str, Any]:
        """Plain data that all searches depend on."""
        return {
            "scenario": scenario_to_dict(self.scenario),
            "machine": _plain(self.space.spec),
            "bounds": {name: list(pair) for name, pair in self.space.bounds.items()},
            "offset_from_centre": self.space.offset_from_centre,
            "kept": list(self.space.kept),
            "limits": self.requirements.limits,
            "goal": self.requirements.goal,
        }


@dataclass(frozen=True)
class LayoutStudy:
    problem: Problem  # of the searches
    options: LayoutOptions
    searches: dict[str, Found]  # result of each, by its key
    before: Layout  # the scenario's own machine
    layouts: list[Layout]  # the best few, the best first

    @property
    def evaluations(self) -> int:
        return sum(found.evaluations for found in self.searches.values())

    @property
    def files(self) -> list[str]:
        return [*(f"{one.name}.yaml" for one in self.layouts), "searches/", "judged/"]

    @property
    def verdict(self) -> str:
        tried = f"of {self.evaluations} layouts in {len(self.searches)} searches"
        if not self.layouts:
            least = min(self.searches.values(), key=lambda one: self.problem.cost(one.measures))
            missing = ", ".join(f"{name} by {100 * s:.3g} %" for name, s in least.missed.items())
            return f"no: {tried} none keeps the limits; the nearest misses {missing}"
        keeping = [one for one in self.layouts if not one.missed]
        best, goal = (keeping or self.layouts)[0], self.problem.requirements.goal
        which = "the best" if best is self.layouts[0] else f"{best.name}, which keeps the limits,"
        reached = f"no {goal} at every instant"
        if goal in best.measures:
            value = f"{MEASURES[goal].factor * best.measures[goal]:.3g} {MEASURES[goal].shown}"
            reached = f"a {goal} of {value.rstrip(' -')}"
        done = sum(one.outcome.status == "completed" for one in self.layouts)
        count = len(self.layouts)
        run = f"{done} of {count} complete"
        if done == count:
            run = "it completes" if count == 1 else "all of them complete"
        kept = done == count and not any(one.missed for one in self.layouts)
        missed = "".join(
            f"; {one.name} misses {', '.join(one.missed)}" for one in self.layouts if one.missed
        )
        word = "yes" if kept else "partly"
        return f"{word}: {tried} {which} has {reached}; {run} the scenario{missed}"

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "verdict": self.verdict,
            **self.problem.summary,
            **{name: getattr(self.options, name) for name in ("seed", "starts", "generations")},
            "evaluations": self.evaluations,
            "searches": {
                key: {"measures": one.measures, "missed": one.missed}
                for key, one in self.searches.items()
            },
            "before": self.before.summary,
            "layouts": [one.summary for one in self.layouts],
        }


def study_layout(
    scenario: Scenario,
    directory: str | Path,
    options: LayoutOptions,
    progress: Progress | None = None,
) -> LayoutStudy:
    """Search machines for a scenario's motion, or continue a search; write the best.

    The search begins at the scenario's machine, which has a pattern. Machines go into the
    directory, finished searches below it.
    """
    folder, problem = Path(directory), problem_of(scenario, options)
    seed, generations = options.seed, options.generations
    jobs = {
        f"{arrangement.key}_{start}": (problem, arrangement, seed, start, generations)
        for arrangement in problem.space.arrangements()
        for start in range(options.starts)
    }
    searches = run_jobs(
        jobs,
        search,
        folder / "searches",
        settings=problem.summary | {"seed": seed, "generations": generations},
        read=partial(read_kept, Found, "the file of a search"),
        progress=part_of(progress, 0, len(jobs) + options.best + 1),
        **options.jobs,
    )
    chosen = _best_of(problem, list(searches.values()), options.best)
    texts = {}
    for k, one in enumerate(chosen, 1):
        arrangement = Arrangement(tuple(one.order), tuple(one.branches))
        machine = problem.space.machine(one.values, arrangement, f"layout_{k}")
        texts[machine.name] = yaml_text(_plain(machine))
        write_whole(folder / f"{machine.name}.yaml", texts[machine.name])
    number = len(texts) + 1
    while (old := folder / f"layout_{number}.yaml").exists():  # of an earlier start
        old.unlink()
        number += 1
    places = {name: str((folder / f"{name}.yaml").resolve()) for name in texts}
    places = {"before": scenario.mechanism} | places
    judged = run_jobs(
        {key: (problem, place) for key, place in places.items()},
        judge,
        folder / "judged",
        settings=problem.summary | {"machines": texts},
        read=partial(read_kept, Judged, "the file of a judgement"),
        workers=options.workers,
        progress=part_of(progress, len(jobs), len(jobs) + len(places)),
    )

    def layout(key: str, order: Sequence[int], values: Sequence[float] | Array) -> Layout:
        one, mechanism = judged[key], load_mechanism(places[key])
        name, missed = key if key in texts else mechanism.name, problem.missed(one.measures)
        own = name, mechanism, tuple(order), np.array(values)
        return Layout(*own, one.measures, missed, one.nearest, one.outcome)

    space = problem.space
    before = layout("before", space.pattern.plate_order, own_values(space.spec))
    layouts = [layout(key, one.order, one.values) for key, one in zip(texts, chosen, strict=True)]
    return LayoutStudy(problem, options, searches, before, layouts)


def problem_of(scenario: Scenario, options: LayoutOptions) -> Problem:
    calibration = scenario.controller.calibration
    fixed = {"plant.mechanism": scenario.plant.mechanism, "controller.calibration": calibration}
    refuse(fixed, "where the machine is searched for; expected null")
    experiment = prepare_unchecked(scenario)
    spec = mechanism_spec(resolve("mechanism", scenario.mechanism))
    space = space_around(spec, options.vary or {}, options.keep)
    crank = own_numbers(spec)["crank"]
    usual = {"reach": _REACH * crank, "clearance": _APART * crank, **_USUAL}
    if math.isfinite(experiment.torque_limit):
        usual["torque"] = experiment.torque_limit
    motion = motion_of(experiment.mechanism.home, experiment.reference, _instants(experiment))
    wanted = requirements(options.goal, options.limits or {}, usual)
    return Problem(scenario, space, motion, wanted)


def _instants(experiment: Experiment) -> Array:
    """Return evenly spaced instants, and those at which a coordinate is largest or least."""
    duration = experiment.scenario.duration
    every = check_instants(duration)
    poses = poses_along(experiment.reference, every)
    extreme = every[np.concatenate([poses.argmin(axis=0), poses.argmax(axis=0)])]
    return np.unique(np.concatenate([np.linspace(0.0, duration, INSTANTS), extreme]))


def search(
    problem: Problem, arrangement: Arrangement, seed: int, start: int, generations: int
) -> bytes:
    """Search the best layout of one arrangement; return its file."""
    space = problem.space
    low, high = np.array(space.ranges(arrangement)).T
    free = low < high
    # The machine is the first trial of its arrangement, so that the result is as good at least.
    own = own_values(space.spec)
    is_own = list(arrangement.order) == space.pattern.plate_order
    is_own &= list(arrangement.branches) == space.pattern.branches
    known = start == 0 and is_own and bool(np.all((low <= own) & (own <= high)))

    def whole(some: Array) -> Array:
        values = low.copy()
        values[free] = some
        return values

    def cost(some: Array) -> float:
        return problem.cost(problem.trial(whole(some), arrangement))

    stream = [seed, start, *arrangement.order, *(b + 1 for b in arrangement.branches)]
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
    exact = problem.missed(problem.trial(whole(found.x), arrangement))
    for digits in (DIGITS, 2 * DIGITS):  # the best lies on limits, which rounding may miss
        values = space.rounded(whole(found.x), digits)
        measures = problem.trial(values, arrangement)
        missed = problem.missed(measures)
        if missed.keys() <= exact.keys():
            break
    order, branches = list(arrangement.order), list(arrangement.branches)
    kept = Found(order, branches, values.tolist(), _finite(measures), missed, int(found.nfev))
    return sealed_json(dataclasses.asdict(kept))


def judge(problem: Problem, machine: str) -> bytes:
    """Measure a machine, by name or file, at all instants, and run it; return the file."""
    scenario = dataclasses.replace(problem.scenario, mechanism=machine)
    experiment = prepare_unchecked(scenario)
    mechanism, time = experiment.mechanism, check_instants(scenario.duration)
    motion = motion_of(mechanism.home, experiment.reference, time)
    links = ClearanceScene(mechanism, base=False)
    least = clearance_along(links, mechanism, time, motion.wanted[:, :6]).least(fixed=False)
    measures = {"reach": least_reach(mechanism, motion)}
    if measures["reach"] > 0 and least is not None:
        measures = geometry(mechanism, motion)
        if not singular(measures):
            measures["torque"] = peak_torque(experiment.nominal, motion)
        measures["clearance"] = least.distance
    try:
        outcome = outcome_of(run_in_bulk(scenario))
    except ConfigError as error:
        outcome = Outcome("refused", str(error), time=0.0)
    return sealed_json(dataclasses.asdict(Judged(_finite(measures), least, outcome)))


def _best_of(problem: Problem, found: list[Found], best: int) -> list[Found]:
    """Return those that keep the limits and differ, the best first."""
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


def _plain(spec: MechanismSpec) -> dict[str, Any]:
    """Return the contents of a file, without fields that are null."""
    return {key: value for key, value in dataclasses.asdict(spec).items() if value is not None}


def _finite(measures: Mapping[str, float]) -> dict[str, float]:
    """Return finite measures; a motion through a singularity has an infinite condition number."""
    return {name: float(value) for name, value in measures.items() if math.isfinite(value)}
