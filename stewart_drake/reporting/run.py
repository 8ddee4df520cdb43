"""Documents of a run, of a comparison, and of the paper's Table II."""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Final

from stewart_drake.loop.preparation import assemble, check_instants
from stewart_drake.loop.results import SimulationResult
from stewart_drake.reporting.document import (
    Block,
    Caution,
    Document,
    Paragraph,
    Section,
    Table,
    Values,
    number,
)
from stewart_drake.scenario.config import ControllerConfig, Scenario
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.studies.compare import PAPER_ERRORS, is_papers, label
from stewart_drake.studies.verdict import loop_word
from stewart_drake.studies.workspace_map import largest_factor

_COLUMNS: Final = {
    "controller": "\ncontroller",
    "paper [%\u00a0s]": "paper\n% s",  # on a page, a head is broken before its unit only
    "E_ac [%\u00a0s]": "E_ac\n% s",
    "floor [%\u00a0s]": "floor\n% s",
    "cost": "cost\n-",
    "commanded peak [N\u00a0m]": "asked\nN m",
    "applied peak [N\u00a0m]": "acted\nN m",
    "rms [N\u00a0m]": None,
    "var. [N\u00a0m]": "var.\nN m",
    "step [ms]": "step\nms",
}
_NEARLY_ALL: Final = 0.9995
"""Share of samples with a measurement from which nothing is said of the others."""
_NOTE: Final = (
    "Floor: what the delay alone adds to E_ac. Cost: squared errors and their integrals by w_Q, "
    "and squared torques by w_R. N m: the largest torque that was asked for (commanded) and that "
    "acted (applied: within the motors' limit, after the delay; of a run that ends early the last "
    "ones never acted); total variation (var.) of the commanded ones, which shows trembling. Step: "
    "the controller's computing time, median."
)
_TWO_COLUMNS: Final = {
    "controller": "\ncontroller",
    "paper [%\u00a0s]": "paper\n% s",
    "as printed [%\u00a0s]": "as printed\n% s",
    "reproduced [%\u00a0s]": "reproduced\n% s",
    "below LQR [%]": "below LQR\n%",
}
_TWO_CAPTION: Final = "Table II of the paper: E_ac there, of its law as printed, and reproduced"
_PLANTS: Final = {
    "exact": "exact plant",
    "multibody": "multibody plant",
    "paper": "the paper's torque map, frozen at home, as plant",
}
_QUEUES: Final = {
    "reference": "the torques for it in flight",
    "equilibrium": "the torques that hold it in flight",
    "zero": "nothing in flight",
}
_MODELS: Final = {"multibody": "the plant's own", "paper": "the paper's"}


def run_document(result: SimulationResult) -> Document:
    """How one run ended, its errors, torques and computing times."""
    return Document("", "", [Section("", *run_blocks(result))])


def run_blocks(result: SimulationResult) -> list[Block]:
    """Return the blocks of `run_document`."""
    s = result.summary
    step, floor = s["controller_step_ms"], f"delay floor {number(s['delay_floor'])} % s"
    peaks = zip(COORDINATE_NAMES, s["peak_error"], strict=True)
    entries = {"status": result.status.replace("_", " ")}
    entries |= {name: f"{kind}, not the scenario's" for name, kind in s["own"].items()}
    if result.stopped is not None:
        entries["status"] += f" at {result.stopped.time:.3f} s"
        if result.status != "interrupted":
            entries["reason"] = result.stopped.reason
    share = s["measured_share"]
    if share < _NEARLY_ALL:
        floor += f", measured at {100 * share:.1f} % of the samples"
    entries |= {
        "E_ac": f"{number(s['accumulated_error'])} % s, {floor}"
        if math.isfinite(s["accumulated_error"])
        else f"none, {floor}",
        "peak error": ", ".join(f"{name} {number(value)}" for name, value in peaks)
        + " % of peak to peak",
        "torque": f"commanded peak {number(s['peak_torque'])}, rms {number(s['rms_torque'])} N m; "
        f"applied peak {number(s['peak_torque_applied'])} N m",
        "controller step": f"median {number(step['median'])}, worst {number(step['worst'])} ms",
        "wall time": f"{s['wall_s']:.1f} s",
    }
    entries |= {name.replace("_", " "): str(n) for name, n in s["counts"].items() if n}
    return [Values(entries), *map(Caution, s["warnings"])]


def comparison_document(results: Mapping[str, SimulationResult]) -> Document:
    """A row per controller; for the paper's experiment with the numbers of its Table II."""
    return Document("", "", [Section("", *comparison_blocks(results))])


def comparison_blocks(
    results: Mapping[str, SimulationResult], tuned: Mapping[str, SimulationResult] | None = None
) -> list[Block]:
    """Return the blocks of `comparison_document`, with the tuner's runs last."""
    table_two = table_two_blocks(results)
    papers = not table_two and any(
        is_papers(result.scenario, any_size=True) for result in results.values()
    )
    runs = [(label(name), name, run) for name, run in results.items()]
    runs += [(f"{label(name)}, tuned", name, run) for name, run in (tuned or {}).items()]
    rows = [comparison_row(title, name, run) for title, name, run in runs]
    kept = [k for k, head in enumerate(_COLUMNS) if papers or "paper" not in head]
    heads, brief = list(_COLUMNS), list(_COLUMNS.values())
    loops = "; ".join(
        f"{label(name)}: {loop_word(result.summary['controller_margin'])}"
        for name, result in results.items()
    )
    return [
        *table_two,
        Table(
            [heads[k] for k in kept],
            [[row[k] for k in kept] for row in rows],
            "Table II of the paper, and what comes out here" if papers else "",
            brief=[brief[k] for k in kept],
        ),
        Paragraph(_NOTE, brief=True),
        Paragraph(f"Loops, linearised along the reference: {loops}.", brief=True),
        *map(Caution, _shared_warnings(results)),
    ]


