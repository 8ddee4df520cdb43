"""The compiled core: the numbers of CasADi's virtual machine, of the same equations."""

import functools
import math
import re
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.core import build, library
from stewart_drake.dynamics import generate, native_functions
from stewart_drake.dynamics.native_functions import NativeFunctions, functions_of
from stewart_drake.dynamics.stewart import StewartDynamics, plant_parameters
from stewart_drake.dynamics.workspace import margin, measures_at
from stewart_drake.scenario.signals import (
    BALL_JOINTS,
    NUM_PLANT_PARAMETERS,
    PAYLOAD,
    PLANT_PARAMETERS,
)
from tests.mechanisms import PAPER, random_mechanism, random_pose
from tests.virtual_machine import VirtualMachine

NO_PARAMETERS = plant_parameters()
CLOSE = 1e-13
"""Relative to the largest number of a result; they differ by the order of sums."""
ARGUMENTS = {
    "accelerations": "pose rates torque parameters gravity",
    "inverse_dynamics": "pose rates accelerations parameters gravity",
    "energy": "pose rates parameters gravity",
    "residual_derivatives": "pose rates accelerations torque parameters gravity",
    "measures": "pose",
    "measures_of_tree": "pose angles",
    "change": "state torque parameters gravity",
}
QUICK = ("accelerations", "energy", "measures", "measures_of_tree", "change")
"""Functions that the virtual machine builds in a tenth of a second each."""


def arguments(rng, mechanism):
    """Random ones within reach, by name."""
    pose = random_pose(rng, mechanism)
    rates, accelerations, torque, angles = rng.normal(0, 1, (4, 6))
    return {
        "pose": pose,
        "rates": rates,
        "state": np.concatenate([pose, rates]),
        "accelerations": accelerations,
        "torque": torque,
        "parameters": parameters(rng),
        "gravity": rng.uniform(0, 10),
        "angles": angles,
    }


def parameters(rng):
    """Return random parameters of the plant; the payload leaves the plate a positive mass."""
    found = rng.normal(0, 0.1, NUM_PLANT_PARAMETERS)
    found[PAYLOAD] = abs(found[PAYLOAD])
    found[BALL_JOINTS] = 0.0, 0.0, 0.1  # which the virtual machine lacks
    return found


def difference(found, expected):
    """Largest, of all results, relative to the largest number of each."""
    pairs = zip(_listed(found), _listed(expected), strict=True)
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def _listed(results):
    return [np.asarray(r) for r in results] if isinstance(results, list) else [np.asarray(results)]


@functools.cache
def machine(seed):
    """Return the dynamics of a random mechanism, cached."""
    return VirtualMachine(random_mechanism(np.random.default_rng(seed)))


def assert_equal(seed, names=tuple(ARGUMENTS), made=None):
    """Core and virtual machine agree on a random machine; `made`: another library than the core."""
    rng, other = np.random.default_rng(seed), machine(seed)
    mechanism = other.mechanism
    with patch.object(native_functions, "core", lambda: made or library.core()):
        one = NativeFunctions(mechanism)
    for _ in range(3):
        given = arguments(rng, mechanism)
        for name in names:
            values = [given[argument] for argument in ARGUMENTS[name].split()]
            found = getattr(one, name.removesuffix("_of_tree"))(*values)
            expected = getattr(other, name)(*values)
            assert difference(found, expected) < CLOSE, (seed, name)
        limits = given["pose"], rng.choice([-1.0, 1.0]), rng.normal(0, 0.1, 8)
        assert math.isclose(one.margins(*limits)[0], other.margin(*limits), abs_tol=CLOSE)


def test_native_equals_the_virtual_machine():
    """Random machines; `make soak` has a thousand."""
    for seed in range(20):
        assert_equal(seed, QUICK)
    for seed in range(4):
        assert_equal(seed)


