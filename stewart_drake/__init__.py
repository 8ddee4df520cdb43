"""Delay-aware control of rotary Stewart platforms, with Drake."""

from importlib import import_module
from typing import Any, Final

from stewart_drake.reporting.analyses import ANALYSES, words_of

_PUBLIC: Final = {
    "functions": "check_model evaluate_tuner export_c export_csv identify make_tuner_data "
    "model_sdf new plan_identification replay_log run_live run_machine setpoints train_tuner "
    "view_model",
    "files.resources": "shipped",
    "dynamics.stewart": "StewartDynamics",
    "files.errors": "ConfigError",
    "loop.diagram": "ClosedLoop build_closed_loop",
    "loop.exact": "ExactPlant set_accuracy",
    "loop.law_design": "DesignedLaw design_law",
    "loop.peer": "machine_identity",
    "loop.platforms": "AddStewartPlatform StewartPlatform",
    "loop.controller_margin": "linear_models",
    "mechanism.files": "load_mechanism",
    "mechanism.geometry": "Mechanism",
    "mechanism.kinematics": "ForwardKinematicsError UnreachablePoseError",
    "reporting.api": "compare controller_margin report simulate "
    + " ".join("_".join(words_of(n)) for n in ANALYSES),
    "reporting.results": "AnalysisResult ComparisonResult ControllerMargin SimulationResult",
    "scenario.config": "ActuatorConfig ControllerConfig DelayConfig EncoderSensorConfig "
    "PlantConfig PositionServoConfig Scenario SensorConfig ServoActuatorConfig StateSensorConfig "
    "TorqueActuatorConfig TunerConfig",
    "scenario.link_config": "LinkConfig NetworkConfig WireConfig",
    "scenario.loading": "load_scenario",
    "scenario.run_log": "read_log",
    "scenario.reference_config": "CsvConfig HoldConfig ReachyMoveConfig ReferenceConfig SineConfig "
    "WaypointsConfig",
}
"""Public names by module. *.ci/public_names.py* writes a stub for type checkers from it.

Names are imported when first used, so that the command answers --help without Drake.
"""
_MODULES: Final = ("law", "systems")
_RENAMED: Final = {
    "Answer": "sd.AnalysisResult",
    "plot": "the method plot() of a result",
    "replay": "the method replay() of a result",
    "table": "the method table() of a result",
}

_HOMES: Final = {name: module for module, names in _PUBLIC.items() for name in names.split()}
__all__ = sorted(["__version__", *_HOMES, *_MODULES])


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("stewart-drake")
    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    if name not in _HOMES:
        now = f"; it is {_RENAMED[name]} now" if name in _RENAMED else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{now}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
