"""A workspace study as a table for a terminal and as a page."""

from typing import Any, Final

import numpy as np

from stewart_drake.dynamics.equations import DEAD_CENTRE_SINE
from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT
from stewart_drake.report.page import Page, Picture, Provenance, Section, Table
from stewart_drake.report.tables import number, rows, wrap
from stewart_drake.report.workspace_figures import (
    margins_figure,
    motors_figure,
    sections_figure,
)
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.studies.sizing import Sizing
from stewart_drake.studies.workspace import WorkspaceStudy
from stewart_drake.studies.workspace_map import Travel

_LEGS: Final = "{:<5}{:>10}{:>8}{:>8}{:>10}{:>10}{:>9}{:>9}{:>10}"


def workspace_table(study: WorkspaceStudy) -> str:
    """The verdict, then a row per leg; 80 columns."""
    summary = study.summary
    lines = [
        wrap(study.verdict),
        _LEGS.format("", "reach", "at", "sine", "torque", "torque", "speed", "power", "power"),
        _LEGS.format(
            "leg", "min mm", "s", "min", "peak N m", "rms N m", "rad/s", "peak W", "rms W"
        ),
    ]
    motors = summary["motors"] or [{}] * 6
    for leg, motor in zip(summary["legs"], motors, strict=True):
        lines.append(
            _LEGS.format(
                leg["leg"],
                number(1e3 * leg["least_reach_margin"]),
                f"{leg['time']:.2f}",
                _sine(leg, 2),
                *(
                    number(motor.get(name, np.nan))
                    for name in (
                        "peak_torque",
                        "rms_torque",
                        "peak_speed",
                        "peak_power",
                        "rms_power",
                    )
                ),
            )
        )
    entries = {
        "condition": f"home {number(summary['home']['condition'])}, "
        f"worst {number(summary['worst_condition'])} on the reference",
        "parallel": f"home {number(summary['home']['parallel'])}, least "
        f"{number(summary['least_parallel'])} (a simulation stops at {SINGULARITY_LIMIT:g})",
    }
    if study.torque_limit is not None and summary["motors"]:
        used = max(motor["use_of_limit"] for motor in summary["motors"])
        entries["motors"] = f"the reference takes {100 * used:.3g} % of {study.torque_limit:g} N m"
    if study.travel:
        entries["from home"] = travel_text(study.travel)
    return "\n".join([*lines, rows(entries)])


def travel_text(travel: list[Travel]) -> str:
    """How far each coordinate goes from home alone, degrees and mm."""
    parts = []
    for k, t in enumerate(travel):
        factor, unit = _unit(k)
        parts.append(f"{COORDINATE_NAMES[k]} {factor * t.low:.3g} to +{factor * t.high:.3g} {unit}")
    return ", ".join(parts)


def workspace_page(study: WorkspaceStudy, made: Provenance) -> Page:
    """The study as a page; sections that have nothing to show are left out."""
    scenario = study.experiment.scenario
    mechanism = study.experiment.mechanism
    summary = study.summary
    facts = {
        "mechanism": mechanism.name,
        "least reach margin": f"{number(1e3 * study.worst[2])} mm, leg {study.worst[1]}, "
        f"t = {study.worst[0]:.2f} s",
        "largest amplitude": _factor(study),
        "condition number": f"{number(summary['home']['condition'])} at home, "
        f"{number(summary['worst_condition'])} at worst",
    }
    parts = [_along(study, summary)]
    if study.sizing is not None:
        parts.append(_motors(study.sizing, study.torque_limit, summary["motors"]))
    if study.travel:
        parts.append(_around(study))
    fits = study.exit is None
    return Page(
        title=f"Workspace of {mechanism.name}, {scenario.reference.kind} reference",
        verdict=study.verdict[:1].upper() + study.verdict[1:],
        sections=parts,
        provenance=made,
        tone="bad" if not fits else "fair" if study.home is not None else "good",
        facts=facts,
    )


def _along(study: WorkspaceStudy, summary: dict[str, Any]) -> Section:
    table = Table(
        (
            "leg",
            "least reach margin [mm]",
            "at [s]",
            "least sine off dead centre",
            "least transmission",
        ),
        [
            (
                str(leg["leg"]),
                number(1e3 * leg["least_reach_margin"]),
                f"{leg['time']:.2f}",
                _sine(leg),
                number(leg["least_transmission"]),
            )
            for leg in summary["legs"]
        ],
        "Along the reference; negative margins are missing millimetres.",
    )
    length = 1e3 * summary["characteristic_length"]
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
        margins_figure(study.margins, study.exit),
        "Margins along the reference. Dotted: where a simulation stops.",
    )
    return Section("Along the reference", text, [table], [picture])


def _motors(sizing: Sizing, torque_limit: float | None, motors: list[dict[str, Any]]) -> Section:
    names = {
        "peak_torque": "torque peak [N\u00a0m]",
        "rms_torque": "torque rms [N\u00a0m]",
        "peak_speed": "speed peak [rad/s]",
        "rms_speed": "speed rms [rad/s]",
        "peak_power": "power peak [W]",
        "least_power": "power least [W]",
        "rms_power": "power rms [W]",
    }
    table = Table(
        ("leg", *names.values()),
        [(str(m["leg"]), *(number(m[name]) for name in names)) for m in motors],
        "Per crank, by inverse dynamics of the nominal plant on the reference.",
    )
    text = [
        "What the motors must do to follow the reference exactly, without catch-up, feedback and "
        "unknown loads. Negative power is fed back or braked away."
    ]
    if torque_limit is not None:
        used = max(m["use_of_limit"] for m in motors)
        text.append(f"The largest torque is {100 * used:.3g} % of the limit, {torque_limit:g} N m.")
    picture = Picture(motors_figure(sizing, torque_limit), "Torque, speed and power per crank.")
    return Section("Motors", text, [table], [picture])


def _around(study: WorkspaceStudy) -> Section:
    table_rows = []
    for k, t in enumerate(study.travel):
        factor, unit = _unit(k)
        table_rows.append(
            (
                COORDINATE_NAMES[k],
                unit,
                f"{factor * t.low:.4g}",
                t.low_reason,
                f"+{factor * t.high:.4g}",
                t.high_reason,
            )
        )
    table = Table(
        ("coordinate", "unit", "from home down", "ends because", "up", "ends because"),
        table_rows,
        "One coordinate alone; the other five stay as at home.",
    )
    picture = Picture(
        sections_figure(study.sections, study.experiment.mechanism.home, study.margins.pose),
        "Condition number over sections through home, the other four coordinates as there. Only "
        "the part that is connected with home within the section is shown. The reference is "
        "projected: off the section it may be elsewhere in the workspace.",
    )
    text = [
        "No contact between parts is modelled: cables, covers and crossing rods may end a motion "
        "earlier."
    ]
    return Section("Around home", text, [table], [picture])


def _sine(leg: dict[str, Any], digits: int = 3) -> str:
    """What is left to the dead centre; a dash where the leg does not reach: there is no angle."""
    value = leg["least_sine"]
    return number(value if value >= 0 else np.nan, digits)


def _factor(study: WorkspaceStudy) -> str:
    factor = study.factor
    if np.isnan(factor.value):
        return "-"
    return f"{'' if factor.limited else 'more than '}{factor.told} of this one"


def _unit(coordinate: int) -> tuple[float, str]:
    return (180 / np.pi, "deg") if coordinate < 3 else (1e3, "mm")
