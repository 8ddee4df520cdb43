"""Python functions of the commands other than runs and analyses of a scenario.

Bad input raises a ConfigError of one line.
"""

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from stewart_drake.core.layout import DEFAULT_GRAVITY
from stewart_drake.export.controller import exported, write
from stewart_drake.export.setpoints import Setpoints, load_units, make_setpoints
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import make_folder, write_asked, write_whole
from stewart_drake.files.yamlio import validate, yaml_text
from stewart_drake.identification import identify as identification
from stewart_drake.identification.logs import POSE, Precision, angle_std, load_log
from stewart_drake.identification.plan import MOTION, Plan, motion_csv, plan
from stewart_drake.identification.servo_fit import ServoIdentification, identify_servos
from stewart_drake.identification.servo_logs import is_servo_log, read_servo_log
from stewart_drake.identification.servo_plan import SETPOINTS_FILE, ServoPlan, plan_servos
from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.live.options import LiveOptions, MachineOptions
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.files import as_mechanism, load_mechanism, mechanism_yaml
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.sdformat import to_sdformat
from stewart_drake.reporting import servo_identification
from stewart_drake.reporting.csv_file import read_signals, signals_csv
from stewart_drake.reporting.identification import document, plan_document
from stewart_drake.reporting.page import Provenance
from stewart_drake.reporting.results import (
    AnalysisResult,
    MechanismCheck,
    NewMachine,
    SimulationResult,
    analysis_result,
)
from stewart_drake.scenario.calibration import save_calibration
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import as_scenario, scenario_yaml, setting_texts
from stewart_drake.scenario.run_log import is_run
from stewart_drake.studies.jobs import Progress
from stewart_drake.studies.new_machine import check_mechanism, new_machine
from stewart_drake.studies.options import refuse, takes
from stewart_drake.studies.study_options import Measurements
from stewart_drake.tuning.options import DataOptions, EvaluationOptions, TrainingOptions

MECHANISM: Final = "mechanism.yaml"
CALIBRATION: Final = "calibration.yaml"
SCENARIO: Final = "scenario.yaml"
SERVOS: Final = "servos.yaml"
FOUND: Final = "found.yaml"
_STD_12_BITS: Final = angle_std(12)
"""Default standard deviation of a crank angle in a log of servos, rad."""


