"""A machine and a first scenario from a few measurements: new."""

import re
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from stewart_drake.cli.common import AsJson, Delivery, Quiet
from stewart_drake.cli.options import flags_named
from stewart_drake.files.errors import ConfigError

if TYPE_CHECKING:
    from stewart_drake.studies.new_machine import NewMachine


class Cranks(StrEnum):
    """Where the cranks of a pair point."""

    apart = "apart"
    together = "together"


_ASKED: Final = {
    "base_radius": "radius of the circle of the motor shafts, m",
    "shaft_distance": "distance of the two shafts of a pair, m",
    "plate_radius": "radius of the circle of the plate's joints, m",
    "joint_distance": "distance of two neighbouring joints of the plate, m",
    "crank": "crank, from shaft to rod, m",
    "rod": "rod, from joint to joint, m",
    "plate_mass": "mass of the plate with its load, kg",
    "crank_mass": "mass of a crank, kg",
    "rod_mass": "mass of a rod, kg",
}
"""What nobody else knows, and how it is asked for."""


def _measured(field: str) -> Any:
    return typer.Option(help=_ASKED[field][0].upper() + _ASKED[field][1:] + ".")


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="For the two files.")],
    base_radius: Annotated[float | None, _measured("base_radius")] = None,
    shaft_distance: Annotated[float | None, _measured("shaft_distance")] = None,
    plate_radius: Annotated[float | None, _measured("plate_radius")] = None,
    joint_distance: Annotated[float | None, _measured("joint_distance")] = None,
    crank: Annotated[float | None, _measured("crank")] = None,
    rod: Annotated[float | None, _measured("rod")] = None,
    plate_mass: Annotated[float | None, _measured("plate_mass")] = None,
    crank_mass: Annotated[float | None, _measured("crank_mass")] = None,
    rod_mass: Annotated[float | None, _measured("rod_mass")] = None,
    shaft_height: Annotated[float, typer.Option(help="Of the shafts, m.")] = 0.0,
    upright: Annotated[
        float, typer.Option(help="Degrees from the horizon of the planes the cranks turn in.")
    ] = 90.0,
    cranks: Annotated[
        Cranks, typer.Option(help="Of a pair: they point apart, or together.")
    ] = Cranks.apart,
    torque_limit: Annotated[float | None, typer.Option(help="Of each motor, N m.")] = None,
    delay: Annotated[float, typer.Option(help="From computing a torque to feeling it, s.")] = 0.1,
    gravity: Annotated[bool, typer.Option(help="Whether it acts.")] = True,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Make a machine and a first scenario from a few measurements.

    What is not given is asked for. Lengths in m, masses in kg; moments of inertia are estimated.
    """
    given = {
        "base_radius": base_radius,
        "shaft_distance": shaft_distance,
        "plate_radius": plate_radius,
        "joint_distance": joint_distance,
        "crank": crank,
        "rod": rod,
        "plate_mass": plate_mass,
        "crank_mass": crank_mass,
        "rod_mass": rod_mass,
    }
    from stewart_drake.studies import new_machine as study

    delivery = Delivery(folder, quiet, as_json)
    study.check_free(folder)  # before nine questions
    measured = _complete(given, asking=sys.stdin.isatty() and not (quiet or as_json))
    with flags_named({name: _flag(name) for name in study.Measurements.__annotations__}):
        measurements = study.Measurements(
            **measured,
            shaft_height=shaft_height,
            upright=upright,
            cranks=cranks.value,
            torque_limit=torque_limit,
            delay=delay,
            gravity=gravity,
        )
    made = study.new_machine(measurements, _name_of(folder), folder)
    _tell(delivery, made)
    delivery.wrote(study.MACHINE, study.SCENARIO)
    delivery.write(made.summary)
    status = delivery.end(made.summary)
    delivery.say(f"next: stewart-drake simulate {folder / study.SCENARIO} --out {folder / 'run'}")
    return status


def _tell(delivery: Delivery, made: "NewMachine") -> None:
    """The machine at home, the motion, and what the delay does."""
    from stewart_drake.reporting.mechanism import document
    from stewart_drake.studies.verdict import Verdict, loop_verdict

    delivery.say(document(made.check).plain())
    margin = made.margin
    delay = Verdict(margin.eta, margin.pole, margin.pole_time)
    for text in (made.verdict, loop_verdict(margin), str(delay)):
        delivery.tell(text)


def _complete(given: dict[str, float | None], asking: bool) -> dict[str, float]:
    """Every measurement; what is missing is asked for at a terminal, and an error elsewhere."""
    missing = [name for name, value in given.items() if value is None]
    if missing and not asking:
        flags = ", ".join(_flag(name) for name in missing)
        raise ConfigError(
            f"new: got no {flags}; expected what is measured on the machine; "
            "a terminal is asked for it"
        )
    answers = {name: _ask(_ASKED[name]) for name in missing}
    return {name: answers[name] if value is None else value for name, value in given.items()}


def _ask(question: str) -> float:
    from stewart_drake.studies.new_machine import LARGEST

    while True:
        value = float(typer.prompt(question, type=float))
        if not (question.endswith(", m") and value > LARGEST):
            return value
        if typer.confirm(f"{value:g} m? {value / 1000:g} m for {value:g} mm", default=True):
            return value / 1000


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _name_of(folder: Path) -> str:
    """A machine's name from that of its folder; `machine` where it makes none."""
    name = re.sub("[^A-Za-z0-9_-]", "_", folder.resolve().name)
    from stewart_drake.mechanism.geometry import RESERVED_NAMES

    fits = re.match("[A-Za-z]", name) and name not in RESERVED_NAMES
    return name if fits else "machine"