def test_mass_matrix_bias_and_map_are_those_of_the_equations():
    """They come from derivatives and accelerations; the oracle has its own expressions."""
    for seed in range(6):
        other = machine(seed)
        given = arguments(np.random.default_rng(seed), other.mechanism)
        pose, rates, free = given["pose"], given["rates"], given["parameters"]
        dynamics = StewartDynamics(other.mechanism, gravity=given["gravity"], free=PLANT_PARAMETERS)
        found = dynamics.mass_matrix(pose, free), dynamics.bias(pose, rates, free)
        found = [*found, dynamics.actuation_map(pose).T]
        expected = other.terms(pose, rates, free, given["gravity"])
        assert difference(found, expected) < 1e-9


@pytest.mark.soak
@pytest.mark.parametrize("part", range(20))
def test_native_equals_the_virtual_machine_on_a_thousand_machines(part):
    for seed in range(1000 + 50 * part, 1000 + 50 * (part + 1)):
        assert_equal(seed)


@pytest.mark.parametrize("steps", [1, 2, 7, 130])
def test_predictions_are_those_of_the_virtual_machine(steps):
    """Steps shorter than the motion's time constants, so that rounding does not grow."""
    rng = np.random.default_rng(steps)
    torque = PAPER_HOLD + rng.normal(0, 0.01, (steps, 6))
    state = np.concatenate([PAPER.home, 0.01 * rng.normal(0, 1, 6)])
    given = state, torque, NO_PARAMETERS, 9.81, rng.uniform(1e-4, 5e-4, steps)
    found = NativeFunctions(PAPER).many_steps(*given)
    expected = VirtualMachine(PAPER).many_steps(steps)(*given)[0].reshape(steps, 12)
    assert np.abs(expected[-1] - state).max() > 1e-7
    assert np.abs(found - expected).max() < CLOSE * np.abs(expected).max() * max(1, steps / 10)


PAPER_HOLD = sd.StewartDynamics(PAPER).equilibrium_torque(PAPER.home)


def test_far_out_of_reach_and_without_numbers_they_agree_too():
    """Squares are held above zero, and NaN stays NaN."""
    rng = np.random.default_rng(5)
    one, other = NativeFunctions(PAPER), VirtualMachine(PAPER)
    for distance in (0.1, 0.3, 1.0, 1e3):
        pose = PAPER.home + rng.normal(0, 1, 6) * ([1.0] * 3 + [distance] * 3)
        rates, torque = rng.normal(0, 1, (2, 6))
        values = (pose, rates, torque, NO_PARAMETERS, 9.81)
        assert difference(one.accelerations(*values), other.accelerations(*values)) < 1e-11
        assert difference(one.measures(pose), other.measures(pose)) < 1e-12
    for coordinate in range(6):
        pose = PAPER.home.copy()
        pose[coordinate] = np.nan
        zero = np.zeros(6)
        assert np.isnan(one.margins(pose, 1.0, np.zeros(8))[0])
        assert np.isnan(other.margin(pose, 1.0, np.zeros(8)))
        for functions in (one, other):
            found = functions.accelerations(pose, zero, zero, NO_PARAMETERS, 9.81)[0]
            assert np.isnan(found).any()


def test_the_margin_is_the_least_of_the_measures():
    functions = functions_of(PAPER)
    measures = functions.measures(PAPER.home)
    least = np.zeros(8)
    for index in range(8):
        least[:] = -10.0
        least[index] = 0.25
        sign = -1.0 if index == 6 else 1.0
        expected = sign * measures[index] - 0.25 if index == 6 else measures[index] - 0.25
        assert functions.margins(PAPER.home, sign, least) == pytest.approx(expected, abs=1e-15)
    assert margin(PAPER, PAPER.home) == measures_at(PAPER, PAPER.home).margin > 0.1


def test_threads_do_not_share_arrays():
    """Eight threads on one function, released from Python's lock while they compute."""
    functions, meeting = NativeFunctions(PAPER), threading.Barrier(8)
    expected, short = {}, np.full(200, 1e-4)
    for n in range(8):
        torque = np.full((200, 6), 0.01 * n)
        expected[n] = functions.many_steps(_START, torque, NO_PARAMETERS, 9.81, short)

    def repeated(n):
        meeting.wait(10)
        torque = np.full((200, 6), 0.01 * n)
        given = _START, torque, NO_PARAMETERS, 9.81, short
        return all(np.array_equal(functions.many_steps(*given), expected[n]) for _ in range(50))

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(repeated, range(8)))
    assert not np.array_equal(expected[0], expected[1])


