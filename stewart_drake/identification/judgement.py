"""Accuracy of an identification: directions that a log does not show, and poses."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics.workspace import border, margin
from stewart_drake.identification.model import MachineModel, Numbers
from stewart_drake.identification.unknowns import (
    GEOMETRY,
    NAMES,
    NUM_UNKNOWNS,
    OFFSETS,
    Unknowns,
)
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import ANGLES, LEGS, NUM_LEGS, POSITION
from stewart_drake.types import Array

UNSEEN: Final = 0.8  # share of its prior variance above which a direction counts as unseen
_ALIKE: Final = 0.9  # share of a named direction inside the unseen ones, to be one of them
_POSES: Final = 200
_ROOM: Final = 0.3  # share of the margin in the middle at which the workspace counts as ended
_GROUPS: Final = {
    "torque biases": "torque_bias_",
    "the payload's mass": "payload_mass",
    "the payload's place": "payload_position_",
    "viscous friction": "joint_damping",
    "Coulomb friction": "coulomb_friction",
    "crank lengths": "crank_length_",
    "rod lengths": "rod_length_",
    "plate joints": "plate_joint_",
    "shafts": "shaft_",
    "encoder offsets": "offset_",
    "the delay": "delay",
}


class PoseUncertainty(NamedTuple):
    """Standard deviations of a pose that is computed from crank angles: median and worst.

    The last two are those of the change from the pose in the middle of the workspace, which does
    not depend on the places of base and plate.
    """

    angle: tuple[float, float]  # rad, the largest of the three
    position: tuple[float, float]  # m, likewise
    angle_change: tuple[float, float]
    position_change: tuple[float, float]

    @property
    def summary(self) -> dict[str, dict[str, float]]:
        units = ("angle_rad", "position_m", "angle_from_middle_rad", "position_from_middle_m")
        return {
            name: {"median": pair[0], "worst": pair[1]}
            for name, pair in zip(units, self, strict=True)
        }


def named_directions(mechanism: Mechanism) -> dict[str, Array]:
    """Return directions (NUM_UNKNOWNS,) in which whole machines differ, by name."""
    joints, found = mechanism.p_PQ, {}

    def of_legs(columns: slice | int, values: Array) -> Array:
        legs = np.zeros((NUM_LEGS, 8))
        legs[:, columns] = values
        direction = np.zeros(NUM_UNKNOWNS)
        direction[GEOMETRY] = legs.ravel()
        return direction

    for axis, unit in zip("xyz", np.eye(3), strict=True):
        found[f"where the base stands along {axis}"] = of_legs(slice(5, 8), unit)
        found[f"where the plate's centre of mass lies along its {axis}"] = of_legs(
            slice(2, 5), unit
        )
        turned = np.cross(unit, joints)
        found[f"how the plate's frame is turned about its {axis}"] = of_legs(slice(2, 5), turned)
    lengths = [mechanism.crank_lengths[:, None], mechanism.rod_lengths[:, None]]
    whole = np.hstack([*lengths, mechanism.p_PQ, mechanism.p_WS])
    found["the scale of all lengths"] = of_legs(slice(0, 8), whole)
    all_offsets = np.zeros(NUM_UNKNOWNS)
    all_offsets[OFFSETS] = 1.0
    found["the zero of all encoders together"] = all_offsets
    return found


def unseen(unknowns: Unknowns, covariance: Array) -> tuple[int, list[str]]:
    """Return number and names of the directions that the log does not show.

    In units of the prior, the covariance of the free unknowns after the log has eigenvalues from 0
    (found by the log) to 1 (as uncertain as before). The eigenvectors above UNSEEN span a space.
    Whole-machine directions in it are named, and the rest by its unknowns.
    """
    free, std = unknowns.free, unknowns.std[unknowns.free]
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    space = vectors[:, values > UNSEEN]
    count, names = space.shape[1], list[str]()
    singles = {
        NAMES[k].replace("_", " "): np.eye(NUM_UNKNOWNS)[k]
        for k in free
        if not GEOMETRY.start <= k < GEOMETRY.stop
    }
    for name, direction in {**named_directions(unknowns.mechanism), **singles}.items():
        d = direction[free] / std
        inside = space.T @ d
        if np.linalg.norm(d) == 0 or space.shape[1] == 0:
            continue
        if np.sum(inside**2) > _ALIKE * (d @ d):
            names.append(name)
            # The rest of the space is perpendicular to the named directions.
            inside = inside / np.linalg.norm(inside)
            space = space @ np.linalg.svd(inside[:, None])[0][:, 1:]
    if space.shape[1]:
        names.append(f"{space.shape[1]} mixtures of {_mixture(free, space)}")
    return count, names


def _mixture(free: NDArray[np.intp], space: Array) -> str:
    """Return the unknowns in the directions of a space (k, n), the largest shares first."""
    weights = np.mean(space**2, axis=1)
    shares = {
        group: sum(w for k, w in zip(free, weights, strict=True) if NAMES[k].startswith(start))
        for group, start in _GROUPS.items()
    }
    ordered = sorted(shares.items(), key=lambda item: -item[1])
    return ", ".join(f"{group} ({100 * share:.0f} %)" for group, share in ordered if share > 0.05)


def workspace_poses(mechanism: Mechanism, middle: Array) -> Array:
    """Return poses (n, 6) all over the workspace around a pose, the first of them.

    They lie on rays in random directions, with at least a share of the margin in the middle.
    """
    rng, size = np.random.default_rng(0), np.repeat([1.0, mechanism.crank_lengths.mean()], 3)
    least, poses = _ROOM * margin(mechanism, middle), [middle]
    for ray in size * rng.standard_normal((_POSES - 1, 6)):

        def is_inside(s: float, ray: Array = ray) -> bool:
            return margin(mechanism, middle + s * ray) > least

        inside, _ = border(is_inside, 0.0, 1.0, 2**-12)
        # Evenly in the volume of the six-dimensional ball that the ray is a radius of.
        poses.append(middle + inside * rng.uniform() ** (1 / 6) * ray)
    return np.array(poses)


def pose_uncertainty(
    unknowns: Unknowns, values: Array, covariance: Array, middle: Array
) -> PoseUncertainty | None:
    """Return how well crank angles determine poses, None if the machine does not reach `middle`.

    alpha = h(pose; geometry) + offset stays as it is, so that
    d pose = -J^-1 (dh/dgeometry d geometry + d offset),   J = dh/dpose.
    """
    of_angles = np.r_[GEOMETRY, OFFSETS]
    P = unknowns.whole(covariance)[np.ix_(of_angles, of_angles)]
    found = unknowns.machine(values)
    if not margin(found, middle) > 0:
        return None
    slopes = pose_slopes(unknowns, unknowns.numbers(values), workspace_poses(found, middle))
    slopes = slopes[np.isfinite(slopes).all(axis=(1, 2))]  # a ray may leave and come back
    return PoseUncertainty(*_spread(slopes, P), *_spread(slopes - slopes[0], P))


def pose_slopes(unknowns: Unknowns, numbers: Numbers, poses: Array) -> Array:
    """Return d pose / d[geometry; offsets] (n, 6, 54) at poses (n, 6) for fixed crank angles."""
    model = MachineModel(unknowns.mechanism, 0.0)
    _, J, by_geometry = model.crank_angles(poses, numbers)
    offsets = np.broadcast_to(np.eye(len(LEGS)), (len(poses), NUM_LEGS, NUM_LEGS))
    return -np.linalg.solve(J, np.concatenate([by_geometry, offsets], axis=2))


def _spread(slopes: Array, P: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return median and worst over the poses, of angles and of positions."""
    std = np.sqrt(np.maximum(np.einsum("nij,jk,nik->ni", slopes, P, slopes), 0.0))
    largest = (std[:, part].max(axis=1) for part in (ANGLES, POSITION))
    angle, position = ((float(np.median(one)), float(one.max())) for one in largest)
    return angle, position
