"""Names, sizes and slices of every vector that crosses a port (block order, SI units).

Nothing else in the package does index arithmetic on these vectors.
"""

import re
from collections.abc import Iterable
from typing import Final, Literal, NamedTuple

COORDINATES: Final = ("phi", "theta", "psi", "x", "y", "z")
COORDINATE_NAMES: Final = ("roll", "pitch", "yaw", "x", "y", "z")
"""Names of the coordinates for users and in their files."""
COORDINATE_UNITS: Final = ("rad", "rad", "rad", "m", "m", "m")
RATE_UNITS: Final = ("rad/s", "rad/s", "rad/s", "m/s", "m/s", "m/s")
LEGS: Final = (1, 2, 3, 4, 5, 6)  # numbers of the legs, from one

NUM_LEGS: Final = 6
NUM_COORDINATES: Final = 6
NUM_TORQUES: Final = NUM_LEGS
NUM_STATE: Final = 2 * NUM_COORDINATES  # `state` = [pose(6); rates(6)]
NUM_REFERENCE: Final = 3 * NUM_COORDINATES  # `reference` = [pose(6); rates(6); accelerations(6)]

POSE: Final = slice(0, 6)
RATES: Final = slice(6, 12)
ACCELERATIONS: Final = slice(12, 18)

ANGLES: Final = slice(0, 3)  # roll, pitch, yaw inside a pose
POSITION: Final = slice(3, 6)  # xyz inside a pose

SETPOINT: Final = slice(0, 12)
"""Crank angles (6) and rates (6) inside a command to servos, which has the size of a reference."""
MODEL_TORQUE: Final = slice(12, 18)  # torques (6) inside such a command
Carried = Literal["torque", "command"]
CARRIED: Final[dict[Carried, int]] = {"torque": NUM_TORQUES, "command": NUM_REFERENCE}
"""Size of each kind of command to the motors."""

PARAMETERS: Final = (*(f"torque_bias_{leg}" for leg in LEGS), "payload_mass", "joint_damping")
"""Constant plant parameters that are unknown to the controller."""
PARAMETER_UNITS: Final = (*("N m",) * 6, "kg", "N m s/rad")
NUM_PARAMETERS: Final = len(PARAMETERS)
BIAS: Final = slice(0, 6)
PAYLOAD: Final = 6
DAMPING: Final = 7

CONSTANTS: Final = (
    *PARAMETERS,
    "coulomb_friction",
    "coulomb_speed",
    *(f"payload_position_{axis}" for axis in "xyz"),
    "ball_joint_damping",
    "ball_joint_friction",
    "ball_joint_friction_speed",
)
"""All constants of the equations of motion that are not the mechanism's."""
CONSTANT_UNITS: Final = (
    *(*PARAMETER_UNITS, "N m", "rad/s", "m", "m", "m"),
    *("N m s/rad", "N m", "rad/s"),
)
NUM_CONSTANTS: Final = len(CONSTANTS)
WRENCHES: Final = tuple(f"wrench_{kind}_{axis}" for kind in ("moment", "force") for axis in "xyz")
"""Wrench on the plate in the world at its centre of mass, moment then force; it may change."""
WRENCH_UNITS: Final = (*("N m",) * 3, *("N",) * 3)
PLANT_PARAMETERS: Final = (*CONSTANTS, *WRENCHES)
"""All parameters of the equations of motion that are not the mechanism's."""
PLANT_PARAMETER_UNITS: Final = (*CONSTANT_UNITS, *WRENCH_UNITS)
NUM_PLANT_PARAMETERS: Final = len(PLANT_PARAMETERS)
COULOMB: Final = 8
COULOMB_SPEED: Final = 9
SHAFTS: Final = slice(7, 10)  # damping, Coulomb friction and its speed
PAYLOAD_POSITION: Final = slice(10, 13)
WRENCH: Final = slice(NUM_CONSTANTS, NUM_PLANT_PARAMETERS)
BALL_JOINTS: Final = slice(13, 16)  # damping, Coulomb friction and its speed
BALL_JOINT_FRICTION_SPEED: Final = 15
NUM_BALL_JOINT_PARAMETERS: Final = 3
DEFAULT_COULOMB_SPEED: Final = 0.02  # rad/s
DEFAULT_BALL_JOINT_SPEED: Final = 0.1  # rad/s

WEIGHTS: Final = ("w_Q", "w_R")

