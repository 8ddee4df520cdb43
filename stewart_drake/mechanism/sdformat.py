"""SDFormat of a `Mechanism` for Drake: links, joints, shapes, a ball constraint per leg."""

from collections.abc import Iterable, Mapping
from xml.etree import ElementTree as ET

import numpy as np

from stewart_drake.mechanism.assembly import Assembly, assemble
from stewart_drake.mechanism.clearance import proportions
from stewart_drake.mechanism.geometry import Body, Mechanism
from stewart_drake.scenario.signals import LEGS
from stewart_drake.types import Array

BASE_COLOR = (0.60, 0.63, 0.67, 1.0)
MOTOR_COLOR = (0.16, 0.18, 0.21, 1.0)
CRANK_COLOR = (0.90, 0.45, 0.10, 1.0)
ROD_COLOR = (0.52, 0.55, 0.60, 1.0)
JOINT_COLOR = (0.30, 0.32, 0.36, 1.0)
PLATE_COLOR = (0.13, 0.42, 0.70, 1.0)


def to_sdformat(mechanism: Mechanism, *, collision: bool = True, weld: bool = True) -> str:
    """Return the mechanism as an SDFormat 1.9 document, assembled at its home pose.

    Links: `base`, `plate`, `crank_i`, `rod_i`; joints: `base_weld`, `motor_i` (revolute, actuated),
    `universal_i`; a frame at every joint: `shaft_i`, `tip_i`, `rod_end_i`, `plate_joint_i`. Legs i
    count from 1.
    The loops are closed by `drake:ball_constraint` between `rod_i` and `plate`.

    Discs, motors, posts, crank arms and rod tubes collide with other objects in the scene. The
    collision filter group `machine` excludes collisions within the machine, whose joints overlap.
    Without `collision` shapes are only drawn. Without `weld` the base is free, else `base_weld`
    fixes it in the world.
    """
    home = assemble(mechanism, mechanism.home)
    sdf = ET.Element("sdf", {"version": "1.9", "xmlns:drake": "http://drake.mit.edu"})
    model = _add(sdf, "model", name=mechanism.name)
    _base(model, mechanism, weld)
    _plate(model, mechanism, home)
    for leg in LEGS:
        _leg(model, mechanism, home, leg)
    if collision:
        group = _add(model, "drake:collision_filter_group", name="machine")
        for link in model.iter("link"):
            ET.SubElement(group, "drake:member").text = link.get("name")
        ET.SubElement(group, "drake:ignored_collision_filter_group").text = "machine"
    else:
        for link in model.iter("link"):
            for shape in link.findall("collision"):
                link.remove(shape)
    ET.indent(sdf, " " * 2)
    return '<?xml version="1.0"?>\n' + ET.tostring(sdf, encoding="unicode") + "\n"


def _base(model: ET.Element, mechanism: Mechanism, weld: bool) -> None:
    link = _add(model, "link", name="base")
    if mechanism.base.mass > 0:
        _inertial(link, mechanism.base, np.zeros(3))
    size = proportions(mechanism)
    radius = 1.2 * np.hypot(mechanism.p_WS[:, 0], mechanism.p_WS[:, 1]).max()
    axes = mechanism.R_WS[:, :, 2]
    # The motors sit behind the planes in which their cranks turn, sunk into the disc they stand on.
    centres = mechanism.p_WS - axes * (size.motor_length / 2 + size.crank_thickness)
    tilt = np.hypot(axes[:, 0], axes[:, 1])
    reach = np.abs(axes[:, 2]) * size.motor_length / 2 + tilt * size.motor_radius
    bottom = (centres[:, 2] - reach).min() - 0.2 * size.motor_radius
    top = bottom + 0.6 * size.motor_radius
    disc = _cylinder(radius, top - bottom)
    _solid(link, "disc", _pose([0, 0, (top + bottom) / 2]), disc, BASE_COLOR)
    for leg, p_WS, R_WS, centre in zip(LEGS, mechanism.p_WS, mechanism.R_WS, centres, strict=True):
        motor = _cylinder(size.motor_radius, size.motor_length)
        _solid(link, f"motor_{leg}", _pose(centre, R_WS), motor, MOTOR_COLOR)
        height = centre[2] - top
        post = _cylinder(0.7 * size.motor_radius, height)
        foot = [centre[0], centre[1], top + height / 2]
        _solid(link, f"post_{leg}", _pose(foot), post, BASE_COLOR)
        _frame(model, f"shaft_{leg}", "base", _pose(p_WS, R_WS))
    if weld:
        _joint(model, "base_weld", "fixed", "world", "base")


