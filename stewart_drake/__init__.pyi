# Written by .ci/public_names.py.
import collections.abc
import pathlib
import typing

import stewart_drake.reporting.results
import stewart_drake.scenario.config
import stewart_drake.studies.study_options
from stewart_drake import law as law
from stewart_drake import systems as systems
from stewart_drake.dynamics.stewart import StewartDynamics as StewartDynamics
from stewart_drake.files.errors import ConfigError as ConfigError
from stewart_drake.files.resources import shipped as shipped
from stewart_drake.functions import check_model as check_model
from stewart_drake.functions import export_c as export_c
from stewart_drake.functions import export_csv as export_csv
from stewart_drake.functions import identify as identify
from stewart_drake.functions import model_sdf as model_sdf
from stewart_drake.functions import plan_identification as plan_identification
from stewart_drake.functions import replay_log as replay_log
from stewart_drake.functions import setpoints as setpoints
from stewart_drake.functions import view_model as view_model
from stewart_drake.loop.controller_margin import linear_models as linear_models
from stewart_drake.loop.diagram import ClosedLoop as ClosedLoop
from stewart_drake.loop.diagram import build_closed_loop as build_closed_loop
from stewart_drake.loop.exact import ExactPlant as ExactPlant
from stewart_drake.loop.exact import set_accuracy as set_accuracy
from stewart_drake.loop.law_design import DesignedLaw as DesignedLaw
from stewart_drake.loop.law_design import design_law as design_law
from stewart_drake.loop.peer import machine_identity as machine_identity
from stewart_drake.loop.platforms import AddStewartPlatform as AddStewartPlatform
from stewart_drake.loop.platforms import StewartPlatform as StewartPlatform
from stewart_drake.mechanism.files import load_mechanism as load_mechanism
from stewart_drake.mechanism.geometry import Mechanism as Mechanism
from stewart_drake.mechanism.kinematics import ForwardKinematicsError as ForwardKinematicsError
from stewart_drake.mechanism.kinematics import UnreachablePoseError as UnreachablePoseError
from stewart_drake.reporting.api import compare as compare
from stewart_drake.reporting.api import controller_margin as controller_margin
from stewart_drake.reporting.api import report as report
from stewart_drake.reporting.api import simulate as simulate
from stewart_drake.reporting.results import AnalysisResult as AnalysisResult
from stewart_drake.reporting.results import ComparisonResult as ComparisonResult
from stewart_drake.reporting.results import ControllerMargin as ControllerMargin
from stewart_drake.reporting.results import SimulationResult as SimulationResult
from stewart_drake.scenario.config import ActuatorConfig as ActuatorConfig
from stewart_drake.scenario.config import ControllerConfig as ControllerConfig
from stewart_drake.scenario.config import DelayConfig as DelayConfig
from stewart_drake.scenario.config import EncoderSensorConfig as EncoderSensorConfig
from stewart_drake.scenario.config import PlantConfig as PlantConfig
from stewart_drake.scenario.config import PositionServoConfig as PositionServoConfig
from stewart_drake.scenario.config import Scenario as Scenario
from stewart_drake.scenario.config import SensorConfig as SensorConfig
from stewart_drake.scenario.config import ServoActuatorConfig as ServoActuatorConfig
from stewart_drake.scenario.config import StateSensorConfig as StateSensorConfig
from stewart_drake.scenario.config import TorqueActuatorConfig as TorqueActuatorConfig
from stewart_drake.scenario.config import TunerConfig as TunerConfig
from stewart_drake.scenario.link_config import LinkConfig as LinkConfig
from stewart_drake.scenario.link_config import NetworkConfig as NetworkConfig
from stewart_drake.scenario.link_config import WireConfig as WireConfig
from stewart_drake.scenario.loading import load_scenario as load_scenario
from stewart_drake.scenario.reference_config import CsvConfig as CsvConfig
from stewart_drake.scenario.reference_config import HoldConfig as HoldConfig
from stewart_drake.scenario.reference_config import ReachyMoveConfig as ReachyMoveConfig
from stewart_drake.scenario.reference_config import ReferenceConfig as ReferenceConfig
from stewart_drake.scenario.reference_config import SineConfig as SineConfig
from stewart_drake.scenario.reference_config import WaypointsConfig as WaypointsConfig
from stewart_drake.scenario.run_log import read_log as read_log

__version__: str

