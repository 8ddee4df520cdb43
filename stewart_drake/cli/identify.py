"""A machine from its logs, and the plan of a log: identify."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stewart_drake.cli.common import AsJson, Delivery, Out, Quiet, Settings, refuse
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.tolerances import TOLERANCE_UNITS, Tolerances, read_tolerances
from stewart_drake.reporting.terminal import working

if TYPE_CHECKING:
    from stewart_drake.identification.log_files import Precision
    from stewart_drake.reporting.results import AnalysisResult

MECHANISM = "mechanism.yaml"
CALIBRATION = "calibration.yaml"
SCENARIO = "scenario.yaml"

Tolerance = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help="How far off it may be, a standard deviation, 0: known. Repeatable. "
        + "; ".join(f"{name}: {unit}" for name, unit in TOLERANCE_UNITS.items())
        + ".",
    ),
]
Bits = Annotated[
    int | None,
    typer.Option(metavar="N", help="Of the encoders of a CSV log, per turn; 14 by default."),
]
Gravity = Annotated[
    bool | None,
    typer.Option(help="Whether gravity acted in a CSV log, as by default, or was balanced."),
]


def identify(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[LOG]...", help="signals.nc of simulate, or CSV; of one machine."),
    ] = None,
    mechanism: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="As drawn; needed with logs.")
    ] = None,
    plan: Annotated[
        str | None,
        typer.Option(
            metavar="SCENARIO", help="Instead of logs: a motion to log, and what it would tell."
        ),
    ] = None,
    settings: Settings = None,
    delay: Annotated[
        float | None,
        typer.Option(metavar="S", help="Believed; that of the log by default, or 0.1 s."),
    ] = None,
    tolerance: Tolerance = None,
    bits: Bits = None,
    pose_std: Annotated[
        str | None,
        typer.Option(
            metavar="RAD,M",
            help="Errors of poses; 1e-4,2e-5 in a CSV log. With --plan: poses are measured too.",
        ),
    ] = None,
    gravity: Gravity = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Find delay, friction and geometry in a log.

    Even in that of a lost run. Writes mechanism.yaml and calibration.yaml for simulate, and a page.
    A CSV log has the columns time[s], torque_1[N m] to torque_6 as they were commanded,
    angle_1[rad] to angle_6, and where they were measured roll[rad] to z[m].
    """
    tolerances = read_tolerances(tolerance or ())
    precision = _precision(bits, pose_std)
    if (plan is None) == (not logs):
        given = "neither" if plan is None else "both"
        raise ConfigError(f"LOG, --plan: got {given}; expected logs, or --plan SCENARIO")
    if delay is not None and not 0 <= delay <= 100:
        raise ConfigError(f"--delay: got {delay:g}; expected 0 to 100 s")
    typed = {"delay": delay, "tolerance": tolerance, "bits": bits, "pose-std": pose_std, "out": out}
    of_csv = {"--bits": bits, "--pose-std": pose_std, "--gravity": gravity}
    if plan is not None:
        said = {"--mechanism": mechanism, "--delay": delay, "--gravity": gravity}
        refuse(said, "with --plan, whose scenario says it (--set); expected none")
        delivery, measured = Delivery(out, quiet, as_json), pose_std is not None
        answer = _planned(plan, settings or [], tolerances, precision, measured, typed, quiet)
        names = _write_plan(answer, delivery)
    else:
        refuse({"--set": settings}, "without --plan; expected it with --plan")
        if all(path.suffix == ".nc" for path in logs or ()):
            refuse(of_csv, "with logs that say it themselves (.nc); expected it of a CSV log")
        acted, delivery = gravity is not False, Delivery(out, quiet, as_json)
        answer = _found(logs or [], mechanism, tolerances, precision, delay, acted, typed, quiet)
        names = _write_found(answer, delivery)
    return delivery.answer(answer, *names)


