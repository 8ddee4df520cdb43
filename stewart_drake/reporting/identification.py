"""Documents and figures of an identified machine, and of a planned log."""

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.identification.identify import WRONG, Identification
from stewart_drake.identification.logs import ANGLES, KINDS, Log
from stewart_drake.identification.plan import MOTION, Plan
from stewart_drake.identification.unknowns import DELAY, GEOMETRY, NAMES, OFFSETS
from stewart_drake.identification.unknowns import UNITS as SI_UNITS
from stewart_drake.reporting.document import (
    Document,
    Picture,
    Table,
    from_template,
    measured,
    number,
)
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.style import FACTORS, LEG_LINES, UNITS
from stewart_drake.scenario.signals import COORDINATE_NAMES, LEGS, PAYLOAD
from stewart_drake.studies.verdict import loop_verdict, milliseconds
from stewart_drake.types import Array

_UNITS: Final = {
    "N m": ("mN m", 1e3),
    "kg": ("kg", 1.0),
    "N m s/rad": ("mN m s/rad", 1e3),
    "m": ("mm", 1e3),
    "rad": ("mrad", 1e3),
    "s": ("ms", 1e3),
}
"""Unit in which an unknown is shown and the factor to it, by SI unit."""
_ADJACENT: Final = 0.1  # s between segments that are one stretch
_DOUBTFUL: Final = 1.2  # chi^2 per value of a log that noise does not explain alone
_WEAK: Final = 0.5
"""Standard deviation after the log, relative to that before, above which an unknown is weak."""
_VALUE_NAMES: Final = {
    "angles": [f"leg {leg}" for leg in LEGS],
    "pose": list(COORDINATE_NAMES),
    "rates": [f"d{name}/dt" for name in COORDINATE_NAMES],
}
"""Names of the measured values, by kind of measurement."""


def document(found: Identification, folder: str | Path = "") -> Document:
    """Describe the machine; `folder` is that of its files in the command that uses them."""
    delay_ms, right = 1e3 * found.values[DELAY], found.right
    interval, delay = measured(1e3 * found.std[DELAY], delay_ms)
    cautions, names = _cautions(found), file_names(found.logs)
    return from_template(
        "identification",
        "bad" if not right else "fair" if cautions else "good",
        right=right,
        delay=delay if right else f"{delay_ms:.6g}",
        interval=interval,
        wrong=WRONG,
        logs=names,
        segments=len(found.fit.problem.segments),
        cautions=cautions,
        found=_table(found, geometry=False),
        offsets=_offsets(found) if right else "",
        geometry=_table(found, geometry=True),
        chi2=found.chi2,
        fits=[("tolerances" if k == "prior" else k, chi2) for k, chi2 in found.chi2.items()],
        residuals=[
            Picture(
                partial(residual_figure, found, i),
                f"{name}: residuals of the fit, in standard deviations of a measurement.",
                "residuals",
            )
            for i, name in enumerate(names)
        ],
        weak=_weak(found) if right else [],
        poses=found.pose_uncertainty if right else None,
        outside=right and found.pose_uncertainty is None,
        folder=folder and shlex.quote(str(folder)),
        **dict.fromkeys(("plan", "reduced", "motion", "risk", "heavier")),
        **_shared(found),
    )


def plan_document(plan: Plan) -> Document:
    free = [k for k in plan.unknowns.free if not _of_geometry(k)]
    columns = {"now ± 1 σ": plan.unknowns.std, "after ± 1 σ": plan.std}
    return from_template(
        "identification",
        interval=number(1e3 * plan.std[DELAY], 2),
        file=MOTION,
        motion=partial(motion_figure, plan),
        found=_unknowns(free, columns, brief=True),
        poses=plan.pose_uncertainty,
        reduced=plan.share < 1,
        loop=loop_verdict(plan.margin),
        risk=_risk(plan),
        heavier=f"{max(100.0, 10 * plan.scenario.controller.weights[1]):g}",
        angles=number(1e3 * plan.measured[ANGLES].max(), 2),
        plan=plan,
        logs=(),
        segments="",
        **dict.fromkeys(
            ("cautions", "weak", "outside", "fits", "residuals", "geometry", "offsets")
        ),
        **_shared(plan),
    )


