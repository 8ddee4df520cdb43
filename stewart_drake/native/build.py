"""`python -m stewart_drake.native.build` compiles the C beside it, as an installation does.

The build hook loads this file by its path, before anything is installed: nothing but Python in it.
"""

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
LIBRARY = FOLDER / "_dynamics.so"
# Neither contracted to fused operations nor reordered: the numbers are those of CasADi's virtual
# machine to the last digits. Without errno and traps, which nobody reads, the compiler can do two
# legs at a time; that changes no number.
FLAGS = (
    *("-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"),
    *("-fPIC", "-shared", "-fvisibility=hidden"),
)


SOURCES = sorted(str(path) for path in FOLDER.glob("*.c"))


def source_hash() -> str:
    """Of what the library is compiled from; the library carries it."""
    sources = sorted(FOLDER.glob("*.[ch]"))
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in sources)).hexdigest()[:16]


def compiler() -> list[str] | None:
    """The command: CC, or what is there under a usual name; None without any."""
    named = shlex.split(os.environ.get("CC", ""))
    for command in [named] if named else [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]):
            return command
    return None


def compile_library(target: Path = LIBRARY) -> str | None:
    """Compile into a file; in one line why that did not work, or None."""
    command = compiler()
    if command is None:
        return "there is no C compiler"
    try:
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            made = Path(folder) / target.name
            options = [*FLAGS, f'-DSOURCE="{source_hash()}"', "-o", str(made)]
            arguments = [*command, *options, *SOURCES, "-lm"]
            done = subprocess.run(arguments, capture_output=True, text=True, errors="replace")
            if done.returncode == 0:
                os.replace(made, target)  # a process that has the former one open keeps it
                return None
    except OSError as error:
        return f"{error}"
    said = next((line for line in done.stderr.splitlines() if "error" in line), "it failed")
    return f"{shlex.join(command)}: {said}"


if __name__ == "__main__":
    sys.exit(compile_library())
