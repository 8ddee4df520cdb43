"""What the documents say exists, runs, loads and is true.

Conventions of `docs/*.md`, so that names can be checked:

* a dotted name in code type is relative to the package (`law.riccati.lqr`), a field of a
  scenario (`plant.gravity`) or a port of the loop (`plant.torque`);
* a path in code type is relative to the repository or to the package; `file.py::name` is a test;
* a word in code type with an underscore or an inner capital occurs in the package's source, its
  tests or its data files;
* ```python blocks run, ```yaml blocks load, `stewart-drake` lines of ```sh blocks parse; what is
  only for reading is ```text.
"""

import ast
import dataclasses
import functools
import importlib
import importlib.util
import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import stewart_drake as sd
from stewart_drake.files import resources
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import load_yaml
from stewart_drake.law.delay_model import chain, delayed_model
from stewart_drake.law.error_model import double_integrators, linear_model
from stewart_drake.law.riccati import reduced_gain
from stewart_drake.loop.controller import DelayLqiController
from stewart_drake.loop.diagram import ClosedLoop
from stewart_drake.loop.metrics import accumulated_error
from stewart_drake.mechanism.kinematics import leg_geometry, rotation
from stewart_drake.mechanism.torque_map import torque_map
from stewart_drake.scenario.config import ControllerConfig, Scenario
from stewart_drake.scenario.loading import load_controller, load_understood, setting_choices
from stewart_drake.scenario.reference_files import read_waypoints
from stewart_drake.scenario.signals import SIGNALS, exported_ports, ports_of
from stewart_drake.scenario.trajectories import evaluate, make_reference
from tests.mechanisms import PAPER

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "stewart_drake"
DOCS = [
    path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if path.exists()
]
CHECKED_NAMES = [path for path in DOCS if path.parent == ROOT / "docs"]

FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```[ \t]*$", re.DOTALL | re.MULTILINE)
CODE = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
SUFFIXES = (".py", ".md", ".yaml", ".sdf", ".xml", ".toml", ".txt", ".json")


class Block(NamedTuple):
    """A fenced block of a document and the line it starts in."""

    path: Path
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT)}:{self.line}"


def blocks(*languages: str) -> list[Block]:
    """All fenced blocks in one of these languages."""
    found = []
    for path in DOCS:
        text = path.read_text(encoding="utf-8")
        for match in FENCE.finditer(text):
            line = text.count("\n", 0, match.start()) + 1
            found.append(Block(path, line, match[1], match[2]))
    return [block for block in found if block.language in languages]


def prose(path: Path) -> str:
    """A document without its fenced blocks."""
    return FENCE.sub("", path.read_text(encoding="utf-8"))


def each(found: list[Block]) -> Any:
    return pytest.mark.parametrize("block", found, ids=str)


# ------------------------------------------------------------------ names


@functools.cache
def words() -> frozenset[str]:
    """All identifiers and words of the package, the tests and the data files."""
    folders = (PACKAGE, ROOT / "tests", ROOT / "models", ROOT / "diagrams")
    texts = (
        path.read_text(encoding="utf-8")
        for folder in folders
        for path in folder.rglob("*")
        if path.suffix in (".py", ".yaml", ".c", ".h") and path != Path(__file__)
    )
    return frozenset(word for text in texts for word in re.findall(r"[A-Za-z_]\w*", text))


@functools.cache
def functions_in(path: Path) -> frozenset[str]:
    """Names of the test functions in a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return frozenset(node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def is_field(dotted: str) -> bool:
    """Whether this is a section or a field of a scenario."""
    fields = {choice.partition("=")[0] for choice in setting_choices()}
    return dotted in fields or dotted in {field.partition(".")[0] for field in fields}


def is_name(dotted: str) -> bool:
    """Whether the package has this module, or an attribute of it by this name."""
    parts = ["stewart_drake", *dotted.split(".")]
    for end in range(len(parts), 1, -1):
        module = ".".join(parts[:end])
        try:
            if importlib.util.find_spec(module) is None:
                continue
        except ModuleNotFoundError:
            continue
        value: Any = importlib.import_module(module)
        for part in parts[end:]:
            fields = getattr(value, "__dataclass_fields__", {})
            if part in fields:
                return True
            if not hasattr(value, part):
                return False
            value = getattr(value, part)
        return True
    return False


@functools.cache
def loop() -> Any:
    """The closed loop of the paper's scenario, with the exact plant."""
    return sd.build_closed_loop(sd.load_scenario("paper", settings=["plant.kind=exact"]))


@functools.cache
def ports() -> frozenset[str]:
    """`system.port` of all systems in the loop."""
    found = set()
    for system in loop().GetSystems():
        inputs = (system.get_input_port(i) for i in range(system.num_input_ports()))
        outputs = (system.get_output_port(i) for i in range(system.num_output_ports()))
        found |= {f"{system.get_name()}.{port.get_name()}" for port in (*inputs, *outputs)}
    return frozenset(found)


@functools.cache
def modules() -> frozenset[str]:
    """Modules and packages directly below the package."""
    return frozenset(path.stem for path in PACKAGE.iterdir() if path.suffix in ("", ".py"))


def problem_with(code: str) -> str | None:
    """What is wrong with a piece of code type; None where nothing is, or nothing can be told."""
    code = code.strip()
    if "::" in code:
        file, _, test = code.partition("::")
        if not (ROOT / file).is_file():
            return f"{file} does not exist"
        return None if test in functions_in(ROOT / file) else f"{file} has no {test}"
    if re.fullmatch(r"[\w./-]+/", code) or (code.endswith(SUFFIXES) and not re.search(r"\s", code)):
        exists = any((base / code).exists() for base in (ROOT, PACKAGE))
        return None if exists else f"{code} does not exist"
    field = re.match(r"[\w.]+(?=: |=)", code)  # `plant.gravity: false`, `plant.gravity=true`
    dotted = field[0] if field else code
    if re.fullmatch(r"[A-Za-z_]\w*(\.\w+)+", dotted):
        first = dotted.split(".")[0]
        if first not in modules() | {"controller", "sensor", "delay_chain"} and not is_field(first):
            return None
        known = is_field(dotted) or is_name(dotted) or dotted in ports()
        return None if known else f"nothing is called {dotted}"
    if re.fullmatch(r"[A-Za-z_]\w+", dotted) and re.search(r"_|[a-z][A-Z]", dotted):
        return None if dotted in words() else f"nothing in the code is called {dotted}"
    return None


def test_the_documents_exist() -> None:
    assert {path.name for path in CHECKED_NAMES} >= {"theory.md", "errata.md", "architecture.md"}


@pytest.mark.parametrize("path", CHECKED_NAMES, ids=lambda path: path.name)
def test_what_is_named_exists(path: Path) -> None:
    problems = {problem_with(code) for code in CODE.findall(prose(path))} - {None}
    assert not problems, "\n".join(sorted(map(str, problems)))


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    text = prose(path)
    anchors = {
        re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
        for title in re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    }
    for link in LINK.findall(text):
        file, _, anchor = link.partition("#")
        if "://" in link or link.startswith("mailto:"):
            continue
        assert not file or (path.parent / file).exists(), f"{path.name}: {link}"
        assert file or anchor in anchors, f"{path.name}: {link}"


@pytest.mark.parametrize(
    ("code", "wrong"),
    [
        ("law.riccati.lqr", False),
        ("law.riccati.lqrr", True),
        ("law.nothing", True),
        ("plant.gravity: false", False),
        ("plant.gravitas", True),
        ("plant.torque", False),
        ("sensor.torque", True),
        ("dynamics.stewart.StewartDynamics.predict", False),
        ("law.nominal.NominalPlant.substeps", False),
        ("scenario/signals.py", False),
        ("law/", False),
        ("law/nothing.py", True),
        ("tests/test_docs.py::test_the_documents_exist", False),
        ("tests/test_docs.py::test_nothing", True),
        ("tests/test_none.py::test_nothing", True),
        ("GetSubsystemByName", False),
        ("no_such_name", True),
        ("scipy.linalg.nothing", False),
        ("legs", False),
    ],
)
def test_the_check_of_names_finds_what_is_wrong(code: str, wrong: bool) -> None:
    assert (problem_with(code) is not None) is wrong


# ------------------------------------------------------------------ code blocks


@each([block for block in blocks("python", "py") if block.path.name != "extending.md"])
def test_python_runs(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but those of docs/extending.md, which `tests/test_extending.py` runs and looks into."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    source = "\n" * block.line + block.text  # so that a traceback shows the document's line
    exec(compile(source, str(block.path), "exec"), {"__name__": "__main__"})


def load_any(path: Path) -> None:
    """Load a YAML file as what its keys say it is."""
    keys = set(load_yaml(path))
    if keys & {"crank", "rod", "pattern", "legs"}:
        sd.load_mechanism(path)
    elif keys == {"times", "poses"}:
        read_waypoints(str(path))
    elif keys <= {field.name for field in dataclasses.fields(ControllerConfig)}:
        load_controller(path)
    else:
        sd.load_scenario(path)


@each(blocks("yaml", "yml"))
def test_yaml_loads(block: Block, tmp_path: Path) -> None:
    path = tmp_path / "block.yaml"
    path.write_text(block.text, encoding="utf-8")
    load_any(path)


def command_lines(block: Block) -> Iterator[list[str]]:
    """Arguments of every `stewart-drake` call in a shell block."""
    for line in re.sub(r"\\\n", " ", block.text).splitlines():
        for part in re.split(r"&&|\|\||;|\|", line.strip().removeprefix("$ ")):
            arguments = shlex.split(part, comments=True)
            while arguments and re.fullmatch(r"[A-Z_]+=.*", arguments[0]):
                arguments = arguments[1:]
            if arguments and os.path.basename(arguments[0]) == "stewart-drake":
                yield arguments[1:]


def parse(arguments: list[str]) -> dict[str, Any]:
    """The parameters of a call, by the command line's own parser; nothing is run."""
    typer = pytest.importorskip("typer")
    cli = pytest.importorskip("stewart_drake.cli")
    command, name, parameters = typer.main.get_command(cli.app), "stewart-drake", {}
    parent = None
    while True:
        if {"--help", "--version"} & set(arguments[:1]):
            return {}
        parent = command.make_context(name, list(arguments), parent=parent)
        parameters |= parent.params
        if not hasattr(command, "resolve_command"):
            return parameters
        rest = [*getattr(parent, "_protected_args", []), *parent.args]
        if not rest:
            return parameters
        name, command, arguments = command.resolve_command(parent, rest)


@each(blocks("sh", "bash", "shell", "console"))
def test_commands_parse(block: Block) -> None:
    """Options by the parser, shipped names and settings by the loader."""
    for arguments in command_lines(block):
        parameters = parse(arguments)
        scenario = parameters.get("scenario")
        if scenario is None or resources.is_path(scenario):
            continue
        overlay = (parameters.get("controller"), parameters.get("settings") or ())
        load = load_understood if arguments[0] == "compare" else sd.load_scenario
        load(scenario, *overlay)


@pytest.mark.parametrize(
    "line",
    ["simulatee", "simulate --no-such-option", "simulate nowhere", "simulate --set plant.x=1"],
)
def test_a_wrong_command_is_found(line: str) -> None:
    block = Block(ROOT / "README.md", 1, "sh", f"$ OMP_NUM_THREADS=1 stewart-drake {line}  # text")
    with pytest.raises(Exception, match=r"(?i)no such|expected") as caught:
        test_commands_parse(block)
    assert isinstance(caught.value, ConfigError) or "No such" in str(caught.value)


# ------------------------------------------------------------------ the picture of the loop


def test_architecture_shows_the_loop_as_it_is() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    diagram = loop()
    preview = diagram.GetSubsystemByName("controller").GetInputPort("preview").size()

    def named(system: Any, port: Any) -> str:
        # Drake's own blocks have one port each way, which the table leaves out.
        one = system.get_name() in ("saturation", "torque_bias", "weights")
        return system.get_name() if one else f"{system.get_name()}.{port.get_name()}"

    built = {
        (named(source, source.get_output_port(i)), named(target, target.get_input_port(j)))
        + (source.get_output_port(i).size(),)
        for (target, j), (source, i) in diagram.connection_map().items()
    }
    rows = re.findall(r"^\| `([\w.]+)` \| `([\w.]+)` \| (18 p|\d+) \|", text, re.MULTILINE)
    shown = {(a, b, preview if size == "18 p" else int(size)) for a, b, size in rows}
    assert shown == built
    assert preview % 18 == 0
    exported = {diagram.get_output_port(i).get_name() for i in range(diagram.num_output_ports())}
    assert all(f"`{name}`" in text for name in exported)


def port_rows(text: str) -> dict[str, tuple[str, str]]:
    """Port -> size and unit, of the table of output ports in a text; a row may name several."""
    table = text.split("with output ports", 1)[1].split("\n\n", 2)[1]
    rows: dict[str, tuple[str, str]] = {}
    for line in table.splitlines()[2:]:
        names, size, unit, _ = (cell.strip() for cell in line.strip("|").split("|"))
        for name in names.replace("`", "").split(","):
            assert name.strip() not in rows, f"{name} has two rows"
            rows[name.strip()] = (size, unit)
    return rows


