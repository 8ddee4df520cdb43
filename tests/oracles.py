"""`PartitionedTree`: the dynamics of a mechanism by Drake's tree algorithms, closed generically.

The machine cut open at its spherical joints is a tree, which Drake knows how to treat: base - crank
- rod, six times, and the floating plate, with velocities v (24,). Closing the loops demands that
every rod end moves with its plate joint,

    Phi(q) v = 0,    Phi v_dot + b(q, v) = 0,

b the acceleration bias of the rod end seen from the joint. Coordinate partitioning (Wehage & Haug,
1982) takes the plate's velocities nu (6,) as independent and solves for the legs' (18,), with
Phi = [Phi_l, Phi_p]:

    v = Gamma nu,   Gamma = [-Phi_l^-1 Phi_p; 1],   Gamma_dot nu = [-Phi_l^-1 b; 0].

Reactions at the cut joints do no work on Gamma's columns, hence

    M_r nu_dot + h_r = Gamma' S torque,   M_r = Gamma' M Gamma,
    h_r = Gamma' (M Gamma_dot nu + C v - tau_applied).

Nothing of the closed-form equations is used: only the SDFormat file is common to both.
"""

import re
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RollPitchYaw
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    JacobianWrtVariable,
    MultibodyForces,
    RpyFloatingJoint,
    SpatialInertia,
    UnitInertia,
)
from scipy.integrate import solve_ivp

from stewart_drake.dynamics.stewart import plant_parameters
from stewart_drake.law.riccati import prediction_matrix, reduced_gain
from stewart_drake.mechanism.clearance import LINK_PAIRS, link_radii
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError, dot, leg_geometry, legs_along
from stewart_drake.mechanism.sdformat import to_sdformat
from stewart_drake.scenario.signals import (
    ANGLES,
    BIAS,
    COULOMB,
    COULOMB_SPEED,
    DAMPING,
    LEGS,
    PAYLOAD,
    PAYLOAD_POSITION,
    POSITION,
    WRENCH,
)
from stewart_drake.types import Array

NO_PARAMETERS = plant_parameters()
CLOSURE_TOLERANCE = 1e-14
"""Largest gap in m between rod end and plate joint at which Newton's method stops."""
ORIGIN = np.zeros((3, 1))


