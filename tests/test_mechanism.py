"""Mechanism files: what is refused and how, what the paper's file describes, what is protected."""

import copy
import dataclasses
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import data_root
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import Body, Mechanism
from tests.faults import one_line
from tests.mechanisms import PAPER

Loader = Callable[[dict[str, Any]], Mechanism]
FILE = data_root() / "models" / "paper.yaml"
ABSENT = object()
LEG = {
    "shaft": [0.2, 0.0, 0.01],
    "motor_axis": [1.0, 0.0, 0.0],
    "crank_zero": [0.0, 1.0, 0.0],
    "plate_joint": [0.12, 0.0, 0.0],
    "branch": 1,
}


@pytest.fixture
def load(tmp_path):
    """Write a mechanism file and load it."""

    def write_and_load(contents):
        yaml = YAML()
        yaml.representer.ignore_aliases = lambda *_: True
        with (tmp_path / "mine.yaml").open("w") as stream:
            yaml.dump(contents, stream)
        return load_mechanism(tmp_path / "mine.yaml")

    return write_and_load


def paper_with(edits):
    """Return the paper's file with fields, dots between their sections, replaced or taken out."""
    contents = YAML(typ="safe").load(FILE.read_text())
    for name, value in edits.items():
        section = contents
        *above, field = name.split(".")
        for key in above:
            section = section[key]
        if value is ABSENT:
            del section[field]
        else:
            section[field] = value
    return contents


def third_leg(**changes):
    """Edits that put six explicit legs in place of the pattern, the third of them changed."""
    legs = [copy.deepcopy(LEG) for _ in range(6)]
    legs[2].update(changes)
    return {"pattern": ABSENT, "legs": legs}


# edits, how the message names field and value, what it says is allowed
INVALID = [
    ({"rod.length": [0.4] * 5}, "rod.length: got [0.4, 0.4, 0.4, 0.4, 0.4]", "list of six"),
    ({"rod.length": [-0.4] + [0.4] * 5}, "rod.length: got [-0.4, 0.4,", "positive"),
    ({"rod.length": [0.404] * 5 + [0.11]}, "rod.length: got 0.11 m for leg 6", "longer than its"),
    ({"plate.inertia": [0, 30e-4, 30e-4]}, "plate.inertia: got [0, 0.003, 0.003]", "positive"),
    ({"rod.inertia": [1e-6, 1e-4]}, "rod.inertia: got [1e-06, 0.0001]", "3 numbers, not 2"),
    (
        {"crank.inertia": [0.01e-4, 0.58e-4, 0.60e-4]},  # as printed in Table I
        "crank.inertia: got [1e-06, 5.8e-05, 6e-05] kg m^2, which violates the triangle inequality",
        "at most the sum of the other two",
    ),
    (  # all impossible bodies at once
        {"base.inertia": [1.0, 1.0, 3.0], "crank.mass": 0, "rod.inertia": [0, 1e-3, 1e-3]},
        "base.inertia: got [1, 1, 3]",
        "crank.mass: got 0 kg",
    ),
    ({"pattern.branches": [-1, 1, -1, 0, -1, 1]}, "pattern.branches[3]: got 0", "-1 or 1"),
    (
        {"pattern.plate_order": [0, 0, 1, 2, 3, 4]},
        "pattern.plate_order: got [0, 0, 1, 2, 3, 4]",
        "each of 0 to 5 once",
    ),
    (
        {"home": [0, 0, 0, 0, 0, 0.6]},
        "home: got [0, 0, 0, 0, 0, 0.6], out of reach: all legs short by ",
        "within reach",
    ),
    ({"home": [0, np.pi / 2, 0, 0, 0, 0.38]}, "home: got a pitch of 1.5708", "less than pi/2"),
    ({"pattern": ABSENT}, "pattern, legs: got neither", "exactly one of the two"),
    ({"legs": [LEG] * 6}, "pattern, legs: got both", "exactly one of the two"),
    ({"pattern": ABSENT, "legs": [LEG] * 5}, "legs: got [{'shaft'", "6 legs, not 5"),
    (third_leg(motor_axis=[0, 0, 0]), "legs[2].motor_axis: got [0.0, 0.0, 0.0]", "not zero"),
    (third_leg(crank_zero=[0, 0, 0]), "legs[2].crank_zero: got [0.0, 0.0, 0.0]", "not zero"),
    (third_leg(crank_zero=[0.005, 1, 0]), "legs[2].crank_zero: got 89.7", "perpendicular"),
    (third_leg(branch=0.5), "legs[2].branch: got 0.5", "-1 or 1"),
    ({"name": "world"}, "name: got 'world'", "none of world, "),
    ({"name": "ab\n"}, r"name: got 'ab\n'", "letters, digits"),
]


