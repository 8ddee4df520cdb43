"""Names, commands, code and figures in the documents agree with the project.

Of README, CHANGELOG (without what is before 0.2), CONTRIBUTING, `docs/` and `benchmarks/results/`:

* a dotted name in code type is relative to the package (`law.riccati.lqr`), a field of a
  scenario (`plant.gravity`) or a port of the loop (`plant.torque`); `sd.NAME` is public;
* a path in code type is relative to the repository or to the package; one below `out/` is what a
  command of a block, or the Makefile, writes;
* a command in code type (`analyze delay`, `make test`, `python FILE`) exists, with its options;
* a word in code type with an underscore or an inner capital occurs in the package's source, its
  tests or its data files; names that are gone stand in the first column of docs/upgrading.md;
* ```python blocks run, ```yaml blocks load, `stewart-drake` lines of ```sh blocks parse; what is
  only for reading is ```text.
"""

import ast
import dataclasses
import functools
import importlib.util
import itertools
import os
import pydoc
import re
import shlex
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.files import resources
from stewart_drake.files.yamlio import load_yaml
from stewart_drake.law.delay_model import chain, delayed_model, double_integrators, linear_model
from stewart_drake.law.riccati import reduced_gain
from stewart_drake.loop.controller import DelayLqiController
from stewart_drake.loop.diagram import ClosedLoop
from stewart_drake.loop.results import accumulated_error
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.mechanism.kinematics import leg_geometry, rotation
from stewart_drake.mechanism.trajectories import evaluate, make_reference
from stewart_drake.scenario.config import ControllerConfig, Scenario
from stewart_drake.scenario.loading import load_compatible, load_controller, setting_choices
from stewart_drake.scenario.reference_files import read_waypoints
from stewart_drake.scenario.signals import SIGNALS, exported_ports, ports_of
from tests.mechanisms import PAPER

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "stewart_drake"
DOCS = [
    *(ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "benchmarks" / "results").glob("*.md")),
]

FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```[ \t]*$", re.DOTALL | re.MULTILINE)
CODE = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
SUFFIXES = (".py", ".md", ".yaml", ".sdf", ".xml", ".toml", ".txt", ".json", ".c", ".h", ".ipynb")


class Block(NamedTuple):
    """A fenced block of a document and the line it starts in."""

    path: Path
    line: int
    language: str
    text: str

    def __str__(self):
        return f"{self.path.relative_to(ROOT)}:{self.line}"


def blocks(*languages):
    """All fenced blocks in one of these languages."""
    found = []
    for path in DOCS:
        text = path.read_text(encoding="utf-8")
        for match in FENCE.finditer(text):
            line = text.count("\n", 0, match.start()) + 1
            found.append(Block(path, line, match[1], match[2]))
    return [block for block in found if block.language in languages]


def prose(path):
    """Return a document without its fenced blocks; of the changelog what is not history."""
    return FENCE.sub("", path.read_text(encoding="utf-8")).split("\n## [0.1.0]")[0]


def document(path):
    """Its name in a test."""
    return str(path.relative_to(ROOT))


def each(found):
    return pytest.mark.parametrize("block", found, ids=str)


# ------------------------------------------------------------------ names


def texts(kinds, *folders):
    """Return the texts of all files of these kinds in folders of the repository."""
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*"))
    kept = (path for path in paths if path.suffix in kinds and path != Path(__file__))
    return "\n".join(path.read_text(encoding="utf-8") for path in kept)


@functools.cache
def sources():
    """Return the texts of the package, the Makefile and the data files."""
    more = ((ROOT / name).read_text(encoding="utf-8") for name in ("Makefile", "mkdocs.yml"))
    kinds = (".py", ".j2", ".c", ".h", ".yaml")
    return "\n".join((texts(kinds, "stewart_drake", "models", "diagrams"), *more))


@functools.cache
def words():
    """All identifiers and words of the package, the tests and the data files."""
    return frozenset(re.findall(r"[A-Za-z_]\w*", sources() + texts((".py", ".c", ".h"), "tests")))


@functools.cache
def gone():
    """Return names of 0.1 and 0.2 that no longer exist, by docs/upgrading.md and the renames."""
    table = prose(ROOT / "docs" / "upgrading.md").split("| before | now |")[1]
    modules = re.findall(r"^\| `(?:stewart_drake\.)?([\w.]+)`", table, re.MULTILINE)
    return frozenset([*modules, *(f"controller.{name}" for name in ControllerConfig.renamed)])


@functools.cache
def commands():
    """Options by command, such as `analyze delay`; of a family, those of its members."""
    typer = pytest.importorskip("typer")
    cli = pytest.importorskip("stewart_drake.cli")
    found = {}

    def gather(command, name):
        options = {option for p in command.params for option in (*p.opts, *p.secondary_opts)}
        for word, below in getattr(command, "commands", {}).items():
            options |= gather(below, f"{name} {word}".strip())
        found[name] = frozenset(options) | {"--help"}
        return found[name]

    gather(typer.main.get_command(cli.app), "")
    return found


def problem_with_command(code):
    """Return the problem with a command or its options; `stewart-drake` may be left out."""
    words, known = code.removeprefix("stewart-drake ").split(), commands()
    name = ""
    while words and f"{name} {words[0]}".strip() in known:
        name = f"{name} {words.pop(0)}".strip()
    if words and any(other.startswith(f"{name} ") for other in known) and name:
        if not words[0].startswith("-"):
            return f"stewart-drake {name} has no {words[0]}"
    elif not name and words and not words[0].startswith("-"):
        return f"stewart-drake has no {words[0]}"
    for word, after in itertools.zip_longest(words, words[1:], fillvalue=""):
        option, _, _ = word.partition("=")
        if option.startswith("--") and option not in known[name]:
            return f"stewart-drake {name} has no {option}"
        field = after.partition("=")[0]
        if option == "--set" and "." in field and field != "section.field" and not is_field(field):
            return f"no field is called {field}"
    return None


def is_field(dotted):
    """Whether this is a section or a field of a scenario."""
    fields = {choice.partition("=")[0] for choice in setting_choices()}
    return dotted in fields or dotted in {field.partition(".")[0] for field in fields}


def is_name(dotted):
    """Whether the package has this module, or an attribute of it by this name."""
    above, _, last = f"stewart_drake.{dotted}".rpartition(".")
    if pydoc.locate(f"{above}.{last}") is not None:
        return True
    return last in getattr(pydoc.locate(above), "__dataclass_fields__", {})


@functools.cache
def loop():
    """Return the closed loop of the paper's scenario, with the exact plant."""
    return sd.build_closed_loop(sd.load_scenario("paper", settings=["plant.kind=exact"]))


@functools.cache
def ports():
    """`system.port` of all systems in the loop."""
    found = set()
    for system in loop().GetSystems():
        inputs = (system.get_input_port(i) for i in range(system.num_input_ports()))
        outputs = (system.get_output_port(i) for i in range(system.num_output_ports()))
        found |= {f"{system.get_name()}.{port.get_name()}" for port in (*inputs, *outputs)}
    return frozenset(found)


def problem_at_a_shell(program, rest):
    """Return the problem with `stewart-drake ...`, `make ...` or `python ...`."""
    if program == "stewart-drake":
        return problem_with_command(rest)
    words = [word for word in rest.split() if "=" not in word and word != "..."]
    if program == "make":
        makefiles = (ROOT / "Makefile", *PACKAGE.rglob("Makefile"))  # that of a board, too
        told = "\n".join(path.read_text(encoding="utf-8") for path in makefiles)
        targets = re.findall(r"^([\w-]+):", told, re.MULTILINE)
        missing = set(words) - set(targets)
        return f"make has no {', '.join(sorted(missing))}" if missing and '"' not in rest else None
    if words[:1] == ["-m"]:
        name = words[1].removeprefix("stewart_drake.")
        exists = is_name(name) or importlib.util.find_spec(words[1]) is not None
        return None if exists else f"no module {words[1]}"
    script = next((word for word in words if word.endswith(".py")), None)
    return None if script is None or (ROOT / script).is_file() else f"{script} does not exist"


@functools.cache
def problem_with(code):
    """Return the problem with a piece of code type, None where none is found."""
    code = code.strip()
    if code in gone():
        return None
    first, _, rest = code.partition(" ")
    if first in ("stewart-drake", "make", "python") and rest:
        return problem_at_a_shell(first, rest)
    if first.startswith("--") or (rest and first in commands()):
        return problem_with_command(code)
    if code.startswith("out/"):
        told = sources() + "".join(block.text for block in blocks("sh"))
        written = code.rstrip("/") in told or code.rpartition("/")[0] in told
        return None if written else f"no command writes {code}"
    if re.fullmatch(r"[\w./-]+/", code) or (code.endswith(SUFFIXES) and not re.search(r"\s", code)):
        exists = any((base / code).exists() for base in (ROOT, PACKAGE))
        return None if exists else f"{code} does not exist"
    field = re.match(r"[\w.]+(?=: |=)", code)  # `plant.gravity: false`, `plant.gravity=true`
    dotted = (field[0] if field else code).partition("(")[0]
    if dotted.startswith("sd."):
        public, _, below = dotted.removeprefix("sd.").partition(".")
        known = public in sd.__all__ and (not below or hasattr(getattr(sd, public), below))
        return None if known or public in ("NAME", "...") else f"sd has no {public}"
    if dotted in gone():
        return None
    if re.fullmatch(r"[A-Za-z_]\w*(\.\w+)+", dotted):
        first = dotted.split(".")[0]
        parts = {path.stem for path in PACKAGE.iterdir() if path.suffix in ("", ".py")}
        if first not in parts | {"controller", "sensor", "delay_chain"} and not is_field(first):
            return None
        known = is_field(dotted) or is_name(dotted) or dotted in ports()
        return None if known else f"nothing is called {dotted}"
    if re.fullmatch(r"[A-Za-z_]\w+", dotted) and re.search(r"_|[a-z][A-Z]", dotted):
        return None if dotted in words() else f"nothing in the code is called {dotted}"
    return None


@pytest.mark.parametrize("path", DOCS, ids=document)
def test_what_is_named_exists(path):
    codes = set(CODE.findall(prose(path)))
    if path.name == "CHANGELOG.md":  # which abbreviates, and names files that are written
        codes = {code for code in codes if not code.startswith("_") and not code.endswith(SUFFIXES)}
    problems = {problem_with(code) for code in codes} - {None}
    assert not problems, "\n".join(sorted(map(str, problems)))


def docstrings(path):
    """Yield the docstrings of a module, its classes and functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield ast.get_docstring(node) or ""
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield str(node.value.value)


def test_dotted_names_in_docstrings_exist():
    """The reference is made of them. `plant` may be somebody's own there."""
    problems = {
        f"{document(path)}: {problem_with(code)}"
        for path in PACKAGE.rglob("*.py")
        for text in docstrings(path)
        for code in re.findall(r"`([a-z_]+(?:\.\w+)+)`", text)
        if not code.endswith(SUFFIXES) and not code.startswith("plant.") and problem_with(code)
    }
    assert not problems, "\n".join(sorted(problems))


def anchors(path):
    """Return the anchors of a document's headings, as GitHub and the site make them."""
    titles = re.findall(r"^#+ (.*)$", FENCE.sub("", path.read_text("utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("path", DOCS, ids=document)
def test_links_lead_somewhere(path):
    for link in LINK.findall(prose(path)):
        file, _, anchor = link.partition("#")
        if "://" in link or link.startswith("mailto:"):
            continue
        target = path.parent / file if file else path
        assert target.exists(), f"{path.name}: {link}"
        assert not anchor or anchor in anchors(target), f"{path.name}: {link}"


# ------------------------------------------------------------------ code blocks


ELSEWHERE = ("extending.md", "tutorial.md")


@each([block for block in blocks("python", "py") if block.path.name not in ELSEWHERE])
def test_python_runs(block, tmp_path, monkeypatch, capsys):
    """All but those that tests/test_extending.py and tests/test_tutorial.py run and look into.

    A sentence below that begins with "It prints" has the printed numbers.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    source = "\n" * block.line + block.text  # so that a traceback shows the document's line
    exec(compile(source, str(block.path), "exec"), {"__name__": "__main__"})
    below = block.path.read_text(encoding="utf-8").split(f"{block.text}```\n", 1)[1].lstrip()
    if below.startswith("It prints"):
        sentence, number = re.split(r"\.\s", below)[0], r"\d+\.\d+"
        assert re.findall(number, sentence) == re.findall(number, capsys.readouterr().out)


