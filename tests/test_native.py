"""The dynamics in C: the numbers of CasADi's virtual machine, the same source, the same results."""

import ctypes
import functools
import math
import os
import re
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.dynamics import generate
from stewart_drake.dynamics.functions import DynamicsFunctions, compiled_functions, margin_of
from stewart_drake.dynamics.native_functions import NativeFunctions
from stewart_drake.dynamics.stewart import plant_parameters
from stewart_drake.dynamics.virtual_machine import VirtualMachine
from stewart_drake.dynamics.workspace import margin
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.native import build, library
from stewart_drake.native.layout import SIGNATURES
from stewart_drake.report.document import Document
from stewart_drake.report.page import Provenance, html
from stewart_drake.scenario.signals import NUM_PLANT_PARAMETERS, PAYLOAD
from tests.backends import switched
from tests.mechanisms import PAPER, random_mechanism, random_pose

Array = NDArray[np.float64]
NO_PARAMETERS = plant_parameters()
CLOSE = 1e-13
"""Relative to the largest number of a result; they differ by the order of sums."""
QUICK = ("accelerations", "energy", "measures", "measures_of_tree", "change", "margin")
"""Functions that the virtual machine builds in a tenth of a second each."""


@pytest.fixture(scope="module")
def native() -> ctypes.CDLL:
    """The compiled library; where STEWART_NATIVE=require it cannot be missing."""
    with switched(None):
        found = library.backend()
    if found.library is None:
        pytest.skip(found.reason)
    return found.library


def arguments(rng: np.random.Generator, mechanism: Mechanism) -> dict[str, Array | float]:
    """Random ones within reach, by their names in the layout."""
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
        "sign": rng.choice([-1.0, 1.0]),
        "least": rng.normal(0, 0.1, 8),
    }


def parameters(rng: np.random.Generator) -> Array:
    """Of the plant, any: but of a payload that leaves the plate its mass, so that it can move."""
    found = rng.normal(0, 0.1, NUM_PLANT_PARAMETERS)
    found[PAYLOAD] = abs(found[PAYLOAD])
    return found


def difference(found: object, expected: object) -> float:
    """Largest, of all results, relative to the largest number of each."""
    pairs = zip(_listed(found), _listed(expected), strict=True)
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def _listed(results: object) -> list[Array]:
    return [np.asarray(r) for r in results] if isinstance(results, list) else [np.asarray(results)]


@functools.cache
def machine(seed: int) -> VirtualMachine:
    """Of a random mechanism; what is built of it stays."""
    return VirtualMachine(random_mechanism(np.random.default_rng(seed)))


def assert_equal(
    library: ctypes.CDLL, seed: int, names: tuple[str, ...] = tuple(SIGNATURES), poses: int = 3
) -> None:
    """Native and virtual machine agree on a random machine."""
    rng, other = np.random.default_rng(seed), machine(seed)
    mechanism = other.mechanism
    one: DynamicsFunctions = NativeFunctions(mechanism, library)
    for _ in range(poses):
        given = arguments(rng, mechanism)
        for name in names:
            values = [given[argument] for argument in SIGNATURES[name].arguments]
            found, expected = (getattr(functions, name)(*values) for functions in (one, other))
            assert difference(found, expected) < CLOSE, (seed, name)


def test_native_equals_the_virtual_machine(native) -> None:
    """Random machines; `make soak` has a thousand."""
    for seed in range(20):
        assert_equal(native, seed, QUICK)
    for seed in range(4):
        assert_equal(native, seed)


@pytest.mark.soak
@pytest.mark.parametrize("part", range(20))
def test_native_equals_the_virtual_machine_on_a_thousand_machines(native, part: int) -> None:
    for seed in range(1000 + 50 * part, 1000 + 50 * (part + 1)):
        assert_equal(native, seed)


