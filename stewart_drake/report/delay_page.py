"""The analysis of the delay for a terminal and as a page."""

import math
from typing import Final

from stewart_drake.loop.controller_margin import ControllerMargin
from stewart_drake.report.analysis_figures import growth_figure, loop_figure, map_figure
from stewart_drake.report.page import Page, Picture, Provenance, Section, Table, Tone
from stewart_drake.report.tables import number, rows, wrap
from stewart_drake.scenario.delay import Delay
from stewart_drake.studies.delay_limits import DelayStudy
from stewart_drake.studies.delay_loop import LoopMargins
from stewart_drake.studies.delay_map import Cell
from stewart_drake.studies.verdict import loop_verdict, milliseconds

_TONES: Final[dict[str, Tone]] = {"yes": "good", "hardly": "fair", "no": "bad"}

FRAGILE: Final = 0.05
"""Of the delay: a loop that bears less error of it is not called good."""

_GROWTH_TEXT: Final = (
    "An error of the predicted state, whatever its source, has the time η to grow before any "
    "torque can answer it: by e^(pη), with p the fastest pole of the open loop. No controller "
    "avoids that; the prediction must be better by this factor.",
    "In motion: linearised about the moving reference, with the torque that follows it. Held "
    "still: at rest at the same pose.",
)
_FLOOR_TEXT: Final = (
    "A plate at rest with nothing in flight that moves it stays where it is for η. What E_ac "
    "collects by then is a floor that no controller goes below."
)
_LOOP_TEXT: Final = (
    "The scenario's loop, linearised at the reference's first pose and cut at the motors. S is "
    "the sensitivity, T the complementary one; 1 / max |T| is the relative error of the motors, of "
    "any kind, that the loop bears for certain. The tolerable errors of gain and delay are found "
    "by the eigenvalues of the loop, all six motors being wrong by the same amount; for one motor "
    "alone they are its classical gain and phase margins. Feedforward and estimator have no part "
    "in this; an estimator may narrow the margins. The sentence on top is about the worst instant "
    "along the reference.",
)
_MAP_TEXT: Final = (
    "Simulations on the exact plant, everything else as in the scenario. E_ac in % s, relative to "
    "each amplitude; darker is further above the floor.",
)


def verdict(study: DelayStudy) -> tuple[str, Tone]:
    """The answer in a few sentences, and how good it is."""
    obstacles = " ".join(study.basis.obstacles)
    if study.verdict is None:
        return f"{obstacles} There is no motion along which a delay could be judged.", "bad"
    loop, tone = study.controller, _TONES[study.verdict.beatable]
    sentences = [*study.basis.obstacles]
    if loop is not None:
        sentences.append(f"{_capital(loop_verdict(loop))}.{_knowledge(loop)}")
        if loop.stable is False:
            tone = "bad"
        elif loop.stable and tone == "good" and loop.delay_margin < FRAGILE * study.eta:
            tone = "fair"
    sentences.append(_capital(str(study.verdict)) + ".")
    return " ".join(sentences), "bad" if obstacles else tone


def delay_table(study: DelayStudy) -> str:
    """Poles, limits, margins and simulations in 80 columns."""
    sc = study.basis.experiment.scenario
    entries = {}
    if study.limits:
        entries["largest delay"] = ", ".join(
            f"{_seconds(delay)} for a growth of {a:g}" for a, delay, _ in study.limits
        )
    floor = f"{number(study.floors[sc.true_delay.steps])} % s of a plate that waits at rest"
    entries["floor of E_ac"] = floor + ("" if study.floor_applies else " (does not apply here)")
    loop = study.loop
    if loop is not None and loop.radius < 1:
        entries["sensitivity"] = (
            f"peak of S {number(loop.S.value)} at {number(loop.S.frequency)} rad/s, of T "
            f"{number(loop.T.value)} at {number(loop.T.frequency)} rad/s"
        )
        entries["gain margin"] = (
            f"at the first pose, all motors {_gains(loop.gain_down, loop.gain_up)}"
            + (
                f", one motor {_gains(loop.motor.gain_down, loop.motor.gain_up)}, "
                f"phase {number(loop.motor.phase)} deg"
                if loop.motor
                else ""
            )
        )
        entries["delay margin"] = (
            f"at the first pose, {milliseconds(loop.later)} longer, "
            f"{milliseconds(loop.earlier)} shorter"
        )
    if study.loop_problem:
        entries["closed loop"] = study.loop_problem
    lines = [wrap(verdict(study)[0]), "", rows(entries)]
    if study.cells:
        lines += [
            "",
            "E_ac in % s over the delay of mu periods and the amplitude, exact plant",
            _map_table(study),
        ]
        if any(cell.status != "completed" for cell in study.cells):
            lines.append("no reach: the motion leaves the workspace, left: the plate does, after s")
    if study.interrupted:
        lines.append("interrupted: not all simulations were run")
    return "\n".join(lines)


