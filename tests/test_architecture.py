"""Rules about the code base itself.

The checkers are functions of source text; the first half of the file applies them to the package,
the second to small samples that break each rule.
"""

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = "stewart_drake"
ROOT = Path(__file__).resolve().parents[1]
MAX_LINES = 60
"""Of a function without its docstring: a screen. Files are as long as their idea."""

# Imports go one way: a room sees itself and those above it.
ROOMS = (
    "types",
    "files",
    "scenario",
    "mechanism",
    "native",
    "dynamics",
    "law",
    "tuner",
    "loop",
    "identification",
    "studies",
    "tuning",
    "reporting",
    "export",
    "live",
    "cli",
)
RANK = {name: number for number, name in enumerate(ROOMS)}

PURE = ("mechanism", "native", "dynamics", "law", "tuner", "identification")
FRAMEWORK = ("pydrake.systems.framework", "pydrake.all")
CONNECTS = ("loop.diagram", "loop.law_design", "loop.platforms")
SEES_PUBLIC_NAMES = ("cli",)  # may import the package itself


# ---------------------------------------------------------------- the checkers


@dataclass(frozen=True)
class Import:
    """One imported name, in full: `from a.b import c` is `a.b.c`."""

    name: str
    line: int
    at_import: bool  # runs when the module is imported: not in a function, not for typing only
    lazy: bool  # in a function


