"""Write stewart_drake/__init__.pyi, which tells type checkers the public names.

The names come from the table in stewart_drake/__init__.py. The functions of analyses, which are
made at run time, are written with their signatures.
"""

import inspect
import re
import subprocess
from pathlib import Path

import stewart_drake as sd
from stewart_drake.reporting.analyses import ANALYSES, words_of

STUB = Path(sd.__file__).with_name("__init__.pyi")


def text():
    made = {"_".join(words_of(name)) for name in ANALYSES}
    lines, functions, modules = [], [], set()
    for name, module in sorted(sd._HOMES.items(), key=lambda pair: pair[::-1]):
        if name not in made:
            lines.append(f"from stewart_drake.{module} import {name} as {name}")
            continue
        shown = f"def {name}{inspect.signature(getattr(sd, name))}: ..."
        shown = shown.replace("pathlib._local.", "pathlib.")  # of Python 3.13
        modules |= set(re.findall(r"\b[a-z_.]+(?=\.[A-Z])", shown))
        functions.append(shown)
    lines += [f"from stewart_drake import {name} as {name}" for name in sd._MODULES]
    imports = [f"import {module}" for module in sorted(modules)]
    shown = f"__version__: str\n__all__ = {sd.__all__!r}\n"
    head = "# Written by .ci/public_names.py.\n"
    return head + "\n".join([*imports, *lines, shown, *functions])


if __name__ == "__main__":
    STUB.write_text(text())
    subprocess.run(["ruff", "check", "-q", "--select", "I", "--fix", STUB], check=True)
    subprocess.run(["ruff", "format", "-q", STUB], check=True)