class PartitionedTree:
    """Reference dynamics in pose coordinates; the methods mirror `StewartDynamics`.

    Args:
        mechanism: the machine.
        gravity: whether Drake's default gravity acts.
    """

    def __init__(self, mechanism: Mechanism, gravity: bool = True) -> None:
        ball = re.compile(r"<drake:ball_constraint>.*?</drake:ball_constraint>", re.DOTALL)
        plant = MultibodyPlant(0.0)
        Parser(plant).AddModelsFromString(ball.sub("", to_sdformat(mechanism)), "sdf")
        self._plate_body = plant.GetBodyByName("plate")
        plate = self._plate_body.body_frame()
        self._floating = plant.AddJoint(RpyFloatingJoint("plate", plant.world_frame(), plate))
        massless = SpatialInertia(0.0, np.zeros(3), UnitInertia(0, 0, 0))
        self._payload = plant.AddRigidBody(
            "payload", plant.GetModelInstanceByName(mechanism.name), massless
        )
        plant.WeldFrames(plate, self._payload.body_frame())
        if not gravity:
            plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        plant.Finalize()
        self.plant, self.context = plant, plant.CreateDefaultContext()
        self._forces = MultibodyForces(plant)
        self._actuation = plant.MakeActuationMatrix()
        self._cranks = [plant.GetJointByName(f"motor_{leg}") for leg in LEGS]
        self._pairs = [
            (plant.GetFrameByName(f"rod_end_{leg}"), plant.GetFrameByName(f"plate_joint_{leg}"))
            for leg in LEGS
        ]
        start = self._floating.velocity_start()
        self._plate = np.arange(start, start + 6)
        self._legs = np.array([self._leg_indices(leg) for leg in LEGS])
        assert plant.num_constraints() == 0
        self._home, self._closed_at = mechanism.home, np.full(6, np.nan)
        _, self._phi = self._newton(np.zeros(plant.num_positions()), mechanism.home)
        self._branches = np.sign(np.linalg.det(self._leg_blocks(self._phi)))

    def _leg_indices(self, leg: int) -> list[int]:
        """Return the indices of crank and universal joint, in v and in q, where q_dot = v."""
        crank = self.plant.GetJointByName(f"motor_{leg}")
        universal = self.plant.GetJointByName(f"universal_{leg}")
        assert all(j.position_start() == j.velocity_start() for j in (crank, universal))
        first = universal.velocity_start()
        return [crank.velocity_start(), first, first + 1]

    # Positions and velocities that close the loops.

    def _closure(self) -> tuple[Array, Array]:
        """Rod ends seen from their plate joints (6, 3), zero when closed, and Phi (6, 3, 24)."""
        gaps, phi = np.empty((6, 3)), np.empty((6, 3, 24))
        for leg, (end, joint) in enumerate(self._pairs):
            gaps[leg] = self.plant.CalcPointsPositions(self.context, end, ORIGIN, joint)[:, 0]
            phi[leg] = self.plant.CalcJacobianTranslationalVelocity(
                self.context, JacobianWrtVariable.kV, end, ORIGIN, joint, joint
            )
        return gaps, phi

    def _leg_blocks(self, phi: Array) -> Array:
        """Phi_l (6, 3, 3): a leg's gap depends on no other leg."""
        return np.array([phi[i][:, self._legs[i]] for i in range(6)])

    def _newton(self, q: Array, pose: Array) -> tuple[Array | None, Array]:
        """Positions with all loops closed at a pose, legs starting from q; None without success."""
        q = q.copy()
        self.plant.SetPositions(self.context, q)
        self._floating.set_angles(self.context, pose[ANGLES])
        self._floating.SetTranslation(self.context, pose[POSITION])
        q[self._plate] = self.plant.GetPositions(self.context)[self._plate]
        last = np.inf
        for _ in range(12):
            gaps, phi = self._closure()
            gap = np.abs(gaps).max()
            # A second step from within ten tolerances only moves the rounding errors about.
            if gap < CLOSURE_TOLERANCE or last < 10 * CLOSURE_TOLERANCE:
                return q, phi
            last = gap
            q[self._legs] -= np.linalg.solve(self._leg_blocks(phi), gaps[..., None])[..., 0]
            self.plant.SetPositions(self.context, q)
        return None, phi

    def _close(self, pose: Array) -> Array:
        """Set positions with all loops closed; Phi (6, 3, 24) there.

        The legs' angles are followed from home, where they are zero, in as few steps along the
        straight line as keep every leg in its branch: det(Phi_l) changes sign in the other one.
        """
        if np.array_equal(pose, self._closed_at):
            return self._phi
        self._closed_at = np.full(6, np.nan)
        q = np.zeros(self.plant.num_positions())
        done, step = 0.0, 1.0
        while done < 1.0:
            target = min(1.0, done + step)
            closed, phi = self._newton(q, self._home + target * (pose - self._home))
            signs = np.sign(np.linalg.det(self._leg_blocks(phi)))
            if closed is not None and np.array_equal(signs, self._branches):
                q, done = closed, target
            else:
                step /= 2
            if step < 1e-3:
                raise ValueError(f"loops cannot be closed on the way from home to {pose}")
        self._closed_at, self._phi = pose.copy(), phi
        return phi

    def _reduce(self, pose: Array, rates: Array, parameters: Array) -> tuple[Array, Array, Array]:
        """M_r (6, 6), h_r (6,) and Gamma' S (6, 6) at a state."""
        plant, context = self.plant, self.context
        phi = self._close(pose)
        phi_l = self._leg_blocks(phi)
        gamma = np.zeros((24, 6))
        gamma[self._plate] = np.eye(6)
        gamma[self._legs] = -np.linalg.solve(phi_l, phi[:, :, self._plate])
        rpy = RollPitchYaw(pose[ANGLES])
        w_WP = rpy.CalcAngularVelocityInParentFromRpyDt(rates[ANGLES])
        plant.SetVelocities(context, gamma @ np.concatenate([w_WP, rates[POSITION]]))
        bias = np.array(
            [
                plant.CalcBiasTranslationalAcceleration(
                    context, JacobianWrtVariable.kV, end, ORIGIN, joint, joint
                )[:, 0]
                for end, joint in self._pairs
            ]
        )
        gamma_dot_nu = np.zeros(24)
        gamma_dot_nu[self._legs] = -np.linalg.solve(phi_l, bias[..., None])[..., 0]

        place, point = parameters[PAYLOAD_POSITION], UnitInertia.PointMass
        self._payload.SetSpatialInertiaInBodyFrame(
            context, SpatialInertia(parameters[PAYLOAD], place, point(place))
        )
        for crank in self._cranks:
            crank.SetDamping(context, parameters[DAMPING])
        plant.CalcForceElementsContribution(context, self._forces)  # gravity and joint damping
        self._plate_body.AddInForce(
            context,
            np.zeros(3),
            SpatialForce(parameters[WRENCH]),
            plant.world_frame(),
            self._forces,
        )
        M = plant.CalcMassMatrix(context)
        h = plant.CalcInverseDynamics(context, gamma_dot_nu, self._forces)
        return gamma.T @ M @ gamma, gamma.T @ h, gamma.T @ self._actuation

    def _passive(self, parameters: Array) -> Array:
        """Return the passive torque (6,) at the shafts, at the state that was reduced last."""
        rates = np.array([crank.get_angular_rate(self.context) for crank in self._cranks])
        friction = parameters[COULOMB] * np.tanh(rates / parameters[COULOMB_SPEED])
        return parameters[BIAS] - friction

    # The answers, in pose coordinates.

    def accelerations(
        self, pose: Array, rates: Array, torque: Array, parameters: Array = NO_PARAMETERS
    ) -> Array:
        """Second derivative (6,) of the pose."""
        M, h, B = self._reduce(pose, rates, parameters)
        nu_dot = np.linalg.solve(M, B @ (torque + self._passive(parameters)) - h)
        rpy_dd = RollPitchYaw(pose[ANGLES]).CalcRpyDDtFromRpyDtAndAngularAccelInParent(
            rates[ANGLES], nu_dot[:3]
        )
        return np.concatenate([rpy_dd, nu_dot[3:]])

    def inverse_dynamics(
        self, pose: Array, rates: Array, accelerations: Array, parameters: Array = NO_PARAMETERS
    ) -> Array:
        """Motor torques (6,) in N m that give these accelerations (6,)."""
        M, h, B = self._reduce(pose, rates, parameters)
        rpy = RollPitchYaw(pose[ANGLES])
        # The second derivatives are affine in the angular acceleration, with the map of the rates.
        rest = rpy.CalcRpyDDtFromRpyDtAndAngularAccelInParent(rates[ANGLES], np.zeros(3))
        w_dot = rpy.CalcAngularVelocityInParentFromRpyDt(accelerations[ANGLES] - rest)
        nu_dot = np.concatenate([w_dot, accelerations[POSITION]])
        return np.linalg.solve(B, M @ nu_dot + h) - self._passive(parameters)

    def equilibrium_torque(self, pose: Array, parameters: Array = NO_PARAMETERS) -> Array:
        """Motor torques (6,) in N m that hold the plate still."""
        return self.inverse_dynamics(pose, np.zeros(6), np.zeros(6), parameters)

    def energy(self, pose: Array, rates: Array, parameters: Array = NO_PARAMETERS) -> float:
        """Kinetic plus potential energy in J; the zero of the latter is Drake's."""
        self._reduce(pose, rates, parameters)
        return float(
            self.plant.CalcKineticEnergy(self.context)
            + self.plant.CalcPotentialEnergy(self.context)
        )