@pytest.mark.parametrize(("edits", "got", "allowed"), INVALID, ids=[got for _, got, _ in INVALID])
def test_invalid_fields_are_refused_in_one_line(edits, got, allowed, load):
    file, _, problem = one_line(lambda: load(paper_with(edits))).partition(": ")
    assert file.endswith("mine.yaml")
    assert problem.startswith(got)
    assert allowed in problem.partition("expected ")[2]


@pytest.mark.parametrize(
    ("edits", "problem"),
    [
        ({"crank.lenght": 1}, "crank.lenght: unknown key; did you mean crank.length?"),
        (third_leg(shft=[0]), "legs[2].shft: unknown key; did you mean legs[2].shaft?"),
        (
            {"plate.mass": "heavy", "rod.mass": ABSENT},
            "plate.mass: got 'heavy'; expected a number; rod.mass: is missing",
        ),
    ],
)
def test_unknown_and_missing_keys_are_named(edits, problem, load):
    assert one_line(lambda: load(paper_with(edits))).endswith(f"mine.yaml: {problem}")


# ------------------------------------------------------------------ moments that nobody measured


def rod_by_quadrature(length, diameter, mass):
    """Moments of a uniform cylinder along x by Gauss-Legendre over its volume; exact for them."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    x, along = length / 2 * nodes, weights / 2
    r, across = diameter / 4 * (1 + nodes), weights / 2 * (1 + nodes)  # r dr over its integral
    xx, rr = mass * along @ x**2, mass * across @ r**2
    return np.array([rr, xx + rr / 2, xx + rr / 2])


def test_moments_left_out_are_those_of_uniform_bars_and_discs(load):
    cranks = [0.10, 0.11, 0.12, 0.13, 0.14, 0.15]
    bodies = ("base", "plate", "crank", "rod")
    edits = {f"{body}.inertia": ABSENT for body in bodies}
    found = load(paper_with({**edits, "crank.length": cranks}))
    for link, length in ((found.crank, 0.125), (found.rod, 0.404)):
        expected = rod_by_quadrature(length, length / 20, link.mass)
        np.testing.assert_allclose(link.inertia, expected, rtol=1e-13)
        assert link.inertia[1] == pytest.approx(link.mass * length**2 / 12, rel=2e-3)  # slender
    # A disc is a stack of rings: the integral of r^2 dm with dm = 2 m r dr / R^2.
    for body, radius in ((found.base, 0.22), (found.plate, 0.12)):
        r = np.linspace(0, radius, 20001)
        polar = np.trapezoid(r**2 * 2 * body.mass * r / radius**2, r)
        np.testing.assert_allclose(body.inertia, polar * np.array([0.5, 0.5, 1]), rtol=1e-7)
    np.testing.assert_allclose(found.plate.inertia, [144e-4, 144e-4, 288e-4], rtol=1e-12)
    assert all(getattr(found, body).estimated for body in bodies)
    assert not any(getattr(PAPER, body).estimated for body in bodies)
    massless = load(paper_with({"base": {"mass": 0}}))
    np.testing.assert_array_equal(massless.base.inertia, 0)


def test_moments_of_what_is_not_uniform_have_to_be_given(load):
    with pytest.raises(ConfigError, match=r"rod\.inertia: is missing.* center of 0\.3"):
        load(paper_with({"rod.inertia": ABSENT, "rod.center": 0.3}))


# ------------------------------------------------------------------ files in millimetres

LENGTHS = ["crank.length", "rod.length", "pattern.base_radius", "pattern.plate_radius"]
LENGTHS += ["pattern.shaft_height"]


def enlarged(name, factor, masses, inertias):
    """Return a shipped mechanism's file with all lengths, masses and inertias multiplied."""
    contents = YAML(typ="safe").load((FILE.parent / f"{name}.yaml").read_text())
    for field in [*LENGTHS, "pattern.plate_height"]:
        section, key = field.split(".")
        if key in contents[section]:
            contents[section][key] *= factor
    contents["home"][3:] = [factor * x for x in contents["home"][3:]]
    for body in ("base", "plate", "crank", "rod"):
        contents[body]["mass"] *= masses
        contents[body]["inertia"] = [inertias * x for x in contents[body]["inertia"]]
    return contents