def evaluate_tuner(
    directory: str | pathlib.Path,
    networks: str | pathlib.Path | collections.abc.Sequence[str | pathlib.Path] = (),
    scenario: str | pathlib.Path = "paper",
    controller: str | pathlib.Path | None = None,
    settings: collections.abc.Iterable[str] = (),
    *,
    progress: collections.abc.Callable[[int, int], None] | None = None,
    command: str = "",
    family: typing.Literal["T", "N2"] | None = None,
    seed: int = 0,
    scenarios: int = 40,
    workers: int | None = None,
    scheduler: str | None = None,
) -> stewart_drake.reporting.results.AnalysisResult: ...
def make_tuner_data(
    directory: str | pathlib.Path,
    scenario: str | pathlib.Path = "paper",
    controller: str | pathlib.Path | None = None,
    settings: collections.abc.Iterable[str] = (),
    *,
    progress: collections.abc.Callable[[int, int], None] | None = None,
    family: typing.Literal["T", "N2"] | None = None,
    seed: int = 0,
    disturbed: int | None = None,
    draws: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> stewart_drake.reporting.results.AnalysisResult: ...
def new(
    directory: str | pathlib.Path,
    name: str,
    *,
    base_radius: str | float,
    shaft_distance: str | float,
    plate_radius: str | float,
    joint_distance: str | float,
    crank: str | float,
    rod: str | float,
    plate_mass: str | float,
    crank_mass: str | float,
    rod_mass: str | float,
    shaft_height: str | float = 0.0,
    upright: float = 90.0,
    cranks: typing.Literal["apart", "together"] = "apart",
    torque_limit: str | float | None = None,
    delay: str | float = 0.1,
    gravity: bool = True,
) -> stewart_drake.reporting.results.NewMachine: ...
def run_live(
    scenario: stewart_drake.scenario.config.Scenario | str | pathlib.Path,
    machine: str,
    *,
    duration: float | None = None,
    hold: bool = False,
    armed: bool = False,
    key: pathlib.Path | None = None,
    max_missing: float | None = None,
    accept_jitter: bool = False,
    log: pathlib.Path | None = None,
    learn: int = 0,
    learned: pathlib.Path | None = None,
    mirror: str | None = None,
) -> stewart_drake.reporting.results.SimulationResult: ...
def run_machine(
    scenario: stewart_drake.scenario.config.Scenario | str | pathlib.Path,
    *,
    rate: float = 1.0,
    watchdog: float = 1.0,
    safe: typing.Literal["zero", "hold"] = "zero",
    restart: typing.Literal["rest", "motion"] = "rest",
    port: int = 47000,
    host: str = "127.0.0.1",
    key: pathlib.Path | None = None,
    duration: float = 0.0,
    log: pathlib.Path | None = None,
    reachy: str | None = None,
    ahead: float = 0.0,
) -> dict[str, typing.Any]: ...
def train_tuner(
    data: str | pathlib.Path,
    out: str | pathlib.Path,
    *,
    progress: collections.abc.Callable[[int, int], None] | None = None,
    regret: bool = False,
    start: float | None = None,
    labels: typing.Literal["as_run", "best_in_cell", "best_in_cell_torque"] | None = None,
    split: typing.Literal["sample", "run", "cell"] | None = None,
    density: typing.Literal["magnitude", "signed"] | None = None,
    seed: int = 0,
    workers: int | None = None,
) -> stewart_drake.reporting.results.AnalysisResult: ...
def analyze_delay(
    scenario: stewart_drake.scenario.config.Scenario | str | pathlib.Path,
    simulations: bool = True,
    *,
    settings: collections.abc.Iterable[str] = (),
    controller: str | pathlib.Path | None = None,
) -> stewart_drake.reporting.results.AnalysisResult: ...
def analyze_hautus(
    scenario: stewart_drake.scenario.config.Scenario | str | pathlib.Path,
    *,
    settings: collections.abc.Iterable[str] = (),
) -> stewart_drake.reporting.results.AnalysisResult: ...
def analyze_link(
    scenario: stewart_drake.scenario.config.Scenario | str | pathlib.Path,
    runs: int = 5,
    *,
    settings: collections.abc.Iterable[str] = (),
    controller: str | pathlib.Path | None = None,
    directory: str | pathlib.Path | None = None,
) -> stewart_drake.reporting.results.AnalysisResult: ...
def analyze_robustness(
    scenario: stewart_drake.scenario.config.Scenario | str | pathlib.Path,
    runs: int = 200,
    *,
    settings: collections.abc.Iterable[str] = (),
    controller: str | pathlib.Path | None = None,
    directory: str | pathlib.Path | None = None,
    ranges: collections.abc.Sequence[str]
    | stewart_drake.studies.study_options.Ranges
    | collections.abc.Mapping[str, typing.Any]
    | None = None,
    seed: int = 0,
    limit: float | None = None,
    also: collections.abc.Sequence[str]
    | collections.abc.Mapping[str, stewart_drake.scenario.config.Scenario]
    | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> stewart_drake.reporting.results.AnalysisResult: ...
def analyze_workspace(
    scenario: stewart_drake.scenario.config.Scenario | str | pathlib.Path,
    *,
    settings: collections.abc.Iterable[str] = (),
) -> stewart_drake.reporting.results.AnalysisResult: ...
def layout(
    scenario: stewart_drake.scenario.config.Scenario | str | pathlib.Path,
    directory: str | pathlib.Path | None = None,
    *,
    settings: collections.abc.Iterable[str] = (),
    goal: str = "condition",
    limits: collections.abc.Sequence[str] | collections.abc.Mapping[str, float] | None = None,
    vary: collections.abc.Sequence[str]
    | collections.abc.Mapping[str, tuple[float, float]]
    | None = None,
    keep: collections.abc.Sequence[str] = (),
    best: int = 3,
    starts: int = 1,
    generations: int = 100,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
) -> stewart_drake.reporting.results.AnalysisResult: ...
def learn(
    scenario: stewart_drake.scenario.config.Scenario | str | pathlib.Path,
    repetitions: int = 6,
    *,
    settings: collections.abc.Iterable[str] = (),
    controller: str | pathlib.Path | None = None,
) -> stewart_drake.reporting.results.AnalysisResult: ...
