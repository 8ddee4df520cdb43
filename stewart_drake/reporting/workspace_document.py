"""What is told of a workspace study."""

from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import numpy as np

from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT
from stewart_drake.native.layout import DEAD_CENTRE_SINE
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
from stewart_drake.reporting.style import FACTORS, UNITS
from stewart_drake.reporting.words import number
from stewart_drake.reporting.workspace_figures import (
    clearance_figure,
    margins_figure,
    motors_figure,
    sections_figure,
)
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.studies.clearance import ClearTravel, Nearest
from stewart_drake.studies.sizing import Sizing
from stewart_drake.studies.workspace import WorkspaceStudy
from stewart_drake.studies.workspace_map import Travel

_COORDINATES: Final = tuple(zip(COORDINATE_NAMES, FACTORS, UNITS, strict=True))
_NEAREST: Final = 8
"""Pairs that are told of even where all of them are apart."""
_MOTORS: Final = {
    "peak_torque": "torque peak [N\u00a0m]",
    "rms_torque": "torque rms [N\u00a0m]",
    "peak_speed": "speed peak [rad/s]",
    "rms_speed": "speed rms [rad/s]",
    "peak_power": "power peak [W]",
    "least_power": "power least [W]",
    "rms_power": "power rms [W]",
}


def document(study: WorkspaceStudy) -> Document:
    """Reach and singularity along the reference, motors, and what is around home."""
    mechanism, summary = study.experiment.mechanism, study.summary
    time, leg, margin = study.worst
    factor = study.factor
    largest = f"{'' if factor.limited else 'more than '}{factor.told} of this one"
    facts = {
        "mechanism": mechanism.name,
        "least reach margin": f"{number(1e3 * margin)} mm, leg {leg}, t = {time:.2f} s",
        "largest amplitude": "-" if np.isnan(factor.value) else largest,
        "least clearance": _nearest_text(study.clearance.along.least(fixed=False)),
    }
    sections = [_along(study, summary), _clearance(study)]
    if study.sizing is not None:
        sections.append(_motors(study.sizing, study.torque_limit, summary["motors"]))
    if study.travel:
        sections.append(_around(study))
    return Document(
        f"Workspace of {mechanism.name}, {study.experiment.scenario.reference.kind} reference",
        study.verdict,
        sections,
        _tone(study),
        facts,
    )


def _tone(study: WorkspaceStudy) -> Tone:
    if study.exit is not None:
        return "bad"
    return "fair" if study.home is not None or study.clearance.along.touching else "good"


def travel_text(travel: list[Travel]) -> str:
    """How far each coordinate goes from home alone, degrees and mm."""
    return ", ".join(
        f"{name} {factor * t.low:.3g} to +{factor * t.high:.3g} {unit}"
        for (name, factor, unit), t in zip(_COORDINATES, travel, strict=True)
    )


def _along(study: WorkspaceStudy, summary: Mapping[str, Any]) -> Section:
    columns = (
        "leg",
        "least reach margin [mm]",
        "at [s]",
        "least sine off dead centre",
        "least transmission",
    )
    rows = [
        (
            str(leg["leg"]),
            number(1e3 * leg["least_reach_margin"]),
            f"{leg['time']:.2f}",
            # A dash where the leg does not reach: there is no angle.
            number(leg["least_sine"] if leg["least_sine"] >= 0 else np.nan),
            number(leg["least_transmission"]),
        )
        for leg in summary["legs"]
    ]
    caption = "Negative margins are missing millimetres."
    length = 1e3 * summary["characteristic_length"]
    home = summary["home"]
    values = {
        "condition": f"home {number(home['condition'])}, "
        f"worst {number(summary['worst_condition'])} on the reference",
        "parallel": f"home {number(home['parallel'])}, least "
        f"{number(summary['least_parallel'])} (a simulation stops at {SINGULARITY_LIMIT:g})",
    }
    text = [
        "The reach margin is how far the rod's end could still be moved before the leg cannot be "
        f"closed. A run ends where a crank comes within {DEAD_CENTRE_SINE:g} (sine of the angle) "
        "of its dead centre: there it cannot follow (serial singularity). It also ends where "
        f"det W falls below {SINGULARITY_LIMIT:g}: there locked cranks no longer hold the plate "
        "(parallel singularity). The transmission is the cosine of the angle between the rod and "
        "the way of the crank's tip.",
        "The condition number is that of A, which takes the plate's twist to crank rates, with "
        f"angular velocities times {length:.4g} mm, the mean distance of the plate joints from "
        "the centre of mass. 1 is a machine alike in all directions.",
        "The largest amplitude scales the motion about its first pose. It is the end of the first "
        "range that fits: beyond, larger motions might fit again.",
    ]
    picture = Picture(
        partial(margins_figure, study.margins, study.exit),
        "Margins along the reference. Dotted: where a simulation stops.",
    )
    table = Table(columns, rows, caption, brief=True)
    return Section("Along the reference", *text, table, Values(values), picture)


