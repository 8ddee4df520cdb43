"""`python -m stewart_drake.core.build` makes the compiled core, as an installation does.

First it generates equations.h if its source has changed, and the .sdf files if one is missing; then
the library. The build hook loads this file by its path before anything is installed, so it imports
only modules of the standard library.
"""

import hashlib
import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]
LIBRARY = FOLDER / "_dynamics.so"
DECLARED = "_dynamics.cffi"
"""Python module next to the library: its declarations, as cffi loads them without a parser."""
EQUATIONS = FOLDER / "equations.h"
MODELS = ROOT / "models"
GENERATORS = ("equations", "derivatives", "generate")
"""Modules of `dynamics` that write equations.h."""

SOURCE_ONLY_HEADERS = (
    *("real.h", "equations.h", "dop853.h", "dop853_table.h"),
    *("filter_attempt.h", "legs.h", "short.h"),
)
"""Headers that Python does not use."""

# No fused operations and no reordering, so that results match CasADi's to the last digits.
# No errno or traps, so that loops over legs vectorise.
FLAGS = (
    *("-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"),
    *("-fPIC", "-shared", "-fno-semantic-interposition"),
)
_DEFINITION = r"^[a-z][\w ]+[ *](stewart_\w+)(?:\(| =)"
SOURCES = sorted(str(path) for path in FOLDER.glob("*.c"))


def source_hash() -> str:
    """Return the hash of the library's source; the library contains it."""
    return _hash(sorted(FOLDER.glob("*.[ch]")))


def equations_hash() -> str:
    """Return the hash of the sources that write equations.h; the file begins with it."""
    dynamics = FOLDER.with_name("dynamics")
    return _hash([*(dynamics / f"{name}.py" for name in GENERATORS), FOLDER / "layout.py"])


def _hash(paths: list[Path]) -> str:
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in paths)).hexdigest()[:16]


def is_generated() -> bool:
    """Check that equations.h is current and that every mechanism has its SDFormat."""
    if not EQUATIONS.exists() or equations_hash() not in EQUATIONS.read_text().partition("\n")[0]:
        return False
    return all(path.with_suffix(".sdf").exists() for path in MODELS.glob("*.yaml"))


def generate() -> None:
    """Write equations.h and models/*.sdf.

    Raises:
        CalledProcessError: what writes them failed, for want of CasADi for example.
    """
    command = [sys.executable, "-m", "stewart_drake.dynamics.generate"]
    # Keep the old PYTHONPATH: pip passes its build environment in it.
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    subprocess.run(command, check=True, cwd=ROOT, env=os.environ | {"PYTHONPATH": path})


def system_compiler() -> list[str] | None:
    """Return the command of CC, or of a usual C compiler; None without one."""
    named = shlex.split(os.environ.get("CC", ""))
    for command in [named] if named else [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]):
            return command
    return None


def compiler() -> list[str] | None:
    """Return the command of the system's C compiler, else of the package ziglang; None without.

    Zig's builds run with glibc 2.28 and later. Its checks of undefined behaviour are off, since
    they need another library.
    """
    found = system_compiler()
    if found is None and importlib.util.find_spec("ziglang") is not None:
        found = [sys.executable, "-m", "ziglang", "cc", "-fno-sanitize=undefined"]
        if sys.platform == "linux":
            found += ["-target", f"{platform.machine()}-linux-gnu.2.28"]
    return found


def declarations() -> str:
    """Return the declarations of the headers, without directives but for integer constants.

    cffi reads only `#define NAME 123`; a header writes any other constant as an enum.
    """
    headers: dict[str, str] = {}
    for path in sorted(FOLDER.glob("*.h")):
        _include(path.name, headers)
    text = "\n".join(headers.values())
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    text = re.sub(r"^static inline .*?^}\n", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"\brestrict\b|(?<=extern )const", "", text)
    lines = (line for line in text.splitlines() if not _is_directive(line))
    return "typedef double real;\n" + "\n".join(lines)


def _include(name: str, headers: dict[str, str]) -> None:
    """Add a header to the others, after those that it includes."""
    if name in headers or name in SOURCE_ONLY_HEADERS:
        return
    text = (FOLDER / name).read_text("utf-8")
    for included in re.findall(r'^#include "(.*)"', text, re.MULTILINE):
        _include(included, headers)
    headers.setdefault(name, text)


def _is_directive(line: str) -> bool:
    return line.startswith("#") and not re.fullmatch(r"#define \w+ +\d+ *", line)


def sources_of(symbols: Iterable[str]) -> list[str]:
    """Return the files that define functions or tables, with all files that these need."""
    texts = {path.name: path.read_text("utf-8") for path in sorted(FOLDER.glob("*.[ch]"))}
    code = {name: re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL) for name, text in texts.items()}
    defined = {
        symbol: name
        for name in code
        if name.endswith(".c")
        for symbol in re.findall(_DEFINITION, code[name], re.MULTILINE)
    }
    found, left = dict[str, None](), [defined[symbol] for symbol in symbols]
    while left:
        name = left.pop()
        if name not in found:
            found[name] = None
            left += re.findall(r'#include "(.*)"', code[name])
            if name.endswith(".c"):
                used = re.findall(r"\bstewart_\w+", code[name])
                left += [defined[symbol] for symbol in used if symbol in defined]
    return list(found)


def declare(target: Path) -> None:
    """Write the module of declarations, where cffi is installed."""
    if importlib.util.find_spec("cffi") is None:
        return
    from cffi import FFI

    ffi = FFI()
    ffi.set_source("declared", None, compiler_verbose=0)
    ffi.cdef(declarations())
    ffi.emit_python_code(str(target))
    with target.open("a", encoding="utf-8") as file:
        file.write(f'source = "{source_hash()}"\n')


def compile_library(target: Path = LIBRARY) -> str | None:
    """Compile into a file. Return None, or one line with the reason of a failure."""
    command = compiler()
    if command is None:
        return "no C compiler found; install one, or the Python package ziglang"
    try:
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            made = Path(folder) / target.name
            options = [*FLAGS, f'-DSOURCE="{source_hash()}"', "-o", str(made)]
            arguments = [*command, *options, *SOURCES, "-lm"]
            done = subprocess.run(arguments, capture_output=True, text=True, errors="replace")
            if done.returncode == 0:
                declare(made.with_name(DECLARED))
                for part in made.parent.iterdir():  # a process keeps the former one if open
                    os.replace(part, target.with_name(part.name))
                return None
    except OSError as error:
        return f"{error}"
    failed = f"failed with exit code {done.returncode}"
    said = next((line for line in done.stderr.splitlines() if "error" in line), failed)
    return f"{shlex.join(command)}: {said}"


if __name__ == "__main__":
    if not is_generated():
        generate()
    sys.exit(compile_library())
