"""Rules about the code base that neither ruff nor import-linter (pyproject.toml) can check."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "stewart_drake"
CONNECTING = ("loop/diagram.py", "loop/law_design.py", "loop/platforms.py")
"""The modules that build diagrams."""


def test_diagrams_are_connected_in_one_place():
    calls = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if ".Connect(" in path.read_text(encoding="utf-8")
    }
    assert calls == set(CONNECTING)


def test_importing_the_package_leaves_torch_and_drake_out():
    code = "import sys, stewart_drake; sys.exit(bool({'torch', 'pydrake'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr or "torch or pydrake was imported"
