"""Documents and figures of a machine that was identified, and of a planned log."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.identification.identify import WRONG, Identification
from stewart_drake.identification.judgement import PoseUncertainty
from stewart_drake.identification.logs import KINDS, Log
from stewart_drake.identification.plan import MOTION, Plan
from stewart_drake.identification.unknowns import DELAY, GEOMETRY, NAMES
from stewart_drake.identification.unknowns import UNITS as SI_UNITS
from stewart_drake.reporting.document import (
    Caution,
    Document,
    Paragraph,
    Picture,
    Table,
    Tone,
    Values,
    table,
)
from stewart_drake.reporting.outline import sections
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.style import FACTORS, LEG_LINES, UNITS
from stewart_drake.reporting.words import number
from stewart_drake.scenario.signals import COORDINATE_NAMES, LEGS
from stewart_drake.types import Array

_UNITS: Final = {
    "N m": ("mN m", 1e3),
    "kg": ("kg", 1.0),
    "N m s/rad": ("mN m s/rad", 1e3),
    "m": ("mm", 1e3),
    "rad": ("mrad", 1e3),
    "s": ("ms", 1e3),
}
"""In which unit an unknown is shown, by its SI unit, and the factor."""
_OF_KIND: Final = {
    "angles": [f"leg {leg}" for leg in LEGS],
    "pose": list(COORDINATE_NAMES),
    "rates": [f"d{name}/dt" for name in COORDINATE_NAMES],
}


def document(found: Identification) -> Document:
    """Return the fit, what was found, what was not."""
    delay = f"{1e3 * found.values[DELAY]:.6g}"
    chi2 = number(found.chi2["all"])
    if found.right:
        interval = number(1e3 * found.std[DELAY], 2)
        if "e" not in interval:  # as many decimals as the interval has
            delay = f"{1e3 * found.values[DELAY]:.{len(interval.partition('.')[2])}f}"
        text = (
            f"The delay is {delay} ± {interval} ms; the machine that was found explains the log "
            f"(chi²/n {chi2})."
        )
    else:
        text = (
            f"No machine within these tolerances explains the log (chi²/n {chi2}, above {WRONG}): "
            f"the values are guesses, among them a delay of {delay} ms, and have no intervals."
        )
    cautions = [Caution(one) for one in _cautions(found)]
    names = file_names(found.logs)
    parts = sections(
        "identification",
        cautions=cautions,
        found=_table(found, geometry=False),
        geometry=_table(found, geometry=True),
        unseen=_unseen(found.unseen),
        chi2=table(
            found.chi2.items(),
            {"of": lambda one: one[0], "chi²/n": lambda one: one[1]},
            brief=True,
        ),
        residuals=[
            Picture(
                partial(residual_figure, found, i),
                f"{name}: what the fit leaves, in standard deviations of a measurement.",
            )
            for i, name in enumerate(names)
        ],
        **(_poses(found.pose_uncertainty) if found.right else {"poses": None, "no_poses": None}),
    )
    facts = {
        "logs": ", ".join(names),
        "mechanism": found.unknowns.mechanism.name,
        "segments": str(len(found.problem.segments)),
    }
    tone: Tone = "bad" if not found.right else "fair" if cautions else "good"
    return Document("A machine from its log", text, parts, tone, facts)


def plan_document(plan: Plan) -> Document:
    """Return the motion, and what its log will tell."""
    std = plan.std
    text = (
        f"A log of this motion will tell the delay to ± {number(1e3 * std[DELAY], 2)} ms and poses "
        f"to {number(1e3 * plan.pose_uncertainty.position[1], 2)} mm."
    )
    free = [k for k in plan.unknowns.free if not _of_geometry(k)]
    parts = sections(
        "identification_plan",
        plan=plan,
        file=MOTION,
        motion=partial(motion_figure, plan),
        found=_unknowns(free, {"now ±": plan.unknowns.std, "after ±": std}, brief=True),
        unseen=_unseen(plan.unseen),
        **_poses(plan.pose_uncertainty),
    )
    facts = {"mechanism": plan.unknowns.mechanism.name, "duration": f"{plan.times[-1]:g} s"}
    return Document("An experiment that tells much", text, parts, "plain", facts)


def file_names(logs: Sequence[Log]) -> list[str]:
    """Return the logs' files, with as many of their folders as tell them from each other."""
    paths = [Path(log.name).resolve().parts for log in logs]
    depth, different = 1, len(set(paths))
    while len({parts[-depth:] for parts in paths}) < different:
        depth += 1
    return ["/".join(parts[-depth:]) for parts in paths]


