"""Record what a change of structure must keep, and compare two records.

    python .ci/record.py write FILE [SECTION ...]    runs, analyses, identify, commands, names
    python .ci/record.py compare OLD NEW             print every difference

`runs` holds the applied torques, status, E_ac and summary keys of every shipped scenario with
every shipped controller, and of conditions that use the other kinds of sensor, link and tuner.
Torques must agree to 1e-12 of their peak, other numbers to 1e-9.
"""

import contextlib
import io
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

NET = ("link.kind=network", "link.low=0.5", "link.high=0.9")
CONDITIONS = {
    "encoders": ("predictor_lqi", ("sensor.kind=encoders",)),
    "encoders_16": (
        "predictor_lqi",
        ("sensor.kind=encoders", "sensor.bits=16", "sensor.samples=2"),
    ),
    "encoders_exact": ("predictor_lqi", ("sensor.kind=encoders", "sensor.bits=null")),
    "network": ("predictor_lqi", NET),
    "network_lossy": ("predictor_lqi", (*NET, "link.loss=0.1", "overlay=dirty")),
    "network_back": ("predictor_lqi", (*NET, "link.return={low: 0.1, high: 0.3}")),
    "adaptive_wrong": ("adaptive_lqi", ("controller.delay_steps=6", "overlay=dirty")),
    "adaptive_drift": (
        "adaptive_lqi",
        ("delay.drift=0.005", "start=on_reference", "queue=reference"),
    ),
    "adaptive_jitter": (
        "adaptive_lqi",
        ("delay.jitter_std=0.003", "start=on_reference", "queue=reference"),
    ),
    "dirty": ("predictor_lqi", ("overlay=dirty", "start=on_reference", "queue=reference")),
    "coulomb": (
        "predictor_lqi",
        (
            "controller.estimate=[torque_bias,payload,damping,coulomb]",
            "plant.coulomb_friction=1e-4",
            "start=on_reference",
            "queue=reference",
        ),
    ),
    "rule": ("predictor_lqi", ("tuner.kind=rule", "start=on_reference", "queue=reference")),
    "late_sensor": ("predictor_lqi", ("sensor.delay=0.2",)),
    "lost_sensor": ("predictor_lqi", ("sensor.loss=0.5", "start=on_reference", "queue=reference")),
    "limit": ("predictor_lqi", ("actuator.torque_limit=1.8",)),
    "fraction": ("predictor_lqi", ("delay.fraction=0.37",)),
    "multibody": ("predictor_lqi", ("plant.kind=multibody",)),
    "ann": ("delay_lqi", ("tuner.kind=ann", "overlay=paper_plant")),
}


def keys(value):
    return (
        {k: keys(v) for k, v in value.items()} if isinstance(value, dict) else type(value).__name__
    )


def run_of(scenario, controller, settings):
    import stewart_drake as sd

    try:
        loaded = sd.load_scenario(scenario, controller, settings)
        result = sd.simulate(loaded)
    except Exception as error:  # a refusal is recorded as it is worded
        return {"error": f"{type(error).__name__}: {error}"}, None
    s = dict(result.summary)
    shape = keys({k: v for k, v in s.items() if k not in ("scenario", "versions")})
    torques = result.signals["torque_applied"].values
    return {"status": result.status, "E_ac": s["accumulated_error"], "keys": shape}, torques


def rows():
    from stewart_drake.files.resources import shipped

    for scenario in shipped("scenario"):
        for controller in shipped("controller"):
            servo = ("actuator.kind=servo",) if controller.startswith("servo") else ()
            yield f"{scenario}/{controller}", scenario, controller, ("plant.kind=exact", *servo)
    for name, (controller, settings) in CONDITIONS.items():
        kind = (
            ()
            if any(x.startswith(("plant.kind", "overlay=paper_plant")) for x in settings)
            else ("plant.kind=exact",)
        )
        yield f"paper+{name}", "paper", controller, (*kind, *settings)


def one(row):
    name, *rest = row
    return name, run_of(*rest)


def record_runs(found, arrays):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for name, (told, torques) in pool.map(one, list(rows())):
            found[name] = told
            if torques is not None:
                arrays[name] = torques


