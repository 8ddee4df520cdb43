"""Figures of one run, and of a comparison in the manner of the paper's figures 5 and 7.

Angles are shown in degrees, positions in mm. A run that ended early ends with a cross at that time.
"""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from stewart_drake.loop.results import SimulationResult
from stewart_drake.reporting import style
from stewart_drake.reporting.style import FACTORS, UNITS, figure_style, write_figures
from stewart_drake.reporting.tuner_figures import shown_until, weights_figure
from stewart_drake.scenario.config import FixedTunerConfig
from stewart_drake.scenario.signals import (
    ANGLES,
    COORDINATES,
    LEGS,
    NUM_PARAMETERS,
    PACKETS,
    PARAMETERS,
    POSITION,
)
from stewart_drake.studies.compare import ADAPTIVE, LABELS, SERVOS
from stewart_drake.studies.compare import label as spoken
from stewart_drake.types import Array

TORQUE_CONTROLLERS: Final = ("delay_lqr", "delay_lqi", "predictor_lqi")
"""Those whose torques a comparison shows: they know of the delay."""

_SYMBOLS: Final = dict(zip(COORDINATES, ("roll φ", "pitch θ", "yaw ψ", "x", "y", "z"), strict=True))
_PARAMETER_UNITS: Final = ("mN m",) * 6 + ("kg", "mN m s/rad")
_PARAMETER_FACTORS: Final = np.array([1e3] * 6 + [1.0, 1e3])
_CROSS: Final = "x"
_STATE_REACH: Final = 0.3
_ERROR_REACH: Final = 0.5
"""How far a diverging run may widen an axis, as a share of the reference's peak to peak."""
_LEAST_SIGMAS: Final = 0.02
"""A parameter's axis shows at least this share of its largest standard deviation to either side:
the band narrows by orders of magnitude, and the estimate counts."""
_LEAST_SPAN: Final = 0.02
"""A coordinate's axis spans at least this share of the widest motion among those of its unit: where
the reference rests, rounding is not to fill it."""
_LEFT: Final = 0.09
_RIGHT: Final = 0.985
"""Of a figure's width, where its axes begin and end."""
_STRIP: Final = 1.6
_STRIP_FOOT: Final = 0.45
"""Inches: the strip of packets, and its room for the time axis."""
_MARGIN: Final = 0.06
"""Empty share of an axis beyond the data."""


def comparison_figures(
    results: Mapping[str, SimulationResult], directory: str | Path
) -> list[Path]:
    """Write states, errors, and torques of each delay-aware controller, as PNG and SVG.

    Of those that find the delay, also how; with the neural tuner, the weights that it set.

    Args:
        results: by controller, as `compare` returns them.
        directory: that exists.

    Returns:
        The paths written; none without results.

    Raises:
        OSError: the directory cannot be written to.
    """
    return write_figures(draw_comparison(results), directory)


def draw_comparison(results: Mapping[str, SimulationResult]) -> dict[str, Figure]:
    """The figures that `comparison_figures` writes, by name; none without results."""
    if not results:
        return {}
    lines = {spoken(name): style.controller_line(name) for name in results}
    runs = {spoken(name): result for name, result in results.items()}
    shown = (
        *TORQUE_CONTROLLERS,
        ADAPTIVE,
        *SERVOS,
        *(name for name in results if name not in LABELS),
    )
    aware = {name: results[name] for name in shown if name in results}
    with figure_style():
        figures = {"states": _states(runs, lines), "errors": _errors(runs, lines)}
        for name, result in aware.items():
            line = style.controller_line(name)
            figures[f"torques_{name}"] = _torques(result, spoken(name), line)
        for name, result in aware.items():
            if _finds_delay(result):
                figures[f"delay_{name}"] = _delay(result)
        tuned = {spoken(n): run for n, run in aware.items() if _is_tuned(run)}
        if tuned:
            figures["weights"] = weights_figure(tuned)
        return figures