def delay_page(study: DelayStudy, made: Provenance) -> Page:
    """The analysis as a page."""
    text, tone = verdict(study)
    sc, found = study.basis.experiment.scenario, study.basis
    sections = []
    if study.poles:
        sections.append(_growth_section(study))
    sections.append(_floor_section(study))
    if study.loops:
        pictures = []
        if any(loop.radius < 1 for loop in study.loops):
            caption = "Peaks and tolerable errors over the delay; dotted: this scenario's own."
            pictures = [Picture(loop_figure(study), caption)]
        tables = [_loop_table(study.loops)]
        sections.append(Section("The closed loop", _LOOP_TEXT, tables, pictures))
    else:
        sections.append(Section("The closed loop", (f"Not judged: {study.loop_problem}.",)))
    if study.cells:
        caption = "E_ac over delay and amplitude; hatched where the motion was not completed."
        more = ("Ctrl-C ended the simulations early.",) if study.interrupted else ()
        sections.append(
            Section(
                "What is achieved",
                (*_MAP_TEXT, *more),
                pictures=[Picture(map_figure(study), caption)],
            )
        )
    c = sc.controller
    facts = {
        "mechanism": found.experiment.mechanism.name,
        "gravity": "yes" if sc.plant.gravity else "no",
        "delay": f"{study.eta:.4g} s: μ = {sc.true_delay.steps} periods of {c.period:g} s, "
        f"fraction {sc.true_delay.fraction:g}",
        "controller": f"model {c.model}, prediction {c.prediction}, weights {c.weight_scaling}, "
        f"w_Q = {c.w_Q:g}, w_R = {c.w_R:g}",
        "start": f"{sc.start.replace('_', ' ')}, torques in flight: {sc.queue}",
    }
    return Page("Does this loop bear its delay?", text, sections, made, tone, facts)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _knowledge(loop: ControllerMargin) -> str:
    """How well the delay must be known, of a stable loop."""
    if not loop.stable or loop.eta == 0 or not math.isfinite(loop.delay_margin):
        return ""
    return f" The delay must be known to {number(100 * loop.delay_margin / loop.eta, 2)} %."


def _growth_section(study: DelayStudy) -> Section:
    limits = [
        (f"{a:g}", _seconds(delay), f"{t:.2f}" if math.isfinite(delay) else "-")
        for a, delay, t in study.limits
    ]
    tables = [
        Table(
            ("tolerable growth", "largest delay", "set at t  [s]"),
            limits,
            "Largest delay, by how much a prediction error may grow.",
        )
    ]
    if study.growths:
        checks = [
            (f"{g.time:.2f}", f"{g.seconds:.3g}", number(g.expected), number(g.simulated))
            for g in study.growths
        ]
        head = ("t  [s]", "over  [s]", "e^(pη)", "simulated growth")
        caption = "Checked: a tiny perturbation of the plate held still, all equations nonlinear."
        tables.append(Table(head, checks, caption))
    picture = Picture(growth_figure(study), "Poles along the reference, and growth over the delay.")
    return Section("The open loop", _GROWTH_TEXT, tables, [picture])


def _floor_section(study: DelayStudy) -> Section:
    sc = study.basis.experiment.scenario
    table = Table(
        ("μ", "delay  [s]", "floor of E_ac  [% s]"),
        [
            (
                str(s),
                f"{Delay(s, sc.true_delay.fraction).eta(sc.controller.period):.4g}",
                f"{value:.2f}",
            )
            for s, value in sorted(study.floors.items())
        ],
    )
    applies = (
        "It applies to this scenario."
        if study.floor_applies
        else "This scenario starts otherwise, so that the floor does not apply to it."
    )
    return Section("The floor of the error", (_FLOOR_TEXT, applies), [table])


def _loop_table(loops: tuple[LoopMargins, ...]) -> Table:
    head = ("μ", "spectral radius", "max |S|", "max |T|", "gain, all motors", "gain, one motor")
    lines = []
    for m in loops:
        motor = m.motor
        stable = m.radius < 1
        lines.append(
            (
                str(m.steps),
                f"{m.radius:.4f}",
                number(m.S.value),
                number(m.T.value),
                _gains(m.gain_down, m.gain_up) if stable else "unstable",
                _gains(motor.gain_down, motor.gain_up) if motor else "-",
                number(motor.phase) if motor else "-",
                number(1e3 * m.later) if stable else "-",
                number(1e3 * m.earlier) if stable else "-",
            )
        )
    columns = (*head, "phase, one motor  [deg]", "delay longer by  [ms]", "shorter by  [ms]")
    return Table(columns, lines, "What the loop bears at each delay, designed for that delay.")


def _map_table(study: DelayStudy) -> str:
    steps = sorted({cell.steps for cell in study.cells})
    factors = sorted({cell.factor for cell in study.cells})
    cells = {(cell.steps, cell.factor): cell for cell in study.cells}
    lines = ["amplitude" + "".join(f"{f'mu = {s}':>14}" for s in steps)]
    for factor in reversed(factors):
        words = "".join(f"{_cell_word(cells[s, factor]):>14}" for s in steps)
        lines.append(f"{100 * factor:>7.0f} %{words}")
    if study.floor_applies:
        floors = "".join(f"{number(study.floors[s]):>14}" for s in steps)
        lines.append(f"{'floor':<9}{floors}")
    return "\n".join(lines)


def _cell_word(cell: Cell) -> str:
    if cell.status == "completed":
        return number(cell.error)
    words = {"out_of_reach": "no reach", "left_workspace": "left", "not_run": "not run"}
    word = words.get(cell.status, "failed")
    return word if math.isnan(cell.time) else f"{word} {cell.time:.2f}"


def _gains(down: float, up: float) -> str:
    return f"{down:.3f} to {up:.3f}" if math.isfinite(up) else f"{down:.3f} to ∞"


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if math.isfinite(value) else "any delay"