@pytest.mark.parametrize("steps", [1, 2, 7, 130])
def test_predictions_are_those_of_the_virtual_machine(native, steps: int) -> None:
    """Steps shorter than the motion's time constants, so that rounding does not grow."""
    rng = np.random.default_rng(steps)
    torque = PAPER_HOLD + rng.normal(0, 0.01, (steps, 6))
    state = np.concatenate([PAPER.home, 0.01 * rng.normal(0, 1, 6)])
    given = state, torque, NO_PARAMETERS, 9.81, rng.uniform(1e-4, 5e-4, steps)
    found, expected = (
        functions.many_steps(steps)(*given)[0].reshape(steps, 12)
        for functions in (NativeFunctions(PAPER, native), VirtualMachine(PAPER))
    )
    assert np.abs(expected[-1] - state).max() > 1e-7
    assert np.abs(found - expected).max() < CLOSE * np.abs(expected).max() * max(1, steps / 10)


PAPER_HOLD = sd.StewartDynamics(PAPER).equilibrium_torque(PAPER.home)


def test_far_out_of_reach_and_without_numbers_they_agree_too(native) -> None:
    """Where squares are held above zero, and where NaN must stay NaN."""
    rng = np.random.default_rng(5)
    one, other = NativeFunctions(PAPER, native), VirtualMachine(PAPER)
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
        for functions in (one, other):
            assert math.isnan(functions.margin(pose, 1.0, np.zeros(8)))
            found = functions.accelerations(pose, zero, zero, NO_PARAMETERS, 9.81)[0]
            assert np.isnan(found).any()


@pytest.mark.parametrize("value", ["0", "require"])
def test_the_margin_is_the_least_of_the_measures(native, value: str) -> None:
    with switched(value):
        functions = compiled_functions(PAPER)
        assert functions.backend == ("casadi" if value == "0" else "native")
        measures = functions.measures(PAPER.home)[0]
        least = np.zeros(8)
        for index in range(8):
            least[:] = -10.0
            least[index] = 0.25
            sign = -1.0 if index == 6 else 1.0
            expected = sign * measures[index] - 0.25 if index == 6 else measures[index] - 0.25
            assert functions.margin(PAPER.home, sign, least) == pytest.approx(expected, abs=1e-15)
            assert margin_of(measures, sign, least) == pytest.approx(expected, abs=1e-15)
        assert margin(PAPER, PAPER.home) > 0.1


def test_threads_have_buffers_of_their_own(native) -> None:
    """Eight threads on one function, released from Python's lock while they compute."""
    functions, meeting = NativeFunctions(PAPER, native), threading.Barrier(8)
    expected = {}
    for n in range(8):
        torque = np.full((200, 6), 0.01 * n)
        expected[n] = functions.many_steps(200)(_START, torque, NO_PARAMETERS, 9.81, 1e-4)[0]

    def repeated(n: int) -> bool:
        meeting.wait(10)
        torque = np.full((200, 6), 0.01 * n)
        call = functions.many_steps(200)
        given = _START, torque, NO_PARAMETERS, 9.81, 1e-4
        return all(np.array_equal(call(*given)[0], expected[n]) for _ in range(50))

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(repeated, range(8)))
    assert not np.array_equal(expected[0], expected[1])


_START = np.concatenate([PAPER.home, np.zeros(6)])


# The source, and what is made of it.


def made_of(equations: str, folder: Path) -> ctypes.CDLL:
    """The dynamics compiled with other equations, quickly."""
    shutil.copytree(build.FOLDER, folder, ignore=shutil.ignore_patterns("*.so", "*.py"))
    (folder / "equations.h").write_text(equations)
    target = folder / "lib.so"
    command = [*(build.compiler() or ()), *build.FLAGS, "-O0", "-o", str(target)]
    sources = [str(folder / name) for name in ("dynamics.c", "packed.c")]
    subprocess.run([*command, *sources, "-lm"], check=True)
    return ctypes.CDLL(str(target))


def test_the_c_is_what_the_equations_are(native, tmp_path: Path) -> None:
    """Word for word; or, as another CasADi writes it, in what it computes."""
    text = generate.equations_in_c()
    if text != generate.FILE.read_text():
        for seed in range(3):
            assert_equal(made_of(text, tmp_path / f"{seed}"), seed)
            assert_equal(native, seed)