def _risk(plan: Plan) -> str:
    """Return the delay error that the loop tolerates if it is less than the log leaves."""
    margin = plan.margin
    small = margin.stable and margin.weighted and margin.delay_margin < plan.std[DELAY]
    return milliseconds(margin.delay_margin) if plan.kept and small else ""


def _shared(study: Identification | Plan) -> dict[str, Any]:
    """Return the values of the template that both documents have."""
    return {
        "mechanism": study.unknowns.mechanism.name,
        "unseen": study.unseen[0] > 0,
        "directions": study.unseen,
        "median_and_worst": _median_and_worst,
    }


def _median_and_worst(values: tuple[float, float], unit: str) -> str:
    median, worst = (number(1e3 * value, 2) for value in values)
    return f"{median} {unit}, at worst {worst} {unit}"


def file_names(logs: Sequence[Log]) -> list[str]:
    """Return the paths of the logs, shortened to the last parts that keep them distinct."""
    paths = [Path(log.name).resolve().parts for log in logs]
    depth, different = 1, len(set(paths))
    while len({parts[-depth:] for parts in paths}) < different:
        depth += 1
    return ["/".join(parts[-depth:]) for parts in paths]


def _cautions(found: Identification) -> list[str]:
    cautions = []
    step = max(log.step for log in found.logs)
    if step and found.unknowns.std[DELAY]:
        cautions.append(
            f"a log of the multibody plant: its steps shift the delay by up to {1e3 * step:g} ms, "
            "which its interval contains; plant.kind=exact has no such error"
        )
    payload, std = found.values[PAYLOAD], found.std[PAYLOAD]
    if found.right and payload < -2 * std:
        plate = found.unknowns.mechanism.plate.mass + payload
        cautions.append(
            "a negative payload: the plate is lighter than the mechanism file says; set its "
            f"plate.mass to {plate:.4g} kg and identify again, since plant.payload_mass is at "
            "least 0"
        )
    if found.right and (ratio := found.chi2["all"]) > _DOUBTFUL:
        cautions.append(
            f"chi²/n of {ratio:.2f} is more than noise explains: true errors may be several of the "
            "stated deviations; log the motion of --plan"
        )
    if found.right and not found.fit.promised < 1:
        cautions.append(
            "the search ended before the minimum: values may be wrong by several of the stated "
            "deviations; log a motion with less friction, or the motion of --plan"
        )
    cautions += _left_out(found)
    far = found.unknowns.free[np.abs(found.fit.residuals.prior) > 4]
    zeros = [k for k in far if OFFSETS.start <= k < OFFSETS.stop]
    if zeros:
        legs = ", ".join(f"leg {LEGS[k - OFFSETS.start]}" for k in zeros)
        limit = f"{4e3 * found.unknowns.std[OFFSETS.start]:.3g}"
        cautions.append(f"encoder zeros more than {limit} mrad (four tolerances) off: {legs}")
    if others := [NAMES[k] for k in far if k not in zeros][:5]:
        cautions.append(
            f"more than four tolerances off: {', '.join(others)}; is the drawing right?"
        )
    return cautions


def _left_out(found: Identification) -> list[str]:
    """Return the parts of the logs that the fit leaves out, in s."""
    told, kept = [], {id(segment) for segment in found.fit.problem.segments}
    for log, name, end in zip(found.logs, file_names(found.logs), found.ends, strict=True):
        spans = list[list[float]]()
        for segment in found.fit.whole.segments:
            if segment.log.name != log.name or id(segment) in kept:
                continue
            if spans and spans[-1][1] >= segment.start - _ADJACENT:
                spans[-1][1] = segment.log.times[segment.rows[-1]]
            else:
                spans.append([segment.start, segment.log.times[segment.rows[-1]]])
        if spans:
            listed = ", ".join(f"{a:.4g} to {b:.4g} s" for a, b in spans[:5])
            more = f" and {len(spans) - 5} more" if len(spans) > 5 else ""
            told.append(f"{name}: left out {listed}{more}: no trajectory fits there")
        if log.times[-1] < end:
            told.append(
                f"{name}: left out {log.times[-1]:.4g} to {end:.4g} s: the search found no machine "
                "that explains the whole log; did the plate tremble later, or was it lost? Cut the "
                "log before that to use more of it"
            )
    return told