def identify(
    logs: str | Path | Sequence[str | Path],
    mechanism: Mechanism | str | Path,
    *,
    delay: float | None = None,
    tolerances: Tolerances | Mapping[str, float] | None = None,
    precision: Precision | Mapping[str, float] | None = None,
    gravity: bool = True,
    velocity_gain: float | None = None,
    command: str = "",
    folder: str | Path = "",
) -> AnalysisResult:
    """Find delay, friction and geometry in logs of one machine.

    `save` of the result also writes mechanism.yaml and calibration.yaml, and, if they explain the
    log, found.yaml, an overlay of a scenario that reads both. A CSV log of setpoints and crank
    angles identifies position servos instead; if their numbers explain the log, `save` writes them
    to servos.yaml, an overlay of a scenario.

    Args:
        logs: signals.nc of a run, or CSV; one CSV log of setpoints.
        mechanism: as drawn; a shipped name or a path.
        delay: assumed before, s; by default that of the log, or 0.1 s.
        tolerances: prior standard deviations of the machine, such as `{"lengths": 1e-4}`; the
            defaults for others.
        precision: of a CSV log, such as `{"angle": 1e-4}`; the defaults for others, with 12 bits
            for one of setpoints.
        gravity: whether gravity acted in a CSV log.
        velocity_gain: of the position servos, N m s/rad, which a log does not tell from damping;
            by default that of the log's scenario, or 0.
        command: that the page names; by default the call of this function.
        folder: of `save`, for the command on the page that reads its files.
    """
    tolerances, precision = _expected(tolerances, precision)
    paths = [logs] if isinstance(logs, str | Path) else list(logs)
    machine = as_mechanism(mechanism)
    typed = command or f"sd.identify({[str(path) for path in paths]!r}, {mechanism!r})"
    if not paths:
        raise ConfigError("logs: got none; expected one or more")
    if delay is not None and not 0 <= delay <= 100:
        raise ConfigError(f"delay: got {delay:g}; expected 0 to 100 s")
    refuse_for_runs(paths, {"precision": precision, "gravity": None if gravity else False})
    if any(is_servo_log(Path(path)) for path in paths):
        if len(paths) > 1 or delay is not None or tolerances is not None:
            raise ConfigError(
                f"{paths[0]}: got more than one log of setpoints, a delay or tolerances; expected "
                "one log, whose delay is found without any"
            )
        log = read_servo_log(Path(paths[0]), machine)
        if velocity_gain is None:
            servos = log.scenario and log.scenario.actuator
            velocity_gain = getattr(servos, "velocity_gain", 0.0)
        if not 0 <= velocity_gain < 1e6:
            raise ConfigError(
                f"velocity_gain: got {velocity_gain:g}; expected 0 or more, N m s/rad"
            )
        std = _STD_12_BITS if precision is None else precision.angle
        g = DEFAULT_GRAVITY if gravity else 0.0
        find_servos = partial(identify_servos, log, machine, std, g, velocity_gain)
        describe_servos = partial(servo_identification.document, folder=folder)
        return analysis_result(find_servos, describe_servos, typed, _write_servos)
    read = [load_log(Path(path), machine, precision or Precision(), gravity) for path in paths]
    if velocity_gain is not None:
        raise ConfigError("velocity_gain: got one; expected none without a log of setpoints")
    find = partial(identification.identify, read, machine, tolerances, delay)
    return analysis_result(find, partial(document, folder=folder), typed, _write_machine)


def refuse_for_runs(logs: Iterable[str | Path], options: Mapping[str, object]) -> None:
    """Refuse options of a CSV log that are not None if all logs are of runs."""
    if all(is_run(Path(log)) and not is_servo_log(Path(log)) for log in logs):
        refuse(options, "with logs of runs, which contain it; expected it with an own CSV log")


def plan_identification(
    scenario: Scenario | str | Path,
    settings: Iterable[str] = (),
    *,
    poses: bool = False,
    tolerances: Tolerances | Mapping[str, float] | None = None,
    precision: Precision | Mapping[str, float] | None = None,
    command: str = "",
) -> AnalysisResult:
    """Plan a motion to log, and predict what its log shows of the machine.

    `save` of the result also writes the motion and the scenario that follows it; for a scenario
    with position servos, setpoints.csv.

    Args:
        scenario: of the machine; a shipped name or a path.
        settings: as `load_scenario` takes them.
        poses: whether poses are measured, not only crank angles.
        tolerances, precision: as of `identify`; by default the encoders of the scenario count.
        command: that the page names; by default the call of this function.
    """
    tolerances, precision = _expected(tolerances, precision)
    settings = list(setting_texts(settings))
    loaded = as_scenario(scenario, settings=settings)
    more = f", {settings}" if settings else ""
    typed = command or f"sd.plan_identification({scenario!r}{more})"
    if loaded.actuator.kind == "position_servo":
        if poses or tolerances is not None:
            raise ConfigError(
                "plan: got measured poses or tolerances with position servos; expected neither, "
                "their log has setpoints and crank angles"
            )
        angle = _STD_12_BITS if precision is None else precision.angle
        make_servo_plan = partial(plan_servos, prepare(loaded), angle)
        shown = servo_identification.plan_document
        return analysis_result(make_servo_plan, shown, typed, _write_setpoints)
    sensor = loaded.sensor
    if precision is None and sensor.kind == "encoders" and sensor.bits is not None:
        precision = Precision(angle=angle_std(sensor.bits))
    std = (precision or Precision()).std
    if not poses:
        std[POSE] = np.inf  # not measured
    make_plan = partial(plan, prepare(loaded), std, tolerances)
    return analysis_result(make_plan, plan_document, typed, _write_plan)


