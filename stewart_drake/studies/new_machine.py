"""A machine, a scenario and a first check, from a few measurements with a ruler and scales.

The machine has threefold symmetry: three pairs of shafts on a circle of the base, three pairs of
joints on a circle of the plate. Two shafts at the distance d on a circle of radius R have the angle

    separation = 2 asin(d / (2 R))

at its centre, and so have two joints. Each pair of joints sits between two pairs of shafts, and
holds one rod of each. Home is at the height z that maximises the least |r.t| of the six legs, with
r along the rod and t along the crank tip's circle. |r.t| is 0 at a dead centre.

`check_mechanism` checks any machine at home: reach, torque, poles and singularity.
"""

import math
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.law.startup import reference_torque
from stewart_drake.loop.clearance import ClearanceScene
from stewart_drake.loop.controller_margin import ControllerMargin, controller_margin
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.files import PatternSpec, load_mechanism, pattern_legs
from stewart_drake.mechanism.geometry import Mechanism, plate_radius
from stewart_drake.mechanism.kinematics import leg_geometry, reachable_heights
from stewart_drake.mechanism.trajectories import poses_along
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.signals import COORDINATES
from stewart_drake.scenario.timing import Delay
from stewart_drake.studies.clearance import clearance_along
from stewart_drake.studies.study_options import Measurements
from stewart_drake.studies.verdict import Verdict, loop_verdict, milliseconds
from stewart_drake.studies.workspace_map import Measures, Travel, measure, travel
from stewart_drake.types import Array

BODIES: Final = ("base", "plate", "crank", "rod")


_SAME: Final = 1e-3
"""Largest relative difference of equal numbers."""


class MechanismCheck(NamedTuple):
    mechanism: Mechanism
    # why the home pose is unusable: torque, poles and travel are then empty; or None
    failure: Failure | None
    measures: Measures  # at home
    crank_angles: Array  # (6,) rad
    torque: Array  # (6,) N m that hold the plate
    # (12,) of the open loop, 1/s, the fastest growing first
    poles: NDArray[np.complex128]
    travel: list[Travel]  # of each coordinate

    @property
    def verdict(self) -> str:
        """Whether the machine can be used as described, in a sentence."""
        if self.failure is not None:
            return f"no: the home pose is singular, {self.failure.reason}"
        limit, worst = self.mechanism.effort_limit, float(np.abs(self.torque).max())
        if limit is not None and worst > limit:
            return (
                f"no: the motors cannot hold the plate, {worst:.3g} N m at home against a limit "
                f"of {limit:.3g} N m"
            )
        return "yes: it stands at home, every leg in reach and off its dead centre"

    @property
    def unlike(self) -> str:
        """Finding that every second leg differs at home though drawn alike, or empty."""
        m, torque = self.mechanism, np.abs(self.torque)
        radii = [np.linalg.norm(points[:, :2], axis=1) for points in (m.p_WS, m.p_PQ)]
        drawn = (*radii, m.crank_lengths, m.rod_lengths)
        regular = all(np.ptp(one) < _SAME * one.max() for one in drawn)
        if not regular or m.home[:5].any() or torque.size == 0:
            return ""
        if np.ptp(torque.reshape(3, 2), axis=0).max() < _SAME * torque.max():
            return ""
        return (
            f"not alike, though drawn alike: torques to hold {torque.min():.3g} to "
            f"{torque.max():.3g} N m; check branches and plate_order"
        )

    @property
    def summary(self) -> dict[str, Any]:
        """Content of `summary.json`, SI units; NaN for a missing value."""
        limit = self.mechanism.effort_limit
        return {
            "name": self.mechanism.name,
            "verdict": self.verdict,
            "failure": None if self.failure is None else self.failure._asdict(),
            "home": self.mechanism.home,
            "inertia": {name: getattr(self.mechanism, name).inertia for name in BODIES},
            "inertia_estimated": [
                name for name in BODIES if getattr(self.mechanism, name).estimated
            ],
            "crank_angles": self.crank_angles,
            "characteristic_length": plate_radius(self.mechanism),
            "measures": self.measures._asdict(),
            "torque": self.torque,
            "torque_limit": np.nan if limit is None else limit,
            "poles": [[pole.real, pole.imag] for pole in self.poles],
            "travel": [t._asdict() for t in self.travel],
        }


