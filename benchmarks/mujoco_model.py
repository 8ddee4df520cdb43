"""A `Mechanism` as a MuJoCo model: the same tree and inertias, loops closed by soft constraints.

The tree is that of the generated SDFormat: base - crank (hinge) - rod (two hinges), and the plate,
here on three slides and three hinges, so that its joint positions are the pose. Per leg one
`connect` holds the rod's end at the plate's joint. MuJoCo's constraints are soft: a critically
damped spring closes a gap, and of the acceleration that would open it a share 1 - d remains.

Run as a script, it compares the accelerations with those of `StewartDynamics`: their difference
falls with 1 - d down to rounding errors, so that nothing but that softness keeps the models apart.
"""

import time
from collections.abc import Callable
from typing import NamedTuple
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

import stewart_drake as sd
from stewart_drake.core.layout import DEFAULT_GRAVITY
from stewart_drake.mechanism.assembly import assemble, joint_state
from stewart_drake.mechanism.geometry import Body, Mechanism
from stewart_drake.scenario.signals import LEGS, POSE, RATES
from stewart_drake.types import Array

Torque = Callable[[float], Array]

HIGHEST_IMPEDANCE = 0.9999
"""d; MuJoCo takes any higher value in an MJCF document for this one."""


class Closure(NamedTuple):
    """How the loops are closed.

    Attributes:
        time_constant: of the critically damped spring, s (`solref`).
        hardening: divides the softness (1 - d) / d, by way of the inverse weights of the loaded
            model; 1 is the hardest that an MJCF document can ask for.
        iterations: of Newton's method. One solves for equalities alone, which make a quadratic
            problem; badly conditioned ones, as after hardening, take a second to be accurate.
    """

    time_constant: float
    hardening: float = 1.0
    iterations: int = 1


def to_mjcf(mechanism: Mechanism, gravity: bool, closure: Closure) -> str:
    """Return the mechanism as an MJCF document, its legs assembled at the home pose."""
    home = assemble(mechanism, mechanism.home)
    root = ET.Element("mujoco", model=mechanism.name)
    ET.SubElement(root, "compiler", angle="radian")
    option = ET.SubElement(
        root,
        "option",
        integrator="RK4",
        solver="Newton",
        tolerance="0",
        iterations=str(closure.iterations),
        gravity=_listed([0, 0, -DEFAULT_GRAVITY if gravity else 0]),
    )
    # Otherwise time constants below two time steps would be raised to that.
    ET.SubElement(option, "flag", refsafe="disable", contact="disable")
    world = ET.SubElement(root, "worldbody")
    equality, actuator = ET.SubElement(root, "equality"), ET.SubElement(root, "actuator")

    plate = _body(world, "plate", np.zeros(3), np.eye(3), mechanism.plate, np.zeros(3))
    for kind, axes in (("slide", "xyz"), ("hinge", "zyx")):
        for axis in axes:
            _joint(plate, f"{kind}_{axis}", kind, np.eye(3)["xyz".index(axis)])
    spring = {
        "solref": _listed([closure.time_constant, 1]),
        "solimp": _listed([HIGHEST_IMPEDANCE, HIGHEST_IMPEDANCE, 1e-3, 0.5, 2]),
    }
    for i, leg in enumerate(LEGS):
        tip = np.array([mechanism.crank_lengths[i], 0, 0])
        end = np.array([mechanism.rod_lengths[i], 0, 0])
        R_WC, R_WD, p_WS = home.R_WC[i], home.R_WD[i], mechanism.p_WS[i]
        link = mechanism.crank
        crank = _body(world, f"crank_{leg}", p_WS, R_WC, link, link.center * tip)
        _joint(crank, f"motor_{leg}", "hinge", np.array([0, 0, 1]))
        link = mechanism.rod
        rod = _body(crank, f"rod_{leg}", tip, R_WC.T @ R_WD, link, link.center * end)
        _joint(rod, f"first_{leg}", "hinge", R_WD.T @ mechanism.R_WS[i][:, 2])
        _joint(rod, f"second_{leg}", "hinge", np.array([0, 1, 0]))
        ET.SubElement(rod, "site", name=f"rod_end_{leg}", pos=_listed(end))
        ET.SubElement(plate, "site", name=f"joint_{leg}", pos=_listed(mechanism.p_PQ[i]))
        sites = {"site1": f"rod_end_{leg}", "site2": f"joint_{leg}"}
        ET.SubElement(equality, "connect", sites | spring)
        ET.SubElement(actuator, "motor", joint=f"motor_{leg}")
    return ET.tostring(root, encoding="unicode")