def _motors(sizing: Sizing, limit: float | None, motors: list[dict[str, Any]]) -> Section:
    rows = [(str(m["leg"]), *(number(m[name]) for name in _MOTORS)) for m in motors]
    caption = "Per crank, by inverse dynamics of the nominal plant on the reference."
    text = (
        "What the motors must do to follow the reference exactly, without catch-up, feedback and "
        "unknown loads. Negative power is fed back or braked away."
    )
    parts: list[Block | str] = [text, Table(("leg", *_MOTORS.values()), rows, caption, brief=True)]
    if limit is not None:
        used = f"{100 * max(m['use_of_limit'] for m in motors):.3g} %"
        text = f"The largest torque is {used} of the limit, {limit:g} N m."
        parts.append(Paragraph(text, brief=True))
    figure = partial(motors_figure, sizing, limit)
    return Section("Motors", *parts, Picture(figure, "Torque, speed and power per crank."))


def _nearest_text(nearest: Nearest | None) -> str:
    if nearest is None:
        return "-"
    crossing = _crossing(nearest)
    where = f"{nearest.pair}, t = {nearest.time:.2f} s"
    return f"{number(1e3 * nearest.distance)} mm, {where}{crossing and f', {crossing}'}"


def _crossing(nearest: Nearest) -> str:
    """Return whether two parts cross; the disc of the base is only drawn."""
    if nearest.distance >= 0:
        return ""
    return "crosses the disc as drawn" if "base" in nearest.pair else "they cross"


def _clearance(study: WorkspaceStudy) -> Section:
    """Which parts come near each other, or are in each other."""
    found = study.clearance
    rows = [
        (
            str(one.pair),
            number(1e3 * one.distance),
            f"{one.time:.2f}",
            _crossing(one),
        )
        for one in _told(found.along.nearest)
    ]
    columns = ("parts", "distance [mm]", "at [s]", "")
    caption = "On the reference, the nearest first; negative: by how far they are in each other."
    values = {
        "links": _nearest_text(found.along.least(fixed=False)),
        "motors and posts": _nearest_text(found.along.stand),
        "drawn disc of the base": _nearest_text(found.along.disc),
    }
    if found.along.touching:
        told = (f"{one.pair} ({1e3 * one.distance:.1f} mm)" for one in found.along.touching)
        values["links that cross"] = ", ".join(told)
    parts: list[Block | str] = [
        "Least distances on the reference between shapes of the model, without those that meet in "
        "a joint. Links are cranks, rods and plate. A machine's file does not give their "
        "thickness: they are drawn in proportion to its lengths, and so is the base with its "
        "motors. The base's disc may lie elsewhere in a real machine. In a simulation nothing of a "
        "machine touches itself.",
        Values(values),
        Table(columns, rows, caption),
        Picture(
            partial(clearance_figure, found, study.sections, study.experiment.mechanism.home),
            "Left: along the reference; below the dotted line parts are in each other. Right: over "
            "the first section through home, distance of the nearest two links.",
        ),
    ]
    if found.travel:
        names = ("coordinate", "unit", "clear from home down", "ends at", "up", "ends at")
        ways = [_clear_row(*one) for one in zip(_COORDINATES, found.travel, strict=True)]
        caption = "One coordinate alone, until two links touch or the workspace ends."
        parts.append(Table(names, ways, caption))
    return Section("Clearance", *parts)


def _told(nearest: list[Nearest]) -> list[Nearest]:
    """Those that cross, and the nearest of the others."""
    crossing = sum(one.distance < 0 for one in nearest)
    return nearest[: max(crossing, _NEAREST)]


def _clear_row(unit: tuple[str, float, str], way: ClearTravel) -> tuple[str, ...]:
    name, factor, of = unit
    low, high = (
        "the workspace's end" if pair is None else str(pair)
        for pair in (way.low_pair, way.high_pair)
    )
    return name, of, f"{factor * way.low:.4g}", low, f"+{factor * way.high:.4g}", high


def _around(study: WorkspaceStudy) -> Section:
    rows = [
        (name, unit, f"{factor * t.low:.4g}", t.low_reason, f"+{factor * t.high:.4g}",
         t.high_reason)
        for (name, factor, unit), t in zip(_COORDINATES, study.travel, strict=True)
    ]  # fmt: skip
    columns = ("coordinate", "unit", "from home down", "ends because", "up", "ends because")
    caption = "One coordinate alone; the other five stay as at home."
    figure = partial(
        sections_figure, study.sections, study.experiment.mechanism.home, study.margins.pose
    )
    picture = Picture(
        figure,
        "Condition number over sections through home, the other four coordinates as there. Only "
        "the part that is connected with home within the section is shown. The reference is "
        "projected: off the section it may be elsewhere in the workspace.",
    )
    text = "Links that touch end no travel here, see Clearance; nor do cables and covers."
    travel = Values({"from home alone": travel_text(study.travel)})
    return Section("Around home", text, travel, Table(columns, rows, caption), picture)
