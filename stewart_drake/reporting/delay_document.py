"""What is told of an analysis of the delay."""

import math
from functools import partial
from typing import Final

from stewart_drake.law.servos import mean_inertia
from stewart_drake.loop.controller_margin import ControllerMargin
from stewart_drake.reporting.analysis_figures import growth_figure, loop_figure, map_figure
from stewart_drake.reporting.document import (
    Block,
    Document,
    Paragraph,
    Picture,
    Section,
    Table,
    Tone,
    Values,
)
from stewart_drake.reporting.words import capital, number
from stewart_drake.scenario.delay import Delay
from stewart_drake.studies.delay_limits import DelayStudy
from stewart_drake.studies.delay_loop import LoopMargins
from stewart_drake.studies.delay_map import Cell
from stewart_drake.studies.verdict import loop_verdict, milliseconds

_TONES: Final[dict[str, Tone]] = {"yes": "good", "hardly": "fair", "no": "bad"}

_BANDWIDTH: Final = 10.0
"""Hz, of the servos that torques are compared with."""
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
    "along the reference."
)
_LOOP_CAPTION: Final = "Peaks and tolerable errors over the delay; dotted: this scenario's own."
_SERVO_TEXT: Final = (
    "A law across the delay is needed where the delay is inside the actuator, or nothing may "
    "compute at the machine. Else position servos at the motors (actuator.kind servo, controllers "
    "servo_preview and servo_feedforward) are the answer, and under gravity with a long delay the "
    "only one: crank angles of the reference are sent ahead, and nothing waits for the delay. That "
    "is stiffness instead of knowledge, unless the model's torque is sent too."
)
_SERVO_CAPTION: Final = "Torques across the delay, or servos of 10 Hz that see their cranks."
_MAP_TEXT: Final = (
    "Simulations on the exact plant, everything else as in the scenario. E_ac is relative to each "
    "amplitude; in the figure, darker is further above the floor."
)
_MAP_WORDS: Final = {"out_of_reach": "no reach", "left_workspace": "left", "not_run": "not run"}


def document(study: DelayStudy) -> Document:
    """Poles, limits, margins and simulations."""
    verdict, tone = _verdict(study)
    sc, found = study.basis.experiment.scenario, study.basis
    sections = [_growth_section(study)] if study.poles else []
    sections += [_floor_section(study), _loop_section(study), _servo_section(study)]
    if study.cells:
        text = "Interrupted: not all simulations were run."
        more = [Paragraph(text, brief=True)] * study.interrupted
        caption = "E_ac over delay and amplitude; hatched where the motion was not completed."
        figure = Picture(partial(map_figure, study), caption)
        table = _map_table(study)
        sections.append(Section("What is achieved", _MAP_TEXT, *more, table, figure))
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
    return Document("Does this loop bear its delay?", verdict, sections, tone, facts)


def _verdict(study: DelayStudy) -> tuple[str, Tone]:
    """The answer in a few sentences, and how good it is."""
    obstacles = " ".join(study.basis.obstacles)
    if study.verdict is None:
        return f"{obstacles} There is no motion along which a delay could be judged.", "bad"
    loop, tone = study.controller, _TONES[study.verdict.beatable]
    sentences = [*study.basis.obstacles]
    if loop is not None:
        sentences.append(f"{capital(loop_verdict(loop))}.{_knowledge(loop)}")
        if loop.stable is False:
            tone = "bad"
        elif tone == "good" and (loop.problem or loop.delay_margin < FRAGILE * study.eta):
            tone = "fair"
    sentences.append(capital(str(study.verdict)) + ".")
    return " ".join(sentences), "bad" if obstacles else tone


def _knowledge(loop: ControllerMargin) -> str:
    """How well the delay must be known, of a stable loop."""
    if not loop.stable or loop.eta == 0 or not math.isfinite(loop.delay_margin):
        return ""
    return f" The delay must be known to {number(100 * loop.delay_margin / loop.eta, 2)} %."


def _growth_section(study: DelayStudy) -> Section:
    limits = [
        (f"{a:g}", f"{delay:.3g}", f"{t:.2f}") if math.isfinite(delay) else (f"{a:g}", "any", "-")
        for a, delay, t in study.limits
    ]
    caption = "Largest delay, by how much a prediction error may grow."
    columns = ("tolerable growth", "largest delay  [s]", "set at t  [s]")
    parts: list[Block | str] = [*_GROWTH_TEXT, Table(columns, limits, caption, brief=True)]
    if study.growths:
        checks = [
            (f"{g.time:.2f}", f"{g.seconds:.3g}", number(g.expected), number(g.simulated))
            for g in study.growths
        ]
        head = ("t  [s]", "over  [s]", "e^(pη)", "simulated growth")
        caption = "Checked: a tiny perturbation of the plate held still, all equations nonlinear."
        parts.append(Table(head, checks, caption))
    caption = "Poles along the reference, and growth over the delay."
    return Section("The open loop", *parts, Picture(partial(growth_figure, study), caption))