@pytest.mark.parametrize("masses", [1, 1000], ids=["kg", "g"])
@pytest.mark.parametrize("name", ["paper", "desktop", "motion_base"])
def test_a_file_in_millimetres_is_asked_for_metres(name, masses, load):
    said = one_line(lambda: load(enlarged(name, 1000, masses, 1)))
    assert re.search(r"expected .*metres.*\(are these millimetres\?\)", said)


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        (["rod.length"], "^[^,]*rod.length"),
        (["crank.length"], "crank.length"),
        (["pattern.base_radius", "pattern.plate_radius"], "pattern"),
    ],
    ids=["rods", "cranks", "radii"],
)
def test_some_lengths_in_millimetres_are_named(fields, named, load):
    contents = enlarged("desktop", 1, 1, 1)
    for field in fields:
        section, key = field.split(".")
        contents[section][key] *= 1000
    contents["plate"]["mass"] *= 1e5  # heavier than paper at any size
    with pytest.raises(ConfigError, match=rf"{named}: got up to .*\(are these millimetres\?\)"):
        load(contents)


@pytest.mark.parametrize("name", ["paper", "desktop", "motion_base"])
@pytest.mark.parametrize("factor", [1e-3, 0.01, 0.1, 1, 5])
def test_machines_of_any_size_in_metres_are_taken(name, factor, load):
    """Sizes from a tenth of a millimetre to ten metres, masses growing at least by the square."""
    masses = factor**2 if factor > 1 else factor**3
    load(enlarged(name, factor, masses, masses * factor**2))


# ------------------------------------------------------------------ a home out of reach


@pytest.mark.parametrize("z", [0.6, 0.05, -3.0, 380.0])
def test_a_reachable_height_is_named(z, load):
    """The range that is named is in reach, its outside is not, and the proposal loads."""
    home = [0.1, -0.05, 0.2, 0.01, 0.0]
    said = one_line(lambda: load(paper_with({"home": [*home, z]})), "within reach")
    named = re.search(r"z between (\S+) and (\S+) m, such as (\S+)$", said)
    assert named is not None
    low, high, middle = map(float, named.groups())
    load(paper_with({"home": [*home, middle]}))
    for edge, step in ((low, -1e-3), (high, 1e-3)):
        assert PAPER.reach_margins(np.array([*home, edge - step])).min() > 0
        assert PAPER.reach_margins(np.array([*home, edge + step])).min() < 0
        # The edge itself, to the four digits it is told with.
        assert abs(PAPER.reach_margins(np.array([*home, edge])).min()) < 2e-4


def test_that_no_height_is_reachable_is_said(load):
    for sideways in (0.4, 50.0):
        with pytest.raises(ConfigError, match="within reach, but none exists at this x, y"):
            load(paper_with({"home": [0, 0, 0, sideways, 0, 0.38]}))


# ------------------------------------------------------------------ built in Python

REFUSED = [
    ({"p_WS": np.zeros((5, 3))}, "p_WS: got shape (5, 3); expected (6, 3)"),
    ({"rod_lengths": 0.4}, "rod_lengths: got shape (); expected (6,)"),
    ({"home": [0, 0, 0, 0, 0, np.inf]}, "home: got [0, 0, 0, 0, 0, inf]; expected finite"),
    ({"R_WS": 1.01 * PAPER.R_WS}, "motor frames: off a rotation by 2.0e-02"),
    ({"R_WS": -PAPER.R_WS}, "motor frames: off a rotation by"),
    ({"branches": np.zeros(6)}, "branches: got [0, 0, 0, 0, 0, 0]; expected -1 or 1"),
    ({"base": Body(np.inf, [1, 1, 1])}, "base.mass: got inf kg"),
]


@pytest.mark.parametrize(("changes", "problem"), REFUSED, ids=[problem for _, problem in REFUSED])
def test_constructor_refuses_what_no_mechanism_has(changes, problem):
    one_line(lambda: dataclasses.replace(PAPER, **changes), start=problem)


def test_arrays_are_copies_and_read_only():
    shafts, moments = PAPER.p_WS.copy(), np.array([30e-4, 30e-4, 60e-4])
    mechanism = dataclasses.replace(PAPER, p_WS=shafts, plate=Body(4.0, moments))
    shafts += 1
    moments += 1
    np.testing.assert_array_equal(mechanism.p_WS, PAPER.p_WS)
    np.testing.assert_array_equal(mechanism.plate.inertia, PAPER.plate.inertia)

    bodies = [mechanism, *(getattr(mechanism, name) for name in ("base", "plate", "crank", "rod"))]
    arrays = [value for body in bodies for value in vars(body).values() if np.ndim(value)]
    assert len(arrays) == 12
    for array in arrays:
        assert array.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


# ------------------------------------------------------------------ what files describe