def _precision(bits: int | None, pose_std: str | None) -> "Precision":
    from stewart_drake.identification.log_files import Precision, angle_std

    if bits is not None and not 1 <= bits <= 52:
        raise ConfigError(f"--bits: got {bits}; expected 1 to 52")
    precision = Precision() if bits is None else Precision(angle_std(bits))
    if pose_std is None:
        return precision
    try:
        angle, position = (float(part) for part in re.split(r"\s*,\s*", pose_std.strip()))
    except ValueError:
        angle = position = -1.0
    if not (0 < angle < 10 and 0 < position < 10):
        raise ConfigError(
            f"--pose-std: got {pose_std!r}; expected two positive numbers, rad and m, as 1e-4,2e-5"
        )
    return precision._replace(pose_angle=angle, pose_position=position)


def _found(
    logs: list[Path],
    mechanism: str | None,
    tolerances: Tolerances,
    precision: "Precision",
    delay: float | None,
    gravity: bool,
    typed: dict[str, Any],
    quiet: bool,
) -> "AnalysisResult":
    from stewart_drake.identification.identify import identify as find
    from stewart_drake.identification.log_files import read_log
    from stewart_drake.mechanism.files import load_mechanism
    from stewart_drake.reporting.identification_document import document
    from stewart_drake.reporting.page import command_line
    from stewart_drake.reporting.results import analysis_result

    if mechanism is None:
        raise ConfigError("--mechanism: is missing; expected a shipped name or a file, as drawn")
    machine = load_mechanism(mechanism)
    with working("identify", quiet):
        read = [read_log(path, machine, precision, gravity) for path in logs]
        words = [*map(str, logs), *(() if gravity else ("--no-gravity",))]
        command = command_line("identify", *words, options={"mechanism": mechanism, **typed})
        return analysis_result(lambda: find(read, machine, tolerances, delay), document, command)


def _planned(
    scenario: str,
    settings: list[str],
    tolerances: Tolerances,
    precision: "Precision",
    poses: bool,
    typed: dict[str, Any],
    quiet: bool,
) -> "AnalysisResult":
    import numpy as np

    from stewart_drake.identification.logs import ANGLES, POSE
    from stewart_drake.identification.plan import plan
    from stewart_drake.loop.experiment import prepare
    from stewart_drake.reporting.identification_document import plan_document
    from stewart_drake.reporting.page import command_line
    from stewart_drake.reporting.results import analysis_result
    from stewart_drake.scenario.loading import load_scenario

    std = np.full_like(precision.std, np.inf)
    for part in (ANGLES, POSE) if poses else (ANGLES,):
        std[part] = precision.std[part]
    experiment = prepare(load_scenario(scenario, settings=settings))
    command = command_line("identify", settings=settings, options={"plan": scenario, **typed})
    with working("plan", quiet):
        return analysis_result(lambda: plan(experiment, std, tolerances), plan_document, command)


def _write_found(answer: "AnalysisResult", delivery: Delivery) -> list[str]:
    """What simulate takes."""
    from stewart_drake.files.fileio import replacing
    from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
    from stewart_drake.scenario.calibration import save_calibration

    if delivery.out is None:
        return []
    delivery.discard(MECHANISM, CALIBRATION)
    path = delivery.out / MECHANISM
    text = mechanism_yaml(answer.study.mechanism)
    with replacing(path) as partial:
        partial.write_text(text)
    save_calibration(delivery.out / CALIBRATION, answer.study.calibration(load_mechanism(path)))
    return [MECHANISM, CALIBRATION]


def _write_plan(answer: "AnalysisResult", delivery: Delivery) -> list[str]:
    """The motion, and the scenario that makes the plate do it."""
    from stewart_drake.files.fileio import replacing
    from stewart_drake.identification.plan import MOTION
    from stewart_drake.scenario.loading import scenario_yaml

    if delivery.out is None:
        return []
    delivery.discard(MOTION, SCENARIO)
    texts = {MOTION: answer.study.motion_csv, SCENARIO: scenario_yaml(answer.study.scenario)}
    for name, text in texts.items():
        with replacing(delivery.out / name) as partial:
            partial.write_text(text)
    return list(texts)
