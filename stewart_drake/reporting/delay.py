"""Document and figures of an analysis of the delay."""

import math
from functools import partial
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from stewart_drake.law.servos import mean_inertia
from stewart_drake.loop.controller_margin import ControllerMargin
from stewart_drake.reporting.document import Document, Table, Tone, Values, table
from stewart_drake.reporting.outline import sections
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.style import DATA_INK, DATA_PAPER, line
from stewart_drake.reporting.words import capital, number
from stewart_drake.scenario.delay import Delay
from stewart_drake.studies.delay_limits import DelayStudy
from stewart_drake.studies.delay_loop import LoopMargins
from stewart_drake.studies.delay_map import Cell
from stewart_drake.studies.verdict import HARDLY, NO, loop_verdict, milliseconds

_TONES: Final[dict[str, Tone]] = {"yes": "good", "hardly": "fair", "no": "bad"}
_BANDWIDTH: Final = 10.0
"""Bandwidth in Hz of the servos that torques are compared with."""
FRAGILE: Final = 0.05
"""Tolerable error of the delay, as a share of it, from which a stable loop is called good."""
_MAP_WORDS: Final = {"out_of_reach": "no reach", "left_workspace": "left", "not_run": "not run"}
_CELL_WORDS: Final = {"out_of_reach": "out of reach", "left_workspace": "leaves workspace"}


def document(study: DelayStudy) -> Document:
    """Return poles, limits, margins and simulations."""
    (verdict, tone), tables = _verdict(study), _tables(study)
    sc, c = study.basis.experiment.scenario, study.basis.experiment.scenario.controller
    context = {
        "limits": study.poles and tables["limits"],
        "growths": study.poles and study.growths and tables["growths"],
        "floors": tables["floors"],
        "growth_figure": study.poles and partial(growth_figure, study),
        "floor": study.floors[sc.true_delay.steps],
        "margins": _margins(study.loop),
        "loops": study.loops and _loop_table(study.loops),
        "loop_figure": any(one.radius < 1 for one in study.loops) and partial(loop_figure, study),
        "servos": _servos_table(study),
        "cells": study.cells and _map_table(study),
        "failed": any(cell.status != "completed" for cell in study.cells),
        "map_figure": study.cells and partial(map_figure, study),
    }
    facts = {
        "mechanism": study.basis.experiment.mechanism.name,
        "gravity": "yes" if sc.plant.gravity else "no",
        "delay": f"{study.eta:.4g} s: μ = {sc.true_delay.steps} periods of {c.period:g} s, "
        f"fraction {sc.true_delay.fraction:g}",
        "controller": f"model {c.model}, prediction {c.prediction}, weights {c.weight_scaling}, "
        f"w_Q = {c.w_Q:g}, w_R = {c.w_R:g}",
        "start": f"{sc.start.replace('_', ' ')}, torques in flight: {sc.queue}",
    }
    parts = sections("delay", study=study, **context)
    return Document("Is this loop stable with its delay?", verdict, parts, tone, facts)


def _verdict(study: DelayStudy) -> tuple[str, Tone]:
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
    """Return how well the delay of a stable loop must be known."""
    if not loop.stable or loop.eta == 0 or not math.isfinite(loop.delay_margin):
        return ""
    return f" The delay must be known to {number(100 * loop.delay_margin / loop.eta, 2)} %."


def _tables(study: DelayStudy) -> dict[str, Table]:
    limits = table(
        study.limits,
        {
            "tolerable growth": lambda one: f"{one[0]:g}",
            "largest delay  [s]": lambda one: f"{one[1]:.3g}" if one[1] < math.inf else "any",
            "set at t  [s]": lambda one: f"{one[2]:.2f}" if one[1] < math.inf else "-",
        },
        brief=True,
    )
    growths = table(
        study.growths,
        {
            "t  [s]": lambda one: f"{one.time:.2f}",
            "over  [s]": lambda one: f"{one.seconds:.3g}",
            "e^(pη)": lambda one: one.expected,
            "simulated growth": lambda one: one.simulated,
        },
    )
    floors = table(
        sorted(study.floors.items()),
        {
            "μ": lambda one: one[0],
            "delay  [s]": lambda one: f"{_eta(study, one[0]):.4g}",
            "floor of E_ac  [% s]": lambda one: f"{one[1]:.2f}",
        },
    )
    return {"limits": limits, "growths": growths, "floors": floors}


def _eta(study: DelayStudy, steps: int) -> float:
    sc = study.basis.experiment.scenario
    return Delay(steps, sc.true_delay.fraction).eta(sc.controller.period)