def load_any(path):
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
def test_yaml_loads(block, tmp_path):
    path = tmp_path / "block.yaml"
    path.write_text(block.text, encoding="utf-8")
    load_any(path)


def command_lines(block):
    """Arguments of every `stewart-drake` call in a shell block."""
    for line in re.sub(r"\\\n", " ", block.text).splitlines():
        for part in re.split(r"&&|\|\||;|\|", line.strip().removeprefix("$ ")):
            arguments = shlex.split(part, comments=True)
            while arguments and re.fullmatch(r"[A-Z_]+=.*", arguments[0]):
                arguments = arguments[1:]
            if arguments and os.path.basename(arguments[0]) == "stewart-drake":
                yield arguments[1:]


def parse(arguments):
    """Return the parameters of a call, by the command line's own parser; nothing is run."""
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
def test_commands_parse(block):
    """Options by the parser, shipped names and settings by the loader."""
    for arguments in command_lines(block):
        parameters = parse(arguments)
        scenario = parameters.get("scenario")
        if scenario is None or resources.is_path(scenario):
            continue
        overlay = (parameters.get("controller"), parameters.get("settings") or ())
        load = load_compatible if arguments[0] == "compare" else sd.load_scenario
        load(scenario, *overlay)


# ------------------------------------------------------------------ the picture of the loop