def _cautions(found: Identification) -> list[str]:
    told = []
    if found.left_out:
        stretches = "stretch" if found.left_out == 1 else "stretches"
        told.append(
            f"{found.left_out} {stretches} of the logs left out, where no trajectory could be "
            "followed"
        )
    beyond = np.abs(found.fit.residuals.prior) > 4
    if beyond.any():
        names = ", ".join(NAMES[k] for k in found.unknowns.free[beyond][:5])
        told.append(f"more than four tolerances off: {names}; is the drawing right?")
    return told


def _of_geometry(k: int) -> bool:
    return GEOMETRY.start <= k < DELAY


def _table(found: Identification, geometry: bool) -> Table:
    free = [k for k in found.unknowns.free if _of_geometry(k) == geometry]
    std = found.std if found.right else np.full(len(found.values), np.nan)
    head = "off the drawing" if geometry else "found"
    values = found.values - found.unknowns.mean if geometry else found.values
    columns = {head: values, "±": std, "± before": found.unknowns.std}
    return _unknowns(free, columns, brief=not geometry)


def _unknowns(free: Sequence[int], columns: dict[str, Array], brief: bool) -> Table:
    """Return name and unit of each unknown, and columns of its numbers."""

    def cell(values: Array, k: int) -> str:
        return number(_UNITS[SI_UNITS[k]][1] * values[k], 4)

    names = {
        "unknown": lambda k: NAMES[k].replace("_", " "),
        "unit": lambda k: _UNITS[SI_UNITS[k]][0],
    }
    cells = {head: partial(cell, values) for head, values in columns.items()}
    return table(free, {**names, **cells}, brief=brief)


def _poses(poses: PoseUncertainty | None) -> dict[str, Any]:
    if poses is None:
        reason = (
            "No figures: the pose in the middle of the motion, measured with the drawn machine, is "
            "outside the workspace of the machine that was found."
        )
        return {"poses": None, "no_poses": Paragraph(reason, brief=True)}

    def told(pair: tuple[float, float], unit: str) -> str:
        middle, worst = (number(1e3 * value, 2) for value in pair)
        return f"{middle} {unit}, at worst {worst} {unit}"

    values = {
        "position": told(poses.position, "mm"),
        "angles": told(poses.angle, "mrad"),
        "position, from the middle": told(poses.position_beside, "mm"),
        "angles, from the middle": told(poses.angle_beside, "mrad"),
    }
    return {"poses": Values(values), "no_poses": None}


def _unseen(directions: tuple[int, list[str]]) -> Paragraph | None:
    count, names = directions
    plural = "direction is" if count == 1 else "directions are"
    text = f"{count} {plural} about as uncertain as before: {'; '.join(names)}."
    return Paragraph(text, brief=True) if count else None


def residual_figure(found: Identification, log: int) -> Figure:
    """Draw what the fit leaves of a log's measurements, by kind, in standard deviations."""
    times, residuals = residuals_of(found, log)
    panels = []
    for kind, part in KINDS.items():
        if found.logs[log].measures(part):
            values = residuals[:, part]
            looks = (line._replace(linewidth=0.9) for line in LEG_LINES)
            curves = [
                Curve(times, values[:, k], label, look)
                for k, (label, look) in enumerate(zip(_OF_KIND[kind], looks, strict=True))
            ]
            limits = {sign * 2.0: f"{sign * 2} standard deviations" for sign in (1, -1)}
            panels.append(Panel(f"{kind}  [std]", curves, limits=limits, legend="panel"))
    return draw(panels)


def residuals_of(found: Identification, log: int) -> tuple[Array, Array]:
    """Return times (n,) of a log in s, and residuals (n, 18) in standard deviations, or NaN."""
    times, rows = [], []
    for i, segment in enumerate(found.problem.segments):
        if segment.log is not found.logs[log]:
            continue
        here = found.fit.residuals.measured[: len(segment.rows), i]
        there = np.isfinite(segment.log.values[segment.rows])
        times.append(segment.log.times[segment.rows])
        rows.append(np.where(there, here, np.nan))
    if not times:
        return np.empty(0), np.empty((0, 18))
    return np.concatenate(times), np.concatenate(rows)


def motion_figure(plan: Plan) -> Figure:
    """Draw the motion that is proposed, degrees and mm from its middle."""
    moved = FACTORS * (plan.poses - np.median(plan.poses, axis=0))
    curves = [
        Curve(plan.times, moved[:, k], name, LEG_LINES[k % 3])
        for k, name in enumerate(COORDINATE_NAMES)
    ]
    panels = [
        Panel(f"from the middle  [{UNITS[k]}]", curves[k : k + 3], legend="panel", height=2.5)
        for k in (0, 3)
    ]
    return draw(panels, 2)