def _expected(tolerances: Any, precision: Any) -> tuple[Tolerances | None, Precision | None]:
    if not isinstance(tolerances, Tolerances | None):
        tolerances = validate(Tolerances, tolerances, "tolerances")
    if not isinstance(precision, Precision | None):
        precision = validate(Precision, precision, "precision")
    return tolerances, precision


def _write_plan(found: Plan, folder: Path) -> list[str]:
    motion = motion_csv(found.times, found.poses)
    return _write_texts(folder, {MOTION: motion, SCENARIO: scenario_yaml(found.scenario)})


def _write_setpoints(found: ServoPlan, folder: Path) -> list[str]:
    return _write_texts(folder, {SETPOINTS_FILE: found.csv})


def _write_machine(found: identification.Identification, folder: Path) -> list[str]:
    write_whole(folder / MECHANISM, mechanism_yaml(found.mechanism))
    calibration = found.calibration(load_mechanism(folder / MECHANISM))
    save_calibration(folder / CALIBRATION, calibration)
    files = {"mechanism": MECHANISM, "controller": {"calibration": CALIBRATION}}
    like = {"plant": found.plant} | ({"sensor": found.sensor} if found.sensor else {})
    overlay = yaml_text(files | like) if found.right else None
    return [MECHANISM, CALIBRATION, *_write_texts(folder, {FOUND: overlay})]


def _write_servos(found: ServoIdentification, folder: Path) -> list[str]:
    return _write_texts(folder, {SERVOS: yaml_text(found.overlay) if found.right else None})


def _write_texts(folder: Path, texts: Mapping[str, str | None]) -> list[str]:
    """Write files, or for None remove that of an earlier log; return the names written."""
    for name, text in texts.items():
        if text is None:
            (folder / name).unlink(missing_ok=True)
        else:
            write_whole(folder / name, text)
    return [name for name, text in texts.items() if text is not None]


def export_csv(signals: str | Path, out: str | Path | None = None) -> str:
    """Return saved signals as CSV, a line per instant; units are in the header.

    Args:
        signals: signals.nc, a log (.mcap, .csv) or the folder of a run.
        out: file to write, if not None; its folder is made.

    Raises:
        ConfigError: there is no such file, or it holds no signals.
    """
    text = signals_csv(read_signals(Path(signals)))
    if out is not None:
        write_asked("out", out, text)
    return text


def replay_log(log: str | Path, out: str | Path | None = None) -> str:
    """Return a log as an HTML page with a 3-D animation.

    Args:
        log: .mcap, .csv, signals.nc or the folder of a run.
        out: file to write, if not None.

    Raises:
        ConfigError: not a log of a run, or one without its scenario.
    """
    from stewart_drake.reporting.replay import log_html

    text = log_html(Path(log))
    if out is not None:
        write_asked("out", out, text)
    return text


def setpoints(
    scenario: Scenario | str | Path,
    rate: float = 50.0,
    out: str | Path | None = None,
    *,
    plain: bool = False,
    start: Sequence[float] | None = None,
    soft_end: bool = False,
    units: str | Path | None = None,
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
) -> Setpoints:
    """Return the crank angles to send to position servos for a scenario's motion.

    They are checked for reach, and for range, speed and torque of each motor. `export.setpoints`
    has the equations.

    Args:
        scenario: a Scenario, a shipped name or a path; its `actuator.kind` is `position_servo`.
        rate: of the setpoints, Hz.
        out: CSV file to write, if not None.
        plain: whether to send the angles of the reference, without compensation.
        start: (6,) pose at which the plate rests at first, rad and m; None is the reference's.
        soft_end: whether the motion ends at rest.
        units: YAML file with the units of the servos (`export.setpoints.ServoUnits`), for `out`.
        controller: laid over the scenario's own; for a name or a path.
        settings: as `load_scenario` takes them; for a name or a path.

    Raises:
        ConfigError: bad input, or a motion beyond a limit, with time and motor.
    """
    if out is None:
        refuse({"units": units}, "without out; expected both or neither")
    servo_units = None if units is None else load_units(units)
    loaded = as_scenario(scenario, controller, settings)
    made = make_setpoints(loaded, rate, plain=plain, start=start, soft_end=soft_end)
    if out is not None:
        made.save(out, servo_units)
    return made


