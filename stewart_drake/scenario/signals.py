"""Names, sizes and slices of every vector that crosses a port (block order, SI units).

Nothing else in the package does index arithmetic on these vectors.
"""

from typing import Final, Literal, NamedTuple

COORDINATES: Final = ("phi", "theta", "psi", "x", "y", "z")
COORDINATE_NAMES: Final = ("roll", "pitch", "yaw", "x", "y", "z")
"""The same for a person, and in files that a person writes."""
COORDINATE_UNITS: Final = ("rad", "rad", "rad", "m", "m", "m")
RATE_UNITS: Final = ("rad/s", "rad/s", "rad/s", "m/s", "m/s", "m/s")
LEGS: Final = (1, 2, 3, 4, 5, 6)
"""Legs are numbered from one wherever a person reads the number."""

NUM_LEGS: Final = 6
NUM_COORDINATES: Final = 6
NUM_TORQUES: Final = NUM_LEGS
NUM_STATE: Final = 2 * NUM_COORDINATES
"""`state` = [pose(6); rates(6)]."""
NUM_REFERENCE: Final = 3 * NUM_COORDINATES
"""`reference` = [pose(6); rates(6); accelerations(6)]."""

POSE: Final = slice(0, 6)
RATES: Final = slice(6, 12)
ACCELERATIONS: Final = slice(12, 18)

ANGLES: Final = slice(0, 3)
"""Roll, pitch, yaw inside a pose."""
POSITION: Final = slice(3, 6)
"""xyz inside a pose."""

SETPOINT: Final = slice(0, 12)
"""Crank angles (6) and rates (6) inside a command to servos, which has the size of a reference."""
MODEL_TORQUE: Final = slice(12, 18)
"""Torques (6) inside it."""
Carried = Literal["torque", "command"]
CARRIED: Final[dict[Carried, int]] = {"torque": NUM_TORQUES, "command": NUM_REFERENCE}
"""What can be on the way to the motors, and its size."""

PARAMETERS: Final = (*(f"torque_bias_{leg}" for leg in LEGS), "payload_mass", "joint_damping")
"""Constant plant parameters that nobody tells the controller, in this order."""
PARAMETER_UNITS: Final = (*("N m",) * 6, "kg", "N m s/rad")
NUM_PARAMETERS: Final = len(PARAMETERS)
BIAS: Final = slice(0, 6)
PAYLOAD: Final = 6
DAMPING: Final = 7

PLANT_PARAMETERS: Final = (
    *PARAMETERS,
    "coulomb_friction",
    "coulomb_speed",
    *(f"payload_position_{axis}" for axis in "xyz"),
)
"""All constants of the equations of motion that are not the mechanism's, in their order."""
PLANT_PARAMETER_UNITS: Final = (*PARAMETER_UNITS, "N m", "rad/s", "m", "m", "m")
NUM_PLANT_PARAMETERS: Final = len(PLANT_PARAMETERS)
COULOMB: Final = 8
COULOMB_SPEED: Final = 9
PAYLOAD_POSITION: Final = slice(10, 13)
DEFAULT_COULOMB_SPEED: Final = 0.02
"""rad/s, where nothing else is said."""

WEIGHTS: Final = ("w_Q", "w_R")

PACKETS: Final = ("sent", "lost", "late", "played", "dry")
"""Counts of a link with packets: late are those that came after their first torque's time, played
and dry the periods in which a torque of a packet acted, and in which there was none.
"""

TUNER_INPUTS: Final = (
    *(f"error_{name}" for name in COORDINATES),
    *(f"rate_error_{name}" for name in COORDINATES),
    *(f"torque_{leg}" for leg in LEGS),
)
"""What densities are taken of: `sample` = [state error(12); commanded torque(6)]."""

STATE: Final = (*COORDINATES, *(f"{name}_dot" for name in COORDINATES))
"""Labels of a state's twelve components."""


class Dimension(NamedTuple):
    """What the components of signals are called, and what that is."""

    labels: tuple[str, ...] | tuple[int, ...]
    long_name: str


DIMENSIONS: Final[dict[str, Dimension]] = {
    "coordinate": Dimension(
        COORDINATES,
        "phi, theta, psi are roll, pitch, yaw; x, y, z of the plate's centre of mass",
    ),
    "leg": Dimension(LEGS, "legs and their motors, numbered from one"),
    "weight": Dimension(WEIGHTS, "weight of the errors, weight of the torques"),
    "parameter": Dimension(PARAMETERS, "parameters that nobody tells the controller"),
    "tuner_input": Dimension(TUNER_INPUTS, "what a density is taken of"),
    "state": Dimension(STATE, "coordinates, then their time derivatives"),
    "packet": Dimension(PACKETS, "what became of packets, and of the periods they are for"),
}


class Quantity(NamedTuple):
    """What signals can be of: their dimension, None for a single number, and components' units."""

    dimension: str | None
    units: tuple[str, ...]


