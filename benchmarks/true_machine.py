"""A plant with friction and a payload that are unknown to the controller.

SEEDS of the environment is the number of runs with noise. All runs are of `paper` with
`predictor_lqi` and a known delay of 0.8 s, on the exact plant by default. The reference takes
0.013 N m.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _bench import EXACT, ON, PAYLOAD, grouped, noise, section, size, table, write

import stewart_drake as sd
from stewart_drake.mechanism.geometry import fingerprint
from stewart_drake.scenario.calibration import Calibration, save_calibration
from stewart_drake.scenario.signals import CONSTANTS

STARTS = {"on the reference": ON, "from rest": ()}
SEEDS = range(100, 100 + size("SEEDS", 5))
BIAS = "plant.torque_bias=[3e-4,-3e-4,3e-4,-3e-4,3e-4,-3e-4]"
THREE = (BIAS, PAYLOAD, "plant.joint_damping=1e-3")
ASIDE = (PAYLOAD, "plant.payload_position=[0.03,-0.02,0.05]")
PLANTS: dict[str, tuple[str, ...]] = {
    "nothing": (),
    **{
        f"Coulomb friction {c:g} N m": (f"plant.coulomb_friction={c}",)
        for c in (1e-4, 3e-4, 1e-3, 2e-3)
    },
    "the same of 1e-3, built up over 0.1 rad/s": (
        "plant.coulomb_friction=1e-3",
        "plant.coulomb_speed=0.1",
    ),
    "payload 0.4 kg at 30, -20, 50 mm": ASIDE,
    "bias 3e-4, payload 0.4 kg, damping 1e-3": THREE,
    "all of it": (*THREE, ASIDE[1], "plant.coulomb_friction=1e-3"),
}
LAWS: dict[str, tuple[str, ...]] = {
    "default": (),
    "coulomb": ("controller.estimate=[torque_bias,payload,damping,coulomb]",),
}
NOISE = noise(1e-3)
PRIORS = (None, 1e-2, 3e-3, 1e-3, 3e-4)
"""Prior standard deviations of the bias, N m; None is the shipped one."""


def calibrated(settings: Sequence[str], folder: str) -> tuple[str, ...]:
    """Return the setting of a calibration with the plant's true values, nearly exact."""
    scenario = sd.load_scenario("paper", settings=settings)
    mechanism = sd.load_mechanism("paper")
    truth = np.array(scenario.plant.parameters)
    std = np.array([1e-6] * 6 + [1e-4, 1e-7, 1e-7, 1e-5] + [1e-5] * 3 + [1e-7, 1e-7, 1e-5])
    path = Path(folder) / f"{abs(hash(tuple(settings)))}.yaml"
    save_calibration(path, Calibration(fingerprint(mechanism), CONSTANTS, truth, np.diag(std**2)))
    return (f"controller.calibration={path}",)


def run(*settings: str) -> float:
    """Return E_ac of one run, NaN if it does not complete."""
    scenario = sd.load_scenario("paper", "predictor_lqi", (EXACT, *settings))
    return sd.simulate(scenario, judge_stability=False).accumulated_error


def cell_text(errors: list[float]) -> str:
    """Return the mean E_ac of the runs that completed."""
    done = [e for e in errors if np.isfinite(e)]
    if not done:
        return "lost"
    lost = "" if len(done) == len(errors) else f" ({len(done)} of {len(errors)})"
    return f"{np.mean(done):.3g}{lost}"


def means(title: str, columns: Sequence[str], rows: dict[str, list[list[Any]]]) -> str:
    """Return a table: a row per name, a cell per list of settings with the mean over them."""
    cells = {(name, k): cell for name, some in rows.items() for k, cell in enumerate(some)}
    found = grouped(run, cells)
    lines = [
        (name, *(cell_text(found[name, k]) for k in range(len(some))))
        for name, some in rows.items()
    ]
    return section(title, table(("the plant has", *columns), lines))


def friction(folder: str) -> str:
    """Return runs with the default, with estimated friction, and with known values."""
    columns = [f"{law}, {start}" for start in STARTS for law in (*LAWS, "known")]
    rows = {
        name: [
            [(*plant, *where, *law)]
            for where in STARTS.values()
            for law in (*LAWS.values(), calibrated(plant, folder))
        ]
        for name, plant in PLANTS.items()
    }
    return means("E_ac, clean", columns, rows)


def noisy(folder: str) -> str:
    """Return the same with noise of 0.1 % of the amplitudes, on the reference."""
    rows = {
        name: [
            [(*plant, *ON, *law, NOISE, f"sensor.seed={seed}") for seed in SEEDS]
            for law in (*LAWS.values(), calibrated(plant, folder))
        ]
        for name, plant in PLANTS.items()
    }
    title = f"E_ac on the reference with noise of 0.1 %, mean of {len(SEEDS)} seeds"
    return means(title, (*LAWS, "known"), rows)


def multibody(folder: str) -> str:
    """Return runs on the multibody plant, with two steps."""
    plants = ("nothing", "Coulomb friction 0.001 N m", "payload 0.4 kg at 30, -20, 50 mm")
    engines = {
        "exact": (),
        "multibody 1 ms": ("plant.kind=multibody",),
        "multibody 0.2 ms": ("plant.kind=multibody", "plant.time_step=2e-4"),
    }
    rows = {
        name: [
            [(*ON, *PLANTS[name], *calibrated(PLANTS[name], folder), *engine)]
            for engine in engines.values()
        ]
        for name in plants
    }
    return means("E_ac on the reference, known, on both plants", list(engines), rows)


def priors(_: str) -> str:
    """Return runs with other prior standard deviations of the bias."""
    plants = {
        "nothing": (),
        "bias 3e-4": (BIAS,),
        "bias 3e-4, payload 0.4 kg, damping 1e-3": THREE,
        "bias of 5e-3": ("plant.torque_bias=[5e-3,-5e-3,5e-3,-5e-3,5e-3,-5e-3]",),
    }
    settings = [() if s is None else (f"controller.prior={{torque_bias: {s}}}",) for s in PRIORS]
    rows = {
        name + more: [
            [(*plant, *ON, *noise, *prior, f"sensor.seed={seed}") for seed in seeds]
            for prior in settings
        ]
        for name, plant in plants.items()
        for more, noise, seeds in (("", (), SEEDS[:1]), (", noise of 0.1 %", (NOISE,), SEEDS))
    }
    columns = ["shipped, 0.018 N m", *(f"{std:g} N m" for std in PRIORS[1:])]
    return means("E_ac on the reference by the prior of the bias", columns, rows)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        parts = (make(folder) for make in (friction, noisy, multibody, priors))
        write(__file__, "A plant with unknown friction and payload", parts)


if __name__ == "__main__":
    main()