def check_mechanism(mechanism: Mechanism, gravity: bool = True) -> MechanismCheck:
    """Check a mechanism at home; a singular home pose is a finding, not an error."""
    home = mechanism.home
    failure = diagnose(mechanism, 0.0, home)
    torque, poles = np.empty(0), np.empty(0, dtype=np.complex128)
    if failure is None:
        dynamics = StewartDynamics(mechanism, gravity=gravity)
        torque = dynamics.equilibrium_torque(home)
        found = np.linalg.eigvals(dynamics.linearize(home)[0]).astype(np.complex128)
        poles = found[np.lexsort((found.imag, -found.real))]
    return MechanismCheck(
        mechanism=mechanism,
        failure=failure,
        measures=measure(mechanism, home),
        crank_angles=mechanism.crank_angles(home),
        torque=torque,
        poles=poles,
        travel=travel(mechanism),
    )


MACHINE: Final = "machine.yaml"
SCENARIO: Final = "scenario.yaml"

_HEIGHTS: Final = 400
"""Number of heights of home that are compared."""
_TRAVEL_SHARE: Final = 0.25
"""Amplitude of the proposed motion, as a share of the travel of z."""
_MOTION_PERIOD: Final = 2.0
"""Period of the proposed motion, s."""
_CHECKED_POSES: Final = 41
"""Number of its poses at which the clearance of links is checked."""
_FAST_PERIOD: Final = 0.02
_SLOW_PERIOD: Final = 0.1
"""Sampling periods of the controller, s: the slow one for a delay beyond _MAX_STEPS fast ones."""
_MAX_STEPS: Final = 25
_CLOSE: Final = 0.1
"""Delay margin below which a warning is printed, in periods."""


class NewMachine(NamedTuple):
    """New machine with a first check, at home and along the proposed motion."""

    check: MechanismCheck
    margin: ControllerMargin
    peak_torque: float  # of the motion, N m
    crossings: list[str]  # links that cross in the motion, see `ClearanceAlong.crossings`

    @property
    def verdict(self) -> str:
        """Whether the motors can do what is proposed, in a sentence."""
        limit = self.check.mechanism.effort_limit
        takes = f"the proposed motion takes motor torques of up to {self.peak_torque:.3g} N m"
        if limit is None:
            return takes
        return f"{takes}, the motors have {limit:.3g}" + (
            "" if self.peak_torque < limit else ": too weak"
        )

    @property
    def findings(self) -> list[str]:
        """Sentences about torque, stability and delay."""
        found = [self.verdict, loop_verdict(self.margin), str(Verdict.of(self.margin))]
        if self.margin.stable and self.margin.delay_margin < _CLOSE * self.margin.period:
            found.append(
                f"know the delay to {milliseconds(self.margin.delay_margin)}, as with a play-out "
                "buffer, or raise controller.w_R (stewart-drake analyze delay compares)"
            )
        return found

    @property
    def summary(self) -> dict[str, Any]:
        return self.check.summary | {
            "peak_torque": self.peak_torque,
            "controller_margin": self.margin.summary,
            "crossings": self.crossings,
        }


def separation(distance: float, radius: float) -> float:
    """Return the angle at a circle's centre, degrees, between points at a distance, m."""
    return math.degrees(2 * math.asin(distance / (2 * radius)))


def proposed_pattern(m: Measurements) -> PatternSpec:
    return PatternSpec(
        rotation_deg=0.0,
        base_radius=m.base_radius,
        base_separation_deg=round(separation(m.shaft_distance, m.base_radius), 4),
        plate_radius=m.plate_radius,
        plate_separation_deg=round(separation(m.joint_distance, m.plate_radius), 4),
        plate_offset_deg=60.0,
        plate_order=[5, 0, 1, 2, 3, 4],
        shaft_height=m.shaft_height,
        installation_deg=m.upright,
        branches=[1, -1] * 3 if m.cranks == "apart" else [-1, 1] * 3,
    )


def best_height(pattern: PatternSpec, m: Measurements) -> float:
    """Return z in m of the plate's joints that maximises the least |r.t|."""
    legs = pattern_legs(pattern, m.crank, m.rod)
    guess = m.shaft_height + m.rod
    heights_found = reachable_heights(legs, np.array([0, 0, 0, 0, 0, guess]))
    if heights_found is None:
        gap = float(np.linalg.norm((legs.p_PQ - legs.p_WS)[:, :2], axis=1).max())
        raise ConfigError(
            f"rod: got {m.rod:g} m with cranks of {m.crank:g} m; expected rods that reach the "
            f"plate, whose joints are {gap:.3g} m from the shafts horizontally"
        )
    low, high = heights_found
    heights = np.linspace(low, high, _HEIGHTS + 2)[1:-1]
    transmission = [
        np.abs(leg_geometry(legs, np.array([0, 0, 0, 0, 0, z])).transmission).min() for z in heights
    ]
    return float(heights[int(np.argmax(transmission))])


