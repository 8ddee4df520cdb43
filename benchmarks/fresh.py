"""Compare the law with 0.2 under drawn conditions that no tuning used.

`python benchmarks/fresh.py` prints E_ac of each condition, and its ratio to 0.2's. A condition is a
machine, a motion, a delay, a period, a sensor, a link and unknown parameters, drawn from SEED. Each
runs with three seeds of its noise and signs, on the exact plant. fresh_0.2.json has the same runs
of 0.2's law: condition, seed, E_ac.
"""

import json
from pathlib import Path

import numpy as np
from _bench import in_parallel, size

import stewart_drake as sd
from stewart_drake.law.startup import reference_torque
from stewart_drake.loop.preparation import prepare

SEED, SEEDS = 20290, 3


def settings_of(number: int) -> tuple[str, str, list[str]]:
    """Return scenario, controller and settings of a condition, without signs and seeds."""
    rng = np.random.Generator(np.random.Philox([SEED, number]))
    base = str(rng.choice(["paper", "paper", "paper_clear", "desktop", "motion_base", "gravity"]))
    period = float(rng.choice([0.01, 0.02, 0.05, 0.1, 0.2]))
    low, high = {"desktop": (0.04, 0.1), "motion_base": (0.06, 0.2), "gravity": (0.06, 0.16)}.get(
        base, (0.15, 1.5)
    )
    if base in ("desktop", "gravity"):
        period = min(period, 0.02)
    delay = rng.uniform(low, high)
    steps, fraction = divmod(delay / period, 1.0)
    fraction = 0.0 if rng.random() < 0.6 else round(fraction, 3)
    chosen = [
        "plant.kind=exact",
        f"controller.period={period}",
        f"delay.steps={max(int(steps), 1)}",
        f"delay.fraction={fraction}",
    ]
    name = {"paper_clear": "paper"}.get(base, base)
    if base == "paper_clear":
        chosen.append("mechanism=paper_clear")
    if base in ("paper", "paper_clear", "gravity"):
        share = rng.uniform(0.3, 1.0)
        amplitude = share * np.array([np.pi / 12] * 3 + [0.02, 0.02, 0.08])
        chosen.append(f"reference.amplitude={[round(float(a), 6) for a in amplitude]}")
        chosen.append(f"reference.frequency={round(rng.uniform(0.5, 1.5), 3)}")
        at_rest = base != "gravity" and rng.random() < 0.3
        chosen += [] if at_rest else ["start=on_reference", "queue=reference"]
    if rng.random() < 0.25:
        chosen += ["sensor.kind=encoders", f"sensor.bits={rng.choice([14, 17, 20])}"]
        if rng.random() < 0.5:
            chosen.append("sensor.samples=5")
    adaptive = "sensor.kind=encoders" not in chosen and rng.random() < 0.3
    if rng.random() < 0.15:
        chosen.append("sensor.loss=0.1")
    elif rng.random() < 0.15:
        chosen.append(f"delay.jitter_std={round(0.01 * period, 5)}")
    if adaptive:
        wrong = rng.uniform(0.8, 1.2) * (max(int(steps), 1) + fraction)
        chosen += [
            f"controller.delay_steps={int(wrong)}",
            f"controller.delay_fraction={wrong % 1:.3f}",
            "controller.delay_max=2.0",
        ]
    return name, "adaptive_lqi" if adaptive else "predictor_lqi", chosen


def run(number: int, seed: int) -> tuple[int, int, float | None]:
    """Return condition, seed and E_ac of one run, None if the plate is lost."""
    name, controller, chosen = settings_of(number)
    rng = np.random.Generator(np.random.Philox([SEED, 1000 + number]))
    sizes = rng.uniform(0, 1, 5)  # of the unknowns, the same for every seed
    kinds = rng.random(5) < 0.5
    experiment = prepare(sd.load_scenario(name, controller, chosen))
    motion = experiment.motion_scale
    duration = experiment.scenario.duration
    torque = reference_torque(experiment.nominal, experiment.reference, duration)
    signs = np.random.Generator(np.random.Philox([SEED, 2000 + number, seed]))
    bias = kinds[0] * 0.05 * sizes[0] * torque * signs.choice([-1.0, 1.0], 6)
    plate = experiment.mechanism.plate.mass
    noise = kinds[1] * 1e-3 * sizes[1] * np.concatenate([motion, motion])
    chosen += [
        f"plant.torque_bias={[float(f'{b:.4g}') for b in bias]}",
        f"plant.payload_mass={kinds[2] * 0.12 * sizes[2] * plate:.4g}",
        f"plant.joint_damping={kinds[3] * 0.05 * sizes[3] * torque:.4g}",
        f"plant.coulomb_friction={kinds[4] * (sizes[4] < 0.3) * 0.01 * torque:.4g}",
    ]
    if "sensor.kind=encoders" not in chosen:
        chosen.append(f"sensor.noise_std={[float(f'{s:.4g}') for s in noise]}")
    chosen += [f"sensor.seed={seed}", f"delay.seed={seed}"]
    result = sd.simulate(sd.load_scenario(name, controller, chosen), judge_stability=False)
    done = result.status == "completed"
    return number, seed, result.accumulated_error if done else None


if __name__ == "__main__":
    kept = Path(__file__).parent / "results" / "fresh_0.2.json"
    before = json.loads(kept.read_text(encoding="utf-8"))[: size("FRESH", 120, SEEDS)]
    rows = in_parallel(run, [(number, seed) for number, seed, _ in before])
    old, new = (
        np.array([np.inf if e is None else e for _, _, e in each]).reshape(-1, SEEDS).mean(1)
        for each in (before, rows)
    )
    print("condition, mean E_ac in % s of 0.2, now, their ratio")
    for number, (was, now) in enumerate(zip(old, new, strict=True)):
        name, controller, _ = settings_of(number)
        print(f"{number:3d} {name:12s} {controller:14s} {was:8.4g} {now:8.4g} {now / was:6.3f}")
    finite = np.isfinite(old) & np.isfinite(new)
    mean = np.exp(np.log(new[finite] / old[finite]).mean())
    print(f"geometric mean of the ratios {mean:.3f}; lost: {np.sum(~np.isfinite(new))} conditions")
