"""Delays identified from short logs of lost runs, LOGS of them a row.

A delay-blind controller from rest loses the plate after some 1.5 s. Payload and biases
are unknown to `identify`, which has the drawing and the default tolerances.
"""

import os
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from _bench import AMPLITUDE, EXACT, QUICK, delay_settings, in_parallel, noise, size, table, write

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.identify import identify
from stewart_drake.identification.logs import Precision, load_log
from stewart_drake.identification.unknowns import DELAY
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.loading import load_scenario

FRESH = int(os.environ.get("FRESH", "6000"))
"""First seed; 3000 to 5009 were used during development."""
LOGS = size("LOGS", 10)
CASES = [
    (machine, delay, noise)
    for machine in ("paper", "desktop")
    for delay in (0.08, 0.8)
    for noise in (0.0, 1e-3)
]
"""Scenario, delay in s, and noise as a share of the amplitudes."""
AMPLITUDES = {
    "paper": AMPLITUDE,
    "desktop": np.array([0.18, 0.12, 0.35, 0.012, 0.012, 0.008]),
}
"""Amplitudes of the references, rad and m."""
ENDS = (1.3, 1.7)
"""Earliest and latest loss of the plate, s."""
HEAD = (
    *("scenario", "delay [s]", "noise", "within 1 ms", "refused", "wrong"),
    *("rms error [ms]", "stated, rms [ms]"),
)


def short_run(machine: str, delay: float, share: float, seed: int) -> SimulationResult:
    """Lose the plate within ENDS, by a delay-blind LQR from rest.

    Payload up to a fifth of the plate, biases of 0.1 to 0.3 mN m of random signs and the weight of
    the torques are drawn until the plate is lost in time. Without gravity: under it such a
    controller loses the plate within 0.3 s.

    Args:
        machine: a shipped scenario.
        delay: true one, s.
        share: of the noise in the reference's amplitudes, per second for rates.
        seed: of the draw.
    """
    rng = np.random.default_rng([seed, machine == "paper", round(1e3 * delay), share > 0])
    period = load_scenario(machine).controller.period
    plate = sd.load_mechanism(machine).plate.mass
    while True:
        payload = 0.2 * plate * rng.uniform()
        bias = 3e-4 * rng.uniform(0.3, 1, 6) * rng.choice([-1, 1], 6)
        settings = (
            *(EXACT, "plant.gravity=false", "start=rest", "queue=zero", "duration=2"),
            *delay_settings(delay, period),
            f"controller.w_R={10 ** rng.uniform(0, 2):.6g}",
            f"plant.payload_mass={payload:.6g}",
            f"plant.torque_bias=[{','.join(f'{x:.6g}' for x in bias)}]",
            noise(share, AMPLITUDES[machine]),
            f"sensor.seed={seed}",
        )
        run = simulate(load_scenario(machine, "lqr", settings), judge_stability=False)
        if run.stopped is not None and ENDS[0] <= run.stopped.time <= ENDS[1]:
            return run


class Found(NamedTuple):
    """Error of an identified delay and its stated standard deviation, s; NaN for a refused log."""

    late: float
    std: float
    refusal: str


def find(machine: str, delay: float, noise: float, seed: int, end: float = np.inf) -> Found:
    """Identify from the signals of a short run, up to `end` in s."""
    run, drawing = short_run(machine, delay, noise, seed), sd.load_mechanism(machine)
    with TemporaryDirectory() as folder:
        run.save(folder)
        log = load_log(Path(folder) / "signals.nc", drawing, Precision())
    kept = log.times <= end
    log = replace(log, times=log.times[kept], values=log.values[kept])
    try:
        found = identify([log], drawing)
    except ConfigError as error:
        return Found(np.nan, np.nan, str(error).partition(": ")[2])
    return Found(float(found.values[DELAY] - delay), float(found.std[DELAY]), "")


def row(case: tuple[str, float, float], found: list[Found]) -> list[str]:
    """Return a row; wrong is an error above 1 ms and 2.6 standard deviations."""
    machine, delay, noise = case
    late, std = (1e3 * np.array([getattr(one, name) for one in found]) for name in ("late", "std"))
    known = np.isfinite(late)
    wrong = np.abs(late) > np.maximum(1.0, 2.6 * std)
    counts = np.abs(late) <= 1.0, ~known, wrong
    sizes = (
        f"{np.sqrt(np.mean(one[known] ** 2)):.2g}" if known.any() else "-" for one in (late, std)
    )
    numbers = (str(int(one.sum())) for one in counts)
    return [machine, f"{delay:g}", f"{100 * noise:g} %", *numbers, *sizes]


def main() -> None:
    rows, refusals = [], list[str]()
    for case in CASES[:1] if QUICK else CASES:
        found = in_parallel(find, [(*case, FRESH + seed) for seed in range(LOGS)])
        rows.append(row(case, found))
        print(*rows[-1], flush=True)
        refusals += [f"- {one.refusal}\n" for one in found if one.refusal]
    write(__file__, "Delays from short logs of lost runs", [table(HEAD, rows), "".join(refusals)])


if __name__ == "__main__":
    main()
