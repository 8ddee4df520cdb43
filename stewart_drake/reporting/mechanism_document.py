"""What is told of a mechanism at its home pose, held there under gravity."""

import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.reporting.document import Document, Section, Values
from stewart_drake.reporting.words import number
from stewart_drake.reporting.workspace_document import travel_text
from stewart_drake.studies.mechanism_check import MechanismCheck
from stewart_drake.types import Array


def document(check: MechanismCheck) -> Document:
    """What `model check` prints."""
    mechanism, measures = check.mechanism, check.measures
    cranks, rods = _lengths(mechanism.crank_lengths), _lengths(mechanism.rod_lengths)
    entries = {
        "name": mechanism.name,
        "lengths": f"cranks {cranks} mm, rods {rods} mm",
        "inertias": _inertias(mechanism),
        "crank angles": _six(np.rad2deg(check.crank_angles), "deg"),
        "reach margin": _six(1e3 * measures.reach, "mm"),
        "sine off dead centre": _six(measures.sines, ""),
        "singularity measure": f"{number(measures.parallel)} (parallel; a simulation stops at "
        f"{SINGULARITY_LIMIT:g})",
    }
    if check.failure is None:
        limit = mechanism.effort_limit
        entries |= {
            "condition number": f"{number(measures.condition)}; 1 mrad of crank error moves the "
            f"plate by {number(1e3 * measures.play * 1e-3)} mm at most",
            "torque to hold": _six(check.torque, "N m")
            + ("" if limit is None else f" (limit {limit:g})"),
            "open-loop poles": _poles(check.poles),
            "from home alone": travel_text(check.travel),
        }
    return Document(mechanism.name, check.verdict, [Section("", Values(entries))])


def _inertias(mechanism: Mechanism) -> str:
    """Principal moments of what moves, and which of them nobody measured."""
    parts = []
    for name, shape in (("plate", "disc"), ("crank", "bar"), ("rod", "bar")):
        body = getattr(mechanism, name)
        moments = ", ".join(f"{value:.3g}" for value in body.inertia)
        note = f" (estimated: uniform {shape})" if body.estimated else ""
        parts.append(f"{name} {moments}{note}")
    return "; ".join(parts) + " kg m^2"


def _six(values: Array, unit: str) -> str:
    return (", ".join(number(value) for value in values) + f" {unit}").rstrip()


def _lengths(values: Array) -> str:
    """One number where all are alike."""
    alike = bool(np.ptp(values) < 1e-12)
    return ", ".join(number(1e3 * value) for value in (values[:1] if alike else values))


def _poles(poles: NDArray[np.complex128]) -> str:
    """Growing, oscillating and resting ones; a frictionless machine has each with its mirror."""
    fastest = np.abs(poles).max()
    grow = [pole.real for pole in poles if pole.real > 1e-6 * fastest]
    swing = [pole.imag for pole in poles if abs(pole.real) <= 1e-6 * fastest < pole.imag]
    parts = []
    if grow:
        parts.append("unstable " + ", ".join(map(number, grow)) + " /s")
    if swing:
        parts.append("oscillating " + ", ".join(map(number, swing)) + " rad/s")
    return "; ".join(parts) or "all zero"
