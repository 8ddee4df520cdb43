"""Make models/reachy_mini.yaml from the robot's own files.

    pip download --no-deps reachy-mini==1.13.0 && unzip -d robot reachy_mini-1.13.0-*.whl
    python analysis/reachy_machine.py robot/reachy_mini

Lengths, shafts and joints come from assets/kinematics_data.json; masses, inertias and the ranges of
the cranks from the MJCF. The crank's inertia is the link's own: a servo's armature belongs to the
scenario. The package is licensed under Apache-2.0 by Pollen Robotics, its hardware design files
under Creative Commons BY-NC-SA. Only numbers are taken; no file is copied.
"""

import argparse
import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from stewart_drake.files.yamlio import yaml_text

TORQUE_LIMIT = 0.8
"""N m, `forcerange` of the class xc330m288t, the robot's servo."""
ROD_WITH_PLATE_JOINT = 6
"""Rod that the MJCF joins to the head by a ball joint; the others end in constraints."""


class Inertia:
    """Mass, centre and moments about the centre of a rigid body, summed over its parts.

    Attributes:
        mass: kg.
        center: (3,) m.
        moments: (3, 3) kg m^2.
    """

    def __init__(self) -> None:
        self.mass, self.center, self.moments = 0.0, np.zeros(3), np.zeros((3, 3))

    def add(self, mass: float, center: np.ndarray, moments: np.ndarray) -> None:
        """Add a part, with the parallel axis theorem."""
        total = self.mass + mass
        apart = center - self.center
        lever = apart @ apart * np.eye(3) - np.outer(apart, apart)
        self.moments = self.moments + moments + self.mass * mass / total * lever
        self.center = (self.mass * self.center + mass * center) / total
        self.mass = total


def numbers(element: ElementTree.Element, name: str, default: str) -> np.ndarray:
    """Return the numbers of an attribute."""
    return np.array(element.get(name, default).split(), dtype=np.float64)


def transform(element: ElementTree.Element) -> np.ndarray:
    """Return the pose (4, 4) of a body or site in its parent."""
    w, x, y, z = (q := numbers(element, "quat", "1 0 0 0")) / np.linalg.norm(q)
    found = np.eye(4)
    found[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    found[:3, 3] = numbers(element, "pos", "0 0 0")
    return found


def own_inertia(body: ElementTree.Element) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Return mass, centre and moments of a body without its children, in its frame."""
    inertial = body.find("inertial")
    if inertial is None:
        return None
    xx, yy, zz, xy, xz, yz = numbers(inertial, "fullinertia", "")
    moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return float(inertial.get("mass", "")), numbers(inertial, "pos", "0 0 0"), moments


def add_all(whole: Inertia, body: ElementTree.Element, frame: np.ndarray) -> None:
    """Add a body and its children, at their joints' zero, in a frame (4, 4)."""
    if (own := own_inertia(body)) is not None:
        mass, center, moments = own
        R = frame[:3, :3]
        whole.add(mass, R @ center + frame[:3, 3], R @ moments @ R.T)
    for child in body.findall("body"):
        add_all(whole, child, frame @ transform(child))


def machine(package: Path) -> dict[str, object]:
    """Return the content of the mechanism's file from the robot's package."""
    data = json.loads((package / "assets/kinematics_data.json").read_text())
    mjcf = package / "descriptions/reachy_mini/mjcf/reachy_mini.xml"
    bodies = {body.get("name"): body for body in ElementTree.parse(mjcf).iter("body")}
    head_body = bodies["xl_330"]
    site = next(site for site in head_body.findall("site") if site.get("name") == "head")
    head = Inertia()
    add_all(head, head_body, np.linalg.inv(transform(site)))
    base = Inertia()
    for name in ("body_foot_3dprint", "body_down_3dprint"):
        own = own_inertia(bodies[name])
        assert own is not None
        base.add(*own)
    crank, rod = (own_inertia(bodies[name]) for name in ("dc15_a01_horn_dummy", "stewart_link_rod"))
    assert crank is not None and rod is not None
    crank_length, rod_length = data["motor_arm_length"], data["rod_length"]
    legs = []
    for motor in data["motors"]:
        to_motor = np.array(motor["T_motor_world"])
        legs.append(
            {
                "shaft": np.linalg.inv(to_motor)[:3, 3].tolist(),
                "motor_axis": to_motor[2, :3].tolist(),
                "crank_zero": to_motor[0, :3].tolist(),
                "plate_joint": (np.array(motor["branch_position"]) - head.center).tolist(),
                "branch": 1 if motor["solution"] else -1,
            }
        )
    return {
        "name": "reachy_mini",
        "home": [0.0, 0.0, 0.0, *(head.center + [0.0, 0.0, data["head_z_offset"]]).tolist()],
        "legs": legs,
        "base": {"mass": base.mass, "inertia": np.diag(base.moments).tolist()},
        "plate": {"mass": head.mass, "inertia": np.diag(head.moments).tolist()},
        "crank": {
            "length": crank_length,
            "center": float(crank[1][0] / crank_length),
            "mass": crank[0],
            "inertia": np.diag(crank[2]).tolist(),
        },
        "rod": {
            "length": rod_length,
            "center": float(abs(rod[1][0]) / rod_length),
            "mass": rod[0],
            "inertia": np.diag(rod[2]).tolist(),
        },
        "motor": {"effort_limit": TORQUE_LIMIT},
        "ball_joints": {"plate": [ROD_WITH_PLATE_JOINT]},
    }


def crank_ranges(package: Path) -> list[list[float]]:
    """Return the ranges (6, 2) of the cranks in rad."""
    mjcf = package / "descriptions/reachy_mini/mjcf/reachy_mini.xml"
    joints = {joint.get("name"): joint for joint in ElementTree.parse(mjcf).iter("joint")}
    return [numbers(joints[f"stewart_{leg}"], "range", "").tolist() for leg in range(1, 7)]


HEAD = """# Reachy Mini of Pollen Robotics: the head, antennas up, on six XC330 servos. Made by
# analysis/reachy_machine.py from files of the package reachy-mini 1.13.0 (Apache-2.0). Crank angles
# have the robot's signs and zeros. Not in it: the body's yaw, and products of inertia. The ball
# joints with friction are those of the robot's MJCF.
"""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("package", type=Path, help="folder reachy_mini of the unzipped wheel")
    package = parser.parse_args().package
    target = Path(__file__).parents[1] / "models/reachy_mini.yaml"
    target.write_text(HEAD + yaml_text(machine(package)))
    print(f"wrote {target}")
    print("actuator.angle_range:", [[round(x, 6) for x in one] for one in crank_ranges(package)])