def run_figures(result: SimulationResult, directory: str | Path) -> list[Path]:
    """Write states, errors, torques and, with an estimator, the parameters, as PNG and SVG.

    With the neural tuner, also the weights that it set.

    Args:
        result: of one run.
        directory: that exists.

    Returns:
        The paths written.

    Raises:
        OSError: the directory cannot be written to.
    """
    return write_figures(draw_run(result), directory)


def draw_run(result: SimulationResult) -> dict[str, Figure]:
    """The figures that `run_figures` writes, by name."""
    runs, lines = {"plate": result}, {"plate": style.RUN}
    with figure_style():
        figures = {
            "states": _states(runs, lines),
            "errors": _errors(runs, lines),
            "torques": _torques(result, "applied", style.RUN, commanded=True),
        }
        if np.isfinite(result.signals.parameter_std.values).any():
            figures["parameters"] = _parameters(result)
        if _finds_delay(result):
            figures["delay"] = _delay(result)
        if _is_tuned(result):
            figures["weights"] = weights_figure({"weights that the tuner set": result})
        return figures


def _is_tuned(run: SimulationResult) -> bool:
    return not isinstance(run.scenario.tuner, FixedTunerConfig)


def _finds_delay(run: SimulationResult) -> bool:
    return bool(np.isfinite(run.signals.delay_std.values).any())


def _states(runs: Mapping[str, SimulationResult], lines: Mapping[str, style.Line]) -> Figure:
    figure, axes = _grid(runs.values())
    wanted = max((run.signals for run in runs.values()), key=lambda s: s.sizes["time"])
    spans = FACTORS * np.array([_span(values) for values in wanted.reference.values.T])
    least = _LEAST_SPAN * np.repeat([spans[ANGLES].max(), spans[POSITION].max()], 3)
    for k, ax in enumerate(axes):
        reference = FACTORS[k] * wanted.reference.values[:, k]
        ax.plot(wanted.time.values, reference, label="reference", **style.REFERENCE._asdict())
        data = {label: FACTORS[k] * run.signals.pose.values[:, k] for label, run in runs.items()}
        _limit(ax, [reference, *_trusted(runs, data)], data, _STATE_REACH * spans[k], least[k])
        _plot(ax, runs, lines, data)
        ax.set_ylabel(f"{_SYMBOLS[COORDINATES[k]]}  [{UNITS[k]}]")
    return _with_legend(figure, axes)


def _errors(runs: Mapping[str, SimulationResult], lines: Mapping[str, style.Line]) -> Figure:
    figure, axes = _grid(runs.values())
    for k, ax in enumerate(axes):
        data = {label: FACTORS[k] * run.signals.error.values[:, k] for label, run in runs.items()}
        motion = FACTORS[k] * max(
            (_span(run.signals.reference.values[:, k]) for run in runs.values()), default=0.0
        )
        _limit(ax, _trusted(runs, data), data, _ERROR_REACH * motion)
        _plot(ax, runs, lines, data)
        ax.set_ylabel(f"{_SYMBOLS[COORDINATES[k]]} error  [{UNITS[k]}]")
    return _with_legend(figure, axes)


def _torques(
    run: SimulationResult, label: str, line: style.Line, commanded: bool = False
) -> Figure:
    figure, axes = _grid([run], sharey=True, strip=_STRIP if has_packets(run) else 0.0)
    steps: dict[str, Any] = {"drawstyle": "steps-post"}
    for k, ax in enumerate(axes):
        time = run.signals.time.values
        if commanded:
            values = run.signals.torque_commanded.values[:, k]
            ax.plot(time, values, label="commanded", **steps, **style.COMMANDED._asdict())
        values = run.signals.torque_applied.values[:, k]
        _plot(ax, {label: run}, {label: line}, {label: values}, **steps)
        ax.set_ylabel(f"motor {LEGS[k]}{'' if commanded else ' applied'}  [N m]")
    if has_packets(run):
        _packet_strip(figure, run, axes[0].get_xlim())
    return _with_legend(figure, axes)


