"""The exported C on a microcontroller's compiler and library: arm-none-eabi-gcc and newlib."""

import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

from tests.test_export_c import exported, made

COMPILER: Final = "arm-none-eabi-gcc"
CORTEX_M7: Final = f"{COMPILER} -mcpu=cortex-m7 -mthumb -mfpu=fpv5-d16 -mfloat-abi=hard"
CORTEX_M4: Final = f"{COMPILER} -mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard"
CONTROLLER: Final = ("dynamics.o", "riccati.o", "law.o", "stewart_config.o")
BESIDE: Final = ("stewart_motion.o", "protocol.o", "stewart_test.o", "protocol_test.o")
"""What else needs no more than the standard library."""


@pytest.fixture(autouse=True)
def newlib() -> None:
    if shutil.which(COMPILER) is None or shutil.which("make") is None:
        pytest.skip(f"there is no {COMPILER} (Debian: gcc-arm-none-eabi), or no make")
    source = "#include <math.h>\n"
    command = [COMPILER, "-E", "-x", "c", "-o", "/dev/null", "-"]
    if subprocess.run(command, input=source.encode(), capture_output=True).returncode != 0:
        pytest.skip("there is no newlib (Debian: libnewlib-arm-none-eabi)")


@pytest.mark.slow
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
@pytest.mark.parametrize("name", ["paper", "gravity"])
def test_it_compiles_without_a_warning(name: str, single: bool, tmp_path: Path) -> None:
    """In single precision nothing of the controller is computed in double."""
    settings = ("controller.estimate=[]",) if single else ()
    folder = exported(tmp_path, name, (*settings, "duration=0.5"), single)
    compiler = f"CC={CORTEX_M4 if single else CORTEX_M7}"
    made(folder, " ".join(BESIDE), compiler)  # warnings are errors
    made(folder, " ".join(CONTROLLER), compiler, "CFLAGS=-O2 -Wdouble-promotion -Wundef")
    if single:
        listed = subprocess.run(
            ["arm-none-eabi-nm", "-u", *CONTROLLER], cwd=folder, capture_output=True, text=True
        )
        assert listed.returncode == 0 and "sinf" in listed.stdout
        assert "__aeabi_d" not in listed.stdout, "a double is computed in software on a Cortex-M4"
