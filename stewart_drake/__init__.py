"""Delay-aware control of rotary Stewart platforms, with Drake."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from stewart_drake.dynamics.stewart import StewartDynamics
    from stewart_drake.files.errors import ConfigError
    from stewart_drake.loop.diagram import build_closed_loop
    from stewart_drake.loop.exact import ExactPlant, set_accuracy
    from stewart_drake.loop.law_design import DesignedLaw, design_law
    from stewart_drake.loop.platforms import AddStewartPlatform, StewartPlatform
    from stewart_drake.loop.results import SimulationResult
    from stewart_drake.loop.simulation import simulate
    from stewart_drake.loop.state_space import linear_models
    from stewart_drake.mechanism.files import load_mechanism
    from stewart_drake.mechanism.geometry import Mechanism
    from stewart_drake.mechanism.kinematics import ForwardKinematicsError, UnreachablePoseError
    from stewart_drake.reporting.answer import Answer
    from stewart_drake.reporting.api import (
        analyze_delay,
        analyze_hautus,
        analyze_link,
        analyze_robustness,
        analyze_workspace,
        layout,
        plot,
        replay,
        report,
        table,
    )
    from stewart_drake.scenario.config import ControllerConfig, PlantConfig, Scenario
    from stewart_drake.scenario.loading import load_scenario
    from stewart_drake.studies.compare import compare

# Names are imported when first asked for, so that the command answers --help without Drake.
_MODULES = {
    "AddStewartPlatform": "loop.platforms",
    "Answer": "reporting.answer",
    "ConfigError": "files.errors",
    "ControllerConfig": "scenario.config",
    "DesignedLaw": "loop.law_design",
    "ExactPlant": "loop.exact",
    "ForwardKinematicsError": "mechanism.kinematics",
    "Mechanism": "mechanism.geometry",
    "PlantConfig": "scenario.config",
    "Scenario": "scenario.config",
    "SimulationResult": "loop.results",
    "StewartDynamics": "dynamics.stewart",
    "StewartPlatform": "loop.platforms",
    "UnreachablePoseError": "mechanism.kinematics",
    "analyze_delay": "reporting.api",
    "analyze_hautus": "reporting.api",
    "analyze_link": "reporting.api",
    "analyze_robustness": "reporting.api",
    "analyze_workspace": "reporting.api",
    "build_closed_loop": "loop.diagram",
    "compare": "studies.compare",
    "design_law": "loop.law_design",
    "layout": "reporting.api",
    "linear_models": "loop.state_space",
    "load_mechanism": "mechanism.files",
    "load_scenario": "scenario.loading",
    "plot": "reporting.api",
    "replay": "reporting.api",
    "report": "reporting.api",
    "set_accuracy": "loop.exact",
    "simulate": "loop.simulation",
    "table": "reporting.api",
}

__all__ = [
    "__version__",
    "AddStewartPlatform",
    "Answer",
    "ConfigError",
    "ControllerConfig",
    "DesignedLaw",
    "ExactPlant",
    "ForwardKinematicsError",
    "Mechanism",
    "PlantConfig",
    "Scenario",
    "SimulationResult",
    "StewartDynamics",
    "StewartPlatform",
    "UnreachablePoseError",
    "analyze_delay",
    "analyze_hautus",
    "analyze_link",
    "analyze_robustness",
    "analyze_workspace",
    "build_closed_loop",
    "compare",
    "design_law",
    "layout",
    "linear_models",
    "load_mechanism",
    "load_scenario",
    "plot",
    "replay",
    "report",
    "set_accuracy",
    "simulate",
    "table",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("stewart-drake")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
