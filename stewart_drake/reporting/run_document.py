"""How one run went, and several beside each other."""

import math
from collections.abc import Mapping
from typing import Final

from stewart_drake.loop.results import SimulationResult
from stewart_drake.reporting.document import (
    Block,
    Caution,
    Cell,
    Document,
    Paragraph,
    Section,
    Table,
    Values,
)
from stewart_drake.reporting.table_two import paper_error, table_two_blocks
from stewart_drake.reporting.words import number
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.studies.compare import is_papers, label
from stewart_drake.studies.verdict import loop_word

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
    "ones never acted); total variation (var.) of the commanded ones, which tells trembling. Step: "
    "the controller's computing time, median."
)


def run_document(result: SimulationResult) -> Document:
    """How one run ended, its errors, torques and computing times."""
    return Document("", "", [Section("", *run_blocks(result))])


def run_blocks(result: SimulationResult) -> list[Block]:
    """What `run_document` holds."""
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
    """What `comparison_document` holds; the tuner's runs come after those with fixed weights."""
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


def comparison_row(title: str, name: str, run: SimulationResult) -> list[Cell]:
    """The cells of `comparison_blocks`; of a run that ended early how, in place of its errors."""
    s, stopped = run.summary, run.stopped
    errors: list[Cell] = [
        number(value) for value in (s["accumulated_error"], s["delay_floor"], s["cost"])
    ]
    if stopped is not None:
        leg = "" if stopped.leg is None else f", leg {stopped.leg}"
        errors = [f"{run.status.replace('_', ' ')} at {stopped.time:.2f} s{leg}", None, None]
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