def _floor_section(study: DelayStudy) -> Section:
    sc = study.basis.experiment.scenario
    rows = [
        (
            str(s),
            f"{Delay(s, sc.true_delay.fraction).eta(sc.controller.period):.4g}",
            f"{value:.2f}",
        )
        for s, value in sorted(study.floors.items())
    ]
    table = Table(("μ", "delay  [s]", "floor of E_ac  [% s]"), rows)
    own = f"{number(study.floors[sc.true_delay.steps])} % s with this delay. "
    applies = (
        "It applies to this scenario."
        if study.floor_applies
        else "This scenario starts otherwise, so that the floor does not apply to it."
    )
    return Section("The floor of the error", _FLOOR_TEXT, Paragraph(own + applies, True), table)


def _loop_section(study: DelayStudy) -> Section:
    loop, parts = study.loop, list[Block | str]()
    if study.loop_problem:
        parts.append(Paragraph(f"Not judged: {study.loop_problem}.", brief=True))
    if loop is not None and loop.radius < 1:
        motor = loop.motor and (
            f"; one motor {_gains(loop.motor.gain_down, loop.motor.gain_up)}, "
            f"phase {number(loop.motor.phase)} deg"
        )
        entries = {
            "sensitivity": f"peak of S {number(loop.S.value)} at {number(loop.S.frequency)} rad/s, "
            f"of T {number(loop.T.value)} at {number(loop.T.frequency)} rad/s",
            "gain margin": f"all motors {_gains(loop.gain_down, loop.gain_up)}{motor or ''}",
            "delay margin": f"{milliseconds(loop.later)} longer, "
            f"{milliseconds(loop.earlier)} shorter",
        }
        parts += [Paragraph("At the first pose, with this delay:", brief=True), Values(entries)]
    if study.loops:
        parts += [_LOOP_TEXT, _loop_table(study.loops)]
    if any(one.radius < 1 for one in study.loops):
        parts.append(Picture(partial(loop_figure, study), _LOOP_CAPTION))
    return Section("The closed loop", *parts)


def _servo_section(study: DelayStudy) -> Section:
    """When a law across the delay is needed, and when loops at the motors are the answer."""
    loop, verdict = study.controller, study.verdict
    stiffness = mean_inertia(study.basis.experiment.nominal) * (2 * math.pi * _BANDWIDTH) ** 2
    knows = loop is not None and loop.stable and math.isfinite(loop.delay_margin)
    rows = [
        (
            "an error of the state grows, before it is answered",
            "-" if verdict is None else f"{number(verdict.amplification)} fold",
            "hardly: it is answered within a ms",
        ),
        (
            "an unknown torque of 1 mN m at a shaft",
            "is found, and answered a delay later",
            f"leaves {number(1.0 / stiffness)} mrad at the crank",
        ),
        (
            "a delay that is not known",
            f"bears {milliseconds(loop.delay_margin)}" if loop and knows else "must be estimated",
            "never unstable; as late as that",
        ),
        ("a plate that is not where its cranks say", "is seen and corrected", "is not seen"),
        ("a push on the plate", "is answered a delay later", "gives way as stiffness allows"),
        ("needs", "a measured plate, nothing at the machine", "a fast loop at each motor"),
    ]
    head = ("", "torques across the delay", "servos at the motors")
    return Section("Torques, or servos", _SERVO_TEXT, Table(head, rows, _SERVO_CAPTION))


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


def _map_table(study: DelayStudy) -> Table:
    steps = sorted({cell.steps for cell in study.cells})
    factors = sorted({cell.factor for cell in study.cells})
    cells = {(cell.steps, cell.factor): cell for cell in study.cells}
    rows = [
        (f"{100 * factor:.0f} %", *(_cell_word(cells[s, factor]) for s in steps))
        for factor in reversed(factors)
    ]
    if study.floor_applies:
        rows.append(("floor", *(number(study.floors[s]) for s in steps)))
    caption = "E_ac in % s over the delay of mu periods and the amplitude, exact plant."
    if any(cell.status != "completed" for cell in study.cells):
        caption += " No reach: the motion leaves the workspace, left: the plate does, after s."
    return Table(("amplitude", *(f"mu = {s}" for s in steps)), rows, caption, brief=True)


def _cell_word(cell: Cell) -> str:
    if cell.status == "completed":
        return number(cell.error)
    word = _MAP_WORDS.get(cell.status, "failed")
    return word if math.isnan(cell.time) else f"{word} {cell.time:.2f}"


def _gains(down: float, up: float) -> str:
    return f"{down:.3f} to {up:.3f}" if math.isfinite(up) else f"{down:.3f} to ∞"
