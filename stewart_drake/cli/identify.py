"""Command identify: a machine from its logs, and the plan of a log."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from stewart_drake.cli.common import Chosen, Delivery, command_line, named, on_interrupt
from stewart_drake.cli.options import command
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import validate_pairs
from stewart_drake.identification.progress import shown_by
from stewart_drake.identification.tolerances import TOLERANCE_UNITS, Tolerances
from stewart_drake.reporting.terminal import phase_bar
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.options import refuse

if TYPE_CHECKING:
    from stewart_drake.identification.logs import Precision

_DEFAULTS = asdict(Tolerances())
_UNITS = "; ".join(
    f"{name}: {unit} ({'depends' if _DEFAULTS[name] is None else f'{_DEFAULTS[name]:g}'})"
    for name, unit in TOLERANCE_UNITS.items()
)


@command(without=("scenario", "controller"))
def identify(
    *,
    logs: list[Path] | None = typer.Argument(
        None, metavar="[LOG]...", help="Logs of one machine: of a run, or CSV."
    ),
    mechanism: str | None = typer.Option(
        None, metavar="NAME|FILE", help="Mechanism as drawn; needed with logs."
    ),
    plan: str | None = typer.Option(
        None, metavar="SCENARIO", help="Plan a motion to log for this scenario, without logs."
    ),
    chosen: Chosen,
    delay: float | None = typer.Option(
        None, metavar="S", help="Assumed delay; that of the log by default, or 0.1 s."
    ),
    tolerance: list[str] | None = typer.Option(
        None,
        metavar="NAME=VALUE",
        help=f"Standard deviation of an unknown, 0: known. Repeatable. {_UNITS}. Those "
        "that depend do so on the log's torques and speeds, and on the plate.",
    ),
    bits: int | None = typer.Option(
        None,
        metavar="N",
        help="Bits per turn of the encoders of a CSV log; 14, or 12 of position servos.",
    ),
    pose_std: str | None = typer.Option(
        None,
        metavar="RAD,M",
        help="Errors of measured poses; 1e-4,2e-5 in a CSV log. With --plan: measure poses.",
    ),
    velocity_gain: float | None = typer.Option(
        None,
        metavar="N",
        help="Velocity gain of position servos, N m s/rad, which a log shows within the damping.",
    ),
    gravity: bool | None = typer.Option(
        None, help="Gravity acts on the machine of a CSV log, or is balanced."
    ),
    delivery: Delivery,
) -> int:
    """Find delay, friction and geometry in a log.

    It takes seconds to some minutes, longest with strong friction. The run may have been lost. With
    --out, writes mechanism.yaml, calibration.yaml, a page, and found.yaml, which reads both, for
    --set overlay=FILE. A CSV log has the columns time[s], torque_1[N m] to torque_6 (commanded),
    and angle_1[rad] to angle_6, roll[rad] to z[m], or both.

    A CSV log with time[s], setpoint_1[rad] to setpoint_6 and crank_1[rad] to crank_6 shows the
    numbers of position servos. With --out, writes servos.yaml, for --set overlay=FILE.
    """
    tolerances = validate_pairs(Tolerances, tolerance, "--tolerance") if tolerance else None
    precision = _precision(bits, pose_std) if bits is not None or pose_std else None
    if (plan is None) == (not logs):
        given = "neither" if plan is None else "both"
        raise ConfigError(f"LOG, --plan: got {given}; expected logs, or --plan SCENARIO")
    typed: dict[str, Any] = {
        "delay": delay,
        "tolerance": tolerance,
        "bits": bits,
        "pose-std": pose_std,
        "velocity-gain": velocity_gain,
        "out": delivery.out,
    }
    if plan is not None:
        of_scenario = {"--mechanism": mechanism, "--delay": delay, "--gravity": gravity}
        of_scenario |= {"--velocity-gain": velocity_gain}
        refuse(of_scenario, "with --plan; expected it in the scenario, or as --set")
    else:
        refuse({"--set": chosen.settings}, "without --plan; expected it with --plan")
    if plan is None and mechanism is None:
        raise ConfigError("--mechanism: is missing; expected a shipped name or a file, as drawn")
    from stewart_drake import functions
    from stewart_drake.identification.plan import MOTION
    from stewart_drake.identification.servo_plan import SETPOINTS_FILE

    stopped = "nothing was written"
    more: Any = {"tolerances": tolerances, "precision": precision}
    if plan is not None:
        loaded = load_scenario(plan, settings=chosen.settings)
        more["command"] = command_line(
            "identify", settings=chosen.settings, options={"plan": plan, **typed}
        )
        with on_interrupt(stopped), phase_bar("plan", delivery.quiet):
            found = functions.plan_identification(loaded, poses=pose_std is not None, **more)
        delivery.discard(MOTION, functions.SCENARIO, SETPOINTS_FILE)
    else:
        of_csv = {"--bits": bits, "--pose-std": pose_std, "--gravity": gravity}
        functions.refuse_for_runs(logs or [], of_csv)
        words = [*map(str, logs or []), *(["--no-gravity"] if gravity is False else [])]
        options = {"mechanism": mechanism, **typed}
        more["command"] = command_line("identify", *words, options=options)
        with (
            on_interrupt(stopped),
            named(delay="--delay", velocity_gain="--velocity-gain"),
            phase_bar("identify", delivery.quiet) as show,
            shown_by(show),
        ):
            found = functions.identify(
                logs or [],
                mechanism or "",
                delay=delay,
                gravity=gravity is not False,
                velocity_gain=velocity_gain,
                folder=delivery.out or "",
                **more,
            )
        delivery.discard(
            functions.MECHANISM, functions.CALIBRATION, functions.FOUND, functions.SERVOS
        )
    unexplained = plan is None and not found.study.right
    return delivery.answer(found, *found.write_files(delivery.out)) or int(unexplained)


def _precision(bits: int | None, pose_std: str | None) -> "Precision":
    from stewart_drake.identification.logs import Precision, angle_std

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
