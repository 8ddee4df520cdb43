"""Play setpoints in Reachy Mini's own MuJoCo model, in an environment with mujoco==3.3.0.

    python reachy_player.py JOB.npz RESULT.npz

It imports nothing of this project. The model is the scene of the package reachy-mini, without
contacts, with physics of 2 ms and a setpoint every 20 ms, as the robot's daemon has them.

The job has `servo` (kp, kv, damping, friction, armature, force limit), `ball` (share of the ball
joints' damping and friction as shipped), and rows of setpoints (n, 6) in rad; the first one is held
for 3 s before. It may have another `step` and `period` in s. The result has the head's rotation
(n, 3, 3) and position (n, 3) in m at the end of each row, and the cranks' angles (n, 6).

With crank angles `wanted` (n, 6) at the ends of the rows, their integrated errors are added to the
setpoints, with the `gain` in 1/s. A measured angle is known `late` periods after it was taken.
"""

import sys
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

SCENE = "descriptions/reachy_mini/mjcf/scenes/empty.xml"
STEP, PERIOD, SETTLE = 0.002, 0.02, 3.0
BALL = {"damping": 0.15, "friction": 0.1, "armature": 0.001}
"""Of each axis of the ball joints, as shipped."""


def model_of(servo, ball):
    """Return the model with these servos; `ball` is the share of the ball joints' friction."""
    package = Path(find_spec("reachy_mini").submodule_search_locations[0])
    model = mujoco.MjModel.from_xml_path(str(package / SCENE))
    model.geom_contype[:] = model.geom_conaffinity[:] = 0
    kp, kv, damping, friction, armature, force = servo
    for actuator in range(model.nu):
        dof = model.jnt_dofadr[model.actuator_trnid[actuator, 0]]
        model.actuator_gainprm[actuator, 0] = kp
        model.actuator_biasprm[actuator, 1:3] = -kp, -kv
        model.actuator_forcerange[actuator] = -force, force
        model.dof_damping[dof], model.dof_frictionloss[dof] = damping, friction
        model.dof_armature[dof] = armature
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_BALL):
        dofs = slice(model.jnt_dofadr[joint], model.jnt_dofadr[joint] + 3)
        model.dof_damping[dofs] = ball * BALL["damping"]
        model.dof_frictionloss[dofs] = ball * BALL["friction"]
        model.dof_armature[dofs] = max(ball, 1e-3) * BALL["armature"]
    return model


def play(servo, ball, setpoints, step=STEP, period=PERIOD, wanted=None, gain=0.0, late=0):
    """Return rotations, positions and crank angles after each row of setpoints."""
    model = model_of(servo, ball)
    model.opt.timestep = step
    data = mujoco.MjData(model)
    names = [f"stewart_{leg}" for leg in range(1, 7)]
    motors = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name) for name in names]
    cranks = [model.jnt_qposadr[model.actuator_trnid[motor, 0]] for motor in motors]
    head = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "head")

    def advance(row, duration):
        data.ctrl[motors] = row
        for _ in range(round(duration / step)):
            mujoco.mj_step(model, data)

    advance(setpoints[0], SETTLE)
    found, correction = ([], [], []), np.zeros(len(motors))
    for k, row in enumerate(setpoints[1:]):
        if wanted is not None and k > late:
            correction += gain * period * (wanted[k - 1 - late] - found[2][k - 1 - late])
        advance(row + correction, period)
        now = data.site_xmat[head].reshape(3, 3), data.site_xpos[head], data.qpos[cranks]
        for values, value in zip(found, now, strict=True):
            values.append(value.copy())
    return [np.array(values) for values in found]


if __name__ == "__main__":
    job = np.load(sys.argv[1])
    more = {name: job[name] for name in ("step", "period", "wanted", "gain", "late") if name in job}
    rotations, positions, angles = play(job["servo"], float(job["ball"]), job["setpoints"], **more)
    np.savez(sys.argv[2], rotations=rotations, positions=positions, cranks=angles)
