"""Figures of one run, and of a comparison in the manner of the paper's figures 5 and 7.

Angles are shown in degrees, positions in mm. A run that ended early ends with a cross at that time.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stewart_drake.loop.results import STILL, SimulationResult
from stewart_drake.reporting import style
from stewart_drake.reporting.document import number
from stewart_drake.reporting.panels import Curve, Panel, Scale, draw
from stewart_drake.reporting.run import FINER, moving, span, worst
from stewart_drake.reporting.style import FACTORS, UNITS, Line
from stewart_drake.scenario.signals import (
    ANGLES,
    COORDINATES,
    LEGS,
    NUM_PARAMETERS,
    PACKETS,
    PARAMETERS,
    PLANT_PARAMETER_UNITS,
    POSITION,
    WEIGHTS,
)
from stewart_drake.studies.compare import label as spoken
from stewart_drake.types import Array

_SYMBOLS: Final = dict(zip(COORDINATES, ("roll φ", "pitch θ", "yaw ψ", "x", "y", "z"), strict=True))
_PARAMETER_GROUPS: Final = (slice(0, 6), slice(6, 7), slice(7, 8))
"""Components of the parameters that share a unit."""
_STATE_REACH: Final = 0.3
_ERROR_REACH: Final = 0.5
"""Largest widening of an axis by a diverging run, as a share of the reference's peak to peak."""
_LEAST_SPAN: Final = 0.02
"""Least span of a coordinate's axis, as a share of the largest in its unit."""
_ROUNDING: Final = 1e-6
"""Least span of a coordinate's axis, deg or mm: less is rounding."""
_FINE: Final = 1e-3
"""Least span of the pose's axis under a reference that holds still, deg or mm."""
_TORQUES: Final = ("torque_commanded", "torque_applied")
_TORQUE_DIGITS: Final = 9
"""Decimals of torques in N m: smaller ones are rounding."""
_LARGE_START: Final = 4.0
"""Range of the torques over that of the second half from which the axes cut off the start."""
_FEW_TICKS: Final = 0.01
"""Span of an axis of sizes from which powers of ten are enough ticks."""
_DECADES: Final = 5
"""Most decades of an axis of sizes below its largest value."""
_MARGIN: Final = 0.06
"""Margin of an axis beyond the data, as a share."""
_AFTER_END: Final = 1.1
"""Length of the time axis of a run that ended early, as a factor on its time."""
_FIXED: Final = Line("#888888", ":", 1.2)

_Runs = Mapping[str, tuple[SimulationResult, Line]]


def draw_comparison(results: Mapping[str, SimulationResult]) -> dict[str, Figure]:
    """Return states, errors, and the torques of each controller, by name.

    A controller that finds the delay adds a figure of it, a tuner one of its weights.
    """
    if not results:
        return {}
    lines = style.controller_lines(results)
    runs = {spoken(name): (result, lines[name]) for name, result in results.items()}
    figures = _poses(runs)
    for name, result in results.items():
        alone = lines[name]._replace(linestyle="-", marker="")
        figures[f"torques_{name}"] = _torques(result, spoken(name), alone)
    figures |= {f"delay_{n}": _delay(one) for n, one in results.items() if has(one, "delay_std")}
    tuned = {spoken(name): run for name, run in results.items() if _is_tuned(run)}
    if tuned:
        figures["weights"] = weights_figure(tuned)
    return figures


def draw_run(result: SimulationResult) -> dict[str, Figure]:
    """Return states, errors, torques, and if estimated or tuned parameters, delay and weights.

    A reference that holds still has no errors: the states show them.
    """
    figures = _poses({"plate": (result, style.RUN)})
    # The torque that position servos ask for at samples is that before the setpoint changes.
    commanded = result.scenario.actuator.kind != "position_servo"
    figures["torques"] = _torques(result, "applied", style.RUN, commanded)
    if has(result, "parameter_std"):
        figures["parameters"] = _parameters(result)
    if has(result, "delay_std"):
        figures["delay"] = _delay(result)
    if _is_tuned(result):
        figures["weights"] = weights_figure({"": result})
    return figures


def _is_tuned(run: SimulationResult) -> bool:
    return run.scenario.tuner.kind != "fixed"


def has(run: SimulationResult, signal: str) -> bool:
    """Return whether a run has a finite value of a signal."""
    return bool(np.isfinite(run.signals[signal].values).any())


