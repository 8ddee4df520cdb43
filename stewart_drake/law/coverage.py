"""Parts of a law that the core does not have: `export-c` refuses them, and runs call Python."""

from typing import Any, Final

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.core_law import in_python
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.sensing import EncoderSensing, StateSensing
from stewart_drake.law.servos import ServoPreview
from stewart_drake.law.timeline import Timeline

_FIELDS: Final = {
    "observer": "controller.estimate",
    "feedforward": "controller.feedforward",
    "planner": "controller.replan",
    "predictor": "controller.prediction",
    "model": "controller.model",
    "cost": "controller.kind",
    "channel": "link.kind",
}


def uncovered_part(law: PredictiveLqi | ServoPreview) -> str | None:
    """Return the scenario field of the first part that the core does not have, or None.

    A user's part counts as another kind of that field.
    """
    parts: Any = in_python(law)
    covered = {
        "controller.limits": not hasattr(law, "limits"),
        "controller.learned": getattr(law, "learned", None) is None,
        "law": type(law) in (PredictiveLqi, ServoPreview) and type(law.plant) is NominalPlant,
        "plant.kind": type(law.plant.dynamics) is StewartDynamics,
        "sensor.kind": type(law.sensing) in (StateSensing, EncoderSensing),
        "actuator.kind": type(law.plant.motors) is TorqueLimit,
        "controller.delay_steps": type(law.timeline) is Timeline,
    } | {field: name not in parts for name, field in _FIELDS.items()}
    return next((field for field, yes in covered.items() if not yes), None)


def backend(law: PredictiveLqi | ServoPreview) -> str:
    """Return `native`, with the first part of a law that is in Python."""
    field = uncovered_part(law)
    return "native" if field is None else f"native, {field} in Python"