def off_dead_centre(mechanism: Mechanism, pose: Array) -> float:
    """Least sine of a crank's angle off the plane of motor axis and plate joint; < 0 beyond."""
    try:
        legs = leg_geometry(mechanism, pose)
    except UnreachablePoseError:
        return -1.0
    p_SQ_W = pose[3:] + legs.p_PQ_W - mechanism.p_WS
    across, along = (np.einsum("li,li->l", p_SQ_W, e) for e in (legs.tangent, legs.crank))
    return float((np.abs(across) / np.hypot(across, along)).min())


def augmented_gain(model, Q, R):
    """Return K_aug (m, n + m L) = K [A^mu, A^(mu-1) B, ..., B]."""
    return reduced_gain(model, Q, R) @ prediction_matrix(model)


def relative(value: Array, expected: Array) -> float:
    """Return the norm of the deviation over the norm of the expected value."""
    return float(np.linalg.norm(value - expected) / np.linalg.norm(expected))


def field(accelerations: Callable[..., Array], *inputs: Array) -> Callable[[Array], Array]:
    """x = [pose; rates] -> x_dot (12,) under inputs, which are a torque and maybe parameters."""
    return lambda x: np.concatenate([x[6:], accelerations(x[:6], x[6:], *inputs)])


def size(mechanism: Mechanism) -> Array:
    """Scale (6,) of pose coordinates: 1 for angles, for lengths that of the plate's height."""
    return np.repeat([1.0, mechanism.home[5] / 0.38], 3)


