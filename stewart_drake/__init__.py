"""Delay-aware control of rotary Stewart platforms, with Drake."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stewart_drake.config import Scenario
    from stewart_drake.diagram import build_closed_loop
    from stewart_drake.errors import ConfigError
    from stewart_drake.mechanism.files import load_mechanism
    from stewart_drake.mechanism.geometry import Mechanism
    from stewart_drake.mechanism.kinematics import ForwardKinematicsError, UnreachablePoseError
    from stewart_drake.plant.dynamics import StewartDynamics
    from stewart_drake.results import SimulationResult
    from stewart_drake.scenario_loading import load_scenario
    from stewart_drake.simulation import simulate

# Names are imported when first asked for, so that the command answers --help without Drake.
_MODULES = {
    "ConfigError": "errors",
    "ForwardKinematicsError": "mechanism.kinematics",
    "Mechanism": "mechanism.geometry",
    "Scenario": "config",
    "SimulationResult": "results",
    "StewartDynamics": "plant.dynamics",
    "UnreachablePoseError": "mechanism.kinematics",
    "build_closed_loop": "diagram",
    "load_mechanism": "mechanism.files",
    "load_scenario": "scenario_loading",
    "simulate": "simulation",
}

__all__ = [
    "ConfigError",
    "ForwardKinematicsError",
    "Mechanism",
    "Scenario",
    "SimulationResult",
    "StewartDynamics",
    "UnreachablePoseError",
    "build_closed_loop",
    "load_mechanism",
    "load_scenario",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