def _poses(runs: _Runs) -> dict[str, Figure]:
    """Return the states, and the errors unless nothing moves."""
    wanted = max((run.signals for run, _ in runs.values()), key=lambda s: s.sizes["time"])
    held = len(wanted.time) > 0 and not any(moving(run).any() for run, _ in runs.values())
    states = {"states": _states(runs, wanted, held)}
    return states if held else states | {"errors": _errors(runs, wanted)}


def _states(runs: _Runs, wanted: xarray.Dataset, held: bool) -> Figure:
    reference = FACTORS * wanted.reference.values
    spans = span(reference)
    least = _least(spans, _FINE if held else _ROUNDING)
    time = wanted.time.values
    curves = [Curve(time, column, "reference", style.REFERENCE) for column in reference.T]
    title = "Pose of the plate and its reference"
    if held:
        errors = ", ".join(worst(run) for run, _ in runs.values())
        title += f", which holds still: the error is at most {errors}"
    if lost := sum(run.stopped is not None for run, _ in runs.values()):
        title += f": {lost} of {len(runs)} runs ended early"
    return _coordinates(title, runs, "pose", _STATE_REACH * spans, least, curves)


def _errors(runs: _Runs, wanted: xarray.Dataset) -> Figure:
    own = span(wanted.reference.values)
    spans, scale = FACTORS * own, np.where(own > STILL, own, 1.0)
    title, errors = "Errors of the pose", {one: r.accumulated_error for one, (r, _) in runs.items()}
    completed = {one: error for one, error in errors.items() if np.isfinite(error)}
    if completed and len(runs) > 1:
        title += f": least with {min(completed, key=completed.__getitem__)}"
    elif completed:
        title += f"; the largest is {', '.join(worst(run) for run, _ in runs.values())}"
    shares = [100 * np.mean(np.abs(r.signals.error.values) / scale, 1) for r, _ in runs.values()]
    mean = _sizes("mean error  [%]", _curves(runs, shares), _trusted(runs, shares), _times(runs))
    drawn = _trusted(runs, [FACTORS * r.signals.error.values for r, _ in runs.values()])
    whole = np.concatenate([some[np.isfinite(some).all(axis=1)] for some in drawn])
    least = _least(span(whole), _ROUNDING)
    return _coordinates(title, runs, "error", _ERROR_REACH * spans, least, below=[mean])


def _least(spans: Array, least: float) -> Array:
    """Return the least spans (6,) of the axes for spans (6,) of what is drawn."""
    largest = np.repeat([spans[ANGLES].max(), spans[POSITION].max()], 3)
    return np.maximum(_LEAST_SPAN * largest, least)


def _sizes(
    name: str, curves: Sequence[Curve], core: Sequence[Array], xlim: tuple[float, float]
) -> Panel:
    """Return a wide panel of sizes over some decades, as far as those of `core` reach."""
    inside = np.concatenate(core)
    largest = float(np.max(inside, initial=0.0, where=np.isfinite(inside)))
    low = max(largest * 10**-_DECADES, float(np.min(inside, initial=largest, where=inside > 0)))
    scale: Scale = "powers" if low < _FEW_TICKS * largest else "log"
    return Panel(
        name,
        curves,
        xlim=xlim,
        ylim=(0.7 * low, 2 * largest) if largest > 0 else None,
        yscale=scale if largest > 0 else "linear",
        height=1.5,
        wide=True,
    )


def _coordinates(
    title: str,
    runs: _Runs,
    signal: str,
    reach: Array,
    least: Array,
    wanted: Sequence[Curve] = (),
    below: Sequence[Panel] = (),
) -> Figure:
    """Draw the six coordinates of a signal, over the wanted ones; `reach`, `least`: `_limits`."""
    panels, word = [], "" if signal == "pose" else f" {signal}"
    for k, unit in enumerate(UNITS):
        data = [FACTORS[k] * run.signals[signal].values[:, k] for run, _ in runs.values()]
        behind = wanted[k : k + 1]
        core = [*(np.asarray(curve.y) for curve in behind), *_trusted(runs, data)]
        panels.append(
            Panel(
                f"{_SYMBOLS[COORDINATES[k]]}{word}  [{unit}]",
                [*behind, *_curves(runs, data)],
                xlim=_times(runs),
                ylim=_limits(core, data, reach[k], least[k]),
            )
        )
    return draw([*panels, *below], 2, down=True, title=title)


