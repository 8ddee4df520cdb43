"""A plant with friction and a payload that nobody told: `python benchmarks/true_machine.py`.

Writes benchmarks/results/true_machine.md; SEEDS of the environment is the number of runs with
noise. All runs are of `paper` with `predictor_lqi` and a delay of 0.8 s that is known, on the exact
plant where nothing else is said. The reference takes 0.013 N m.
"""

import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from _page import RESULTS, size
from joblib import Parallel, delayed

import stewart_drake as sd
from stewart_drake.files.versions import versions
from stewart_drake.mechanism.geometry import fingerprint
from stewart_drake.scenario.calibration import Calibration, save_calibration
from stewart_drake.scenario.signals import PLANT_PARAMETERS

AMPLITUDES = np.tile([0.2617993878] * 3 + [0.02, 0.02, 0.08], 2)
ON_REFERENCE = ("start=on_reference", "queue=reference")
STARTS = {"on the reference": ON_REFERENCE, "from rest": ()}
SEEDS = range(100, 100 + size("SEEDS", 5))
BIAS = "plant.torque_bias=[3e-4,-3e-4,3e-4,-3e-4,3e-4,-3e-4]"
THREE = (BIAS, "plant.payload_mass=0.4", "plant.joint_damping=1e-3")
ASIDE = ("plant.payload_mass=0.4", "plant.payload_position=[0.03,-0.02,0.05]")
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
NOISE = "sensor.noise_std=[" + ",".join(f"{1e-3 * a:.10g}" for a in AMPLITUDES) + "]"
PRIORS = (None, 1e-2, 3e-3, 1e-3, 3e-4)
"""Of the bias, N m; None is the shipped one."""


def told(settings: Sequence[str], folder: str) -> tuple[str, ...]:
    """A file with the plant's true values, nearly exact."""
    scenario = sd.load_scenario("paper", settings=settings)
    mechanism = sd.load_mechanism("paper")
    truth = np.array(scenario.plant.parameters)
    std = np.array([1e-6] * 6 + [1e-4, 1e-7, 1e-7, 1e-5] + [1e-5] * 3)
    path = Path(folder) / f"{abs(hash(tuple(settings)))}.yaml"
    save_calibration(
        path, Calibration(fingerprint(mechanism), PLANT_PARAMETERS, truth, np.diag(std**2))
    )
    return (f"controller.calibration={path}",)


def run(settings: Sequence[str]) -> float:
    """E_ac of one run, NaN where it does not complete."""
    scenario = sd.load_scenario("paper", "predictor_lqi", ("plant.kind=exact", *settings))
    return sd.simulate(scenario, judge_stability=False).accumulated_error


def table(title: str, columns: Sequence[str], rows: dict[str, list[list[Any]]]) -> str:
    """A row per name, a cell per list of settings: the mean over them, and how many completed."""
    jobs = [case for cells in rows.values() for cell in cells for case in cell]
    found = iter(Parallel(n_jobs=-1)(delayed(run)(case) for case in jobs))
    lines = [" | ".join(("the plant has", *columns)), " | ".join(["---"] * (1 + len(columns)))]
    for name, cells in rows.items():
        values = [[next(found) for _ in cell] for cell in cells]
        lines.append(" | ".join((name, *(cell_text(v) for v in values))))
    return f"## {title}\n\n" + "\n".join(f"| {line} |" for line in lines) + "\n"


def cell_text(errors: list[float]) -> str:
    """Mean E_ac of those that completed."""
    done = [e for e in errors if np.isfinite(e)]
    if not done:
        return "lost"
    lost = "" if len(done) == len(errors) else f" ({len(done)} of {len(errors)})"
    return f"{np.mean(done):.3g}{lost}"


def friction(folder: str) -> str:
    """What the law does with it, what estimating and what knowing gain."""
    columns = [f"{law}, {start}" for start in STARTS for law in (*LAWS, "known")]
    rows = {
        name: [
            [(*plant, *where, *law)]
            for where in STARTS.values()
            for law in (*LAWS.values(), told(plant, folder))
        ]
        for name, plant in PLANTS.items()
    }
    return table("E_ac, clean", columns, rows)


def noisy(folder: str) -> str:
    """The same with noise of 0.1 % of the amplitudes, on the reference."""
    rows = {
        name: [
            [(*plant, *ON_REFERENCE, *law, NOISE, f"sensor.seed={seed}") for seed in SEEDS]
            for law in (*LAWS.values(), told(plant, folder))
        ]
        for name, plant in PLANTS.items()
    }
    title = f"E_ac on the reference with noise of 0.1 %, mean of {len(SEEDS)} seeds"
    return table(title, (*LAWS, "known"), rows)


def multibody(folder: str) -> str:
    """On the multibody plant, with two steps."""
    plants = ("nothing", "Coulomb friction 0.001 N m", "payload 0.4 kg at 30, -20, 50 mm")
    engines = {
        "exact": (),
        "multibody 1 ms": ("plant.kind=multibody",),
        "multibody 0.2 ms": ("plant.kind=multibody", "plant.time_step=2e-4"),
    }
    rows = {
        name: [
            [(*ON_REFERENCE, *PLANTS[name], *told(PLANTS[name], folder), *engine)]
            for engine in engines.values()
        ]
        for name in plants
    }
    return table("E_ac on the reference, known, on both plants", list(engines), rows)


def priors(_: str) -> str:
    """What another standard deviation of the bias does to the runs that are shown elsewhere."""
    plants = {
        "nothing": (),
        "bias 3e-4": (BIAS,),
        "bias 3e-4, payload 0.4 kg, damping 1e-3": THREE,
        "bias of 5e-3": ("plant.torque_bias=[5e-3,-5e-3,5e-3,-5e-3,5e-3,-5e-3]",),
    }
    rows = {}
    for name, plant in plants.items():
        for more, noise in {"": (), ", noise of 0.1 %": (NOISE,)}.items():
            seeds = SEEDS if noise else SEEDS[:1]
            rows[name + more] = [
                [
                    (*plant, *ON_REFERENCE, *noise, *prior(std), f"sensor.seed={seed}")
                    for seed in seeds
                ]
                for std in PRIORS
            ]
    columns = ["shipped, 0.018 N m", *(f"{std:g} N m" for std in PRIORS[1:])]
    return table("E_ac on the reference by the prior of the bias", columns, rows)


def prior(std: float | None) -> tuple[str, ...]:
    """The setting of a bias' standard deviation."""
    return () if std is None else (f"controller.prior={{torque_bias: {std}}}",)


def main() -> None:
    """Run and write."""
    packages = ", ".join(f"{package} {number}" for package, number in versions().items())
    parts = [
        "# A plant that nobody told\n",
        f"Made by `python benchmarks/true_machine.py` with {packages}.\n",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for section in (friction, noisy, multibody, priors):
            parts.append(section(folder))
            print(parts[-1], flush=True)
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "true_machine.md").write_text("\n".join(parts))


if __name__ == "__main__":
    sys.exit(main())