def export_c(
    scenario: Scenario | str | Path,
    directory: str | Path,
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
    *,
    single: bool = False,
) -> list[Path]:
    """Write the controller as a folder of C that builds with its own Makefile.

    Args:
        scenario: a Scenario, a shipped name or a path.
        directory: of the files; it is made.
        controller: laid over the scenario's own; for a name or a path.
        settings: as `load_scenario` takes them; for a name or a path.
        single: whether numbers have single precision.

    Returns:
        The paths of the written files. Those that were changed since the last export are kept.

    Raises:
        ConfigError: a law that has no C, or a file in the folder that no export has written.
    """
    loaded, folder = as_scenario(scenario, controller, settings), Path(directory)
    make_folder("directory", folder)
    return write(exported(loaded, single), folder)


@takes(Measurements)
def new(directory: str | Path, name: str, *, options: Measurements) -> NewMachine:
    """Make a machine and a first scenario from a few measurements.

    Args:
        directory: for the two files.
        name: of the machine.
        OPTIONS

    Raises:
        ConfigError: measurements that fit no machine, or files that are there already.
    """
    folder = Path(directory)
    make_folder("directory", folder)
    return NewMachine(*new_machine(options, name, folder))


def check_model(mechanism: Mechanism | str | Path) -> MechanismCheck:
    """Check a mechanism at its home pose, under gravity."""
    return MechanismCheck(*check_mechanism(as_mechanism(mechanism)))


def model_sdf(mechanism: Mechanism | str | Path) -> str:
    """Return a mechanism as SDFormat."""
    return to_sdformat(as_mechanism(mechanism))


def view_model(mechanism: Mechanism | str | Path) -> None:
    """Show a mechanism in Meshcat, with sliders for its pose, until Stop is pressed there."""
    from pydrake.geometry import Meshcat

    from stewart_drake.reporting.viewer import PoseViewer

    PoseViewer(as_mechanism(mechanism), Meshcat()).run(print)


@takes(LiveOptions)
def run_live(
    scenario: Scenario | str | Path,
    machine: str,
    *,
    options: LiveOptions,
) -> SimulationResult:
    """Drive a machine over UDP in real time.

    Args:
        scenario: a Scenario, a shipped name or a path.
        machine: HOST:PORT where it listens.
        OPTIONS

    Returns:
        The run; with `learn` that of all repetitions, or for setpoints the best repetition.

    Raises:
        ConfigError: no such machine, or one that does not begin.
    """
    from stewart_drake.live.contact import parse_address
    from stewart_drake.live.endpoint import read_key
    from stewart_drake.live.learning import learn_live
    from stewart_drake.live.session import drive, open_logs, prepare_session

    options.check_learned()
    if options.learn:
        learnt = learn_live(as_scenario(scenario), machine, options, print).run
        return SimulationResult.of(learnt)
    ready = prepare_session(as_scenario(scenario), parse_address(machine), read_key(options.key))
    rules: Any = options.model_dump(include={"armed", "accept_jitter", "max_missing", "hold"})
    duration = math.inf if options.duration is None else options.duration
    with closing(ready.endpoint):
        logs = open_logs(ready, options, print)
        return SimulationResult.of(drive(ready, duration, logs=logs, **rules))


@takes(MachineOptions)
def run_machine(scenario: Scenario | str | Path, *, options: MachineOptions) -> dict[str, Any]:
    """Simulate a machine, or drive a robot, over UDP in real time.

    Args:
        scenario: a Scenario, a shipped name or a path, for plant, sensor, delay, link and limits.
        OPTIONS

    Returns:
        The summary of the run.
    """
    from stewart_drake.live.reachy import open_chosen

    with open_chosen(as_scenario(scenario), options) as (machine, _):
        machine.run(options.duration or math.inf)
    return machine.summary()