class Signal(NamedTuple):
    """A signal of a run: one line of the table below, from which everything else follows.

    Attributes:
        name: in the record.
        quantity: what it is of.
        long_name: what it is.
        source: the system that has it, or "system.port" where that port is called otherwise; "" for
            what the record computes.
        port: of the closed loop, where it is not called as the signal is.
        part: of the port's components, where it is not all of them.
    """

    name: str
    quantity: Quantity
    long_name: str
    source: str = ""
    port: str = ""
    part: slice = slice(None)

    @property
    def labels(self) -> tuple[str, ...] | tuple[int, ...]:
        """Of the components; none for a single number."""
        return DIMENSIONS[self.quantity.dimension].labels if self.quantity.dimension else ()

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.quantity.units)

    @property
    def unit(self) -> str:
        """In one text: one for all where they agree, else one per component."""
        units = self.quantity.units
        return ", ".join(units[:1] if len(set(units)) == 1 else units)

    @property
    def exported(self) -> str:
        """Its port of the closed loop."""
        return self.port or self.name

    @property
    def system(self) -> str:
        """The system that has it."""
        return self.source.partition(".")[0]

    @property
    def system_port(self) -> str:
        """The port of that system."""
        return self.source.partition(".")[2] or self.exported


_POSE: Final = Quantity("coordinate", COORDINATE_UNITS)
_RATES: Final = Quantity("coordinate", RATE_UNITS)
_INTEGRAL: Final = Quantity("coordinate", tuple(f"{unit} s" for unit in COORDINATE_UNITS))
_TORQUE: Final = Quantity("leg", ("N m",) * NUM_TORQUES)
_WEIGHTS: Final = Quantity("weight", ("1",) * len(WEIGHTS))
_PARAMETERS: Final = Quantity("parameter", PARAMETER_UNITS)
_DENSITY: Final = Quantity("tuner_input", ("1",) * len(TUNER_INPUTS))
_SECONDS: Final = Quantity(None, ("s",))
_STATE: Final = Quantity("state", COORDINATE_UNITS + RATE_UNITS)
_PACKETS: Final = Quantity("packet", ("1",) * len(PACKETS))

_TABLE: Final = (
    Signal("pose", _POSE, "pose of the plate", "plant", "state", POSE),
    Signal("rates", _RATES, "time derivatives of the pose", "plant", "state", RATES),
    Signal("reference", _POSE, "pose that is asked for", "reference", part=POSE),
    Signal(
        "reference_rates",
        _RATES,
        "time derivatives of the reference",
        "reference",
        "reference",
        RATES,
    ),
    Signal("error", _POSE, "pose minus reference"),
    Signal("integral", _INTEGRAL, "integral of the error that the controller has", "controller"),
    Signal("torque_commanded", _TORQUE, "motor torque computed at the last sample", "controller"),
    Signal(
        "torque_applied", _TORQUE, "motor torque that arrives at the plant", "delay_chain.torque"
    ),
    Signal("weights", _WEIGHTS, "weights that the controller used", "controller", "weights_used"),
    Signal("parameters", _PARAMETERS, "estimate of the plant's parameters", "controller"),
    Signal("parameter_std", _PARAMETERS, "standard deviation of that estimate", "controller"),
    Signal("density", _DENSITY, "density (45)", "density"),
    Signal(
        "measurement",
        _STATE,
        "pose and rates that the controller got",
        "controller.measurement_used",
    ),
    Signal("state_estimate", _STATE, "pose and rates that the controller goes on", "controller"),
    Signal("delay_estimate", _SECONDS, "delay that the controller believes in", "controller"),
    Signal(
        "delay_std",
        _SECONDS,
        "standard deviation of that estimate, measured 1.6 to 2.6 times too large",
        "controller",
    ),
    Signal("delay_true", _SECONDS, "true delay of the torque sent last", "delay_chain.delay"),
    Signal("packets", _PACKETS, "counts of packets, NaN without any", "delay_chain"),
)
SIGNALS: Final[dict[str, Signal]] = {signal.name: signal for signal in _TABLE}
"""By name, in the order of the record. Held signals show the value from an instant on.

From here come the ports of the closed loop, those that the controller holds, the record, and names,
units and labels in `signals.nc` and CSV. A new signal is one line, and a port of its source; for
the controller that is an entry in `loop.controller.HELD`.
"""


def run_signals(samples: int | None) -> dict[str, Signal]:
    """SIGNALS of a run whose encoders are read so many times a period; None is without any."""
    if samples is None:
        return SIGNALS
    angles = Quantity("encoder", ("rad",) * (NUM_LEGS * samples))
    said = SIGNALS["measurement"]._replace(
        quantity=angles, long_name="crank angles that the controller got"
    )
    return SIGNALS | {"measurement": said}


def run_dimensions(samples: int | None) -> dict[str, Dimension]:
    """DIMENSIONS of `run_signals`."""
    if samples is None:
        return DIMENSIONS
    labels = tuple(f"A{leg}[{n}]" for n in range(samples) for leg in LEGS)
    said = "encoders of the legs, and the samples of each within a period, the oldest first"
    return DIMENSIONS | {"encoder": Dimension(labels, said)}


def exported_ports() -> dict[str, tuple[str, str]]:
    """Port of the closed loop -> system and its port, in the order of SIGNALS."""
    return {s.exported: (s.system, s.system_port) for s in SIGNALS.values() if s.source}


def ports_of(system: str) -> dict[str, Signal]:
    """The signals that a system has ports for, by port."""
    return {s.system_port: s for s in SIGNALS.values() if s.system == system}
