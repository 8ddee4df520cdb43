"""Document and figures of an analysis of the delay."""

import math
from functools import partial
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from stewart_drake.law.servos import mean_inertia
from stewart_drake.law.stability import Margins
from stewart_drake.loop.controller_margin import ControllerMargin
from stewart_drake.reporting.document import Document, Table, Tone, from_template, number
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.style import DATA_INK, DATA_PAPER, line
from stewart_drake.scenario.timing import Delay
from stewart_drake.studies.delay import Cell, DelayStudy, MotorMargins
from stewart_drake.studies.verdict import HARDLY, NO, fragile, milliseconds, scenario_verdict

_TONES: Final[dict[str, Tone]] = {"yes": "good", "hardly": "fair", "no": "bad"}
_BANDWIDTH: Final = 10.0
"""Bandwidth of the servos in the comparison, Hz."""
_WORDS: Final = {"out_of_reach": "no reach", "left_workspace": "left", "not_run": "not run"}


def document(study: DelayStudy) -> Document:
    loop, verdict, own = study.loop, study.verdict, study.controller
    known = own if own and own.stable and math.isfinite(own.delay_margin) else None
    stiffness = mean_inertia(study.assessment.experiment.nominal) * (2 * math.pi * _BANDWIDTH) ** 2
    steps = study.assessment.experiment.scenario.true_delay.steps
    return from_template(
        "delay",
        _tone(study),
        study=study,
        sc=study.assessment.experiment.scenario,
        eta=partial(_eta, study),
        gains=gains_text,
        milliseconds=milliseconds,
        spoken=own and scenario_verdict(study.assessment.experiment, own),
        growth=verdict and verdict.amplification,
        bandwidth=_BANDWIDTH,
        gives_way=1.0 / stiffness,
        known=known and milliseconds(known.delay_margin),
        floors=sorted(study.floors.items()),
        growth_figure=study.poles and partial(growth_figure, study),
        floor=study.floors[steps],
        margins=loop if loop is not None and loop.radius < 1 else None,
        choices=[(w_R, one, _fading(one)) for w_R, one in study.choices.items()],
        loop_figure=any(one.radius < 1 for one in study.loops) and partial(loop_figure, study),
        cells=study.cells and _map_table(study),
        failed=any(cell.status != "completed" for cell in study.cells),
        map_figure=study.cells and partial(map_figure, study),
    )


def _tone(study: DelayStudy) -> Tone:
    loop = study.controller
    if study.verdict is None or study.assessment.obstacles or (loop and loop.stable is False):
        return "bad"
    tone = _TONES[study.verdict.beatable]
    return "fair" if tone == "good" and loop and (loop.problem or fragile(loop)) else tone


def _fading(loop: ControllerMargin) -> float:
    """Return the time in s in which the slowest error of a loop fades to 1/e."""
    return -loop.period / math.log(loop.radius)


def _eta(study: DelayStudy, steps: int) -> float:
    sc = study.assessment.experiment.scenario
    return Delay(steps, sc.true_delay.fraction).eta(sc.controller.period)


def _map_table(study: DelayStudy) -> Table:
    steps = sorted({cell.steps for cell in study.cells})
    factors = sorted({cell.factor for cell in study.cells}, reverse=True)
    cells = {(cell.steps, cell.factor): cell for cell in study.cells}
    rows = [(f"{100 * f:.0f} %", *(_cell_word(cells[s, f]) for s in steps)) for f in factors]
    if study.floor_applies:
        rows.append(("floor", *(number(study.floors[s]) for s in steps)))
    return Table(("amplitude", *(f"{_eta(study, s):.3g} s" for s in steps)), rows, brief=True)


def _cell_word(cell: Cell, at: str = " {:.2f}") -> str:
    """Return E_ac, or how a run ended, with its time in the form `at`."""
    if cell.status == "completed":
        return number(cell.error)
    word = _WORDS.get(cell.status, "failed")
    return word if math.isnan(cell.time) else word + at.format(cell.time)


def gains_text(margins: Margins | MotorMargins) -> str:
    """Return the range of gains of all motors, or of one."""
    up = f"{margins.gain_up:.3f}" if math.isfinite(margins.gain_up) else "∞"
    return f"{margins.gain_down:.3f} to {up}"


def _least(margins: Margins | MotorMargins) -> float:
    """Return the smallest tolerable error of the gain, as a share."""
    return min(margins.gain_up - 1, 1 - margins.gain_down)