def test_the_readme_has_the_ports_of_the_table_of_signals() -> None:
    rows = port_rows((ROOT / "README.md").read_text())
    assert list(rows) != [] and set(rows) == set(exported_ports())
    for name, (size, unit) in rows.items():
        assert int(size) == loop().GetOutputPort(name).size()
        units = [u for s in SIGNALS.values() if s.exported == name for u in s.quantity.units]
        expected = ", ".join("-" if u == "1" else u for u in dict.fromkeys(units))
        # The record has no accelerations, which are the end of the reference.
        assert unit == expected + (", rad/s^2, m/s^2" if name == "reference" else "")


@pytest.mark.parametrize("system", [ClosedLoop, DelayLqiController])
def test_docstrings_name_the_ports_of_the_table(system: type) -> None:
    ports = exported_ports() if system is ClosedLoop else ports_of("controller")
    missing = [name for name in ports if not re.search(rf"\b{name}\b", system.__doc__ or "")]
    assert not missing


def test_architecture_has_a_row_for_every_part_of_the_package() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    parts = {
        f"{path.name}/" if path.is_dir() else path.name
        for path in PACKAGE.iterdir()
        if not path.name.startswith(("_", "."))
    }
    missing = sorted(part for part in parts if f"`{part}`" not in text)
    assert not missing, f"no row in docs/architecture.md for {', '.join(missing)}"


