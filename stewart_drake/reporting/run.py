"""Documents of a run, and of a comparison with the paper's Table II."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields
from typing import Any, Final

import numpy as np

from stewart_drake.loop.preparation import check_instants, prepare_unchecked
from stewart_drake.loop.results import (
    LEAST_MEASURED,
    STILL,
    SimulationResult,
    second_half,
    waits_at_rest,
)
from stewart_drake.reporting.document import Document, counted, from_template, measured, number
from stewart_drake.reporting.style import FACTORS, TORQUES, UNITS, unit_for
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.link import number_sent
from stewart_drake.scenario.signals import (
    ANGLES,
    BIAS,
    CONSTANTS,
    COORDINATE_NAMES,
    NUM_COORDINATES,
    PARAMETERS,
    PLANT_PARAMETER_UNITS,
    PLANT_PARAMETERS,
    POSITION,
)
from stewart_drake.studies.compare import PAPER_ERRORS, is_papers, label
from stewart_drake.studies.verdict import loop_word
from stewart_drake.studies.workspace_map import largest_factor
from stewart_drake.types import Array, Flags

_EVENTS: Final = {
    "riccati_failures": "samples without a new gain",
    "unreachable": "samples with a predicted pose that is out of reach or singular",
    "nonfinite_torque": "samples with a torque that was not finite",
    "measurements_missing": "samples without a new measurement",
    "saturated_steps": "samples with a torque at the limit",
    "limited_steps": "samples with a limit within the horizon",
    "qp_failures": "samples without a plan within the limits",
    "qp_late": "samples with a plan that was late",
    "tuner_fallbacks": "fallbacks of the tuner",
}
"""Events whose names do not say what is counted; the first word is a plural."""
_MAY_BE_LATE: Final = (
    "a late measurement is used at the sample at which it comes, unless a newer one has come"
)

FINER: Final = {
    "N m": TORQUES,
    "N m s/rad": {"N m s/rad": 1.0, "mN m s/rad": 1e3, "µN m s/rad": 1e6},
    "kg": {"kg": 1.0, "g": 1e3},
    "m": {"m": 1.0, "mm": 1e3},
}
"""Units of a parameter's value, by its SI unit."""

_Runs = Mapping[str, SimulationResult]


def run_document(result: SimulationResult, said: Collection[str] = ()) -> Document:
    """Return status, errors, torques and computing times of a run.

    Warnings in `said` were printed before and are left out.
    """
    s, unmeasured = result.summary, 100 * (1 - result.summary["measured_share"])
    return from_template(
        "run",
        run=result,
        torqueless=torqueless(result),
        s=s,
        peaks=", ".join(_peaks(result, result.summary["peak_error"])),
        second_half=late_error(result),
        floor=waits_at_rest(result.scenario),
        delay=measured(2e3 * s["delay"]["std_s"], 1e3 * s["delay"]["estimated_s"]),
        estimates=_estimates(result),
        held=_held(result),
        least=LEAST_MEASURED,
        # the sum of others is left out
        events=[f"{unmeasured:.1f} % of the samples without a usable measurement"]
        * (unmeasured > 0.05)
        + [
            counted(n, _EVENTS.get(name, name.replace("_", " ")))
            for name, n in s["counts"].items()
            if n and name != "bad_measurements"
        ],
        late=_MAY_BE_LATE if result.scenario.link.back and "live" not in s else "",
        packets=[(n, name) for name, n in s["packets"].items()],
        cautions=[text for text in s["warnings"] if text not in said],
    )


def torqueless(run: SimulationResult) -> bool:
    """Return whether a run completed without one finite torque of its controller."""
    samples = number_sent(run.scenario.duration, run.scenario.controller.period)
    return run.status == "completed" and run.summary["counts"]["nonfinite_torque"] >= samples


def _estimates(run: SimulationResult) -> list[str]:
    """Return the estimated parameters without torque biases and offsets, with two deviations."""
    shown = []
    for name, unit in zip(PLANT_PARAMETERS, PLANT_PARAMETER_UNITS, strict=True):
        found = run.summary["estimates"].get(name)
        if found is not None and name not in PARAMETERS[BIAS]:
            unit, factor = unit_for(2 * found["std"], FINER.get(unit, {unit: 1.0}))
            width, value = measured(2 * factor * found["std"], factor * found["value"])
            shown.append(f"{name.replace('_', ' ')} {value} ± {width} {unit}")
    return shown