def _margins(loop: LoopMargins | None) -> Values | None:
    if loop is None or loop.radius >= 1:
        return None
    motor = loop.motor and (
        f"; one motor {_gains(loop.motor.gain_down, loop.motor.gain_up)}, "
        f"phase {number(loop.motor.phase)} deg"
    )
    return Values(
        {
            "sensitivity": f"peak of S {number(loop.S.value)} at {number(loop.S.frequency)} rad/s, "
            f"of T {number(loop.T.value)} at {number(loop.T.frequency)} rad/s",
            "gain margin": f"all motors {_gains(loop.gain_down, loop.gain_up)}{motor or ''}",
            "delay margin": f"{milliseconds(loop.later)} longer, "
            f"{milliseconds(loop.earlier)} shorter",
        }
    )


def _loop_table(loops: tuple[LoopMargins, ...]) -> Table:
    def gains(m: LoopMargins) -> str:
        return _gains(m.gain_down, m.gain_up) if m.radius < 1 else "unstable"

    def of_motor(m: LoopMargins) -> str:
        return _gains(m.motor.gain_down, m.motor.gain_up) if m.motor else "-"

    return table(
        loops,
        {
            "μ": lambda m: m.steps,
            "spectral radius": lambda m: f"{m.radius:.4f}",
            "max |S|": lambda m: m.S.value,
            "max |T|": lambda m: m.T.value,
            "gain, all motors": gains,
            "gain, one motor": of_motor,
            "phase, one motor  [deg]": lambda m: m.motor.phase if m.motor else "-",
            "delay longer by  [ms]": lambda m: 1e3 * m.later if m.radius < 1 else "-",
            "shorter by  [ms]": lambda m: 1e3 * m.earlier if m.radius < 1 else "-",
        },
    )


def _servos_table(study: DelayStudy) -> Table:
    loop, verdict = study.controller, study.verdict
    stiffness = mean_inertia(study.basis.experiment.nominal) * (2 * math.pi * _BANDWIDTH) ** 2
    knows = loop is not None and loop.stable and math.isfinite(loop.delay_margin)
    growth = "-" if verdict is None else f"{number(verdict.amplification)} fold"
    errors = f"stable up to {milliseconds(loop.delay_margin)}" if loop and knows else ""
    rows = [
        ("growth of an error before it is answered", growth, "hardly any: answered within a ms"),
        (
            "an unknown torque of 1 mN m at a shaft",
            "is found, and answered a delay later",
            f"leaves {number(1.0 / stiffness)} mrad at the crank",
        ),
        (
            "an error of the delay",
            errors or "the delay must be estimated",
            "never unstable; late by the error",
        ),
        ("a plate that is not where its cranks say", "is measured and corrected", "is not noticed"),
        ("a push on the plate", "is answered a delay later", "gives way as stiffness allows"),
        ("needs", "a measured plate, nothing at the machine", "a fast loop at each motor"),
    ]
    return Table(("", "torques across the delay", "servos at the motors"), rows)


def _map_table(study: DelayStudy) -> Table:
    steps = sorted({cell.steps for cell in study.cells})
    factors = sorted({cell.factor for cell in study.cells}, reverse=True)
    cells = {(cell.steps, cell.factor): cell for cell in study.cells}
    rows = [(f"{100 * f:.0f} %", *(_cell_word(cells[s, f]) for s in steps)) for f in factors]
    if study.floor_applies:
        rows.append(("floor", *(number(study.floors[s]) for s in steps)))
    return Table(("amplitude", *(f"mu = {s}" for s in steps)), rows, brief=True)


def _cell_word(cell: Cell) -> str:
    if cell.status == "completed":
        return number(cell.error)
    word = _MAP_WORDS.get(cell.status, "failed")
    return word if math.isnan(cell.time) else f"{word} {cell.time:.2f}"


def _gains(down: float, up: float) -> str:
    return f"{down:.3f} to {up:.3f}" if math.isfinite(up) else f"{down:.3f} to ∞"