@takes(DataOptions)
def make_tuner_data(
    directory: str | Path,
    scenario: str | Path = "paper",
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
    *,
    options: DataOptions,
    progress: Progress | None = None,
) -> AnalysisResult:
    """Make the data that a tuner is trained on, or continue to make it.

    Args:
        directory: of dataset.nc and of the runs.
        scenario: shipped name or path.
        controller: laid over the scenario's own.
        settings: as `load_scenario` takes them.
        progress: called with the numbers of finished and of all conditions.
        OPTIONS
    """
    from stewart_drake.reporting.tuner import data_document
    from stewart_drake.tuning.data import make_data, summarize

    family, started = options.conditions(scenario, controller, settings), time.perf_counter()
    data = make_data(family, directory, progress=progress, **options.jobs)
    seconds = time.perf_counter() - started
    made = Provenance(f"sd.make_tuner_data({str(directory)!r}, {scenario!r})", seconds=seconds)
    summary = summarize(data) | {"wall_s": seconds}
    return AnalysisResult(data, summary, data_document(data, summary), made)


@takes(TrainingOptions)
def train_tuner(
    data: str | Path,
    out: str | Path,
    *,
    options: TrainingOptions,
    progress: Progress | None = None,
) -> AnalysisResult:
    """Train the tuner's network on a data set; `study.network` of the result is the network.

    Args:
        data: folder or file of `make_tuner_data`.
        out: file of the network; with `regret` its runs are kept in the same folder.
        progress: called with the numbers of finished and of all runs of the network.
        OPTIONS

    Raises:
        ConfigError: torch is missing.
    """
    from stewart_drake.reporting.tuner import training_document
    from stewart_drake.tuner.network import save_network
    from stewart_drake.tuning import training
    from stewart_drake.tuning.data import load_data

    options.check()
    read, out = load_data(data), Path(out)
    if options.regret:
        chosen = options.model_dump(include={"seed", "start", "workers"})
        runs = out.with_name(f"{out.stem}-runs")
        found = training.train_by_regret(read, runs, progress=progress, **chosen)
    else:
        given = {"kind": options.labels, "split": options.split, "density": options.density}
        chosen = {name: value for name, value in given.items() if value is not None}
        found = training.train(read, seed=options.seed, **chosen)
    save_network(found.network, out)
    summary, made = training.summarize(found), f"sd.train_tuner({str(data)!r}, {str(out)!r})"
    return AnalysisResult(found, summary, training_document(summary), Provenance(made))


@takes(EvaluationOptions)
def evaluate_tuner(
    directory: str | Path,
    networks: str | Path | Sequence[str | Path] = (),
    scenario: str | Path = "paper",
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
    *,
    options: EvaluationOptions,
    progress: Progress | None = None,
    command: str = "",
) -> AnalysisResult:
    """Compare a tuner with fixed gains on conditions that training did not have.

    Args:
        directory: of the runs; a second call continues with those that are there.
        networks: shipped name or file, or several; none for the shipped one.
        scenario: shipped name or path.
        controller: laid over the scenario's own.
        settings: as `load_scenario` takes them.
        progress: called with the numbers of finished and of all conditions.
        command: that the page names; by default the call of this function.
        OPTIONS
    """
    from stewart_drake.reporting.tuner import evaluation_document
    from stewart_drake.tuning.evaluation import evaluate

    family = options.conditions(scenario, controller, settings)
    networks = [networks] if isinstance(networks, str | Path) else networks
    command = command or f"sd.evaluate_tuner({str(directory)!r}, {list(networks)!r})"
    run = partial(evaluate, family, networks, directory, progress=progress, **options.jobs)
    found = analysis_result(run, evaluation_document, command)
    return replace(found, summary=found.summary | {"wall_s": found.made.seconds})