def _body(
    parent: ET.Element, name: str, p: Array, R: Array, inertia: Body, com: Array
) -> ET.Element:
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    body = ET.SubElement(parent, "body", name=name, pos=_listed(p), quat=_listed([w, x, y, z]))
    moments = {"mass": _listed([inertia.mass]), "diaginertia": _listed(inertia.inertia)}
    ET.SubElement(body, "inertial", {"pos": _listed(com)} | moments)
    return body


def _joint(body: ET.Element, name: str, kind: str, axis: Array) -> None:
    ET.SubElement(body, "joint", name=name, type=kind, axis=_listed(axis))


def _listed(values: ArrayLike) -> str:
    return " ".join(f"{float(value):.17g}" for value in np.ravel(values))


class MujocoStewart:
    """The mechanism in MuJoCo, with the state [pose; rates] (12,) of our plants."""

    def __init__(self, mechanism: Mechanism, gravity: bool, closure: Closure) -> None:
        self.mechanism = mechanism
        self.model = mujoco.MjModel.from_xml_string(to_mjcf(mechanism, gravity, closure))
        self.model.body_invweight0 /= closure.hardening
        self.data = mujoco.MjData(self.model)
        # Joints in the order of the document: x, y, z, yaw, pitch, roll, and three of each leg.
        self._plate = np.array([5, 4, 3, 0, 1, 2])

    def set_state(self, state: Array) -> None:
        """Begin at t = 0 in [pose; rates] (12,), all loops closed."""
        joints = joint_state(self.mechanism, state[POSE], state[RATES])
        mujoco.mj_resetData(self.model, self.data)
        for target, plate, crank, universal in (
            (self.data.qpos, state[POSE], joints.crank, joints.universal),
            (self.data.qvel, state[RATES], joints.crank_rate, joints.universal_rate),
        ):
            target[self._plate] = plate
            target[6:] = np.column_stack([crank, universal]).ravel()

    def state(self) -> Array:
        """[pose; rates] (12,)."""
        return np.concatenate([self.data.qpos[self._plate], self.data.qvel[self._plate]])

    def accelerations(self, state: Array, torque: Array) -> Array:
        """Second derivative (6,) of the pose."""
        self.set_state(state)
        self.data.ctrl[:] = torque
        mujoco.mj_forward(self.model, self.data)
        return self.data.qacc[self._plate].copy()

    def simulate(
        self, start: Array, torque: Array | Torque, duration: float, time_step: float
    ) -> tuple[float, Array]:
        """Seconds of stepping, and the state at the end.

        All steps are one call; a torque (6,) that depends on time is asked for in every stage.
        """
        ctrl = self.data.ctrl

        def drive(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            ctrl[:] = torque(data.time)

        self.set_state(start)
        self.model.opt.timestep = time_step
        if callable(torque):
            mujoco.set_mjcb_control(drive)
        else:
            ctrl[:] = torque
        started = time.process_time()
        mujoco.mj_step(self.model, self.data, nstep=round(duration / time_step))
        seconds = time.process_time() - started
        mujoco.set_mjcb_control(None)
        return seconds, self.state()


def largest_difference(mechanism: Mechanism, hardening: float) -> float:
    """Return the relative difference of the accelerations from the exact ones, at random states."""
    rng, worst = np.random.default_rng(46), 0.0
    for gravity in (True, False):
        exact = sd.StewartDynamics(mechanism, gravity)
        soft = MujocoStewart(mechanism, gravity, Closure(1e-3, hardening, iterations=3))
        for _ in range(10):
            pose = mechanism.home + rng.uniform(-1, 1, 6) * ([0.2] * 3 + [0.02] * 3)
            state, torque = np.concatenate([pose, rng.normal(0, 0.3, 6)]), rng.normal(0, 0.3, 6)
            expected = exact.accelerations(state[POSE], state[RATES], torque)
            difference = np.abs(soft.accelerations(state, torque) - expected).max()
            worst = max(worst, difference / np.abs(expected).max())
    return worst


def main() -> None:
    """Print how far the accelerations agree."""
    mechanism = sd.load_mechanism("paper")
    print("softness 1 - d   accelerations differ, relative, by")
    for hardening in (1.0, 1e2, 1e4, 1e6):
        softness = (1 - HIGHEST_IMPEDANCE) / hardening
        print(f"{softness:<14.0e}   {largest_difference(mechanism, hardening):.1e}")


if __name__ == "__main__":
    main()