def integrate(derivative: Callable[[Array], Array], start: Array, duration: float) -> Array:
    """States (n, ...) on the way from `start`, integrated to nearly rounding."""
    tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    return solve_ivp(lambda t, x: derivative(x), (0, duration), start, **tight).y.T


def central_difference(
    function: Callable[[Array], Array], point: ArrayLike, step: float = 1e-4
) -> Array:
    """Jacobian of `function` at `point` by the five-point formula, whose error is O(step^4)."""
    point = np.asarray(point, dtype=np.float64)
    columns = []
    for direction in step * np.eye(len(point)):
        near = function(point + direction) - function(point - direction)
        far = function(point + 2 * direction) - function(point - 2 * direction)
        columns.append((8 * near - far) / (12 * step))
    return np.column_stack(columns)


def central_difference_linearization(
    tree: PartitionedTree,
    state: Array,
    torque: Array,
    parameters: Array = NO_PARAMETERS,
    step: float = 1e-4,
) -> tuple[Array, Array]:
    """Return A (12, 12) and B (12, 6) of d state / dt."""
    a = tree.accelerations
    return (
        central_difference(field(a, torque, parameters), state, step),
        central_difference(lambda u: field(a, u, parameters)(state), torque, step),
    )


def center_lines(mechanism, poses, legs):
    """Return the lines of cranks, then rods, at poses (n, 6) whose legs are `legs`.

    These are the starts in W, m, and the vectors from there to the ends, (n, 12, 3).
    """
    cranks = mechanism.crank_lengths[:, None] * legs.crank
    rods = mechanism.rod_lengths[:, None] * legs.rod
    joints = poses[:, None, POSITION] + legs.p_PQ_W
    shafts = np.broadcast_to(mechanism.p_WS, joints.shape)
    return np.hstack([shafts, joints - rods]), np.hstack([cranks, rods])


def segment_distances(p, u, q, v):
    """Return distances (...) of the segments p + s u and q + t v, 0 <= s, t <= 1; arrays (..., 3).

    |r + s u - t v|^2, r = p - q, is convex in (s, t). Over all s and t it is least where
    s (u.u v.v - (u.v)^2) = (u.v)(v.r) - (u.r)(v.v). That s is cut to the segment, then the best t
    for it, and then the best s for that t: if one of the three was cut, the minimum over the
    square lies on its border, and these steps end there. Parallel lines have many minima, and s = 0
    leads to one. Lengths are not zero.
    """
    r = p - q
    uu, vv, uv = dot(u, u), dot(v, v), dot(u, v)
    ur, vr = dot(u, r), dot(v, r)
    area = uu * vv - uv**2
    skew = area > 1e-14 * uu * vv
    s = np.clip(np.where(skew, (uv * vr - ur * vv) / np.where(skew, area, 1.0), 0.0), 0.0, 1.0)
    t = np.clip((uv * s + vr) / vv, 0.0, 1.0)
    s = np.clip((uv * t - ur) / uu, 0.0, 1.0)
    return np.sqrt(dot(d := r + s[..., None] * u - t[..., None] * v, d))


def capsule_clearances(mechanism, poses):
    """Return `mechanism.clearance.clearances` (n, 60) by these functions."""
    first, second = np.transpose(LINK_PAIRS)
    start, along = center_lines(mechanism, poses, legs_along(mechanism, poses))
    lines = start[:, first], along[:, first], start[:, second], along[:, second]
    radii = link_radii(mechanism)
    return segment_distances(*lines) - radii[first] - radii[second]