def _torques(run: SimulationResult, label: str, line: Line, commanded: bool = False) -> Figure:
    signals, panels, xlim = run.signals, [], (0.0, shown_until(run))
    asked, acted = (np.round(signals[name].values, _TORQUE_DIGITS) for name in _TORQUES)
    drawn = np.hstack([acted, asked]) if commanded else acted
    late = drawn[signals.time.values >= xlim[1] / 2]
    cut = run.stopped is None and bool(np.ptp(drawn) > _LARGE_START * np.ptp(late) > 0)
    unit, factor = style.unit_for(late if cut else drawn, style.TORQUES)
    ylim = _limits([factor * late.ravel()], [], 0.0) if cut else None

    def curves(asked: Array, acted: Array) -> list[Curve]:
        wanted = Curve(signals.time.values, asked, "commanded", style.COMMANDED, steps=True)
        applied = _curve(run, acted, label, line, steps=True)
        return [wanted, applied] if commanded else [applied]

    for leg, *torques in zip(LEGS, factor * asked.T, factor * acted.T, strict=True):
        name = f"motor {leg}{'' if commanded else ' applied'}  [{unit}]"
        panels.append(Panel(name, curves(*torques), xlim=xlim, ylim=ylim))
    if commanded and (acted.any() or asked.any()):
        sizes = [np.abs(factor * torque).max(axis=1) for torque in (asked, acted)]
        panels.append(_sizes(f"largest of six  [{unit}]", curves(*sizes), sizes, xlim))
    if has(run, "packets"):
        strip = partial(_packet_strip, run=run)
        panels.append(Panel("", xlim=xlim, height=1.15, wide=True, paint=strip))
    title = "Torques of the motors"
    if np.isfinite(acted).any():
        peaks = np.nanmax(np.abs(factor * acted), axis=0)
        most = int(np.nanargmax(peaks))
        most_text = f"at most {number(peaks[most], 2)} {unit} acted, by motor {LEGS[most]}"
        title += f": {most_text if peaks[most] > 0 else 'none acted'}"
    title += "; the motors' axes fit the second half" * cut
    return draw(panels, 2, down=True, sharey=True, title=title)


def _packet_strip(ax: Axes, run: SimulationResult) -> None:
    """Draw a row of ticks for each count of packets and periods, at its increments."""
    counts = run.signals.packets.values
    rises = np.diff(counts, axis=0, prepend=np.zeros((1, len(PACKETS)))) > 0
    time = run.signals.time.values
    for row, (name, rose) in enumerate(zip(PACKETS, rises.T, strict=True)):
        color = style.LIMIT.color if name in ("lost", "late", "dry") else style.RUN.color
        ax.vlines(time[rose], row - 0.35, row + 0.35, color=color, linewidth=1.0)
    labels = [
        f"{name}  {n:.0f}" if np.isfinite(n) else f"{name}  unknown"
        for name, n in zip(PACKETS, counts[-1], strict=True)
    ]
    ax.set_ylim(len(PACKETS) - 0.5, -0.5)
    ax.set_yticks(range(len(PACKETS)), labels, fontsize=8)
    ax.grid(visible=False)


def _parameters(run: SimulationResult) -> Figure:
    time, xlim = run.signals.time.values, (0.0, shown_until(run))
    true = np.array(run.scenario.plant_parameters[:NUM_PARAMETERS])
    values, widths = run.signals.parameters.values, 2 * run.signals.parameter_std.values
    units, factors = [""] * NUM_PARAMETERS, np.ones(NUM_PARAMETERS)
    late = time >= xlim[1] / 2
    late |= not late.any()
    kept = np.vstack([values[late] - widths[late], values[late] + widths[late], true])
    shown = np.nanmax(np.abs(kept), axis=0)
    for some in _PARAMETER_GROUPS:
        choice = FINER[PLANT_PARAMETER_UNITS[some.start]]
        unit, factors[some] = style.unit_for(shown[some], choice)
        units[some] = [unit] * len(units[some])
    true, values, widths = factors * true, factors * values, factors * widths
    panels, kept = [], factors * kept
    for k, name in enumerate(PARAMETERS):
        curves = _estimate(time, values[:, k], widths[:, k], np.full(len(time), true[k]))
        axis, ylim = f"{name.replace('_', ' ')}  [{units[k]}]", _limits([kept[:, k]], [], 0.0)
        panels.append(Panel(axis, curves, xlim=xlim, ylim=ylim))
    inside = np.abs(values[-1] - true) <= widths[-1]
    title = f"Estimated parameters: {inside.sum()} of {len(inside)} true values in the final ± 2 σ"
    title += ". Axes fit the second half; the start is cut off"
    return draw(panels, 2, down=True, title=title)