def _held(run: SimulationResult) -> str:
    """Return how many true values lie within two deviations; empty where none are known."""
    found, true = run.summary["estimates"], run.scenario.plant_parameters
    errors = [
        abs(found[name]["value"] - value) / found[name]["std"]
        for name, value in zip(CONSTANTS, true, strict=True)
        if name in found and found[name]["std"] > 0
    ]
    if "live" in run.summary or not errors:
        return ""
    return f"; {sum(error <= 2 for error in errors)} of {len(errors)} true values are within"


def span(poses: Array) -> Array:
    """Return the peak to peak (6,) of poses (n, 6), which may be none."""
    return np.ptp(poses, axis=0) if len(poses) else np.zeros(NUM_COORDINATES)


def moving(run: SimulationResult) -> Flags:
    """Return which coordinates (6,) the reference moves."""
    return span(run.signals.reference.values) > STILL


def _peaks(run: SimulationResult, percent: Sequence[float], rows: slice = slice(None)) -> list[str]:
    """Return the largest error of each coordinate in some rows, of a moving one also in `percent`.

    The percentage is that of the whole motion, of which a lost run has a part only.
    """
    moved, errors = moving(run), np.abs(run.signals.error.values[rows])
    largest = FACTORS * np.fmax.reduce(errors, axis=0, initial=np.nan)  # leaves out NaN
    return [
        f"{name} {number(round(float(largest[k]), 9))} {UNITS[k]}"
        + f" ({number(percent[k], 2)} %)" * bool(moved[k])
        for k, name in enumerate(COORDINATE_NAMES)
    ]


def late_error(run: SimulationResult) -> str:
    """Return the rms errors of angle and position as text; empty for a lost run."""
    reference, found = run.signals.reference.values, run.summary["rms_error"]
    if run.status != "completed" or not math.isfinite(found["angle_deg"]):
        return ""
    errors = f"{number(found['angle_deg'], 2)} deg, {number(found['position_mm'], 2)} mm"
    rests = bool(second_half(reference).stop < len(reference))
    return f"{errors} in the second half{' of the motion' * rests}"


def worst(
    run: SimulationResult, peaks: Sequence[float] | None = None, rows: slice = slice(None)
) -> str:
    """Return the coordinate with the largest error, of `rows` or of the run, as in `_peaks`.

    The error of a still coordinate is compared with the largest motion in its unit, or with 1 rad
    or 1 m, as in E_ac, if there is none.
    """
    peaks = run.summary["peak_error"] if peaks is None else peaks
    return _peaks(run, peaks, rows)[_worst(run, peaks)]


def _worst(run: SimulationResult, peaks: Sequence[float]) -> int:
    motion = span(run.signals.reference.values)
    largest = np.repeat([motion[ANGLES].max(), motion[POSITION].max()], 3)
    share = np.array(peaks) / np.where(moving(run) | (largest <= STILL), 1.0, largest)
    return int(np.argmax(share))


def comparison_document(
    results: _Runs,
    tuned: _Runs | None = None,
    said: Collection[str] = (),
    own: SimulationResult | None = None,
) -> Document:
    """Return a row per controller, the tuner's runs last; that of the run `own` is marked.

    A first section has the paper's Table II, if the scenario is the paper's and adds rows of its
    controllers. Warnings in `said` were printed before and are left out.
    """
    paper = {name: run for name, run in results.items() if _base(name, run) in PAPER_ERRORS}
    added = [name for name in paper if name not in PAPER_ERRORS]
    table_two = bool(added) and all(
        is_papers(one.scenario, any_size=True) for one in paper.values()
    )
    context: dict[str, Any] = {}
    if table_two:
        whole, sc = prepare_unchecked(Scenario()), paper[added[0]].scenario
        assert whole.scenario.reference.kind == "sine" and sc.reference.kind == "sine"
        instants = check_instants(whole.scenario.duration)
        context = {
            "sc": sc,
            "share": sc.reference.amplitude[0] / whole.scenario.reference.amplitude[0],
            # At high gain x(t + eta) = x_d(t) + eta dx_d/dt, for a sine of 1 rad/s.
            "overshoot": math.hypot(1, sc.eta),
            "room": largest_factor(whole.mechanism, whole.reference, instants),
        }
    mark = {id(own): ", this run"}
    runs = [(label(name) + mark.get(id(run), ""), name, run) for name, run in results.items()]
    runs += [
        (f"{label(name)}, tuned", f"{name}, tuned", run) for name, run in (tuned or {}).items()
    ]
    margins = {name: run.summary["controller_margin"] for name, run in results.items()}
    lost = [margins[name] for name, run in results.items() if run.status == "left_workspace"]
    return from_template(
        "comparison",
        verdict=_best({name: run for _, name, run in runs}),
        table_two=table_two and [_two_row(name, run, results) for name, run in paper.items()],
        papers=not table_two
        and any(is_papers(run.scenario, any_size=True) for run in paper.values()),
        weighted=len({tuple(run.scenario.controller.weights) for _, _, run in runs}) > 1,
        runs=[_row(title, name, run) for title, name, run in runs],
        loops=[(name, label(name), loop_word(margin)) for name, margin in margins.items()],
        surprising=any(margin and margin["stable"] for margin in lost),
        servos=all(run.scenario.actuator.kind == "position_servo" for run in results.values()),
        both=len({run.scenario.controller.command for run in results.values()}) > 1,
        cautions=_shared_warnings(results, said),
        **context,
    )