def _runs_at_import(ancestors: list[ast.AST], node: ast.AST) -> bool:
    child = node
    for parent in reversed(ancestors):
        if isinstance(parent, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            return False
        if (
            isinstance(parent, ast.If)
            and ast.unparse(parent.test).endswith("TYPE_CHECKING")
            and child in parent.body
        ):
            return False
        child = parent
    return True


def _walk(node: ast.AST, ancestors: list[ast.AST]) -> Iterator[tuple[ast.AST, list[ast.AST]]]:
    yield node, ancestors
    for child in ast.iter_child_nodes(node):
        yield from _walk(child, [*ancestors, node])


def _base(node: ast.ImportFrom, module: str, is_package: bool) -> str:
    """The absolute name of the module behind `from`."""
    if not node.level:
        return node.module or ""
    up = node.level - 1 if is_package else node.level
    parts = module.split(".")
    return ".".join([*parts[: len(parts) - up], *([node.module] if node.module else [])])


def imports(source: str, module: str, is_package: bool = False) -> list[Import]:
    """Everything `source` imports, `importlib.import_module("...")` included."""
    found = []
    for node, ancestors in _walk(ast.parse(source), []):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = _base(node, module, is_package)
            names = [f"{base}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and node.args:
            function = ast.unparse(node.func).rpartition(".")[2]
            argument = node.args[0]
            if function in ("import_module", "__import__") and isinstance(argument, ast.Constant):
                names = [str(argument.value)]
        at_import = bool(names) and _runs_at_import(ancestors, node)
        lazy = any(isinstance(a, ast.FunctionDef | ast.AsyncFunctionDef) for a in ancestors)
        found += [Import(name, getattr(node, "lineno", 0), at_import, lazy) for name in names]
    return found


def _within(name: str, module: str) -> bool:
    return name == module or name.startswith(module + ".")


def wrong_way_imports(source: str, module: str, is_package: bool = False) -> list[str]:
    """Imports against the order of ROOMS."""
    if module == PACKAGE:  # it gathers the public names
        return []
    own = module.split(".")[1]
    if own not in RANK:
        return [f"{module} is in no room"]
    problems = []
    for found in imports(source, module, is_package):
        if not _within(found.name, PACKAGE):
            continue
        other = [*found.name.split("."), ""][1]
        if other not in RANK:
            if own not in SEES_PUBLIC_NAMES:
                problems.append(f"{module}:{found.line} imports {found.name}, not in ROOMS")
        elif RANK[other] > RANK[own]:
            problems.append(f"{module}:{found.line} imports {found.name}, which is below it")
    return problems


def framework_imports(source: str, module: str, is_package: bool = False) -> list[str]:
    """Imports of Drake's systems framework in a package of pure mathematics."""
    if module.split(".")[1:2] not in [[name] for name in PURE]:
        return []
    return [
        f"{module}:{found.line} imports {found.name}"
        for found in imports(source, module, is_package)
        if any(_within(found.name, name) for name in FRAMEWORK)
    ]


def torch_imports(source: str, module: str, is_package: bool = False) -> list[str]:
    """Imports of torch outside tuning/, or before a function asks for it."""
    return [
        f"{module}:{found.line} imports {found.name}"
        for found in imports(source, module, is_package)
        if _within(found.name, "torch")
        and (found.at_import or not _within(module, f"{PACKAGE}.tuning"))
    ]


def star_imports(source: str, module: str, is_package: bool = False) -> list[str]:
    """`from x import *`."""
    return [
        f"{module}:{found.line} imports {found.name}"
        for found in imports(source, module, is_package)
        if found.name.endswith(".*")
    ]


def connect_calls(source: str, module: str, is_package: bool = False) -> list[str]:
    """Calls of `Connect` outside the modules that build diagrams."""
    if module in [f"{PACKAGE}.{name}" for name in CONNECTS]:
        return []
    return [
        f"{module}:{node.lineno} calls {ast.unparse(node.func)}"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr == "Connect"
    ]


def _lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Without the docstring, and without classes that are defined inside."""
    lines = (function.end_lineno or 0) - function.lineno + 1
    inside = [node for node in function.body if isinstance(node, ast.ClassDef)]
    if ast.get_docstring(function) is not None:
        inside.append(function.body[0])  # type: ignore[arg-type]
    return lines - sum((node.end_lineno or 0) - node.lineno + 1 for node in inside)


def too_long(source: str, module: str, is_package: bool = False) -> list[str]:
    """Functions over MAX_LINES."""
    return [
        f"{module}:{node.lineno} {node.name} has {_lines(node)} lines"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and _lines(node) > MAX_LINES
    ]


def _needs_docstring(node: ast.AST) -> bool:
    if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        return False
    overrides_drake = node.name.startswith("Do") and node.name[2:3].isupper()
    decorators = {ast.unparse(d).rpartition(".")[2] for d in node.decorator_list}
    says_nothing_new = decorators & {"setter", "deleter", "overload", "override"}
    return not (node.name.startswith("_") or overrides_drake or says_nothing_new)


def undocumented(source: str, module: str, is_package: bool = False) -> list[str]:
    """Public functions, classes and methods of public classes that have no docstring."""
    problems = []

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.If | ast.Try | ast.With):
                visit([n for n in ast.iter_child_nodes(node) if isinstance(n, ast.stmt)], prefix)
            if not _needs_docstring(node):
                continue
            assert isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            if not (ast.get_docstring(node) or "").strip():
                problems.append(f"{module}:{node.lineno} {prefix}{node.name} has no docstring")
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}{node.name}.")

    visit(ast.parse(source).body, "")
    return problems


def cycle(sources: dict[str, tuple[str, bool]]) -> list[str]:
    """The modules of one import cycle, or nothing; `sources` is module: (source, is_package).

    Imports for typing count, those in functions do not.
    """
    graph: dict[str, set[str]] = {}
    for module, (source, is_package) in sources.items():
        if module == PACKAGE:  # it gathers the public names
            continue
        names = [i.name for i in imports(source, module, is_package) if not i.lazy]
        known = {
            name if name in sources else name.rpartition(".")[0]  # a module, or a name in one
            for name in names
        }
        graph[module] = known & sources.keys() - {module}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


# ---------------------------------------------------------------- the package


def package_sources() -> dict[str, tuple[str, bool]]:
    sources = {}
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        if path.name == "__main__.py":
            continue  # which starts the command
        parts = path.relative_to(ROOT).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        module = ".".join(parts[:-1] if is_package else parts)
        sources[module] = (path.read_text(encoding="utf-8"), is_package)
    return sources


def test_every_room_is_there():
    assert {module.split(".")[1] for module in package_sources() if "." in module} == set(RANK)


@pytest.mark.parametrize(
    "checker",
    [
        wrong_way_imports,
        framework_imports,
        torch_imports,
        star_imports,
        connect_calls,
        too_long,
        undocumented,
    ],
)
def test_package_keeps_the_rule(checker):
    sources = package_sources()
    assert sources, "no source files found"
    problems = [
        problem
        for module, (source, is_package) in sources.items()
        for problem in checker(source, module, is_package)
    ]
    assert not problems, "\n".join(problems)


def test_package_has_no_import_cycle():
    assert not cycle(package_sources())


def test_importing_the_package_leaves_torch_out():
    code = f"import sys, {PACKAGE}; sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr or "torch was imported"


# ---------------------------------------------------------------- the checkers on bad samples


def names(source: str, module: str = "stewart_drake.loop.exact", is_package: bool = False):
    return [found.name for found in imports(source, module, is_package)]


def test_imports_are_found_in_every_form():
    assert names("import a.b as c") == ["a.b"]
    assert names("from a.b import c, d") == ["a.b.c", "a.b.d"]
    assert names("from . import x") == ["stewart_drake.loop.x"]
    assert names("from ..law.riccati import gain") == ["stewart_drake.law.riccati.gain"]
    assert names("from . import x", "stewart_drake.loop", is_package=True) == [
        "stewart_drake.loop.x"
    ]
    assert names("import importlib\nimportlib.import_module('torch')") == ["importlib", "torch"]
    assert names("def f():\n    if True:\n        import a") == ["a"]


@pytest.mark.parametrize(
    ("source", "at_import"),
    [
        ("import torch", True),
        ("try:\n    import torch\nexcept ImportError:\n    pass", True),
        ("class C:\n    import torch", True),
        ("if TYPE_CHECKING:\n    pass\nelse:\n    import torch", True),
        ("if typing.TYPE_CHECKING:\n    import torch", False),
        ("def f():\n    import torch", False),
        ("class C:\n    def f(self):\n        from torch import nn", False),
    ],
)
def test_import_time_is_told_from_later(source, at_import):
    (found,) = imports(source, "stewart_drake.tuning.training")
    assert found.at_import is at_import
    assert bool(torch_imports(source, "stewart_drake.tuning.training")) is at_import
    assert torch_imports(source, "stewart_drake.tuner.network")


def test_imports_against_the_order_are_found():
    def wrong(module, source):
        return bool(wrong_way_imports(source, module))

    assert wrong("stewart_drake.mechanism.geometry", "from stewart_drake.loop import x")
    assert wrong("stewart_drake.mechanism.geometry", "def f():\n    from ..cli import main")
    assert wrong("stewart_drake.files.yamlio", "import stewart_drake.scenario.config")
    assert wrong("stewart_drake.files.yamlio", "from stewart_drake import scenario")
    assert wrong("stewart_drake.reporting.html", "import stewart_drake as sd")
    assert wrong("stewart_drake.reporting.html", "from stewart_drake import simulate")
    assert wrong("stewart_drake.misplaced", "")
    assert not wrong("stewart_drake.law.riccati", "from stewart_drake.mechanism import load")
    assert not wrong("stewart_drake.law.riccati", "from .limits import x")
    assert not wrong(
        "stewart_drake.scenario.signals", "import numpy\nfrom stewart_drake.files import errors"
    )
    assert not wrong("stewart_drake.cli", "import stewart_drake as sd")
    assert not wrong("stewart_drake", "from stewart_drake.cli import main")


def test_the_framework_is_found_in_pure_packages_only():
    for source in (
        "from pydrake.systems.framework import LeafSystem",
        "from pydrake.systems import framework",
        "def f():\n    import pydrake.systems.framework",
        "from pydrake.all import Simulator",
    ):
        for package in PURE:
            assert framework_imports(source, f"stewart_drake.{package}.any")
            assert framework_imports(source, f"stewart_drake.{package}", is_package=True)
        assert not framework_imports(source, "stewart_drake.loop.exact")
    assert not framework_imports("import pydrake.math", "stewart_drake.law.riccati")


def test_connect_calls_are_found_outside_the_diagram():
    source = "def f(builder, a, b):\n    builder.Connect(a, b)\n"
    assert connect_calls(source, "stewart_drake.loop.sensor")
    assert connect_calls(source, "stewart_drake.studies.diagram")
    assert not connect_calls(source, "stewart_drake.loop.diagram")
    assert not connect_calls("# b.Connect(x)\n'b.Connect(x)'", "stewart_drake.loop.sensor")


def test_long_functions_and_star_imports_are_found():
    body = "    x = 1\n" * (MAX_LINES - 1)
    assert not too_long(f"def f():\n{body}", "m")
    assert too_long(f"def f():\n    x = 1\n{body}", "m")
    assert not too_long(f"def f():\n    'd'\n{body}", "m")
    assert not too_long(f"def f():\n    class C:\n        x = 1\n{body}", "m")
    assert star_imports("from pydrake.all import *", "m")
    assert not star_imports("from pydrake.math import wrap_to", "m")


@pytest.mark.parametrize(
    ("source", "missing"),
    [
        ("def f(): pass", ["f"]),
        ("async def f(): pass", ["f"]),
        ("class C:\n    def m(self): pass", ["C", "C.m"]),
        ("class C:\n    'd'\n    @property\n    def p(self): return 1", ["C.p"]),
        ("if x:\n    def f(): pass\nelse:\n    def g(): pass", ["f", "g"]),
        ("def f():\n    ''", ["f"]),
        ("def _f(): pass\nclass _C:\n    def m(self): pass", []),
        ("def f():\n    'd'\n    def inner(): pass", []),
        ("class C:\n    'd'\n    def __init__(self): pass\n    def DoIt(self): pass", []),
        ("class C:\n    'd'\n    @p.setter\n    def p(self, v): pass", []),
    ],
)
def test_missing_docstrings_are_found(source, missing):
    assert [problem.split()[1] for problem in undocumented(source, "m")] == missing


def test_import_cycles_are_found():
    def modules(**sources):
        return {f"stewart_drake.{name}": (source, False) for name, source in sources.items()}

    a_imports_b = "from stewart_drake.b import f"
    assert cycle(modules(a=a_imports_b, b="from stewart_drake import a"))
    assert cycle(modules(a=a_imports_b, b="from .c import f", c="import stewart_drake.a"))
    assert cycle(modules(a=a_imports_b, b="if TYPE_CHECKING:\n    from stewart_drake import a"))
    assert not cycle(modules(a=a_imports_b, b="def f():\n    from stewart_drake import a"))
    assert not cycle(modules(a=a_imports_b, b="import numpy"))