def _plate(model: ET.Element, mechanism: Mechanism, home: Assembly) -> None:
    link = _add(model, "link", {"pose": _pose(mechanism.home[3:], home.R_WP)}, name="plate")
    _inertial(link, mechanism.plate, np.zeros(3))
    size = proportions(mechanism)
    radius = 1.08 * np.hypot(mechanism.p_PQ[:, 0], mechanism.p_PQ[:, 1]).max()
    disc = _cylinder(radius, size.plate_thickness)
    deck = float(mechanism.p_PQ[:, 2].mean())
    _solid(link, "disc", _pose([0, 0, deck + size.plate_thickness]), disc, PLATE_COLOR)
    # A pointer along x shows the yaw that a disc would hide.
    bar = _shape("box", size=[0.85 * radius, 0.06 * radius, 0.4 * size.plate_thickness])
    above = deck + 1.6 * size.plate_thickness
    _visual(link, "x_axis", _pose([0.425 * radius, 0, above]), bar, CRANK_COLOR)
    tip = _cylinder(0.09 * radius, 0.4 * size.plate_thickness)
    _visual(link, "x_axis_tip", _pose([0.85 * radius, 0, above]), tip, CRANK_COLOR)
    for leg, p_PQ in zip(LEGS, mechanism.p_PQ, strict=True):
        ball = _shape("sphere", radius=[1.6 * size.rod_radius])
        _visual(link, f"joint_{leg}", _pose(p_PQ), ball, JOINT_COLOR)
        _frame(model, f"plate_joint_{leg}", "plate", _pose(p_PQ))


def _leg(model: ET.Element, mechanism: Mechanism, home: Assembly, leg: int) -> None:
    i = leg - 1
    u, length = mechanism.crank_lengths[i], mechanism.rod_lengths[i]
    size = proportions(mechanism)
    place = {"pose": _pose(mechanism.p_WS[i], home.R_WC[i])}
    crank = _add(model, "link", place, name=f"crank_{leg}")
    _inertial(crank, mechanism.crank, np.array([mechanism.crank.center * u, 0, 0]))
    arm = _shape("box", size=[u, size.crank_width, size.crank_thickness])
    _solid(crank, "arm", _pose([u / 2, 0, 0]), arm, CRANK_COLOR)
    hub = _cylinder(1.2 * size.crank_thickness, 1.5 * size.crank_thickness)
    _visual(crank, "hub", _pose([0, 0, 0]), hub, CRANK_COLOR)
    ball = _shape("sphere", radius=[1.6 * size.rod_radius])
    _visual(crank, "tip", _pose([u, 0, 0]), ball, JOINT_COLOR)
    _frame(model, f"tip_{leg}", f"crank_{leg}", _pose([u, 0, 0]))

    rod = _add(model, "link", {"pose": _pose(home.p_WT[i], home.R_WD[i])}, name=f"rod_{leg}")
    _inertial(rod, mechanism.rod, np.array([mechanism.rod.center * length, 0, 0]))
    along_x = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    tube = _cylinder(size.rod_radius, length)
    _solid(rod, "tube", _pose([length / 2, 0, 0], along_x), tube, ROD_COLOR)
    _frame(model, f"rod_end_{leg}", f"rod_{leg}", _pose([length, 0, 0]))

    motor = _joint(model, f"motor_{leg}", "revolute", "base", f"crank_{leg}")
    axis = _add(motor, "axis", {"xyz": "0 0 1"})
    if mechanism.effort_limit is not None:
        _add(axis, "limit", {"effort": f"{mechanism.effort_limit:.17g}"})

    universal = _joint(model, f"universal_{leg}", "universal", f"crank_{leg}", f"rod_{leg}")
    first = _numbers(home.R_WD[i].T @ mechanism.R_WS[i][:, 2])
    for tag, xyz in (("axis", first), ("axis2", "0 1 0")):
        _add(_add(universal, tag, {"xyz": xyz}), "limit", {"effort": "0"})

    ends = {
        "body_A": f"rod_{leg}",
        "body_B": "plate",
        "p_AP": _numbers([length, 0, 0]),
        "p_BQ": _numbers(mechanism.p_PQ[i]),
    }
    parts = {f"drake:ball_constraint_{name}": value for name, value in ends.items()}
    _add(model, "drake:ball_constraint", parts)