@pytest.mark.slow
def test_other_equations_are_told_from_these(native, tmp_path: Path) -> None:
    """What the tests above would say to a sign that is wrong in one place of each function."""
    text = generate.FILE.read_text()
    assert_equal(made_of(text, tmp_path / "same"), 0)
    for name in re.findall(r"static void (\w+)", text):
        start = text.index(f"static void {name}(")
        place = text.index(" + ", start)
        wrong = made_of(f"{text[:place]} - {text[place + 3 :]}", tmp_path / name)
        with pytest.raises(AssertionError):
            assert_equal(wrong, 0)


def test_it_is_compiled_without_a_warning(native, tmp_path: Path) -> None:
    strict = ["-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
    command = [*(build.compiler() or ()), *build.FLAGS, "-O1", *strict]
    target = str(tmp_path / "lib.so")
    subprocess.run([*command, "-o", target, *build.SOURCES, "-lm"], check=True)


def test_a_library_older_than_its_source_is_not_used(native, monkeypatch) -> None:
    monkeypatch.setattr(library, "source_hash", lambda: "another")
    with switched(None):
        assert library.backend().name == "casadi"
        assert "older than their source" in str(library.backend())
        assert compiled_functions(PAPER).backend == "casadi"
    with switched("require"), pytest.raises(ConfigError, match="older than their source"):
        library.backend()


@pytest.mark.parametrize(
    ("compiler", "reason"),
    [("/nowhere/cc", "there is no C compiler"), ("false", "false: it failed")],
)
def test_without_a_compiler_that_works_one_line_says_so(
    monkeypatch, tmp_path: Path, compiler: str, reason: str
) -> None:
    monkeypatch.setenv("CC", compiler)
    assert build.compile_library(tmp_path / "lib.so") == reason
    assert list(tmp_path.iterdir()) == []


def test_a_compiler_that_complains_is_quoted(monkeypatch, tmp_path: Path) -> None:
    script = tmp_path / "cc"
    script.write_text("#!/bin/sh\necho 'dynamics.c:1: error: no such thing' >&2\nexit 1\n")
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    said = build.compile_library(tmp_path / "lib.so")
    assert said == f"{script}: dynamics.c:1: error: no such thing"


# The switch.


def test_another_value_of_the_switch_is_refused_in_one_line(capsys) -> None:
    with switched("1"):
        assert main(["model", "check", "paper"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "STEWART_NATIVE: got '1'; expected 0" in error


@pytest.mark.parametrize(("value", "name"), [("0", "casadi"), ("require", "native")])
def test_the_backend_is_named(native, capsys, value: str, name: str) -> None:
    with switched(value):
        assert main(["--version"]) == 0
        assert f"dynamics: {name}" in capsys.readouterr().out
        scenario = sd.load_scenario("paper", settings=["duration=0.2"])
        assert sd.simulate(scenario, margin=False).summary["backend"] == name
        page = html(Document("Title", "Verdict.", ()), Provenance("command"))
        assert f"Dynamics: {name}." in page


def test_without_a_library_nothing_but_speed_is_missing(native, monkeypatch) -> None:
    """The same run, with the library gone: what it records differs by rounding."""
    scenario = sd.load_scenario("paper", settings=["duration=0.5", "plant.kind=exact"])
    with switched("require"):
        fast = sd.simulate(scenario, margin=False)
    monkeypatch.setattr(library, "LIBRARY", Path("/nowhere/lib.so"))
    with switched(None):
        slow = sd.simulate(scenario, margin=False)
    assert (fast.summary["backend"], slow.summary["backend"]) == ("native", "casadi")
    torques = [result.signals["torque_commanded"].values for result in (fast, slow)]
    assert np.abs(torques[0] - torques[1]).max() < 1e-7 * np.abs(torques[1]).max()


@pytest.mark.slow
def test_native_dynamics_build_nothing(native) -> None:
    """No expression of CasADi is made where the library serves."""
    code = """if True:
        import casadi, stewart_drake as sd
        def never(*_): raise AssertionError("an expression was made")
        casadi.SX.sym = never
        scenario = sd.load_scenario("paper", settings=["duration=0.1"])
        assert sd.simulate(scenario, margin=False).summary["backend"] == "native" """
    subprocess.run([sys.executable, "-c", code], check=True, env=_with("require"))


def _with(value: str) -> dict[str, str]:
    return os.environ | {library.SWITCH: value}