def test_architecture_shows_the_loop_as_it_is():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    diagram = loop()
    preview = diagram.GetSubsystemByName("controller").GetInputPort("preview").size()

    def named(system, port):
        # Drake's own blocks have one port each way, which the list leaves out.
        one = system.get_name() in ("saturation", "torque_bias", "weights")
        return system.get_name() if one else f"{system.get_name()}.{port.get_name()}"

    built = {
        (named(source, source.get_output_port(i)), named(target, target.get_input_port(j)))
        + (source.get_output_port(i).size(),)
        for (target, j), (source, i) in diagram.connection_map().items()
    }
    rows = re.findall(r"^- `([\w.]+)` → `([\w.]+)` \((18 p|\d+)\)", text, re.MULTILINE)
    shown = {(a, b, preview if size == "18 p" else int(size)) for a, b, size in rows}
    assert shown == built
    assert preview % 18 == 0


# ------------------------------------------------------------------ figures


def rows_of(path, heading):
    """Cells of the first table whose head begins so, without its head."""
    table = path.read_text(encoding="utf-8").split(f"\n| {heading}", 1)[1].split("\n\n")[0]
    return [[cell.strip() for cell in row.strip("|").split(" | ")] for row in table.split("\n")[2:]]


TRACKING = ROOT / "benchmarks" / "results" / "tracking.md"


def test_the_readme_s_table_is_that_of_the_benchmark():
    *others, ours = rows_of(ROOT / "README.md", "controller")
    measured = {tuple(row[:2]): row[2] for row in rows_of(TRACKING, "condition")}
    assert [row[0].split("`")[1] for row in others] == ["lqr", "lqi", "delay_lqr", "delay_lqi"]
    for (controller, _, *shown), column in itertools.product(others, range(2)):
        start = ("from rest", "on the reference")[column]
        found = measured[f"0.8 s, {start}", controller.split("`")[1]]
        assert shown[column] == found.replace("left", "leaves")
    plants = {row[0]: row for row in rows_of(TRACKING, "plant")}
    for cell, column in ((ours[2], 1), (ours[3], 3)):
        multibody, exact = re.findall(r"\d[\d.]*", cell)
        assert float(plants["multibody, 0.001 s"][column]) == pytest.approx(
            float(multibody), rel=0.05
        )
        assert float(plants["exact"][column]) == float(exact)