def has_packets(run: SimulationResult) -> bool:
    """Whether its torques went over a network."""
    return bool(np.isfinite(run.signals.packets.values).any())


def _packet_strip(figure: Figure, run: SimulationResult, span: tuple[float, float]) -> None:
    """A row of ticks for each kind of packet and of period, where its count rises."""
    height = figure.get_figheight()
    low = _STRIP_FOOT / height
    ax = figure.add_axes((_LEFT, low, _RIGHT - _LEFT, (_STRIP - 0.45) / height))
    counts = run.signals.packets.values
    rises = np.diff(counts, axis=0, prepend=np.zeros((1, len(PACKETS)))) > 0
    time = run.signals.time.values
    for row, (name, rose) in enumerate(zip(PACKETS, rises.T, strict=True)):
        color = style.LIMIT.color if name in ("lost", "late", "dry") else style.RUN.color
        ax.vlines(time[rose], row - 0.35, row + 0.35, color=color, linewidth=1.0)
    labels = [
        f"{name}  {n:.0f}" if np.isfinite(n) else f"{name}  not known"
        for name, n in zip(PACKETS, counts[-1], strict=True)
    ]
    ax.set(xlim=span, ylim=(len(PACKETS) - 0.5, -0.5), xlabel="time  [s]")
    ax.set_yticks(range(len(PACKETS)), labels, fontsize=8)
    ax.grid(visible=False)


def _parameters(run: SimulationResult) -> Figure:
    figure, axes = _grid([run], rows=4)
    plant, time = run.scenario.plant, run.signals.time.values
    true = np.array(plant.parameters[:NUM_PARAMETERS])
    true, values, widths = (
        _PARAMETER_FACTORS * data
        for data in (true, run.signals.parameters.values, 2 * run.signals.parameter_std.values)
    )
    for k, ax in enumerate(axes):
        value, width = values[:, k], widths[:, k]
        least = _LEAST_SIGMAS * np.nanmax(width) / 2
        _limit(ax, [value, np.array([true[k] - least, true[k] + least])], {}, 0.0)
        ax.axhline(true[k], label="true value", **style.TRUTH._asdict())
        ax.plot(time, value, label="estimate", **style.RUN._asdict())
        ax.fill_between(
            time,
            value - width,
            value + width,
            color=style.RUN.color,
            alpha=style.BAND_ALPHA,
            linewidth=0,
            label="± 2 σ",
        )
        name = PARAMETERS[k].replace("_", " ")
        ax.set_ylabel(f"{name}  [{_PARAMETER_UNITS[k]}]")
    return _with_legend(figure, axes)


def _delay(run: SimulationResult) -> Figure:
    """The delay with its band, and how far that is from the truth."""
    figure, (whole, fine) = _grid([run], rows=1)
    steps: dict[str, Any] = {"drawstyle": "steps-post"}
    signals = run.signals
    time, true = signals.time.values, signals.delay_true.values
    value, width = signals.delay_estimate.values, 2 * signals.delay_std.values
    for ax, origin, factor in ((whole, 0.0, 1.0), (fine, true, 1e3)):
        ax.plot(
            time, factor * (true - origin), label="true value", **steps, **style.TRUTH._asdict()
        )
        middle = factor * (value - origin)
        ax.plot(time, middle, label="estimate", **steps, **style.RUN._asdict())
        ax.fill_between(
            time,
            middle - factor * width,
            middle + factor * width,
            step="post",
            color=style.RUN.color,
            alpha=style.BAND_ALPHA,
            linewidth=0,
            label="± 2 σ",
        )
    # The band at the end, and an error that is some times as large, can be told apart.
    last = 1e3 * float(np.nanmin(width))
    fine.set_ylim(-10 * last, 10 * last)
    whole.set_ylabel("delay  [s]")
    fine.set_ylabel("delay minus true one  [ms]")
    return _with_legend(figure, [whole, fine])


