"""Tables for a person at a terminal of 80 columns."""

import math
import re
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from stewart_drake.files.resources import Kind, resolve, shipped
from stewart_drake.loop.results import SimulationResult
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.studies.compare import PAPER_ERRORS, is_papers, label
from stewart_drake.studies.verdict import loop_word
from stewart_drake.tuner.density import NUM_INPUTS
from stewart_drake.tuner.network import NUM_OUTPUTS, load_network

WIDTH: Final = 80
_NO_BREAK: Final = "\N{NO-BREAK SPACE}"
_COLUMNS: Final = "{:<16}{:>5}{:>11}{:>11}{:>11}{:>7}{:>7}{:>7}{:>5}"
_NOTE: Final = (
    "floor: of E_ac, from the delay alone; cost: sum of squared errors and their\n"
    "integrals by w_Q, and of squared torques by w_R; N m: largest torque that was\n"
    "asked for (commanded) and that acted (applied: within the limit, after the\n"
    "delay), total variation of the commanded ones; step: the controller's computing\n"
    "time, median"
)


def wrap(text: str, first: str = "", rest: str = "  ") -> str:
    """One paragraph of at most WIDTH columns, its first line and the others opened as given."""
    together = re.sub(r"(?<=\d) (?=%|mm\b|ms\b|s\b)|(?<=beatable:) ", _NO_BREAK, text)
    filled = textwrap.fill(
        together, WIDTH, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
    )
    return filled.replace(_NO_BREAK, " ")


def rows(entries: Mapping[str, str]) -> str:
    """Names and texts in two columns, long texts wrapped."""
    indent = " " * (max(map(len, entries)) + 2)
    return "\n".join(wrap(text, name.ljust(len(indent)), indent) for name, text in entries.items())


def run_table(result: SimulationResult) -> str:
    """How one run ended, its errors, torques and computing times."""
    s = result.summary
    step, floor = s["controller_step_ms"], f"delay floor {number(s['delay_floor'])} % s"
    peaks = zip(COORDINATE_NAMES, s["peak_error"], strict=True)
    entries = {"status": result.status.replace("_", " ")}
    entries |= {name: f"{kind}, not the scenario's" for name, kind in s["own"].items()}
    if result.stopped is not None:
        entries["status"] += f" at {result.stopped.time:.3f} s"
        if result.status != "interrupted":
            entries["reason"] = result.stopped.reason
    entries |= {
        "E_ac": f"{number(s['accumulated_error'])} % s, {floor}"
        if result.status == "completed"
        else f"none, {floor}",
        "peak error": ", ".join(f"{name} {number(value)}" for name, value in peaks)
        + " % of peak to peak",
        "torque": f"commanded peak {number(s['peak_torque'])}, rms {number(s['rms_torque'])} N m; "
        f"applied peak {number(s['peak_torque_applied'])} N m",
        "controller step": f"median {number(step['median'])}, worst {number(step['worst'])} ms",
        "wall time": f"{s['wall_s']:.1f} s",
    }
    counts = {name.replace("_", " "): str(n) for name, n in s["counts"].items() if n}
    return "\n".join([rows(entries | counts), *warning_lines(s["warnings"])])


def warning_lines(warnings: Iterable[str]) -> list[str]:
    """A paragraph per warning."""
    return [wrap(f"warning: {text}") for text in warnings]


def shared_warnings(results: Mapping[str, SimulationResult]) -> list[str]:
    """Every warning of several runs once, with the controllers it is about unless these are all."""
    about: dict[str, list[str]] = {}
    for name, result in results.items():
        for text in result.summary["warnings"]:
            about.setdefault(text, []).append(label(name))
    return [
        text if len(names) == len(results) else f"{', '.join(names)}: {text}"
        for text, names in about.items()
    ]


def loops_sentence(results: Mapping[str, SimulationResult]) -> str:
    """Which loops are stable, linearised along the reference, one after the other."""
    found = [
        f"{label(name)}: {loop_word(result.summary['controller_margin'])}"
        for name, result in results.items()
    ]
    return "loops, linearised along the reference: " + "; ".join(found)


def comparison_table(results: Mapping[str, SimulationResult]) -> str:
    """One row per controller; for the paper's experiment with the numbers of its Table II."""
    papers = any(is_papers(result.scenario) for result in results.values())
    paper, unit = ("paper", "% s") if papers else ("", "")
    lines = [
        _COLUMNS.format("", paper, "E_ac", "floor", "cost", "asked", "acted", "var.", "step"),
        _COLUMNS.format("controller", unit, "% s", "% s", "-", "N m", "N m", "N m", "ms"),
    ]
    for name, result in results.items():
        s = result.summary
        if result.stopped is None:
            values = (s["accumulated_error"], s["delay_floor"], s["cost"])
            outcome = "".join(f"{number(value):>11}" for value in values)
        else:
            leg = "" if result.stopped.leg is None else f", leg {result.stopped.leg}"
            status = result.status.replace("_", " ")
            outcome = f"{f'{status} at {result.stopped.time:.2f} s{leg}':>33}"
        torques = (s["peak_torque"], s["peak_torque_applied"], s["torque_variation"])
        lines.append(
            f"{label(name):<16.16}{paper_error(name) if papers else '':>5}{outcome}"
            + "".join(f"{number(value, 2):>7}" for value in torques)
            + f"{number(round(s['controller_step_ms']['median'], 2), 2):>5}"
        )
    lines += [_NOTE, wrap(loops_sentence(results)), *warning_lines(shared_warnings(results))]
    return "\n".join(lines)


def shipped_table(kind: Kind) -> str:
    """The shipped files of a kind, each with the first sentence of the comment that opens it.

    A network, whose format has no comments, is described by what it is.
    """
    return rows({f"  {name}": _description(resolve(kind, name)) for name in shipped(kind)})


def _description(path: Path) -> str:
    if path.suffix == ".json":
        network = load_network(path)
        low, high = network.bounds.min(), network.bounds.max()
        return (
            f"A network of {NUM_INPUTS} densities ({network.density}), {network.hidden} hidden "
            f"neurons and {NUM_OUTPUTS} weights from {low:g} to {high:g}"
        )
    comment = re.match(r"(#.*\n)*", path.read_text(encoding="utf-8"))
    text = " ".join(line.strip("# ") for line in comment[0].splitlines()) if comment else ""
    return text.partition(". ")[0].rstrip(".")


def number(value: float, digits: int = 3) -> str:
    """So many significant digits; a dash where there is no number."""
    if not math.isfinite(value):
        return "-"
    if value != 0 and not 1e-4 <= abs(value) < 1e5:
        return f"{value:.0e}"
    decimals = digits - 1 - math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.{max(0, decimals)}f}"


def paper_error(name: str) -> str:
    """What the paper reports of a controller, in % s; a dash where it reports none."""
    if name not in PAPER_ERRORS:
        return "-"
    error = PAPER_ERRORS[name]
    return "NaN" if error is None else f"{error:.0f}"