PACKETS: Final = ("sent", "lost", "late", "played", "dry")
"""Counts of a link with packets: late ones arrived after their first torque's time; played and dry
are periods with and without a torque of a packet."""

TUNER_INPUTS: Final = (
    *(f"error_{name}" for name in COORDINATES),
    *(f"rate_error_{name}" for name in COORDINATES),
    *(f"torque_{leg}" for leg in LEGS),
)
"""Inputs of densities: `sample` = [state error(12); commanded torque(6)]."""

STATE: Final = (*COORDINATES, *(f"{name}_dot" for name in COORDINATES))  # labels of a state


class Dimension(NamedTuple):
    """Labels of the components of signals, and their meaning."""

    name: str
    labels: tuple[str, ...] | tuple[int, ...]
    long_name: str


class Quantity(NamedTuple):
    """Dimension of a signal, None for a single number, and units of its components."""

    dimension: Dimension | None
    units: tuple[str, ...]


class Signal(NamedTuple):
    """A signal of a run: one row of the table below, from which everything else follows."""

    name: str  # in the record
    quantity: Quantity
    long_name: str  # meaning
    # system, or "system.port" for a port of another name; "" for a signal that the record computes
    source: str = ""
    port: str = ""  # of the closed loop, if its name is not the signal's
    part: slice = slice(None)  # of the port's components

    @property
    def labels(self) -> tuple[str, ...] | tuple[int, ...]:
        """Labels of the components; none for a single number."""
        return self.quantity.dimension.labels if self.quantity.dimension else ()

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the components in JSON, such as `roll`, `leg_1`, `A1_0`."""
        words = (f"leg_{label}" if isinstance(label, int) else label for label in self.labels)
        return tuple(re.sub(r"\W+", "_", _spoken(word)).strip("_") for word in words) or ("value",)

    @property
    def heads(self) -> list[str]:
        """Heads of the columns in CSV, with units."""
        return headings(self.name, self.labels, self.quantity.units)

    @property
    def size(self) -> int:
        return len(self.quantity.units)

    @property
    def unit(self) -> str:
        """Common unit, or units of all components."""
        units = self.quantity.units
        return ", ".join(units[:1] if len(set(units)) == 1 else units)

    @property
    def exported(self) -> str:
        """Port of the closed loop."""
        return self.port or self.name

    @property
    def system(self) -> str:
        return self.source.partition(".")[0]

    @property
    def system_port(self) -> str:
        return self.source.partition(".")[2] or self.exported


_NAMES: Final = dict(zip(COORDINATES, COORDINATE_NAMES, strict=True))


def _spoken(label: object) -> str:
    """Return a label in words of users: `roll_dot` for `phi_dot`."""
    return "_".join(_NAMES.get(word, word) for word in str(label).split("_"))


def headings(name: str, labels: Iterable[object], units: Iterable[str]) -> list[str]:
    """Return the column heads of a signal, such as `error_roll[rad]`; labels may be none."""
    columns = [f"{name}_{_spoken(label)}" for label in labels] or [name]
    pairs = zip(columns, units, strict=True)
    return [f"{column}[{'-' if unit == '1' else unit}]" for column, unit in pairs]


_COORDINATE: Final = Dimension(
    "coordinate",
    COORDINATES,
    "phi, theta, psi are roll, pitch, yaw; x, y, z of the plate's centre of mass",
)
_LEG: Final = Dimension("leg", LEGS, "legs and their motors, numbered from one")

_POSE: Final = Quantity(_COORDINATE, COORDINATE_UNITS)
_RATES: Final = Quantity(_COORDINATE, RATE_UNITS)
_INTEGRAL: Final = Quantity(_COORDINATE, tuple(f"{unit} s" for unit in COORDINATE_UNITS))
_TORQUE: Final = Quantity(_LEG, ("N m",) * NUM_TORQUES)
_CRANKS: Final = Quantity(_LEG, ("rad",) * NUM_LEGS)
_WEIGHTS: Final = Quantity(
    Dimension("weight", WEIGHTS, "weight of the errors, weight of the torques"),
    ("1",) * len(WEIGHTS),
)
_PARAMETERS: Final = Quantity(
    Dimension("parameter", PARAMETERS, "parameters that are unknown to the controller"),
    PARAMETER_UNITS,
)
_WRENCH: Final = Quantity(
    Dimension("wrench", WRENCHES, "moment, then force, in the world at the plate's centre of mass"),
    WRENCH_UNITS,
)
_DENSITY: Final = Quantity(
    Dimension("tuner_input", TUNER_INPUTS, "inputs of a density"), ("1",) * len(TUNER_INPUTS)
)
_SECONDS: Final = Quantity(None, ("s",))
_STATE: Final = Quantity(
    Dimension("state", STATE, "coordinates, then their time derivatives"),
    COORDINATE_UNITS + RATE_UNITS,
)
_PACKETS: Final = Quantity(
    Dimension("packet", PACKETS, "counts of packets, and of periods"), ("1",) * len(PACKETS)
)

_TABLE: Final = (
    Signal("pose", _POSE, "pose of the plate", "plant", "state", POSE),
    Signal("rates", _RATES, "time derivatives of the pose", "plant", "state", RATES),
    Signal("reference", _POSE, "reference pose", "reference", part=POSE),
    Signal("reference_rates", _RATES, "its time derivatives", "reference", "reference", RATES),
    Signal("error", _POSE, "pose minus reference"),
    Signal("integral", _INTEGRAL, "integral of the error in the controller", "controller"),
    Signal("torque_commanded", _TORQUE, "motor torque computed at the last sample", "controller"),
    Signal("torque_applied", _TORQUE, "motor torque at the plant", "delay_chain.torque"),
    Signal("weights", _WEIGHTS, "weights that the controller used", "controller", "weights_used"),
    Signal("parameters", _PARAMETERS, "estimate of the plant's parameters", "controller"),
    Signal("parameter_std", _PARAMETERS, "standard deviation of that estimate", "controller"),
    Signal("wrench_estimate", _WRENCH, "estimate of a wrench on the plate", "controller"),
    Signal("wrench_std", _WRENCH, "standard deviation of that estimate", "controller"),
    Signal("density", _DENSITY, "density (45)", "density"),
    Signal("measurement", _STATE, "measured pose and rates", "controller.measurement_used"),
    Signal("state_estimate", _STATE, "estimated pose and rates", "controller"),
    Signal("delay_estimate", _SECONDS, "delay that the controller assumes", "controller"),
    Signal(
        "delay_std",
        _SECONDS,
        "standard deviation of that estimate, measured 1.0 to 1.4 times too large",
        "controller",
    ),
    Signal("delay_true", _SECONDS, "true delay of the torque sent last", "delay_chain.delay"),
    Signal("packets", _PACKETS, "counts of packets, NaN without any", "delay_chain"),
)
SIGNALS: Final[dict[str, Signal]] = {signal.name: signal for signal in _TABLE}
"""By name, in the order of the record. Sampled signals show the value from an instant on.

