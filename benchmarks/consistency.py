"""Whether the estimator's errors are as large as it states: NEES over drawn runs of `paper`.

The normalised estimation error squared, e' P^-1 e with the error e of 12 states and 8 parameters
and their stated covariance P, has the mean 20 if P is right (Bar-Shalom, Li, Kirubarajan,
Estimation with Applications, section 5.4). Each run draws six torque biases N(0, 3e-4 N m), a
payload |N(0, 0.3 kg)| and a damping |N(0, 3e-4 N m s)|; measurements have noise of 0.1 % of the
motion. The causes below the first row are unknown to the estimator.
"""

from typing import Any

import numpy as np
from _bench import EXACT, ON, delay_settings, grouped, in_parallel, noise, size, table, write

import stewart_drake as sd
from stewart_drake.loop.bulk import PythonController, preparation_of, run_loop
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.studies.workspace import rms
from stewart_drake.types import Array

RUNS, CAUSE_RUNS = size("RUNS", 100, 2), size("CAUSE_RUNS", 40, 2)
SAMPLES = (5, 10, 20, 50, 99)
"""At which the errors are judged."""
CAUSES = {
    "none": (),
    "delay 2 ms longer": ("controller.delay_steps=7", "controller.delay_fraction=0.98"),
    "Coulomb friction 1e-4 N m": ("plant.coulomb_friction=1e-4",),
    "payload 5 mm off the centre": ("plant.payload_position=[0.005,0,0]",),
}


class Remembering(PythonController):
    """A controller that keeps what it believes at each sample."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.beliefs: list[Any] = []

    def __call__(self, *given: Any) -> Any:
        done = super().__call__(*given)
        self.beliefs.append(self._memory.belief)
        return done


def settings_of(seed: int, *more: str) -> tuple[str, ...]:
    rng = np.random.default_rng(seed)
    bias, payload, damping = 3e-4 * rng.normal(size=6), rng.normal(), rng.normal()
    drawn = f"plant.torque_bias={bias.tolist()}", f"plant.payload_mass={0.3 * abs(payload)}"
    noisy = noise(1e-3), f"sensor.seed={seed}"
    return EXACT, *ON, *noisy, *drawn, f"plant.joint_damping={3e-4 * abs(damping)}", *more


def beliefs(controller: str, settings: tuple[str, ...]) -> tuple[Array, Array, list[Any]]:
    """Return parameters of the plant, states (k, 12) at the samples, and what is believed there."""
    scenario = sd.load_scenario("paper", controller, settings)
    preparation = preparation_of(scenario)
    experiment, when = preparation.experiment(scenario), preparation.when
    prepared = preparation.prepared(experiment)
    law = Remembering(prepared, when, preparation.references[when.sampled])
    course = run_loop(experiment, when, law, prepared.law)
    states = course.states[when.sampled[: len(course.states)]]
    return np.array(scenario.plant.parameters), states, law.beliefs


def nees(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def errors(seed: int, cause: str) -> list[list[float]]:
    """Return NEES of all, states and parameters at `SAMPLES`; nothing of a lost run."""
    truth, states, believed = beliefs("predictor_lqi", settings_of(seed, *CAUSES[cause]))
    found = []
    for k in SAMPLES if len(states) > SAMPLES[-1] else ():
        mean, covariance = believed[k].estimate.mean, believed[k].estimate.covariance
        error = mean - np.concatenate([states[k], truth[: len(mean) - NUM_STATE]])
        parts = slice(None), slice(NUM_STATE), slice(NUM_STATE, None)
        found.append([nees(error[part], covariance[part, part]) for part in parts])
    return found


def delay_errors(seed: int) -> tuple[float, float]:
    """Return the delay's error in ms after 10 s, and the same in stated standard deviations."""
    true, assumed = np.random.default_rng(9000 + seed).uniform(0.5, 1.1, 2)
    delays = *delay_settings(true), *delay_settings(assumed, field="controller.delay_")
    _, _, believed = beliefs("adaptive_lqi", settings_of(seed, *delays))
    error = believed[-1].delay_mean - true
    return 1e3 * error, error / believed[-1].delay_std


def main() -> None:
    cases = {
        cause: [(seed, cause) for seed in range(RUNS if cause == "none" else CAUSE_RUNS)]
        for cause in CAUSES
    }
    rows = []
    for cause, runs in grouped(errors, cases).items():
        completed = np.array([one for one in runs if one])
        means = [" / ".join(f"{value:.3g}" for value in sample) for sample in completed.mean(0)]
        rows.append([cause, f"{len(completed)} of {len(runs)}", *means])
    error, z = np.array(in_parallel(delay_errors, [(seed,) for seed in range(RUNS)])).T
    found = (
        f"The delay, believed 0.5 to 1.1 s and truly another one of these: its error after 10 s is "
        f"{rms(error):.3g} ms rms, {rms(z):.2f} stated deviations (1), and within 1.96 in "
        f"{np.mean(np.abs(z) < 1.96):.0%} of {len(z)} runs."
    )
    heads = ["cause", "completed", *(f"{0.1 * k:.2g} s" for k in SAMPLES)]
    about = "Mean NEES of all 20 values / 12 states / 8 parameters:"
    title = "Errors of the estimator against their stated covariance"
    write(__file__, title, [about, table(heads, rows), found])


if __name__ == "__main__":
    main()
