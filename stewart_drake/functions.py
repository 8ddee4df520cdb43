"""Python functions of the commands that make files: identify, new, export, export-c, model."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from stewart_drake.export.controller import exported, write
from stewart_drake.files.fileio import write_whole
from stewart_drake.identification import identify as identification
from stewart_drake.identification.log_files import Precision, read_log
from stewart_drake.identification.logs import ANGLES, POSE
from stewart_drake.identification.plan import MOTION, Plan, plan
from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.loop.experiment import prepare
from stewart_drake.mechanism.files import as_mechanism, load_mechanism, mechanism_yaml
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.sdformat import to_sdformat
from stewart_drake.reporting.csv_file import read_signals, signals_csv
from stewart_drake.reporting.identification import document, plan_document
from stewart_drake.reporting.results import AnalysisResult, analysis_result
from stewart_drake.scenario.calibration import save_calibration
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import as_scenario, load_scenario, scenario_yaml
from stewart_drake.studies.mechanism_check import MechanismCheck, check_mechanism
from stewart_drake.studies.new_machine import Measurements, NewMachine, new_machine

MECHANISM: Final = "mechanism.yaml"
CALIBRATION: Final = "calibration.yaml"
SCENARIO: Final = "scenario.yaml"


def identify(
    logs: str | Path | Sequence[str | Path],
    mechanism: Mechanism | str | Path,
    *,
    delay: float | None = None,
    tolerances: Tolerances | None = None,
    precision: Precision | None = None,
    gravity: bool = True,
    command: str = "",
) -> AnalysisResult:
    """Find delay, friction and geometry in logs of one machine.

    `save` of the result also writes mechanism.yaml and calibration.yaml, for `simulate`.

    Args:
        logs: signals.nc of a run, or CSV.
        mechanism: as drawn; a shipped name or a path.
        delay: believed, s; None is that of the log, or 0.1 s.
        tolerances: prior standard deviations of the machine; the defaults if None.
        precision: of a CSV log; the defaults if None.
        gravity: whether gravity acted in a CSV log.
        command: that the page names; by default the call of this function.

    Raises:
        ConfigError: bad input.
    """
    paths = [logs] if isinstance(logs, str | Path) else list(logs)
    machine = as_mechanism(mechanism)
    read = [read_log(Path(path), machine, precision or Precision(), gravity) for path in paths]
    return analysis_result(
        lambda: identification.identify(read, machine, tolerances, delay),
        document,
        command or f"sd.identify({[str(path) for path in paths]!r}, {mechanism!r})",
        _write_machine,
    )


def plan_identification(
    scenario: Scenario | str | Path,
    *,
    poses: bool = False,
    tolerances: Tolerances | None = None,
    precision: Precision | None = None,
    command: str = "",
) -> AnalysisResult:
    """Plan a motion to log, and predict what its log shows of the machine.

    `save` of the result also writes the motion and the scenario that follows it.

    Args:
        scenario: of the machine; a shipped name or a path.
        poses: whether poses are measured, not only crank angles.
        tolerances: prior standard deviations of the machine; the defaults if None.
        precision: of the measurements; the defaults if None.
        command: that the page names; by default the call of this function.

    Raises:
        ConfigError: bad input.
    """
    loaded = as_scenario(scenario)
    measured = (precision or Precision()).std
    std = np.full_like(measured, np.inf)
    for part in (ANGLES, POSE) if poses else (ANGLES,):
        std[part] = measured[part]
    experiment = prepare(loaded)
    return analysis_result(
        lambda: plan(experiment, std, tolerances),
        plan_document,
        command or f"sd.plan_identification({scenario!r})",
        _write_plan,
    )


def _write_machine(found: identification.Identification, folder: Path) -> list[str]:
    write_whole(folder / MECHANISM, mechanism_yaml(found.mechanism))
    calibration = found.calibration(load_mechanism(folder / MECHANISM))
    save_calibration(folder / CALIBRATION, calibration)
    return [MECHANISM, CALIBRATION]


def _write_plan(found: Plan, folder: Path) -> list[str]:
    texts = {MOTION: found.motion_csv, SCENARIO: scenario_yaml(found.scenario)}
    for name, text in texts.items():
        write_whole(folder / name, text)
    return list(texts)


def export_csv(signals: str | Path, out: str | Path | None = None) -> str:
    """Return saved signals as CSV, a line per instant; units are in the header.

    Args:
        signals: file that a run saved.
        out: file to write, if not None.

    Raises:
        ConfigError: there is no such file, or it holds no signals.
    """
    text = signals_csv(read_signals(Path(signals)))
    if out is not None:
        write_whole(Path(out), text)
    return text


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
        scenario: or a shipped name or a path.
        directory: of the files; it is made.
        controller: laid over the scenario's own; for a name or a path.
        settings: as `load_scenario` takes them; for a name or a path.
        single: whether numbers have single precision; then without an estimator.

    Returns:
        The paths of the files.

    Raises:
        ConfigError: bad input, or a law that has no C.
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario, controller, settings)
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    return write(exported(scenario, single), folder)


def new(directory: str | Path, name: str, **measurements: float | bool | str | None) -> NewMachine:
    """Make a machine and a first scenario from a few measurements.

    Args:
        directory: for the two files.
        name: of the machine.
        measurements: fields of `stewart_drake.studies.new_machine.Measurements`, m and kg.

    Raises:
        ConfigError: measurements that fit no machine, or files that are there already.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    return new_machine(Measurements(**measurements), name, folder)  # type: ignore[arg-type]


def check_model(mechanism: Mechanism | str | Path) -> MechanismCheck:
    """Check a mechanism at its home pose, under gravity.

    Raises:
        ConfigError: bad input.
    """
    return check_mechanism(as_mechanism(mechanism))


def model_sdf(mechanism: Mechanism | str | Path) -> str:
    """Return a mechanism as SDFormat.

    Raises:
        ConfigError: bad input.
    """
    return to_sdformat(as_mechanism(mechanism))
