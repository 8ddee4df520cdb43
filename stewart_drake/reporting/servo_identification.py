"""Documents and figures of identified position servos, and of a planned log of them."""

import shlex
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.identification.servo_fit import (
    BALL_FRICTION,
    NAMES,
    UNITS,
    D,
    K,
    ServoIdentification,
)
from stewart_drake.identification.servo_plan import SETPOINTS_FILE, ServoPlan
from stewart_drake.reporting.document import Document, Table, Tone, from_template, measured, number
from stewart_drake.reporting.panels import Panel, draw, leg_curves
from stewart_drake.reporting.style import unit_for
from stewart_drake.types import Array

_UNITS: Final = {"s": ("ms", 1e3), "rad": ("mrad", 1e3), "kg m^2": ("g m^2", 1e3)}
"""Unit in which a number is shown, and the factor, by its SI unit; others are shown as they are."""


def document(found: ServoIdentification, folder: str | Path = "") -> Document:
    """Describe the servos; `folder` is that of their file in the command that uses it."""
    notes, log = _cautions(found) if found.right else [], found.model.log
    return _document(
        found,
        "bad" if not found.right else "fair" if notes else "good",
        plan=None,
        cautions=notes,
        folder=folder and shlex.quote(str(folder)),
        found=_table(found, weak=True),
        log=log.name,
        motion=partial(_figure, "crank angles", log.times, log.cranks),
        residuals=partial(_figure, "residuals", log.times[found.model.counted], found.residuals),
    )


def plan_document(plan: ServoPlan) -> Document:
    shares = dict(zip(("sine", "sines", "steps"), plan.shares, strict=True))
    smaller = [f"{name} to {100 * share:.0f} %" for name, share in shares.items() if share < 1]
    notes = [f"reduced to keep the limits: {', '.join(smaller)}"] if smaller else []
    return _document(
        plan.expected,
        "plain",
        plan=plan,
        file=SETPOINTS_FILE,
        duration=plan.log.times[-1],
        torque=number(plan.peak_torque, 2),
        speed=number(plan.peak_speed, 2),
        cautions=notes,
        found=_table(plan.expected, weak=False),
        log="",
        motion=partial(_figure, "crank angles", plan.log.times, plan.log.setpoints),
        residuals=None,
    )


def _document(identified: ServoIdentification, tone: Tone, **more: object) -> Document:
    limit = identified.model.torque_limit
    rows = [_row(name, *one) for name, one in identified.combined.items()]
    return from_template(
        "servo_identification",
        tone,
        right=identified.right,
        weak=identified.weak,
        mechanism=identified.model.mechanism.name,
        gain=identified.velocity_gain and number(identified.velocity_gain),
        limit="none" if np.isinf(limit) else f"{limit:g} N m",
        mass=number(identified.model.mechanism.plate.mass),
        stiffness=number(identified.theta[K]),
        delay=number(1e3 * identified.theta[D]),
        residual=number(np.degrees(identified.residual), 2),
        deviation=number(np.degrees(identified.deviation), 2),
        rounding=number(np.degrees(identified.rounding), 2),
        combined=Table(("number", "unit", "value", "±"), rows, brief=True),
        **more,
    )


def _cautions(found: ServoIdentification) -> list[str]:
    notes = []
    if weak := found.weak:
        names = ", ".join(name.replace("_", " ") for name in weak)
        notes.append(f"weak, so use them together only: {names}")
    if found.ball_joints_tried and BALL_FRICTION not in found.free:
        notes.append("friction of the ball joints does not explain the residual")
    return notes


def _row(name: str, value: float, width: float, unit: str) -> tuple[str, ...]:
    shown, factor = _UNITS.get(unit, (unit, 1.0))
    interval, found = measured(factor * width, factor * value)
    if not np.isfinite(width):
        found = number(factor * value, 4)
    return name.replace("_", " "), shown, found, interval


def _table(found: ServoIdentification, weak: bool) -> Table:
    head = ("number", "unit", "found", "±", "") if weak else ("number", "unit", "assumed", "±")
    rows = []
    for k in found.free:
        mark = ("weak" if NAMES[k] in found.weak else "",) if weak else ()
        rows.append((*_row(NAMES[k], found.theta[k], found.intervals[k], UNITS[k]), *mark))
    return Table(head, rows, brief=True)


def _figure(name: str, times: Array, angles: Array) -> Figure:
    """Draw crank angles (n, 6), rad, in degrees or thousandths."""
    unit, factor = unit_for(np.degrees(angles), {"deg": 1.0, "mdeg": 1e3})
    curves = leg_curves(times, factor * np.degrees(angles), "crank")
    return draw([Panel(f"{name}  [{unit}]", curves, legend="panel", height=2.5)])