CLAIMS = ROOT / "benchmarks" / "results" / "claims.md"
STATISTICS = ("median of all", "completed, %", "median", "mean", "standard deviation", "worst")
STATISTICS += ("lost", "runs", "AUC")


def tables(path):
    """Head and rows of every table of a document."""
    for text in re.findall(r"^\|.*\n\| ?-.*\n(?:\|.*\n)*", path.read_text("utf-8"), re.MULTILINE):
        head, _, *rows = (re.split(r"\s*\|\s*", row)[1:-1] for row in text.splitlines())
        yield head, rows


@functools.cache
def claims():
    """Figures of the table of claims by the name of a row and the statistic."""
    found = {}
    for head, rows in tables(CLAIMS):
        if head[0] == "row":
            found |= {row[0].strip("`"): dict(zip(head, row, strict=True)) for row in rows}
    return found


def problem_with_claim(name, statistic, shown):
    """Compare a cell with the row that it quotes, rounded to the digits that it shows."""
    if name not in claims():
        return f"no claim is called {name}"
    measured = claims()[name][statistic]
    if statistic == "lost":
        measured = measured.partition(",")[0]
    elif re.fullmatch(r"[\d.]+(e-\d+)?", measured) and re.fullmatch(r"[\d.]+", shown):
        measured = f"{float(measured):.{len(shown.partition('.')[2])}f}"
    return None if shown == measured else f"{name}, {statistic}: {shown}, measured {measured}"


def quoted(path):
    """Row, statistic and cell of the tables that name rows of the table of claims.

    A column's head says the statistic, and in code type what to append to the row's name.
    """
    for head, rows in tables(path):
        for cells in rows if "row" in head else []:
            name = cells[head.index("row")].strip("`")
            for title, cell in zip(head, cells, strict=True):
                statistic = next((s for s in STATISTICS if s in title), None)
                if statistic and cell:
                    end = re.search(r"\(`(-[^`]*)`\)", title)
                    yield name + (end[1] if end else ""), statistic, cell


