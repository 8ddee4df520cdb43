"""Measure how many small faults of the package the tests find.

    python .ci/mutants.py FILE [COUNT [SEED [REF]]]    60 mutants of seed 0, of the package as it is

A mutant changes one operator, one number or one condition of a module, at random. The test files
that import the module are run against it, slow tests too, until one fails. FILE (JSON) gets one row
per mutant: where, what, the tests that were run, and whether it was found. A FILE that is there is
continued, so that the same mutants are tried again only where a row was removed. With REF the tests
of that commit are run, against the same mutants: tests that were folded must find as many.
"""

import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
SECONDS = 900
"""Time after which a mutant counts as found: it hangs."""

OPERATORS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.In: ast.NotIn,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
}


class Mutant(NamedTuple):
    path: str
    line: int
    before: str
    after: str
    source: str
    """Text of the changed module."""


def changed(node: ast.AST) -> ast.AST | None:
    """Return the node with one fault, or None where it has no place for one."""
    if isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in OPERATORS:
        node.op = OPERATORS[type(node.op)]()
        return node
    if isinstance(node, ast.Compare) and type(node.ops[0]) in OPERATORS:
        node.ops[0] = OPERATORS[type(node.ops[0])]()
        return node
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        node.value = node.value + 1 if isinstance(node.value, int) else 1.5 * node.value + 0.1
        return node
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        return node.operand
    if isinstance(node, ast.IfExp):
        node.body, node.orelse = node.orelse, node.body
        return node
    return None


def places(tree: ast.Module) -> list[ast.expr]:
    """Return all expressions that can carry a fault, outside annotations and f-strings."""
    found: list[ast.expr] = []

    def visit(node: ast.AST) -> None:
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "type_params") or isinstance(node, ast.JoinedStr):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    if isinstance(child, ast.expr):
                        found.append(child)
                    visit(child)

    visit(tree)
    return found


def draw(rng: random.Random, modules: list[Path]) -> Mutant:
    """Draw one mutant; modules are as likely as they have lines."""
    while True:
        path = rng.choices(modules, [len(m.read_text().splitlines()) for m in modules])[0]
        text = path.read_text()
        node = rng.choice(places(ast.parse(text)) or [ast.Constant(None)])
        before = ast.get_source_segment(text, node) if hasattr(node, "lineno") else None
        after = None if before is None else changed(node)
        if before is None or after is None:
            continue
        lines = text.splitlines(keepends=True)
        start = sum(len(x.encode()) for x in lines[: node.lineno - 1]) + node.col_offset
        fault = f"({ast.unparse(after)})"
        raw = text.encode()
        source = (raw[:start] + fault.encode() + raw[start + len(before.encode()) :]).decode()
        return Mutant(str(path.relative_to(ROOT)), node.lineno, before, fault, source)


def tests_of(path: str, tests: Path) -> list[str]:
    """Return the test files that import a module by its name, or a name from it."""
    module = path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
    package, _, name = module.rpartition(".")
    wanted = re.compile(
        rf"(from|import) {re.escape(module)}\b|from {re.escape(package)} import .*\b{name}\b"
    )
    return sorted(p.name for p in tests.glob("test_*.py") if wanted.search(p.read_text()))


def found(mutant: Mutant, ref: str | None) -> dict[str, object]:
    """Run the tests of a mutant's module in a copy of the repository."""
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        skipped = shutil.ignore_patterns(".git", ".venv*", "out", "__pycache__", ".*_cache")
        shutil.copytree(ROOT, copy, ignore=skipped)
        if ref is not None:
            shutil.rmtree(copy / "tests")
            files = subprocess.run(
                ["git", "archive", ref, "tests"], cwd=ROOT, check=True, capture_output=True
            )
            subprocess.run(["tar", "x"], cwd=copy, input=files.stdout, check=True)
        (copy / mutant.path).write_text(mutant.source)
        tests = tests_of(mutant.path, copy / "tests")
        row = {"path": mutant.path, "line": mutant.line, "before": mutant.before}
        row |= {"after": mutant.after, "tests": tests}
        if not tests:
            return row | {"found": False}
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not soak"]
        threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        try:
            done = subprocess.run(
                [*command, *(f"tests/{name}" for name in tests)],
                cwd=copy,
                env=os.environ | threads | {"PYTHONPATH": str(copy)},
                capture_output=True,
                text=True,
                timeout=SECONDS,
            )
        except subprocess.TimeoutExpired:
            return row | {"found": True, "by": "it hangs"}
        failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
        return row | {"found": done.returncode != 0, "by": failed.group(1) if failed else None}


def main(target: str, count: str = "60", seed: str = "0", ref: str | None = None) -> None:
    rng, out = random.Random(int(seed)), Path(target)
    modules = sorted(ROOT.glob("stewart_drake/**/*.py"))
    rows = json.loads(out.read_text()) if out.exists() else []
    tried = {(row["path"], row["line"], row["after"]) for row in rows}
    for mutant in [draw(rng, modules) for _ in range(int(count))]:
        if (mutant.path, mutant.line, mutant.after) not in tried:
            rows.append(found(mutant, ref))
            out.write_text(json.dumps(rows, indent=1))
            print(*(rows[-1].get(k) for k in ("found", "path", "line", "before", "after", "by")))
    print(f"{sum(row['found'] for row in rows)} of {len(rows)} found")


if __name__ == "__main__":
    main(*sys.argv[1:])