def growth_figure(study: DelayStudy) -> Figure:
    """Draw the fastest pole along the reference, and how an error grows over a delay."""
    time = [point.time for point in study.poles]
    moving, held = [p.moving for p in study.poles], [p.held for p in study.poles]
    poles = [
        Curve(time, moving, "in motion", line(0, marked=False)),
        Curve(time, held, "held still", line(1, marked=False)),
    ]
    longest = max(2.5 * study.eta, 0.1)
    delay = np.linspace(0, longest, 200)
    decades = np.minimum(max(moving) * delay / np.log(10), 30)
    left = Panel(
        "fastest unstable pole p  [1/s]",
        poles,
        "time on the reference  [s]",
        ylim=(0, None),
        height=2.6,
    )
    right = Panel(
        "growth $e^{pη}$ at the worst instant",
        [Curve(delay, 10**decades)],
        "delay η  [s]",
        limits={HARDLY: f"hardly beatable above {HARDLY:g}", NO: f"not beatable above {NO:g}"},
        marks={study.eta: f"this delay, {study.eta:.3g} s"},
        yscale="powers",
        xlim=(0, longest),
        ylim=(0.7, max(1e4, 3 * 10 ** decades.max())),
    )
    return draw([left, right], 2)


def loop_figure(study: DelayStudy) -> Figure:
    """Draw peaks of S and T, and tolerable errors of gain and delay, over the delay."""
    loops = [loop for loop in study.loops if loop.radius < 1]
    single = [
        100 * min(m.motor.gain_up - 1, 1 - m.motor.gain_down) if m.motor else np.nan for m in loops
    ]
    curves = {
        "peak over all frequencies": {
            "S": [m.S.value for m in loops],
            "T": [m.T.value for m in loops],
        },
        "tolerable error of the gain  [%]": {
            "one motor": single,
            "all motors": [100 * min(m.gain_up - 1, 1 - m.gain_down) for m in loops],
        },
        "tolerable error of the delay  [ms]": {
            "longer": [1e3 * m.later for m in loops],
            "shorter": [1e3 * m.earlier for m in loops],
        },
    }
    steps = [loop.steps for loop in loops]
    own = study.basis.experiment.scenario.true_delay.steps
    panels = [
        Panel(
            name,
            [Curve(steps, y, label, line(k)) for k, (label, y) in enumerate(pair.items())],
            "delay μ  [periods]",
            marks={own: ""},
            yscale="log",
            legend="inside",
            height=2.4,
        )
        for name, pair in curves.items()
    ]
    return draw(panels, 3)


def map_figure(study: DelayStudy) -> Figure:
    """Draw E_ac over delay and amplitude, with the floor set by the delay alone."""
    steps = sorted({cell.steps for cell in study.cells})
    factors = sorted({cell.factor for cell in study.cells})

    def paint(ax: Axes) -> None:
        for cell in study.cells:
            floor = study.floors[cell.steps] if study.floor_applies else 0.0
            _draw_cell(ax, cell, steps.index(cell.steps), factors.index(cell.factor), floor)
        ax.set_xticks(range(len(steps)), [f"{_eta(study, s):.3g} s\nμ = {s}" for s in steps])
        ax.set_yticks(range(len(factors)), [f"{100 * factor:.0f} %" for factor in factors])
        ax.grid(False)
        ax.spines[:].set_visible(False)
        ax.tick_params(length=0)

    return draw(
        [
            Panel(
                "amplitude",
                x="delay",
                xlim=(-0.5, len(steps) - 0.5),
                ylim=(-0.5, len(factors) - 0.5),
                height=0.8 * len(factors),
                paint=paint,
            )
        ]
    )


def _draw_cell(ax: Axes, cell: Cell, x: int, y: int, floor: float) -> None:
    done = cell.status == "completed"
    if done:
        text = f"{cell.error:.3g}" + (f"\nfloor {floor:.3g}" if floor else "")
    elif cell.status == "not_run":
        text = "not run"
    else:
        word = _CELL_WORDS.get(cell.status, cell.status.replace("_", " "))
        text = f"{word}\nat {cell.time:.2f} s"
    # Height above the floor, on a scale on which 30 % s is dark; text stays readable on it.
    shade = 0.55 * min(1.0, np.sqrt(max(0.0, cell.error - floor) / 30)) if done else 0.0
    color = (1 - shade, 1 - 0.55 * shade, 1 - 0.3 * shade) if shade > 0 else DATA_PAPER
    hatch = None if done else "////"
    box = Rectangle((x - 0.47, y - 0.45), 0.94, 0.9, fc=color, ec="#9AA3AD", hatch=hatch, lw=0.8)
    ax.add_patch(box)
    paper = None if done else {"fc": DATA_PAPER, "ec": "none", "pad": 1.5}
    look: Any = {"ha": "center", "va": "center", "fontsize": 8, "color": DATA_INK}
    ax.text(x, y, text, bbox=paper, **look)