def test_the_paper_s_machine_is_the_tabulated_one():
    """Pairs 15 and 5 degrees apart on circles of 0.22 and 0.12 m, installed at 70 degrees."""
    base_deg = 24 + np.array([-7.5, 7.5, 112.5, 127.5, 232.5, 247.5])
    t = 24 + 60 + np.array([-2.5, 2.5, 117.5, 122.5, 237.5, 242.5])
    plate_deg = t[[5, 0, 1, 2, 3, 4]]
    beta = np.radians(70)
    for leg in range(6):
        b, p = np.radians(base_deg[leg]), np.radians(plate_deg[leg])
        shaft = [0.22 * np.cos(b), 0.22 * np.sin(b), 0.010]
        joint = [0.12 * np.cos(p), 0.12 * np.sin(p), 0]
        x = [np.sin(b), -np.cos(b), 0]
        y = [np.cos(beta) * np.cos(b), np.cos(beta) * np.sin(b), -np.sin(beta)]
        axis = [np.sin(beta) * np.cos(b), np.sin(beta) * np.sin(b), np.cos(beta)]  # x cross y
        np.testing.assert_allclose(PAPER.p_WS[leg], shaft, atol=1e-15)
        np.testing.assert_allclose(PAPER.p_PQ[leg], joint, atol=1e-15)
        np.testing.assert_allclose(PAPER.R_WS[leg], np.transpose([x, y, axis]), atol=1e-15)
    np.testing.assert_array_equal(PAPER.branches, [-1, 1, -1, 1, -1, 1])
    np.testing.assert_array_equal(PAPER.crank_lengths, 0.11)
    np.testing.assert_array_equal(PAPER.rod_lengths, 0.404)
    np.testing.assert_array_equal(PAPER.home, [0, 0, 0, 0, 0, 0.38])
    for body, mass, inertia in (
        (PAPER.base, 7, [270, 270, 540]),
        (PAPER.plate, 4, [30, 30, 60]),
        (PAPER.crank, 0.04, [0.01, 0.58, 0.59]),
        (PAPER.rod, 0.08, [0.01, 16, 16]),
    ):
        assert body.mass == mass
        np.testing.assert_allclose(body.inertia, np.multiply(inertia, 1e-4), rtol=1e-15)
    assert PAPER.crank.center == PAPER.rod.center == 0.5


def legs_of(directions):
    """Return the paper's legs, listed; `directions` gives axis and crank of a motor's frame."""
    found = []
    for i, (axis, crank) in enumerate(map(directions, PAPER.R_WS)):
        joints = {"shaft": PAPER.p_WS[i].tolist(), "plate_joint": PAPER.p_PQ[i].tolist()}
        frame = {"motor_axis": axis.tolist(), "crank_zero": crank.tolist()}
        found.append(joints | frame | {"branch": int(PAPER.branches[i])})
    return found


def test_explicit_legs_give_the_geometry_of_the_pattern(load):
    """Directions may have any length; the crank's may lean a rounding error off the right angle."""
    legs = legs_of(lambda R: (3.0 * R[:, 2], 0.1 * R[:, 0] + 1e-9 * R[:, 2]))
    explicit = load(paper_with({"pattern": ABSENT, "legs": legs}))
    for field in dataclasses.fields(Mechanism):
        given, expected = getattr(explicit, field.name), getattr(PAPER, field.name)
        if isinstance(expected, np.ndarray):
            np.testing.assert_allclose(given, expected, atol=1e-14, err_msg=field.name)
    pose = PAPER.home + [0.1, 0.05, -0.1, 0.01, 0, 0.02]
    np.testing.assert_allclose(explicit.crank_angles(pose), PAPER.crank_angles(pose), atol=1e-12)


def test_directions_may_be_written_with_three_decimals(load):
    legs = legs_of(lambda R: (R[:, 2].round(3), R[:, 0].round(3)))
    rounded = load(paper_with({"pattern": ABSENT, "legs": legs}))
    np.testing.assert_allclose(rounded.R_WS, PAPER.R_WS, atol=2e-3)
    right = np.einsum("kji,kjl->kil", rounded.R_WS, rounded.R_WS)
    np.testing.assert_allclose(right, np.broadcast_to(np.eye(3), (6, 3, 3)), atol=1e-14)


def test_lengths_may_differ_from_leg_to_leg_and_a_limit_may_lack(load):
    cranks, rods = np.linspace(0.10, 0.15, 6).tolist(), np.linspace(0.40, 0.45, 6).tolist()
    edits = {"crank.length": cranks, "rod.length": rods, "rod.center": 0.25, "motor": ABSENT}
    mechanism = load(paper_with(edits))
    np.testing.assert_array_equal(mechanism.crank_lengths, cranks)
    np.testing.assert_array_equal(mechanism.rod_lengths, rods)
    assert mechanism.rod.center == 0.25 and mechanism.effort_limit is None
    assert load(paper_with({"motor.effort_limit": None})).effort_limit is None
