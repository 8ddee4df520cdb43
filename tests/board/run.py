"""Replay exported controllers on emulated Cortex-M processors and count instructions: `make board`.

QEMU counts instructions, not cycles: it emulates neither caches nor the latency of an operation.
Writes the table in docs/howto/board.md. The exit status is 0 where every replay is within the
tolerance of its export and every step within the bounds of its row.
"""

import re
import shlex
import shutil
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from stewart_drake.export import controller as export_c
from stewart_drake.scenario.loading import load_scenario

HERE: Final = Path(__file__).parent
PAGE: Final = HERE.parents[1] / "docs" / "howto" / "board.md"
MARKS: Final = ("<!-- make board -->\n", "\n<!-- end of make board -->")
PACKAGES: Final = {
    "qemu-system-arm": "qemu-system-arm",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "make": "make",
}
"""Debian's packages of each command."""
OPTIMISED: Final = "-O2"
HEADER: Final = (
    *("controller", "processor", "flash, kB", "state, B", "workspace, B", "stack, B"),
    *("million instructions per step, median", "most", "most, ms", "error / peak"),
)


@dataclass(frozen=True)
class Processor:
    """A processor that QEMU emulates, and the compiler's options for it."""

    name: str
    machine: str
    options: str
    single: bool

    def ms(self, million: float) -> float:
        """Return the time of a number of instructions, as an export's README estimates it."""
        return 1e3 * million / export_c.CLOCKS[self.single].mhz


M7: Final = Processor("M7", "mps2-an500", "-mcpu=cortex-m7 -mfpu=fpv5-d16 -mfloat-abi=hard", False)
M4: Final = Processor(
    "M4", "mps2-an386", "-mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -mfloat-abi=hard", True
)


@dataclass(frozen=True)
class Row:
    """A controller on a processor.

    Attributes:
        name: in the table.
        settings: of the scenario; the plant is exact.
        median, most: bounds of a step, in million instructions.
        workspace: bound, in bytes.
        scenario, controller: names; None is the scenario's own controller.
    """

    name: str
    processor: Processor
    settings: tuple[str, ...] = ()
    median: float = float("inf")
    most: float = float("inf")
    workspace: float = float("inf")
    scenario: str = "paper"
    controller: str | None = None


OUTLIERS: Final = "sensor.faults=[{kind: spike, size: 0.02, share: 0.3, from: 3.0, to: 10.0}]"
FOLLOWS: Final = ("start=on_reference", "queue=reference")  # so that no plan is made in flight
WITHOUT: Final = ("controller.estimate=[]",)
ENCODERS: Final = ("sensor.kind=encoders",)
DELAY: Final = ("controller.delay_estimator=constant", "controller.delay_steps=6")
NETWORK: Final = ("link.kind=network", "link.loss=0.1")
SHORT: Final = ("duration=2.0",)
SERVOS: Final = {"scenario": "reachy_mini"}
LEARNS: Final = {**SERVOS, "controller": "servo_feedforward"}
ROWS: Final = (
    Row("ideal", M7, median=2.1, workspace=67248),
    Row("ideal, outliers", M7, (*FOLLOWS, OUTLIERS), most=5),
    Row("ideal, without estimator", M7, WITHOUT),
    Row("ideal, without estimator", M4, WITHOUT, median=1.8),
    Row("ideal", M4, median=4),
    Row("encoders", M7, ENCODERS, median=4),
    Row("encoders", M4, ENCODERS),
    Row("delay estimator", M7, DELAY, most=20),
    Row("delay estimator", M4, DELAY),
    Row("network", M7, NETWORK),
    Row("servos", M7, SHORT, **SERVOS),
    Row("servos, estimator", M7, SHORT, **LEARNS),
)


@dataclass(frozen=True)
class Counted:
    """Measurements of a replay on a board."""

    flash: int
    state: int
    workspace: int
    stack: int
    median: float
    most: float
    error: float
    period: float  # of the controller, ms


def missing() -> list[str]:
    """Return the Debian packages of missing programs."""
    packages = [package for command, package in PACKAGES.items() if shutil.which(command) is None]
    if shutil.which("arm-none-eabi-gcc") is not None:
        command = "arm-none-eabi-gcc -E -x c -o /dev/null -"
        done = subprocess.run(
            shlex.split(command), input=b"#include <math.h>\n", capture_output=True
        )
        if done.returncode != 0:
            packages.append("libnewlib-arm-none-eabi")
    return packages


