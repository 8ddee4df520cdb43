"""The paper's Table II: what it prints, what its law gives as printed, and what reproduces it."""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Final

from stewart_drake.loop.experiment import assemble, check_instants
from stewart_drake.loop.results import SimulationResult
from stewart_drake.reporting.document import Block, Cell, Paragraph, Table
from stewart_drake.reporting.words import number
from stewart_drake.scenario.config import ControllerConfig, Scenario
from stewart_drake.scenario.reference_config import SineConfig
from stewart_drake.studies.compare import PAPER_ERRORS, is_papers, label
from stewart_drake.studies.reach import largest_factor

_COLUMNS: Final = {
    "controller": "\ncontroller",
    "paper [%\u00a0s]": "paper\n% s",
    "as printed [%\u00a0s]": "as printed\n% s",
    "reproduced [%\u00a0s]": "reproduced\n% s",
    "below LQR [%]": "below LQR\n%",
}
_CAPTION: Final = "Table II of the paper: E_ac there, of its law as printed, and reproduced"
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


def base_of(row: str, scenario: Scenario) -> str:
    """The controller of a row: a row of the scenario's own says which it is."""
    return str(scenario.compare.get(row, {}).get("controller", row))


def paper_error(row: str, scenario: Scenario) -> str:
    """What the paper reports of a row's controller, in % s; a dash where it reports none."""
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
        list(_COLUMNS),
        [_row(name, run, results) for name, run in rows.items()],
        _CAPTION,
        brief=list(_COLUMNS.values()),
    )
    scenario = rows[added[0]].scenario
    told = [f"Conditions: {_conditions(scenario)}.", _why(scenario)]
    return [table, *(Paragraph(text, brief=True) for text in told)]


def _row(name: str, run: SimulationResult, results: Mapping[str, SimulationResult]) -> list[Cell]:
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
    assert isinstance(own, SineConfig) and isinstance(scenario.reference, SineConfig)
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
