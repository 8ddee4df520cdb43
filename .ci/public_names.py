"""Write stewart_drake/__init__.pyi, the public names for type checkers.

The names come from the table in stewart_drake/__init__.py. Functions whose arguments are made of
options at run time are written with their signatures.
"""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import stewart_drake as sd

STUB = Path(sd.__file__).with_name("__init__.pyi")


def text():
    lines, functions, modules = [], [], set()
    for name, module in sorted(sd._HOMES.items(), key=lambda pair: pair[::-1]):
        value = getattr(sd, name)
        made = inspect.isfunction(value) and "__signature__" in vars(value)
        # Those of another module only have another result, which type checkers see.
        if not made or value.__module__ != f"stewart_drake.{module}":
            lines.append(f"from stewart_drake.{module} import {name} as {name}")
            continue
        shown = f"def {name}{inspect.signature(value)}: ..."
        shown = shown.replace("pathlib._local.", "pathlib.")  # of Python 3.13
        shown = re.sub(r"Optional\[(Literal\[.*?\])\]", r"\1 | None", shown)
        shown = re.sub(r"(?<!typing\.)\bLiteral\[", "typing.Literal[", shown)
        modules |= set(re.findall(r"\b[a-z_.]+(?=\.[A-Z])", shown))
        functions.append(shown)
    lines += [f"from stewart_drake import {name} as {name}" for name in sd._MODULES]
    imports = [f"import {module}" for module in sorted(modules)]
    shown = "__version__: str\n"
    head = "# Written by .ci/public_names.py.\n"
    return head + "\n".join([*imports, *lines, shown, *functions])


if __name__ == "__main__":
    STUB.write_text(text())
    ruff = sys.executable, "-m", "ruff"
    subprocess.run([*ruff, "check", "-q", "--select", "I", "--fix", STUB], check=True)
    subprocess.run([*ruff, "format", "-q", STUB], check=True)
