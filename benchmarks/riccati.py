"""The Riccati gain of the whole delay chain against the same gain by the delay reduction.

The paper's model at home, sampled at 0.1 s, identity weights. Times are the least of several
interleaved repeats.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from _bench import section, table, write
from pydrake.math import DiscreteAlgebraicRiccatiEquation
from scipy.linalg import solve_discrete_are

import stewart_drake as sd
from stewart_drake.law.delay_model import (
    DelayedModel,
    LinearModel,
    chain,
    delayed_model,
    double_integrators,
)
from stewart_drake.law.riccati import full_gain, prediction_matrix, reduced_gain
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.types import Array

PERIOD = 0.1
STEPS = (0, 1, 5, 8, 10, 20, 30)
FRACTIONS = (0.0, 0.5)
Q, R = np.eye(12), np.eye(6)


def model(steps: int, fraction: float) -> DelayedModel:
    """Return the paper's model at home, with integral states."""
    mechanism = sd.load_mechanism("paper")
    continuous = double_integrators(torque_map(mechanism, mechanism.home, "virtual_work"))
    return delayed_model(continuous, PERIOD, steps, fraction, integral=True)


def least_ms(calls: Sequence[Callable[[], object]], budget: float) -> list[float]:
    """Return the least time of each call, in ms; they take turns for `budget` seconds.

    There are three turns at least. In each a call is made three times in a row: after the large
    matrices of another call the cache is cold.
    """
    least, started, turns = [np.inf] * len(calls), time.perf_counter(), 0
    while turns < 3 or time.perf_counter() - started < budget:
        turns += 1
        for i, call in enumerate(calls):
            for _ in range(3):
                begun = time.perf_counter()
                call()
                least[i] = min(least[i], time.perf_counter() - begun)
    return [1e3 * seconds for seconds in least]


def drake_only(system: LinearModel) -> Callable[[], Array]:
    """Return a call of Drake's solver, without checks of its arguments and its result."""
    matrices = (system.A, system.B, system.C.T @ Q @ system.C, R)
    A, B, Q_x, R_x = (np.asfortranarray(matrix) for matrix in matrices)
    return lambda: DiscreteAlgebraicRiccatiEquation(A, B, Q_x, R_x)


def gain(system: LinearModel, P: Array) -> Array:
    """Return (44)."""
    return np.linalg.solve(R + system.B.T @ P @ system.B, system.B.T @ P @ system.A)


def difference(K: Array, expected: Array) -> float:
    """Return the largest difference, relative to the largest entry."""
    return float(np.abs(K - expected).max() / np.abs(expected).max())


def comparison(fraction: float) -> tuple[list[str], list[list[str]]]:
    """Return rows of the gain of the whole chain, checked and by scipy, and of the reduced one."""
    header = ["mu", "states", "full, ms", "scipy, ms", "reduced, ms", "full / reduced",
              "gains differ by", "scipy's by"]  # fmt: skip
    rows = []
    for steps in STEPS:
        delayed = model(steps, fraction)
        system = chain(delayed)
        weight = system.C.T @ Q @ system.C
        calls: list[Callable[[], Array]] = [
            lambda delayed=delayed: full_gain(delayed, Q, R)[0],
            lambda s=system, w=weight: gain(s, solve_discrete_are(s.A, s.B, w, R)),
            lambda delayed=delayed: reduced_gain(delayed, Q, R) @ prediction_matrix(delayed),
        ]
        full, by_scipy, reduced = least_ms(calls, 2.0)
        K, other, ours = (call() for call in calls)
        rows.append(
            [str(steps), str(len(system.A)), *(f"{t:.3g}" for t in (full, by_scipy, reduced))]
            + [f"{full / reduced:.3g}", f"{difference(ours, K):.0e}", f"{difference(other, K):.0e}"]
        )
    return header, rows


def checks(fraction: float) -> list[str]:
    """Return the time of the checks in `reduced_gain`, compared with Drake's solver."""
    delayed = replace(model(8, fraction), steps=0)
    bare, checked = least_ms([drake_only(chain(delayed)), lambda: reduced_gain(delayed, Q, R)], 2.0)
    return [f"{fraction:g}", f"{bare:.3g}", f"{checked:.3g}", f"{checked / bare:.3g}"]


def main() -> None:
    parts = [section(f"eta0 = {f:g} dt", table(*comparison(f), "---:")) for f in FRACTIONS]
    header = ["eta0 / dt", "Drake's solver, ms", "reduced_gain, ms", "ratio"]
    cost = table(header, [checks(f) for f in FRACTIONS], "---:")
    write(__file__, "The delay reduction", [*parts, section("Cost of the checks", cost)])


if __name__ == "__main__":
    main()