The ports of the closed loop, the record, and names, units and labels in `signals.nc` and CSV follow
from it. A new signal is one row, and a port of its source; for the controller that is an entry in
`loop.controller.held_by`.
"""


SERVO_SIGNALS: Final = (
    Signal("setpoint", _CRANKS, "crank angles sent at the last sample"),
    Signal("crank", _CRANKS, "crank angles of the pose"),
)
"""Signals of position servos in a log, in addition."""


def run_signals(samples: int | None) -> dict[str, Signal]:
    """Return the signals of a run with this number of encoder readings a period, or without any."""
    if samples is None:
        return SIGNALS
    labels = tuple(f"A{leg}[{n}]" for n in range(samples) for leg in LEGS)
    meaning = "encoders of the legs, and the readings of each within a period, the oldest first"
    angles = Quantity(Dimension("encoder", labels, meaning), ("rad",) * len(labels))
    measured = SIGNALS["measurement"]._replace(quantity=angles, long_name="measured crank angles")
    return SIGNALS | {"measurement": measured}


def recorded_signals(samples: int | None) -> list[Signal]:
    """Return those of `run_signals` that a record takes from the systems, without the error."""
    return [signal for signal in run_signals(samples).values() if signal.source]


def exported_ports() -> dict[str, tuple[str, str]]:
    """Return system and its port by port of the closed loop, in the order of SIGNALS."""
    return {s.exported: (s.system, s.system_port) for s in SIGNALS.values() if s.source}


def ports_of(system: str) -> dict[str, Signal]:
    """Return the signals of a system by its ports."""
    return {s.system_port: s for s in SIGNALS.values() if s.system == system}