def machine_text(m: Measurements, name: str) -> str:
    pattern = proposed_pattern(m)
    rows = "\n".join(f"  {field.name}: {getattr(pattern, field.name)}" for field in fields(pattern))
    height = float(f"{best_height(pattern, m):.4g}")
    limit = "null" if m.torque_limit is None else f"{m.torque_limit!r}"
    return f"""# Lengths in m, masses in kg. Moments of inertia that are not listed are
# estimated, of a uniform disc and bars, a motor's rotor not among them.
name: {name}
home: [0, 0, 0, 0, 0, {height}]       # proposed: where the rods push the cranks best

pattern:
{rows}

base: {{mass: 0}}                  # does not move
plate: {{mass: {m.plate_mass!r}}}
crank: {{length: {m.crank!r}, mass: {m.crank_mass!r}}}
rod: {{length: {m.rod!r}, mass: {m.rod_mass!r}}}
motor: {{effort_limit: {limit}}}
"""


def scenario_text(m: Measurements, mechanism: Mechanism) -> str:
    """Return a first scenario: up and down, over a quarter of the travel of the plate."""
    z = next(t for t in travel(mechanism) if t.coordinate == COORDINATES[5])
    amplitude = float(f"{_TRAVEL_SHARE * min(-z.low, z.high):.1g}")
    period = _FAST_PERIOD if m.delay <= _MAX_STEPS * _FAST_PERIOD else _SLOW_PERIOD
    delay = Delay.of(m.delay, period)
    home = [float(value) for value in mechanism.home]
    queue = "equilibrium      # the motors hold the plate already" if m.gravity else "zero"
    limit = m.torque_limit
    kept = "the start from rest is planned within it"
    actuator = "" if limit is None else f"actuator: {{torque_limit: {limit!r}}}   # N m; {kept}\n"
    return f"""# A first motion of {mechanism.name}; all fields are in the shipped paper.yaml.
mechanism: {MACHINE}
duration: 10.0          # s
start: rest             # as a machine is before its controller runs
queue: {queue}

# Up and down: a log of it shows friction and payload, but hardly the lengths.
# For a log to identify the machine from: stewart-drake identify --plan
reference:
  kind: sine
  amplitude: [0, 0, 0, 0, 0, {amplitude}]
  offset: {home}
  frequency: {1 / _MOTION_PERIOD}
  frequency_unit: Hz

plant: {{kind: exact, gravity: {str(m.gravity).lower()}}}
{actuator}controller: {{period: {period}}}       # s
delay: {{steps: {delay.steps}, fraction: {round(delay.fraction, 9)}}}   # of {m.delay:g} s in all
"""


def refuse_existing(folder: Path) -> None:
    """Raise an error if a folder has one of MACHINE and SCENARIO."""
    for file in (MACHINE, SCENARIO):
        if (folder / file).exists():
            raise ConfigError(
                f"{folder / file}: already exists; expected a folder without it: another one, or "
                f"this one after you delete {file}"
            )


def proposed(m: Measurements, name: str, machine: Path) -> MechanismCheck:
    """Write a mechanism file and return its check; raise an error if it cannot be used."""
    machine.write_text(machine_text(m, name))
    check = check_mechanism(load_mechanism(machine), m.gravity)
    if check.failure is not None:
        found = check.verdict.removeprefix("no: ")
        raise ConfigError(f"{found}; expected other lengths, or {_other_cranks(m)}")
    needed = float(np.abs(check.torque).max())
    if m.torque_limit is not None and m.torque_limit < needed:
        raise ConfigError(
            f"torque_limit: got {m.torque_limit:g} N m, too weak to hold the plate at home; "
            f"expected more than {needed:.3g} N m, or other measurements"
        )
    return check


def _other_cranks(m: Measurements) -> str:
    return f"cranks that point {'apart' if m.cranks == 'together' else 'together'}"


def new_machine(m: Measurements, name: str, folder: Path) -> NewMachine:
    """Check a new machine, and write MACHINE and SCENARIO into a folder if it can be used."""
    refuse_existing(folder)
    with TemporaryDirectory() as temporary:
        machine, scenario = Path(temporary) / MACHINE, Path(temporary) / SCENARIO
        check = proposed(m, name, machine)
        mechanism = check.mechanism
        scenario.write_text(scenario_text(m, mechanism))
        experiment = prepare(load_scenario(scenario))
        time = np.linspace(0.0, _MOTION_PERIOD, _CHECKED_POSES)
        poses = poses_along(experiment.reference, time)
        along = clearance_along(ClearanceScene(mechanism), mechanism, time, poses)
        plant, duration = experiment.nominal, experiment.scenario.duration
        torque = reference_torque(plant, experiment.reference, duration)
        crossings = along.crossings
        if along.touching:
            crossings[0] += f"; compare {_other_cranks(m)}"
        made = NewMachine(check, controller_margin(experiment), torque, crossings)
        for path in (machine, scenario):
            write_whole(folder / path.name, path.read_bytes())
    return made