def _weak(found: Identification) -> list[str]:
    """Return the names of the unknowns, without the geometry, that are hardly better known."""
    before = found.unknowns.std
    others = (k for k in found.unknowns.free if not _of_geometry(k))
    return [NAMES[k].replace("_", " ") for k in others if found.std[k] > _WEAK * before[k]]


def _offsets(found: Identification) -> str:
    """Return the encoders' offsets in mrad, or nothing if they are known."""
    pairs = [
        measured(1e3 * std, 1e3 * value)
        for std, value in zip(found.std[OFFSETS], found.values[OFFSETS], strict=True)
        if std > 0
    ]
    return ", ".join(f"{value} ± {std}" for std, value in pairs)


def _of_geometry(k: int) -> bool:
    """Return whether an unknown belongs to the geometry, or is an offset of a crank angle."""
    return GEOMETRY.start <= k < DELAY


def _table(found: Identification, geometry: bool) -> Table:
    free = [k for k in found.unknowns.free if _of_geometry(k) == geometry]
    std = found.std if found.right else np.full(len(found.values), np.nan)
    head = "off the drawing" if geometry else "found"
    values = found.values - found.unknowns.mean if geometry else found.values
    columns = {head: values, "± 1 σ": std, "± 1 σ before": found.unknowns.std}
    return _unknowns(free, columns, brief=not geometry)


def _unknowns(free: Sequence[int], columns: dict[str, Array], brief: bool) -> Table:
    """Return a table of unknowns: name, unit, and their numbers by the head of the column.

    If there is a column `± 1 σ`, the numbers of the first column have as many decimals as it.
    """
    rows = []
    for k in free:
        unit, factor = _UNITS[SI_UNITS[k]]
        values = {head: factor * column[k] for head, column in columns.items()}
        texts = {head: number(value) for head, value in values.items()}
        if np.isfinite(values.get("± 1 σ", np.nan)):
            first = next(iter(columns))
            texts["± 1 σ"], texts[first] = measured(values["± 1 σ"], values[first])
        rows.append((NAMES[k].replace("_", " "), unit, *texts.values()))
    return Table(("unknown", "unit", *columns), rows, brief=brief)


def residual_figure(found: Identification, index: int) -> Figure:
    """Draw the residuals of the log with this index."""
    times, residuals = residuals_of(found, found.logs[index])
    lines = [line._replace(linewidth=0.9) for line in LEG_LINES]
    limits = {2.0: "2 standard deviations", -2.0: "-2 standard deviations"}
    panels = []
    for kind, part in KINDS.items():
        if found.logs[index].measures(part):
            drawn = zip(residuals[:, part].T, _VALUE_NAMES[kind], lines, strict=True)
            curves = [Curve(times, values, name, line) for values, name, line in drawn]
            panels.append(Panel(f"{kind}  [std]", curves, limits=limits, legend="panel"))
    return draw(panels)


def residuals_of(found: Identification, log: Log) -> tuple[Array, Array]:
    """Return times (n,) of a log in s, and residuals (n, 18) in standard deviations."""
    times, rows = [np.empty(0)], [np.empty((0, 18))]
    for i, segment in enumerate(found.fit.problem.segments):
        if segment.log.name == log.name:  # a fit may leave out samples of the log
            fitted = found.fit.residuals.measured[: len(segment.rows), i]
            has_value = np.isfinite(segment.log.values[segment.rows])
            times.append(segment.log.times[segment.rows])
            rows.append(np.where(has_value, fitted, np.nan))
    return np.concatenate(times), np.concatenate(rows)


def motion_figure(plan: Plan) -> Figure:
    from_middle = FACTORS * (plan.poses - np.median(plan.poses, axis=0))
    curves = [
        Curve(plan.times, from_middle[:, k], name, LEG_LINES[k % 3])
        for k, name in enumerate(COORDINATE_NAMES)
    ]
    panels = [
        Panel(f"from the middle  [{UNITS[k]}]", curves[k : k + 3], legend="panel", height=2.5)
        for k in (0, 3)
    ]
    return draw(panels, 2)
