"""Limits of torque and workspace: `predictor_mpc` against `predictor_lqi`, robustness, solvers.

One setting of the controller for all rows. E_ac in % s, 10 s, delay 0.8 s, exact plant. Torque
limits are shares of the largest torque that the motion takes. Times are those of the processor, of
one thread.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from _bench import AMPLITUDE, EXACT, NONE, ON, grouped, noise, run_sections, section, size, table
from numpy.typing import NDArray
from pydrake.solvers import ClarabelSolver, MathematicalProgram, OsqpSolver, SolverOptions

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.law import limited
from stewart_drake.law.horizon import LeastDistance, solve_by_daqp
from stewart_drake.loop.bulk import Ending, run_in_bulk

SEEDS = size("SEEDS", 8)
BIAS = 3e-4
"""N m, with random signs."""
PAYLOAD = 0.02
"""kg, half a percent of the plate."""
SAMPLES = size("SAMPLES", 12)
"""Problems per case for the solvers."""
TAU = {(1.0, 1.0): 0.0132683, (0.7, 1.0): 0.0101716, (0.5, 2.0): 0.0302161}
"""Largest torque by share of the motion and its frequency in rad/s, N m."""


class Case(NamedTuple):
    """A motion, a start and a torque limit."""

    share: float = 1.0
    frequency: float = 1.0
    limit: float | None = None
    rest: bool = False

    @property
    def settings(self) -> list[str]:
        """Settings of the scenario `paper`."""
        amplitude = ", ".join(f"{a:.10g}" for a in self.share * AMPLITUDE)
        found = [EXACT, f"reference.amplitude=[{amplitude}]"]
        found.append(f"reference.frequency={self.frequency:g}")
        found += [] if self.rest else ON
        if self.limit is not None:
            torque = self.limit * TAU[self.share, self.frequency]
            found.append(f"actuator.torque_limit={torque:.8g}")
        return found

    def __str__(self) -> str:
        motion = "" if self.share == 1 else f"{self.share:g} of the motion"
        motion += "" if self.frequency == 1 else f" at {self.frequency:g} rad/s"
        limit = "no limit" if self.limit is None else f"limit {self.limit:.2f}"
        return ", ".join(filter(None, (motion, "from rest" if self.rest else "", limit)))


CASES = (
    Case(),
    *(Case(limit=limit) for limit in (0.95, 0.90, 0.85, 0.80)),
    *(Case(0.5, 2.0, limit) for limit in (0.80, 0.70)),
    Case(0.7, 1.0, 0.70),
    *(Case(limit=limit, rest=True) for limit in (1.5, 2.3, 4.0, 7.5)),
    *(Case(share) for share in (1.1, 1.2)),
)


class Timed(NamedTuple):
    """A run, with the processor time of each step in ms and whether a limit did bind there."""

    ending: Ending
    ms: NDArray[np.float64]
    bound: NDArray[np.bool_]


@contextmanager
def timed(times: list[float], bound: list[bool]) -> Iterator[None]:
    """Record the time of each step of `LimitedLqi`, ms, and whether a limit did bind."""
    step = limited.LimitedLqi.step

    def watched(self: Any, memory: Any, *given: Any) -> Any:
        begun = time.thread_time()
        after = step(self, memory, *given)
        times.append(1e3 * (time.thread_time() - begun))
        bound.append(after.counts.limited_steps > memory.counts.limited_steps)
        return after

    limited.LimitedLqi.step = watched  # type: ignore[method-assign]
    try:
        yield
    finally:
        limited.LimitedLqi.step = step  # type: ignore[method-assign]


def run(case: Case, controller: str, *settings: str) -> Timed | None:
    """Run a case; None where the controller refuses it."""
    times, bound = list[float](), list[bool]()
    try:
        with timed(times, bound):
            ending = run_in_bulk(sd.load_scenario("paper", controller, [*case.settings, *settings]))
    except ConfigError:
        return None
    return Timed(ending, np.array(times), np.array(bound))


def outcome(found: Timed | None) -> str:
    """Return E_ac, or how the run ended."""
    if found is None:
        return "refused"
    if found.ending.stopped is not None:
        return f"lost {found.ending.stopped.time:.1f} s"
    return f"{found.ending.error_so_far:.3g}"


def milliseconds(found: Timed, bound: bool) -> str:
    """Return median and longest time of the steps in which a limit did bind, or did not."""
    chosen = found.ms[found.bound == bound]
    return f"{np.median(chosen):.1f}, {chosen.max():.1f}" if len(chosen) else "-"


def clean() -> str:
    """Return the table of clean runs."""
    rows = grouped(
        run, {c: [(c, "predictor_lqi", NONE), (c, "predictor_mpc", NONE)] for c in CASES}
    )
    body = []
    for case, (free, plans) in rows.items():
        assert plans is not None
        counts = plans.ending.counts
        failures = counts["qp_failures"] + counts["qp_late"]
        times = milliseconds(plans, False), milliseconds(plans, True)
        body.append([case, outcome(free), outcome(plans), int(plans.bound.sum()), failures, *times])
    head = ["case", "predictor_lqi", "predictor_mpc", "samples with a plan", "without a solution"]
    head += ["ms without a plan: median, most", "ms with a plan"]
    return section("Clean state, nothing unknown", table(head, body))


def dirty(seed: int) -> tuple[str, ...]:
    """Return settings of noise, bias and payload, all unknown."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], 6)
    bias = ", ".join(f"{BIAS * sign:g}" for sign in signs)
    unknown = f"plant.torque_bias=[{bias}]", f"plant.payload_mass={PAYLOAD}"
    return (noise(1e-3), f"sensor.seed={seed}", *unknown)


