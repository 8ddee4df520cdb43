"""The paper's torque map, equations (6)-(19): plate accelerations per motor torque, massless legs.

Each rod pushes the plate with a force F_i along itself, so that (11)-(14)

    [M; F] = tau_1 [F_1 ... F_6]',   tau_1 = [p_PQ_W x e_rod; e_rod]  column by column,

and (15)-(16) relate F_i to the motor torque, F = tau_2 T. A massless leg does no net work:
T alpha_dot = F v_Q.e_rod = F u alpha_dot e_rod.tangent, so tau_2 = 1 / (u e_rod.tangent). The paper
prints e_rod.e_N / u instead; with e_N the crank's tangent that is kept as `printed`.

`virtual_work` also returns what pose coordinates need: d2(angles)/dt2 = E^-1 (R I R')^-1 M at
rest. `printed` takes (17)-(18) at their word: d2(angles)/dt2 = I^-1 M.
"""

from typing import Literal

import numpy as np

from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import angle_rate_map, leg_geometry, levers, rotation
from stewart_drake.scenario.signals import ANGLES
from stewart_drake.types import Array

TorqueMap = Literal["virtual_work", "printed"]


def torque_map(mechanism: Mechanism, pose: Array, form: TorqueMap = "virtual_work") -> Array:
    """tau_tot (6, 6), equation (19): d accelerations / d torque at rest, in SI units.

    Raises:
        UnreachablePoseError: the pose (6,) is out of reach.
        SingularPoseError: `virtual_work` at the dead centre of a leg.
    """
    legs = leg_geometry(mechanism, pose)
    tau_1 = np.vstack([np.cross(legs.p_PQ_W, legs.rod).T, legs.rod.T])
    if form == "printed":
        tau_2 = legs.transmission / mechanism.crank_lengths
        angular = np.diag(1 / mechanism.plate.inertia)
    else:
        tau_2 = 1 / levers(mechanism, legs)
        R_WP = rotation(pose[ANGLES])
        I_W = R_WP @ np.diag(mechanism.plate.inertia) @ R_WP.T
        angular = np.asarray(np.linalg.inv(I_W @ angle_rate_map(pose[ANGLES])), dtype=np.float64)
    tau = tau_1 * tau_2
    return np.vstack([angular @ tau[:3], tau[3:] / mechanism.plate.mass])