_START = np.concatenate([PAPER.home, np.zeros(6)])


# The source, and what is made of it.


def made_of(equations, folder):
    """Return the dynamics compiled with other equations, quickly."""
    shutil.copytree(build.FOLDER, folder, ignore=shutil.ignore_patterns("*.so", "*.py"))
    (folder / "equations.h").write_text(equations)
    target = folder / "lib.so"
    command = [*(build.compiler() or ()), *build.FLAGS, "-O0", "-o", str(target)]
    sources = map(str, folder.glob("*.c"))
    subprocess.run([*command, *sources, "-lm"], check=True)
    return library.Core(target)


def test_the_c_is_what_the_equations_are(tmp_path):
    """Word for word; or, as another CasADi writes it, in what it computes."""
    text = generate.equations_in_c()
    if text != build.EQUATIONS.read_text():
        for seed in range(3):
            assert_equal(seed, made=made_of(text, tmp_path / f"{seed}"))
            assert_equal(seed)


def test_it_is_compiled_without_a_warning(tmp_path):
    strict = ["-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
    command = [*(build.compiler() or ()), *build.FLAGS, "-O1", *strict]
    target = str(tmp_path / "lib.so")
    subprocess.run([*command, "-o", target, *build.SOURCES, "-lm"], check=True)


@pytest.fixture
def unloaded():
    """Forget the library for a test. Structures that others keep belong to the one from before."""
    kept = library.core()
    library.core.cache_clear()
    yield
    library.core.cache_clear()
    with patch.object(library, "Core", lambda *_: kept):
        library.core()


def test_a_library_that_does_not_fit_is_refused_in_one_line(
    unloaded, monkeypatch, tmp_path, capsys
):
    damaged = tmp_path / "lib.so"
    damaged.write_bytes(b"no library")
    for change, problem in (
        (("source_hash", lambda: "another"), "was built from other source"),
        (("LIBRARY", damaged), "cannot be loaded"),
        (("LIBRARY", tmp_path / "none.so"), "is missing"),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(library, *change)
            functions_of.cache_clear()
            assert main(["model", "check", "paper"]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert f"the compiled core {problem}" in error and "core.build" in error


def test_the_build_knows_whether_its_generated_text_is_current(monkeypatch, tmp_path):
    assert build.is_generated(), "make generate"
    with monkeypatch.context() as patched:
        patched.setattr(build, "equations_hash", lambda: "another")
        assert not build.is_generated()
    with monkeypatch.context() as patched:
        patched.setattr(build, "MODELS", tmp_path)
        (tmp_path / "machine.yaml").touch()
        assert not build.is_generated()
        (tmp_path / "machine.sdf").touch()
        assert build.is_generated()


def test_a_compiler_that_fails_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("CC", "false")
    assert build.compile_library(tmp_path / "lib.so") == "false: failed with exit code 1"
    assert list(tmp_path.iterdir()) == []


def test_without_a_compiler_zig_is_taken_and_without_both_one_line_says_so(monkeypatch, tmp_path):
    monkeypatch.setenv("CC", "/nowhere/cc")
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: object())
    assert build.compiler()[:4] == [sys.executable, "-m", "ziglang", "cc"]
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: None)
    assert "no C compiler found" in build.compile_library(tmp_path / "lib.so")


def test_nothing_but_the_generator_of_the_equations_imports_casadi():
    """The package does not depend on it."""
    names = "|".join(build.GENERATORS)
    module = rf"(\.({names}) import| import .*\b({names})\b)"
    of_generator = re.compile(
        rf"^\s*(import casadi|from casadi|from stewart_drake\.dynamics{module})", re.MULTILINE
    )
    found = {
        path.stem
        for path in Path(build.FOLDER).parent.rglob("*.py")
        if of_generator.search(path.read_text(encoding="utf-8"))
    }
    assert found == set(build.GENERATORS)