def _grid(
    runs: Iterable[SimulationResult], rows: int = 3, sharey: bool = False, strip: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """Two columns of axes over one time axis, filled column by column.

    `strip` is room below them, in inches.
    """
    height = 1.5 + 1.8 * rows + strip
    # Fixed margins, in inches over the height: a layout engine takes most of the drawing time.
    room = {"left": _LEFT, "right": _RIGHT, "wspace": 0.24, "hspace": 0.12}
    figure = Figure(figsize=(10, height))
    figure.subplots_adjust(bottom=(0.5 + strip) / height, top=1 - 0.45 / height, **room)
    axes = figure.subplots(rows, 2, sharex=True, sharey=sharey, squeeze=False)
    for ax in axes.ravel():
        ax.yaxis.set_label_coords(-0.14, 0.5)
        # More digits than these would run into the label.
        ax.ticklabel_format(axis="y", scilimits=(-2, 4), useMathText=True)
    for ax in axes[-1]:
        ax.set_xlabel("time  [s]")
    axes[0, 0].set_xlim(0, max(shown_until(run) for run in runs))
    return figure, list(axes.T.ravel())


_LEGEND_LINE: Final = 0.25
"""Inches."""


def _with_legend(figure: Figure, axes: list[Axes]) -> Figure:
    # A run's cross has a line of its own, for which one entry stands.
    handles, labels = axes[0].get_legend_handles_labels()
    if any(line.get_marker() == _CROSS for ax in axes for line in ax.lines):
        handles.append(Line2D([], [], ls="", marker=_CROSS, color="#666666", ms=7, mew=2))
        labels.append("run ended")
    for lines in range(1, max(1, len(labels)) + 1):  # as few as keep the names on the figure
        columns = max(1, math.ceil(len(labels) / lines))
        legend = figure.legend(handles, labels, loc="upper center", ncols=columns)
        if legend.get_window_extent().width <= figure.bbox.width or columns == 1:
            break
        legend.remove()
    room = _LEGEND_LINE * (lines - 1) / figure.get_figheight()
    figure.subplots_adjust(top=figure.subplotpars.top - room)
    return figure


def _plot(
    ax: Axes,
    runs: Mapping[str, SimulationResult],
    lines: Mapping[str, style.Line],
    data: Mapping[str, Array],
    **how: Any,
) -> None:
    for label, run in runs.items():
        line, values = lines[label], data[label]
        ax.plot(run.signals.time.values, values, label=label, **line._asdict(), **how)
        if len(values) and run.stopped is not None and run.status != "interrupted":
            low, high = ax.get_ylim()
            end = np.clip(values[-1], low, high)
            ax.plot(run.stopped.time, end, _CROSS, color=line.color, ms=7, mew=2, clip_on=False)


def _trusted(runs: Mapping[str, SimulationResult], data: Mapping[str, Array]) -> list[Array]:
    """Data of the runs that completed, or of all where none did: nothing is to be squashed then."""
    done = [values for label, values in data.items() if runs[label].status == "completed"]
    return done or list(data.values())


def _finite(parts: Iterable[Array]) -> Array:
    values = np.concatenate(list(parts))
    return values[np.isfinite(values)]


def _span(values: Array) -> float:
    return float(np.ptp(values)) if len(values) else 0.0


def _limit(
    ax: Axes, core: list[Array], data: Mapping[str, Array], reach: float, least: float = 0.0
) -> None:
    """Limits, `least` apart, that show `core` whole and of all data what is `reach` off it."""
    inside = _finite(core)
    if not len(inside):
        return
    everything = _finite([inside, *data.values()])
    low = max(everything.min(), inside.min() - reach)
    high = min(everything.max(), inside.max() + reach)
    widening = max(0.0, least - (high - low)) / 2
    low, high = low - widening, high + widening
    margin = _MARGIN * (high - low)
    if margin > 0:
        ax.set_ylim(low - margin, high + margin)