# ------------------------------------------------------------------ claims of errata.md


def rod_lengths(pose: Array, angles: Array) -> Array:
    """(6,) m: what the rods of the paper's machine would need with these crank angles."""
    x, y = PAPER.R_WS[:, :, 0], PAPER.R_WS[:, :, 1]
    tips = PAPER.p_WS + PAPER.crank_lengths[:, None] * (
        np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y
    )
    joints = pose[3:] + PAPER.p_PQ @ rotation(pose[:3]).T
    return np.asarray(np.linalg.norm(joints - tips, axis=1))


def test_errata_inverse_kinematics() -> None:
    """Entries 5 and 6: without |u|^2, and with acos for the angle of (B, A)."""
    pose, u, rod = PAPER.home, PAPER.crank_lengths, PAPER.rod_lengths
    L = np.einsum("li,lij->lj", pose[3:] + PAPER.p_PQ - PAPER.p_WS, PAPER.R_WS)
    A, B = 2 * u * L[:, 0], 2 * u * L[:, 1]
    right = (L**2).sum(axis=1) + u**2 - rod**2
    size = np.hypot(A, B)
    assert np.array_equal(np.sign(A), [1, -1, 1, -1, 1, -1])

    def angles(C: Array) -> Array:
        return np.arctan2(B, A) + PAPER.branches * np.arccos(C / size)

    assert rod_lengths(pose, angles(right)) == pytest.approx(rod, rel=1e-12)
    off = angles(right - u**2)
    assert np.rad2deg(np.abs(off - angles(right))) == pytest.approx(7.8, abs=0.05)
    assert rod_lengths(pose, off) - rod == pytest.approx(0.0147, abs=1e-4)

    printed = -(np.arcsin(-right / size) - np.arccos(B / size) + np.pi)  # (2) with -C
    gaps = rod_lengths(pose, printed + np.pi) - rod
    assert gaps[1::2] == pytest.approx(0, abs=1e-12)
    assert gaps[::2] == pytest.approx(0.047, abs=5e-4)
    gaps = rod_lengths(pose, -(np.arcsin(right / size) - np.arccos(B / size) + np.pi)) - rod
    assert gaps[1::2] == pytest.approx(0, abs=1e-12)
    assert gaps[::2] == pytest.approx(-0.049, abs=5e-4)


