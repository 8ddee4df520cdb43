"""What is told of a machine that was identified, and of a planned log."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from stewart_drake.identification.identify import WRONG, Identification
from stewart_drake.identification.judgement import PoseUncertainty
from stewart_drake.identification.logs import Log
from stewart_drake.identification.plan import MOTION, Plan
from stewart_drake.identification.unknowns import DELAY, GEOMETRY, NAMES, UNITS
from stewart_drake.reporting.document import (
    Block,
    Caution,
    Document,
    Paragraph,
    Picture,
    Section,
    Table,
    Tone,
    Values,
)
from stewart_drake.reporting.identification_figures import motion_figure, residual_figure
from stewart_drake.reporting.words import number

_UNITS: Final = {
    "N m": ("mN m", 1e3),
    "kg": ("kg", 1.0),
    "N m s/rad": ("mN m s/rad", 1e3),
    "m": ("mm", 1e3),
    "rad": ("mrad", 1e3),
    "s": ("ms", 1e3),
}
"""How an unknown's SI unit is told, and the factor."""
_FIT_TEXT: Final = (
    "chi²/n is the mean square of what the fit leaves, in standard deviations of the measurement: "
    "1 where the model explains all but the measurements' own errors."
)
_POSES_TEXT: Final = (
    "Standard deviation of a pose that is computed from crank angles with the geometry found, "
    "the largest of three coordinates. From the middle: of the change from the pose in the middle "
    "of the motion, where it does not matter how base and plate stand in their frames."
)


def document(found: Identification) -> Document:
    """The fit, what was found, what was not."""
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
    sections = [
        Section("What was found", *cautions, _table(found, geometry=False)),
        _poses(found.pose_uncertainty) if found.right else Section(""),
        _unseen(found.unseen),
        Section("The fit", _FIT_TEXT, _chi2(found), *_pictures(found)),
        Section("Geometry and offsets", _table(found, geometry=True), folded=True),
    ]
    facts = {
        "logs": ", ".join(file_names(found.logs)),
        "mechanism": found.unknowns.mechanism.name,
        "segments": str(len(found.problem.segments)),
    }
    shown = [section for section in sections if section.blocks]
    tone: Tone = "bad" if not found.right else "fair" if cautions else "good"
    return Document("A machine from its log", text, shown, tone, facts)


def file_names(logs: Sequence[Log]) -> list[str]:
    """The logs' files, with as many of their folders as tell them from each other."""
    paths = [Path(log.name).resolve().parts for log in logs]
    depth, different = 1, len(set(paths))
    while len({parts[-depth:] for parts in paths}) < different:
        depth += 1
    return ["/".join(parts[-depth:]) for parts in paths]


def plan_document(plan: Plan) -> Document:
    """The motion, and what its log will tell."""
    std = plan.std
    text = (
        f"A log of this motion will tell the delay to ± {number(1e3 * std[DELAY], 2)} ms and poses "
        f"to {number(1e3 * plan.pose_uncertainty.position[1], 2)} mm."
    )
    rows = [
        _row(NAMES[k], UNITS[k], [plan.unknowns.std[k], std[k]])
        for k in plan.unknowns.free
        if not _of_geometry(k)
    ]
    table = Table(
        ("unknown", "unit", "now ±", "after ±"),
        rows,
        "Standard deviations before and after the log.",
        brief=True,
    )
    share = Paragraph(
        f"The amplitude is {100 * plan.share:.0f} % of what was asked for: more does not stay well "
        "inside the workspace.",
        brief=True,
    )
    sections = [
        Section("The motion", *[share] * (plan.share < 1), _motion_picture(plan)),
        Section("What its log will tell", table),
        _poses(plan.pose_uncertainty),
        _unseen(plan.unseen),
    ]
    facts = {"mechanism": plan.unknowns.mechanism.name, "duration": f"{plan.times[-1]:g} s"}
    shown = [section for section in sections if section.blocks]
    return Document("An experiment that tells much", text, shown, "plain", facts)


def _motion_picture(plan: Plan) -> Picture:
    return Picture(partial(motion_figure, plan), f"The motion of {MOTION}, from its middle.")


def _cautions(found: Identification) -> list[str]:
    """What the reader must know before using the numbers."""
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
    rows = []
    for k in found.unknowns.free:
        if _of_geometry(k) == geometry:
            std = found.std[k] if found.right else np.nan
            before, value = found.unknowns.mean[k], found.values[k]
            shown = [value - before if geometry else value, std, found.unknowns.std[k]]
            rows.append(_row(NAMES[k], UNITS[k], shown))
    head = "off the drawing" if geometry else "found"
    return Table(("unknown", "unit", head, "±", "± before"), rows, brief=not geometry)


def _row(name: str, unit: str, values: Sequence[float]) -> list[str]:
    """Name, unit, and the values in it."""
    told, factor = _UNITS[unit]
    return [name.replace("_", " "), told, *(number(factor * value, 4) for value in values)]


def _chi2(found: Identification) -> Table:
    rows = [[kind, number(value)] for kind, value in found.chi2.items()]
    return Table(("of", "chi²/n"), rows, brief=True)


def _pictures(found: Identification) -> list[Block]:
    return [
        Picture(
            partial(residual_figure, found, i),
            f"{name}: what the fit leaves, in standard deviations of a measurement.",
        )
        for i, name in enumerate(file_names(found.logs))
    ]


def _poses(poses: PoseUncertainty | None) -> Section:
    heading = "Poses from crank angles, over the workspace"
    if poses is None:
        reason = (
            "No figures: the pose in the middle of the motion, measured with the drawn machine, is "
            "outside the workspace of the machine that was found."
        )
        return Section(heading, Paragraph(reason, brief=True))

    def told(pair: tuple[float, float], unit: str) -> str:
        middle, worst = (number(1e3 * value, 2) for value in pair)
        return f"{middle} {unit}, at worst {worst} {unit}"

    values = Values(
        {
            "position": told(poses.position, "mm"),
            "angles": told(poses.angle, "mrad"),
            "position, from the middle": told(poses.position_beside, "mm"),
            "angles, from the middle": told(poses.angle_beside, "mrad"),
        }
    )
    return Section(heading, _POSES_TEXT, values)


def _unseen(directions: tuple[int, list[str]]) -> Section:
    count, names = directions
    if not count:
        return Section("")
    plural = "direction is" if count == 1 else "directions are"
    text = f"{count} {plural} about as uncertain as before: {'; '.join(names)}."
    return Section("What the log does not see", Paragraph(text, brief=True))