def _best(runs: _Runs) -> str:
    """Return which run has the least error, and which ended early or had no torque."""
    idle = [name for name, run in runs.items() if torqueless(run)]
    early = [name for name, run in runs.items() if run.stopped is not None]
    if len(early) == len(runs):
        return "no run completed"
    errors = {n: e for n, run in runs.items() if math.isfinite(e := run.accumulated_error)}
    errors = {name: error for name, error in errors.items() if name not in idle}
    least = min(errors, key=errors.__getitem__, default="")
    parts = [f"least error: {least}, E_ac {number(errors[least])} % s"] if least else []
    ends = {"ended early": early, "no finite torque": idle}
    return "; ".join([*parts, *(f"{end}: {', '.join(some)}" for end, some in ends.items() if some)])


def _row(title: str, name: str, run: SimulationResult) -> dict[str, Any]:
    """Return a row of the comparison; one lost or without a torque shows that, no errors."""
    s, stopped = run.summary, run.stopped
    late = late_error(run).partition(" deg")[0] or "-"
    row = {"late": late, "title": title, "name": name, "paper": _paper_error(name, run), "s": s}
    if torqueless(run):
        return row | {"error": "no finite\ntorque", "worst": "-", "floor": "-", "cost": "-"}
    if stopped is None:
        floor = s["delay_floor"] if waits_at_rest(run.scenario) else "-"
        numbers = {"error": s["accumulated_error"], "floor": floor, "cost": s["cost"]}
        peaks = run.summary["peak_error"]
        k = _worst(run, peaks)
        of_moving = f"{COORDINATE_NAMES[k]} {number(peaks[k], 2)} %"
        return row | numbers | {"worst": of_moving if moving(run)[k] else worst(run)}
    leg = "" if stopped.leg is None else f",\nleg {stopped.leg}"
    ended = f"{run.status.replace('_', ' ')}\nat {stopped.time:.2f} s{leg}"
    return row | {"error": ended, "worst": "-", "floor": "-", "cost": "-"}


def _shared_warnings(results: _Runs, said: Collection[str]) -> list[str]:
    """Return every warning once, with the runs concerned; those of all in `said` are left out."""
    about: dict[str, list[str]] = {}
    for name, result in results.items():
        for text in result.summary["warnings"]:
            about.setdefault(text, []).append(name)
    every = "all runs: " * (len(results) > 1)
    return [
        (every if len(names) == len(results) else f"{', '.join(names)}: ") + text
        for text, names in about.items()
        if len(names) < len(results) or text not in said
    ]


def _base(row: str, run: SimulationResult) -> str:
    return str(run.scenario.compare.get(row, {}).get("controller", row))


def _paper_error(row: str, run: SimulationResult) -> str:
    """Return the paper's E_ac of a row's controller in % s, or a dash."""
    error = PAPER_ERRORS.get(_base(row, run), math.inf)
    return "NaN" if error is None else number(error, 2)


def _two_row(name: str, run: SimulationResult, results: _Runs) -> dict[str, Any]:
    """Return a row of the table that compares with the paper's Table II."""
    base = _base(name, run)
    printed, lqr = results.get(base), results.get("delay_lqr")
    below = math.nan
    if lqr is not None and base == "delay_lqi":
        below = 100 * (1 - run.accumulated_error / lqr.accumulated_error)
    title, before = label(name), printed and printed.scenario.controller
    if name != base:
        own = run.scenario.controller
        changes = [
            f"{one.name} {value:g}" if isinstance(value, float) else f"{one.name} {value}"
            for one in fields(own)
            if (value := getattr(own, one.name)) != getattr(before, one.name, None)
        ]
        title = f"{name}: {', '.join(changes)}"
    return {
        "title": title,
        "paper": _paper_error(name, run),
        "printed": "-" if printed is None else _outcome(printed),
        "reproduced": _outcome(run),
        "below": below,
    }


def _outcome(run: SimulationResult) -> str:
    if run.stopped is None:
        return number(run.accumulated_error)
    return f"{run.status.split('_')[0]} {run.stopped.time:.2f} s"