def robustness() -> str:
    """Return the table of runs with noise, bias and payload."""
    laws, seeds = ("predictor_lqi", "predictor_mpc"), range(7001, 7001 + SEEDS)
    rows = grouped(
        run, {(c, law): [(c, law, *dirty(s)) for s in seeds] for c in CASES for law in laws}
    )
    body, limits_kept = [], 0
    for case in CASES:
        cells: list[object] = [case]
        for law in laws:
            found = [one for one in rows[case, law] if one is not None]
            whole = [one.ending.error_so_far for one in found if one.ending.stopped is None]
            spread = f"{np.mean(whole):.3g} ({max(whole):.3g})" if whole else "-"
            cells += [f"{len(whole)} of {len(found)}" if found else "refused", spread]
        body.append(cells)
        for one in rows[case, "predictor_mpc"]:
            inside = one is not None and one.ending.stopped is None
            highest = np.inf if case.limit is None else case.limit * TAU[case[:2]]
            within = one is not None and one.ending.figures.peak_torque <= highest * (1 + 1e-9)
            limits_kept += inside and within
    head = ["case", "predictor_lqi completes", "E, mean (worst)", "predictor_mpc completes"]
    text = (
        f"Noise of 0.1 %, a bias of {BIAS:g} N m with random signs, a payload of {PAYLOAD} kg, all "
        f"unknown; {SEEDS} seeds. Runs of `predictor_mpc` that violate no limit of torque or "
        f"workspace: {limits_kept} of {SEEDS * len(CASES)}."
    )
    return section("Noise, bias and payload", text, table([*head, "E, mean (worst)"], body))


# ---------------------------------------------------------------- solvers


def by_drake(solver: Any, options: dict[str, float]) -> Callable[[LeastDistance], Any]:
    """Return a solver through Drake's MathematicalProgram; None where it fails."""
    chosen = SolverOptions()
    for name, value in options.items():
        chosen.SetOption(solver.solver_id(), name, value)

    def solve(p: LeastDistance) -> Any:
        program = MathematicalProgram()
        z = program.NewContinuousVariables(len(p.h))
        program.AddQuadraticCost(np.diag(p.h), p.g, z, is_convex=True)
        program.AddLinearConstraint(p.A, p.lower, p.upper, z)
        if p.slacks:
            program.AddBoundingBoxConstraint(0, np.inf, z[: p.slacks])
        result = solver.Solve(program, None, chosen)
        return result.GetSolution(z) if result.is_success() else None

    return solve


SOLVERS: dict[str, Callable[[LeastDistance], Any]] = {
    "DAQP": solve_by_daqp,
    "Clarabel": by_drake(ClarabelSolver(), {}),
    "OSQP": by_drake(OsqpSolver(), {"eps_abs": 1e-5, "eps_rel": 1e-5, "max_iter": 20000}),
}


def problems(case: Case) -> list[LeastDistance]:
    """Return problems of a run, evenly spread."""
    kept = list[LeastDistance]()

    def keep(problem: LeastDistance, seconds: float) -> Any:
        kept.append(problem)
        return solve_by_daqp(problem, seconds)

    def with_keeper(law: Any) -> Any:
        return replace(law, limits=replace(law.limits, solver=keep))

    scenario = sd.load_scenario("paper", "predictor_mpc", [*case.settings, NONE, "duration=5"])
    sd.simulate(scenario, judge_stability=False, modify_law=with_keeper)
    return kept[:: max(1, len(kept) // SAMPLES)][:SAMPLES]


def compared(case: Case) -> list[list[object]]:
    """Return a row per solver: case, solver, times, failures, excess of the cost."""
    found, rows = problems(case), []

    def cost(p: LeastDistance, z: Any) -> float:
        return float(p.h @ z**2 / 2 + p.g @ z)

    results = {}
    for name, solve in SOLVERS.items():
        times, answers = list[float](), []
        for problem in found:
            begun = time.thread_time()
            answers.append(solve(problem))
            times.append(1e3 * (time.thread_time() - begun))
        results[name] = times, answers
    least = [
        min(cost(p, a[i]) for _, a in results.values() if a[i] is not None)
        for i, p in enumerate(found)
    ]
    for name, (times, answers) in results.items():
        excess = [
            (cost(p, z) - low) / max(abs(low), 1e-9)
            for p, z, low in zip(found, answers, least, strict=True)
            if z is not None
        ]
        failed = sum(z is None for z in answers)
        ms = f"{np.median(times):.2f}", f"{max(times):.2f}"
        rows.append([case, name, len(found), *ms, failed, f"{max(excess, default=np.nan):.1e}"])
    return rows


def solvers() -> str:
    """Return the table of solvers."""
    cases = CASES[2], CASES[4], CASES[7], CASES[11], CASES[13]
    body = [row for case in cases for row in compared(case)]
    head = ["case", "solver", "problems", "ms, median", "most", "failed", "relative excess of cost"]
    text = "Clarabel and OSQP through Drake's `MathematicalProgram`."
    return section("Solvers of one quadratic program", text, table(head, body))


SECTIONS = {"clean": clean, "robustness": robustness, "solvers": solvers}

if __name__ == "__main__":
    run_sections(__file__, "Limits of torque and workspace", SECTIONS)