def made(folder: Path, target: str, **variables: str) -> str:
    """Return what make prints.

    Raises:
        SystemExit: it fails, with what it printed.
    """
    command = ["make", "-s", *target.split(), *(f"{k}={v}" for k, v in variables.items())]
    done = subprocess.run(
        command, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        sys.exit(f"{shlex.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout


def counted(row: Row, folder: Path) -> Counted:
    """Export, compile without a warning, and replay."""
    processor = row.processor
    settings = ("plant.kind=exact", *row.settings)
    scenario = load_scenario(row.scenario, row.controller, settings)
    export_c.write(export_c.exported(scenario, processor.single, measured=False), folder)
    for name in ("startup", "meter"):
        shutil.copy(HERE / f"{name}.c", folder / f"board_{name}.c")
    compiler = f"arm-none-eabi-gcc -mthumb {processor.options}"
    link = f"-nostartfiles --specs=rdimon.specs -T {HERE / 'mps2.ld'}"
    emulator = (
        f"qemu-system-arm -M {processor.machine} -icount shift=0 -display none -monitor none "
        "-serial none -semihosting-config enable=on,target=native -kernel"
    )
    sizes = made(
        *(folder, "size"),
        CC=compiler,
        SIZE="arm-none-eabi-size",
        CFLAGS=f"{OPTIMISED} -Wdouble-promotion -Wundef",
    ).splitlines()
    flash = sum(int(size) for size in sizes[-1].split()[:2])  # text and data of the totals
    objects = [line.split()[-1] for line in sizes[1:-1]]
    listed = subprocess.check_output(["arm-none-eabi-nm", "-u", *objects], cwd=folder, text=True)
    if processor.single and "__aeabi_d" in listed:
        sys.exit(f"{row.name}: computes a double in software\n{listed}")
    motion = [folder / f"{name}.c" for name in ("stewart_motion", "motion")]
    examples = [path.with_suffix(".o").name for path in motion if path.exists()]
    made(folder, " ".join(["board_startup.o", *examples]), CC=compiler, CFLAGS=OPTIMISED)
    said = made(
        folder,
        "test",
        CC=f"{compiler} {link} -Wl,board_startup.o",
        CFLAGS=f"{OPTIMISED} -DREPEATS=1",
        METER="board_meter.o",
        EMULATOR=emulator,
    )
    steps = re.findall(r"^step \d+: instructions (\d+), stack (\d+) B$", said, re.MULTILINE)
    instructions = [int(number) / 1e6 for number, _ in steps]
    return Counted(
        flash,
        int(said.split("state ")[1].split()[0]),
        int(said.split("workspace ")[1].split()[0]),
        max(int(depth) for _, depth in steps),
        statistics.median(instructions),
        max(instructions),
        float(said.split("largest error ")[1].split()[0]),
        1e3 * scenario.controller.period,
    )


def cells(row: Row, found: Counted) -> list[str]:
    """Return the cells of a row; steps that take longer than the period are bold."""
    sizes, ms = (found.state, found.workspace, found.stack), row.processor.ms
    steps = (f"{found.median:.2f}", f"{found.most:.2f}", f"{ms(found.most):.0f}")
    late = (ms(million) > found.period for million in (found.median, found.most, found.most))
    return [
        *(row.name, row.processor.name, f"{found.flash / 1000:.1f}"),
        *(str(size) for size in sizes),
        *(f"**{text}**" if long else text for text, long in zip(steps, late, strict=True)),
        f"{found.error:.0e}",
    ]


def beyond(row: Row, found: Counted) -> list[str]:
    """Return a line for each bound of a row that is exceeded."""
    return [
        f"{row.name}, {row.processor.name}: {name} is {getattr(found, name):.5g}, bound {bound:g}"
        for name in ("median", "most", "workspace")
        if not getattr(found, name) <= (bound := getattr(row, name))
    ]


def main() -> int:
    """Replay every row, print the table and write it into the page."""
    packages = missing()
    if packages:
        print(f"make board: missing, expected from apt-get install {' '.join(packages)}")
        return 1
    lines = [f"| {' | '.join(HEADER)} |", "|---|---|" + "---:|" * (len(HEADER) - 2)]
    exceeded: list[str] = []
    print("\n".join(lines), flush=True)
    for row in ROWS:
        with tempfile.TemporaryDirectory() as folder:
            found = counted(row, Path(folder))
        lines.append(f"| {' | '.join(cells(row, found))} |")
        print(lines[-1], flush=True)
        exceeded += beyond(row, found)
    text = PAGE.read_text("utf-8")
    before, rest = text.split(MARKS[0])
    table = "\n".join(("", *lines, ""))
    PAGE.write_text(f"{before}{MARKS[0]}{table}{MARKS[1]}{rest.split(MARKS[1])[1]}", "utf-8")
    print("\n".join(exceeded), end="\n" if exceeded else "")
    return 1 if exceeded else 0


if __name__ == "__main__":
    sys.exit(main())