@pytest.mark.parametrize("path", [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")], ids=document)
def test_figures_of_a_row_are_those_of_the_table_of_claims(path):
    problems = {problem_with_claim(*one) for one in quoted(path)} - {None}
    assert not problems, "\n".join(sorted(map(str, problems)))


def port_rows(text):
    """Port -> size and unit, of the table of output ports in a text; a row may name several."""
    table = text.split("with output ports", 1)[1].split("\n\n", 2)[1]
    rows = {}
    for line in table.splitlines()[2:]:
        names, size, unit, _ = (cell.strip() for cell in line.strip("|").split("|"))
        for name in names.replace("`", "").split(","):
            assert name.strip() not in rows, f"{name} has two rows"
            rows[name.strip()] = (size, unit)
    return rows


def test_the_page_of_results_has_the_ports_of_the_table_of_signals():
    rows = port_rows((ROOT / "docs" / "howto" / "results.md").read_text())
    assert list(rows) != [] and set(rows) == set(exported_ports())
    for name, (size, unit) in rows.items():
        assert int(size) == loop().GetOutputPort(name).size()
        units = [u for s in SIGNALS.values() if s.exported == name for u in s.quantity.units]
        expected = ", ".join("-" if u == "1" else u for u in dict.fromkeys(units))
        # The record has no accelerations, which are the end of the reference.
        assert unit == expected + (", rad/s^2, m/s^2" if name == "reference" else "")


@pytest.mark.parametrize("system", [ClosedLoop, DelayLqiController])
def test_docstrings_name_the_ports_of_the_table(system):
    ports = exported_ports() if system is ClosedLoop else ports_of("controller")
    missing = [name for name in ports if not re.search(rf"\b{name}\b", system.__doc__ or "")]
    assert not missing


def test_architecture_has_a_row_for_every_part_of_the_package():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    parts = {
        f"{path.name}/" if path.is_dir() else path.name
        for path in PACKAGE.iterdir()
        if not path.name.startswith(("_", "."))
    }
    missing = sorted(part for part in parts if f"`{part}`" not in text)
    assert not missing, f"no row in docs/architecture.md for {', '.join(missing)}"


# ------------------------------------------------------------------ claims of errata.md


def rod_lengths(pose, angles):
    """(6,) m: what the rods of the paper's machine would need with these crank angles."""
    x, y = PAPER.R_WS[:, :, 0], PAPER.R_WS[:, :, 1]
    tips = PAPER.p_WS + PAPER.crank_lengths[:, None] * (
        np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y
    )
    joints = pose[3:] + PAPER.p_PQ @ rotation(pose[:3]).T
    return np.asarray(np.linalg.norm(joints - tips, axis=1))


def test_errata_inverse_kinematics():
    """Entries 5 and 6: without |u|^2, and with acos for the angle of (B, A)."""
    pose, u, rod = PAPER.home, PAPER.crank_lengths, PAPER.rod_lengths
    L = np.einsum("li,lij->lj", pose[3:] + PAPER.p_PQ - PAPER.p_WS, PAPER.R_WS)
    A, B = 2 * u * L[:, 0], 2 * u * L[:, 1]
    right = (L**2).sum(axis=1) + u**2 - rod**2
    size = np.hypot(A, B)
    assert np.array_equal(np.sign(A), [1, -1, 1, -1, 1, -1])

    def angles(C):
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


def test_errata_desired_acceleration_is_a_disturbance():
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


def test_errata_accumulated_error_is_a_mean_over_six():
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
def test_errata_delay_destabilises_what_ignores_it(integral, exact, without_delay, delayed):
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


def test_errata_cranks_of_a_pair_intersect():
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


def test_the_site_has_every_page_once():
    def leaves(tree):
        for part in tree if isinstance(tree, list) else tree.values():
            yield from [part] if isinstance(part, str) else leaves(part)

    shown = list(leaves(load_yaml(ROOT / "mkdocs.yml")["nav"]))
    pages = {"README.md" if path == "index.md" else path for path in shown}
    assert len(pages) == len(shown)
    assert pages == {document(path).removeprefix("docs/") for path in DOCS}


RETIRED = {
    "nobody": "unknown to",
    "whatever": "any",
    "whoever": "the user who",
    "reckon": "compute",
    "let_go": "dispose",
    "so many": "a number of",
    "thereof": "of it",
    "is borne": "is tolerated",
    "one's own": "your own",
}
"""Words that readers stumbled over, and their replacements."""


def test_retired_words_stay_away():
    texts = [path for kind in ("py", "c", "h", "j2", "md") for path in PACKAGE.rglob(f"*.{kind}")]
    words = re.compile(rf"\b({'|'.join(RETIRED)})\b", re.IGNORECASE)
    found = [
        f"{document(path)}: {match[0]}; write: {RETIRED[match[0].lower()]}"
        for path in (*texts, *DOCS)
        for match in words.finditer(prose(path))
    ]
    assert not found, "\n".join(found)


def test_errata_density_is_unbounded():
    """Entry 18: 31 samples of a sine in the window of (45)."""
    error = np.sin(0.1 * np.arange(101))
    density = [31 * error[k] / error[k - 30 : k + 1].sum() for k in range(30, 101)]
    assert np.abs(density).max() == pytest.approx(92, abs=1)


def test_errata_seven_ratios_of_weights():
    """Entry 19."""
    weights = (0.1, 1.0, 4.0)
    assert len({round(q / r, 12) for q in weights for r in weights}) == 7
    assert 7 * 5 * 4 == 140


def test_errata_six_hertz_is_four():
    """Entry 20: at 10 Hz they are the same samples but for the sign."""
    t = 0.1 * np.arange(100)
    assert np.sin(2 * np.pi * 6 * t) == pytest.approx(-np.sin(2 * np.pi * 4 * t), abs=1e-12)