def _delay(run: SimulationResult) -> Figure:
    signals, panels = run.signals, []
    time, true, width = signals.time.values, signals.delay_true.values, 2 * signals.delay_std.values
    # Both the final band and an error several times as large are visible on this axis.
    last = 1e4 * float(np.nanmin(width))
    for name, origin, factor, ylim in (
        ("delay  [s]", 0.0, 1.0, None),
        ("delay minus true one  [ms]", true, 1e3, (-last, last)),
    ):
        value, truth = (factor * (one - origin) for one in (signals.delay_estimate.values, true))
        curves = _estimate(time, value, factor * width, truth, steps=True)
        panels.append(Panel(name, curves, xlim=(0.0, shown_until(run)), ylim=ylim))
    title = f"Estimated delay: {signals.delay_estimate.values[-1]:.4g} s at the end"
    title += f", true {true[-1]:.4g} s" if np.isfinite(true[-1]) else ""
    return draw(panels, 2, title=title)


def _estimate(
    time: Array, value: Array, width: Array, true: Array, steps: bool = False
) -> list[Curve]:
    band = value - width, value + width, "± 2 σ"
    truth = Curve(time, true, "true value", style.TRUTH, steps)
    return [truth, Curve(time, value, "estimate", steps=steps, band=band)]


def weights_figure(runs: Mapping[str, SimulationResult]) -> Figure:
    """Draw w_Q, w_R and their ratio, which determines the gain, of runs by title."""
    above, below = list[Panel](), list[Panel]()
    for title, run in runs.items():
        weights, c, end = run.signals.weights.values, run.scenario.controller, shown_until(run)
        ratio, fixed = weights[:, 0] / weights[:, 1], c.weights[0] / c.weights[1]
        first = _curve(run, weights[:, 0], WEIGHTS[0], style.RUN, steps=True)
        other = _curve(run, ratio, "", Line("#000000", "-", 1.3), steps=True)
        second = Curve(first.x, weights[:, 1], WEIGHTS[1], style.COMMANDED, steps=True)
        constant = Curve((0, end), (fixed, fixed), "fixed weights", _FIXED)
        how: dict[str, Any] = {"xlim": (0, end), "yscale": "log" if len(weights) else "linear"}
        above.append(Panel("weight", [first, second], title=title, **how))
        below.append(Panel("w_Q / w_R", [other, constant], **how))
    ratios = np.concatenate([run.signals.weights.values for run in runs.values()])
    title = "Weights of the cost as the tuner sets them"
    if len(ratios):
        low, high = (number(extreme(ratios[:, 0] / ratios[:, 1]), 2) for extreme in (min, max))
        title += f": w_Q / w_R from {low} to {high}"
    return draw([*above, *below], len(runs), sharey="row", title=title)


def shown_until(run: SimulationResult) -> float:
    """Return the end of a run's time axis, s."""
    end = run.scenario.duration
    return end if run.stopped is None else min(end, _AFTER_END * run.stopped.time) or end


def _times(runs: _Runs) -> tuple[float, float]:
    return 0.0, max(shown_until(run) for run, _ in runs.values())


def _curve(
    run: SimulationResult, values: Array, label: str, line: Line, steps: bool = False
) -> Curve:
    stopped = None if run.status == "interrupted" else run.stopped
    ended = None if stopped is None else stopped.time
    return Curve(run.signals.time.values, values, label, line, steps, ended=ended)


def _curves(runs: _Runs, data: Iterable[Array]) -> list[Curve]:
    pairs = zip(runs.items(), data, strict=True)
    return [_curve(run, values, label, line) for (label, (run, line)), values in pairs]


def _trusted(runs: _Runs, data: list[Array]) -> list[Array]:
    """Return the data of completed runs, or of all if there are none."""
    pairs = zip(runs.values(), data, strict=True)
    return [values for (run, _), values in pairs if run.status == "completed"] or data


def _limits(
    core: Iterable[Array], data: Iterable[Array], reach: float, least: float = 0.0
) -> tuple[float, float] | None:
    """Return limits that contain `core` and `data` up to `reach` beyond, at least `least` apart."""
    inside = np.concatenate(list(core))
    inside = inside[np.isfinite(inside)]
    if not len(inside):
        return None
    everything = np.concatenate([inside, *data])
    everything = everything[np.isfinite(everything)]
    low = max(everything.min(), inside.min() - reach)
    high = min(everything.max(), inside.max() + reach)
    widening = max(0.0, least - (high - low)) / 2
    margin = widening + _MARGIN * (high - low + 2 * widening)
    return (low - margin, high + margin) if margin > 0 else None