def record_analyses(found, arrays):
    import stewart_drake as sd

    calls = {
        "hautus": lambda: sd.analyze_hautus("paper"),
        "workspace": lambda: sd.analyze_workspace("desktop"),
        "delay": lambda: sd.analyze_delay("desktop", simulations=False),
        "robustness": lambda: sd.analyze_robustness("desktop", 10, seed=3),
        "link": lambda: sd.analyze_link(
            sd.load_scenario(
                "desktop", None, ("link.kind=network", "link.low=0.05", "link.high=0.1")
            ),
            1,
        ),
        "layout": lambda: sd.layout("desktop", starts=1, generations=2, best=1),
    }
    for name, call in calls.items():
        try:
            found[name] = json.loads(
                json.dumps(
                    call().summary, default=lambda v: v.tolist() if hasattr(v, "tolist") else str(v)
                )
            )
        except Exception as error:
            found[name] = {"error": f"{type(error).__name__}: {error}"}


def record_identify(found, arrays):
    """Identify the machine of a short run from its signals, through the command."""
    with TemporaryDirectory() as folder:
        run = ["simulate", "desktop", "--set", "plant.kind=exact", "--set", "overlay=dirty"]
        _json_of([*run, "--set", "duration=3", "--out", folder])
        log = ["identify", f"{folder}/signals.nc", "--mechanism", "desktop"]
        told = _json_of([*log, "--out", f"{folder}/machine"])
        found["desktop"] = json.loads(json.dumps(told).replace(folder, ""))


def _json_of(arguments):
    from stewart_drake.cli import main

    with contextlib.redirect_stdout(io.StringIO()) as said:
        status = main([*arguments, "--json"])
    return {"status": status} | json.loads(said.getvalue())


def record_commands(found, arrays):
    from stewart_drake.cli import _command

    def walk(command, name):
        found[name] = sorted(o for p in command.params for o in (*p.opts, *p.secondary_opts))
        for word, sub in getattr(command, "commands", {}).items():
            walk(sub, f"{name} {word}")

    walk(_command(), "stewart-drake")


def record_names(found, arrays):
    import stewart_drake as sd

    found["sd"] = sorted(sd.__all__)


SECTIONS = {
    "runs": record_runs,
    "analyses": record_analyses,
    "identify": record_identify,
    "commands": record_commands,
    "names": record_names,
}


def write(path, *sections):
    found, arrays = {}, {}
    for section in sections or SECTIONS:
        found[section] = {}
        SECTIONS[section](found[section], arrays)
    Path(path).with_suffix(".json").write_text(json.dumps(found, indent=1))
    np.savez_compressed(Path(path).with_suffix(".npz"), **arrays)


def differences(old, new, place=""):
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(old.keys() | new.keys()):
            if key not in new:
                yield f"{place}/{key}: gone"
            elif key not in old:
                yield f"{place}/{key}: new"
            else:
                yield from differences(old[key], new[key], f"{place}/{key}")
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for i, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from differences(a, b, f"{place}[{i}]")
    elif isinstance(old, float) and isinstance(new, float):
        if not (
            old == new
            or (old != old and new != new)
            or abs(old - new) <= 1e-9 * max(abs(old), abs(new))
        ):
            yield f"{place}: {old!r} -> {new!r}"
    elif old != new:
        yield f"{place}: {old!r} -> {new!r}"


def compare(old, new):
    a, b = (json.loads(Path(p).with_suffix(".json").read_text()) for p in (old, new))
    for line in differences(a, b):
        print(line[:300])
    a, b = (np.load(Path(p).with_suffix(".npz")) for p in (old, new))
    worst = 0.0
    for name in sorted(set(a.files) & set(b.files)):
        x, y = a[name], b[name]
        if x.shape != y.shape:
            print(f"{name}: shape {x.shape} -> {y.shape}")
            continue
        error = np.nanmax(np.abs(x - y)) / max(np.nanmax(np.abs(x)), 1e-300)
        worst = max(worst, error)
        if error > 1e-12:
            print(f"{name}: torques differ by {error:.1e} of the peak")
    print(f"{len(a.files)} and {len(b.files)} runs; largest difference {worst:.1e} of the peak")


if __name__ == "__main__":
    {"write": write, "compare": compare}[sys.argv[1]](*sys.argv[2:])