def comparison_row(title: str, name: str, run: SimulationResult) -> list[str]:
    """The cells of `comparison_blocks`; of a run that ended early how, in place of its errors."""
    s, stopped = run.summary, run.stopped
    errors: list[str] = [
        number(value) for value in (s["accumulated_error"], s["delay_floor"], s["cost"])
    ]
    if stopped is not None:
        leg = "" if stopped.leg is None else f", leg {stopped.leg}"
        errors = [f"{run.status.replace('_', ' ')}\nat {stopped.time:.2f} s{leg}", "-", "-"]
    torques = (s["peak_torque"], s["peak_torque_applied"], s["rms_torque"], s["torque_variation"])
    step = round(s["controller_step_ms"]["median"], 2)
    told = [*(number(value, 2) for value in torques), number(step, 2)]
    return [title, paper_error(name, run.scenario), *errors, *told]


def _shared_warnings(results: Mapping[str, SimulationResult]) -> list[str]:
    """Every warning of several runs once, with the controllers it is about unless these are all."""
    about: dict[str, list[str]] = {}
    for name, result in results.items():
        for text in result.summary["warnings"]:
            about.setdefault(text, []).append(label(name))
    return [
        text if len(names) == len(results) else f"{', '.join(names)}: {text}"
        for text, names in about.items()
    ]


def base_of(row: str, scenario: Scenario) -> str:
    """The controller of a row: a row of the scenario's own says which it is."""
    return str(scenario.compare.get(row, {}).get("controller", row))


def paper_error(row: str, scenario: Scenario) -> str:
    """Return the paper's E_ac of a row's controller in % s, or a dash."""
    name = base_of(row, scenario)
    if name not in PAPER_ERRORS:
        return "-"
    error = PAPER_ERRORS[name]
    return "NaN" if error is None else f"{error:.0f}"


def table_two_blocks(results: Mapping[str, SimulationResult]) -> list[Block]:
    """The table, its conditions, and why it needs them.

    Nothing where the scenario is not the paper's, or adds no rows of the paper's controllers.
    """
    rows = {
        name: run for name, run in results.items() if base_of(name, run.scenario) in PAPER_ERRORS
    }
    added = [name for name in rows if name not in PAPER_ERRORS]
    if not added or not all(is_papers(run.scenario, any_size=True) for run in rows.values()):
        return []
    table = Table(
        list(_TWO_COLUMNS),
        [_two_row(name, run, results) for name, run in rows.items()],
        _TWO_CAPTION,
        brief=list(_TWO_COLUMNS.values()),
    )
    scenario = rows[added[0]].scenario
    told = [f"Conditions: {_conditions(scenario)}.", _why(scenario)]
    return [table, *(Paragraph(text, brief=True) for text in told)]


def _two_row(
    name: str, run: SimulationResult, results: Mapping[str, SimulationResult]
) -> list[str]:
    base = base_of(name, run.scenario)
    printed, lqr = results.get(base), results.get("delay_lqr")
    below = math.nan
    if lqr is not None and base == "delay_lqi":
        below = 100 * (1 - run.accumulated_error / lqr.accumulated_error)
    title = label(name)
    if name != base:
        changes = [
            f"{field.name} {value:g}" if isinstance(value, float) else f"{field.name} {value}"
            for field in fields(ControllerConfig)
            if (value := getattr(run.scenario.controller, field.name))
            != (None if printed is None else getattr(printed.scenario.controller, field.name))
        ]
        title = f"{name}: {', '.join(changes)}"
    return [
        title,
        paper_error(name, run.scenario),
        "-" if printed is None else _outcome(printed),
        _outcome(run),
        number(below, 2),
    ]


def _outcome(run: SimulationResult) -> str:
    if run.stopped is None:
        return number(run.accumulated_error)
    return f"{run.status.split('_')[0]} {run.stopped.time:.2f} s"


def _conditions(scenario: Scenario) -> str:
    c, share = scenario.controller, _share(scenario)
    return ", ".join(
        [
            "(46) at its full size" if math.isclose(share, 1) else f"{share:.4g} of (46)",
            "started on the reference" if scenario.start == "on_reference" else "from rest",
            _QUEUES[scenario.queue],
            f"{c.prediction} prediction",
            "no feedforward" if c.feedforward == "none" else f"{c.feedforward} feedforward",
            f"model of the gain: {_MODELS[c.model]}",
            f"{c.weight_scaling} weights",
            f"w_Q/w_R = {c.w_Q / c.w_R:.4g}",
            _PLANTS[scenario.plant.kind],
        ]
    )


def _share(scenario: Scenario) -> float:
    """How large the motion is, of (46)."""
    own = Scenario().reference
    assert own.kind == "sine" and scenario.reference.kind == "sine"
    return scenario.reference.amplitude[0] / own.amplitude[0]


def _why(scenario: Scenario) -> str:
    """Why it takes them. At high gain x(t + eta) = x_d(t) + eta dx_d/dt, on a sine of 1 rad/s."""
    whole = assemble(Scenario())
    instants = check_instants(whole.scenario.duration)
    room = largest_factor(whole.mechanism, whole.reference, instants)
    return (
        "Not on the machine at full size: with a high gain the printed law moves the plate by "
        f"sqrt(1 + eta^2) = {math.hypot(1, scenario.eta):.2f} of the motion, where there is room "
        f"for {number(room.value)} of (46); and it loses smaller motions too, as the machine does "
        "not stay what it is within the delay (docs/theory.md, section 33)."
    )