def test_errata_desired_acceleration_is_a_disturbance() -> None:
    """Entry 12: with x on the reference and the torque that keeps it there, B T = -d."""
    scenario = Scenario()
    reference = make_reference(scenario.reference, scenario.duration)
    plant = sd.StewartDynamics(PAPER, gravity=False)
    for t in (0.3, 1.5, 4.0):
        wanted = evaluate(reference, t)
        pose, rates, accelerations = wanted[:6], wanted[6:12], wanted[12:]
        torque = plant.inverse_dynamics(pose, rates, accelerations)
        # d(x - x_d)/dt = 0 although error and, without feedforward, torque would be zero.
        assert plant.accelerations(pose, rates, torque) == pytest.approx(accelerations, abs=1e-9)
        assert np.abs(torque).max() > 1e-3
    peak = np.abs([evaluate(reference, t)[12:] for t in np.linspace(0, 6.3, 200)]).max(axis=0)
    assert peak == pytest.approx([0.2618] * 3 + [0.02, 0.02, 0.08], rel=1e-3)


def test_errata_density_is_unbounded() -> None:
    """Entry 18: 31 samples of a sine in the window of (45)."""
    error = np.sin(0.1 * np.arange(101))
    density = [31 * error[k] / error[k - 30 : k + 1].sum() for k in range(30, 101)]
    assert np.abs(density).max() == pytest.approx(92, abs=1)


def test_errata_seven_ratios_of_weights() -> None:
    """Entry 19."""
    weights = (0.1, 1.0, 4.0)
    assert len({round(q / r, 12) for q in weights for r in weights}) == 7
    assert 7 * 5 * 4 == 140


def test_errata_six_hertz_is_four() -> None:
    """Entry 20: at 10 Hz they are the same samples but for the sign."""
    t = 0.1 * np.arange(100)
    assert np.sin(2 * np.pi * 6 * t) == pytest.approx(-np.sin(2 * np.pi * 4 * t), abs=1e-12)


def test_errata_accumulated_error_is_a_mean_over_six() -> None:
    """Entry 21: one coordinate off by its peak to peak for 10 s counts a sixth of 1000 % s."""
    time = np.linspace(0, 10, 501)
    error = np.zeros((501, 6))
    error[:, 4] = 0.04
    assert accumulated_error(time, error, np.full(6, 0.04)) == pytest.approx(1000 / 6)


@pytest.mark.parametrize(
    ("integral", "exact", "without_delay", "delayed"),
    [
        (False, False, 0.901, 1.339),
        (True, False, 0.911, 1.360),
        (False, True, 0.907, 1.266),
        (True, True, 0.914, 1.288),
    ],
)
def test_errata_delay_destabilises_what_ignores_it(
    integral: bool, exact: bool, without_delay: float, delayed: float
) -> None:
    """Entry 22: spectral radii with equal weights, on the paper's map and on the exact plant."""
    weights = np.eye(12 if integral else 6), np.eye(6)
    believed = double_integrators(torque_map(PAPER, PAPER.home))
    K = reduced_gain(delayed_model(believed, 0.1, 0, 0.0, integral=integral), *weights)
    true = linear_model(*sd.StewartDynamics(PAPER, gravity=False).linearize(PAPER.home))
    plant = true if exact else believed
    soon = delayed_model(plant, 0.1, 0, 0.0, integral=integral)
    late = chain(delayed_model(plant, 0.1, 8, 0.0, integral=integral))
    blind = np.hstack([K, np.zeros((6, 48))])
    text = (ROOT / "docs" / "errata.md").read_text(encoding="utf-8")
    for closed, radius in (
        (soon.A - soon.B_new @ K, without_delay),
        (late.A - late.B @ blind, delayed),
    ):
        assert np.abs(np.linalg.eigvals(closed)).max() == pytest.approx(radius, abs=5.1e-4)
        assert f"| {radius:.3f} |" in text


def test_errata_cranks_of_a_pair_intersect() -> None:
    """The limitation: cranks cross at 28 %, rods at 42 % of their lengths."""
    legs = leg_geometry(PAPER, PAPER.home)
    cranks = PAPER.crank_lengths[:, None] * legs.crank
    tips, rods = PAPER.p_WS + cranks, PAPER.rod_lengths[:, None] * legs.rod
    for first in (0, 2, 4):
        pair = [first, first + 1]
        for starts, bodies, share in ((PAPER.p_WS, cranks, 0.280), (tips, rods, 0.422)):
            points = starts[pair] + share * bodies[pair]
            (p, q), (u, v) = starts[pair], bodies[pair]
            shares = np.linalg.lstsq(np.column_stack([u, -v]), q - p)[0]
            assert shares == pytest.approx(share, abs=5e-4)
            assert p + shares[0] * u == pytest.approx(q + shares[1] * v, abs=1e-12)
            assert np.linalg.norm(points[0] - points[1]) < 1e-3