def _add(
    parent: ET.Element, tag: str, parts: Mapping[str, str] | None = None, **attributes: str
) -> ET.Element:
    """Add an element whose `parts` are elements with a text each, by tag."""
    element = ET.SubElement(parent, tag, attributes)
    for name, text in (parts or {}).items():
        ET.SubElement(element, name).text = text
    return element


def _numbers(values: Iterable[float]) -> str:
    # Adding 0.0 turns -0 into 0, which platforms disagree about.
    return " ".join(f"{float(value) + 0.0:.15g}" for value in values)


def _pose(p: Iterable[float], R: Array | None = None) -> str:
    if R is None:
        return f"{_numbers(p)} 0 0 0"
    # Roll and pitch are read after undoing the yaw. At a pitch of 90 degrees, that of a vertical
    # crank, yaw is arbitrary, and only so does roll take up what rounding made of it.
    yaw = np.arctan2(R[1, 0], R[0, 0])
    cos, sin = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[2, 0], cos * R[0, 0] + sin * R[1, 0])
    roll = np.arctan2(sin * R[0, 2] - cos * R[1, 2], cos * R[1, 1] - sin * R[0, 1])
    return f"{_numbers(p)} {_numbers([roll, pitch, yaw])}"


def _frame(model: ET.Element, name: str, attached_to: str, pose: str) -> None:
    _add(model, "frame", {"pose": pose}, name=name, attached_to=attached_to)


def _inertial(link: ET.Element, body: Body, com: Array) -> None:
    inertial = _add(link, "inertial", {"pose": _pose(com), "mass": _numbers([body.mass])})
    moments = dict(zip(("ixx", "iyy", "izz"), body.inertia, strict=True))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    _add(inertial, "inertia", {name: _numbers([moments.get(name, 0.0)]) for name in names})


def _joint(model: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    return _add(model, "joint", {"parent": parent, "child": child}, name=name, type=kind)


def _solid(
    link: ET.Element, name: str, pose: str, geometry: ET.Element, color: tuple[float, ...]
) -> None:
    """Add a shape for display and collisions."""
    _visual(link, name, pose, geometry, color)
    collision = _add(link, "collision", {"pose": pose}, name=name)
    _add(collision, "geometry").append(geometry)


def _visual(
    link: ET.Element, name: str, pose: str, geometry: ET.Element, color: tuple[float, ...]
) -> None:
    visual = _add(link, "visual", {"pose": pose}, name=name)
    _add(visual, "geometry").append(geometry)
    _add(visual, "material", {"diffuse": _numbers(color)})


def _cylinder(radius: float, length: float) -> ET.Element:
    return _shape("cylinder", radius=[radius], length=[length])


def _shape(kind: str, **sizes: Iterable[float]) -> ET.Element:
    shape = ET.Element(kind)
    for name, values in sizes.items():
        ET.SubElement(shape, name).text = _numbers(values)
    return shape