def growth_figure(study: DelayStudy) -> Figure:
    time = [point.time for point in study.poles]
    moving, held = [p.moving for p in study.poles], [p.held for p in study.poles]
    poles = [
        Curve(time, moving, "in motion", line(0, marked=False)),
        Curve(time, held, "held still", line(1, marked=False)),
    ]
    longest = max(2.5 * study.eta, 0.1)
    delay = np.linspace(0, longest, 200)
    decades = np.minimum(max(moving) * delay / np.log(10), 30)
    over = "time on the reference  [s]"
    left = Panel("fastest unstable pole p  [1/s]", poles, over, ylim=(0, None), height=2.6)
    right = Panel(
        "growth $e^{pη}$ at the worst instant",
        [Curve(delay, 10**decades)],
        "delay η  [s]",
        limits={
            HARDLY: f"hardly compensated above {HARDLY:g}",
            NO: f"not compensated above {NO:g}",
        },
        marks={study.eta: f"this delay, {study.eta:.3g} s"},
        yscale="powers",
        xlim=(0, longest),
        ylim=(0.7, max(1e4, 3 * 10 ** decades.max())),
    )
    return draw([left, right], 2)


def loop_figure(study: DelayStudy) -> Figure:
    loops = [loop for loop in study.loops if loop.radius < 1]
    steps = [loop.steps for loop in loops]
    own = study.assessment.experiment.scenario.true_delay.steps

    def panel(name: str, curves: dict[str, list[float]]) -> Panel:
        lines = [Curve(steps, y, label, line(k)) for k, (label, y) in enumerate(curves.items())]
        return Panel(
            name,
            lines,
            "delay μ  [periods]",
            marks={own: ""},
            yscale="log",
            legend="inside",
            height=2.4,
        )

    peaks = {"S": [m.S.value for m in loops], "T": [m.T.value for m in loops]}
    gains = {
        "one motor": [100 * _least(m.motor) if m.motor else np.nan for m in loops],
        "all motors": [100 * _least(m.margins) for m in loops],
    }
    delays = {
        "longer": [1e3 * m.margins.longer for m in loops],
        "shorter": [1e3 * m.margins.shorter for m in loops],
    }
    panels = [
        panel("peak over all frequencies", peaks),
        panel("tolerable error of the gain  [%]", gains),
        panel("tolerable error of the delay  [ms]", delays),
    ]
    return draw(panels, 3)


def map_figure(study: DelayStudy) -> Figure:
    steps = sorted({cell.steps for cell in study.cells})
    factors = sorted({cell.factor for cell in study.cells})

    def paint(ax: Axes) -> None:
        for cell in study.cells:
            floor = study.floors[cell.steps] if study.floor_applies else 0.0
            _draw_cell(ax, cell, steps.index(cell.steps), factors.index(cell.factor), floor)
        ax.set_xticks(range(len(steps)), [f"{_eta(study, s):.3g} s" for s in steps])
        ax.set_yticks(range(len(factors)), [f"{100 * factor:.0f} %" for factor in factors])
        ax.grid(False)
        ax.spines[:].set_visible(False)
        ax.tick_params(length=0)

    xlim, ylim = (-0.5, len(steps) - 0.5), (-0.5, len(factors) - 0.5)
    height = 0.8 * len(factors)
    how: Any = {"xlim": xlim, "ylim": ylim, "height": height, "paint": paint}
    return draw([Panel("amplitude", x="delay", title="E_ac  [% s]", **how)])


def _draw_cell(ax: Axes, cell: Cell, x: int, y: int, floor: float) -> None:
    done = cell.status == "completed"
    text = _cell_word(cell, "\nat {:.2f} s")
    if done and floor:
        text += f"\nfloor {number(floor)}"
    # 30 % s above the floor is the darkest shade, on which text is still readable.
    shade = 0.55 * min(1.0, np.sqrt(max(0.0, cell.error - floor) / 30)) if done else 0.0
    color = (1 - shade, 1 - 0.55 * shade, 1 - 0.3 * shade) if shade > 0 else DATA_PAPER
    hatch = None if done else "////"
    box = Rectangle((x - 0.47, y - 0.45), 0.94, 0.9, fc=color, ec="#9AA3AD", hatch=hatch, lw=0.8)
    ax.add_patch(box)
    paper = None if done else {"fc": DATA_PAPER, "ec": "none", "pad": 1.5}
    look: Any = {"ha": "center", "va": "center", "fontsize": 8, "color": DATA_INK}
    ax.text(x, y, text, bbox=paper, **look)
