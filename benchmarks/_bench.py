"""Harness of the scripts in this folder: sizes, settings that they share, parallel runs, pages.

`write` makes a page in results/ from the title, a line with the versions, and parts of Markdown.
"""

import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from threadpoolctl import threadpool_limits

from stewart_drake.files.versions import versions

threadpool_limits(limits=1)
QUICK = bool(os.environ.get("QUICK"))
"""Whether to run everything once, at the least size, as a test of the scripts."""
RESULTS = Path("out/bench") if QUICK else Path(__file__).parent / "results"
JOBS = int(os.environ.get("JOBS", "-1"))

EXACT = "plant.kind=exact"
ON = ("start=on_reference", "queue=reference")
NONE = "controller.estimate=[]"
PAYLOAD = "plant.payload_mass=0.4"
NARROW = "controller.prior={torque_bias: 0.003, payload: 0.5, damping: 0.003}"
AMPLITUDE = np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])
"""Of the reference of `paper`, rad and m."""


def with_own(law: Any, *names: str) -> Any:
    """Return a law with some parts as those of a user, which the step in C calls back."""

    def own(part: Any) -> Any:
        given = {one.name: getattr(part, one.name) for one in fields(part)}
        return type("Own", (type(part),), {})(**given)

    return replace(law, **{name: own(getattr(law, name)) for name in names})


def size(name: str, usual: int, least: int = 1) -> int:
    """Return a number of runs: the environment variable `name`, else the usual one."""
    return int(os.environ.get(name, least if QUICK else usual))


def noise(share: float, amplitude: Any = AMPLITUDE) -> str:
    """Return the setting of noise: a share of the amplitudes, per second for the rates."""
    return f"sensor.noise_std={[float(f'{share * a:.10g}') for a in np.tile(amplitude, 2)]}"


def believed(eta: float, period: float = 0.1) -> tuple[str, ...]:
    """Return the settings of a believed delay in s."""
    return delay_settings(eta, period, "controller.delay_")


def delay_settings(eta: float, period: float = 0.1, field: str = "delay.") -> tuple[str, ...]:
    """Return the settings of a delay in s."""
    steps, fraction = divmod(round(eta / period, 9), 1)
    return f"{field}steps={int(steps)}", f"{field}fraction={round(fraction, 9):.9g}"


class Push(LeafSystem):
    """Force on the plate's centre of mass; output `wrench` (6): moment (N m), force (N)."""

    def __init__(self, force: Sequence[float], span: tuple[float, float]) -> None:
        super().__init__()
        self.force, self.span = force, span
        self.DeclareVectorOutputPort("wrench", 6, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        pushed = self.span[0] <= context.get_time() < self.span[1]
        output.SetFromVector([0.0] * 3 + [float(f) if pushed else 0.0 for f in self.force])


class CpuTime:
    """Replacement of the module `time` in which a step of the law is timed."""

    perf_counter = staticmethod(time.thread_time)


def in_parallel(function: Callable[..., Any], cases: Iterable[tuple[Any, ...]]) -> list[Any]:
    """Call a function with each case, on all cores; return the results in order."""
    return Parallel(n_jobs=JOBS)(delayed(function)(*case) for case in cases)


def grouped(
    function: Callable[..., Any], rows: Mapping[Any, Sequence[tuple[Any, ...]]]
) -> dict[Any, list[Any]]:
    """Call a function with the cases of all rows; return the results by row."""
    found = iter(in_parallel(function, [case for cases in rows.values() for case in cases]))
    return {name: [next(found) for _ in cases] for name, cases in rows.items()}


def table(header: Sequence[str], rows: Iterable[Sequence[object]], rule: str = "---") -> str:
    """Return a table in Markdown; `rule` is below each head."""
    lines = [header, [rule] * len(header), *rows]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)


def section(title: str, *parts: str) -> str:
    """Return a heading with text and tables below it."""
    return "\n".join([f"## {title}\n", *(part.rstrip("\n") + "\n" for part in parts)])


def write(script: str, title: str, parts: Iterable[str], more: str = "") -> None:
    """Print a page and write it: the script and versions (and `more`), then its parts.

    Args:
        script: `__file__` of the script; the page has its name.
    """
    packages = ", ".join(f"{package} {number}" for package, number in versions().items())
    name = Path(script).stem
    pieces = [f"# {title}\n\nMade by `python benchmarks/{name}.py` with {packages}{more}.\n"]
    for part in parts:
        pieces.append(part.rstrip("\n") + "\n")
        print(pieces[-1], flush=True)
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{name}.md").write_text("\n".join(pieces), encoding="utf-8")


def run_sections(script: str, title: str, sections: Mapping[str, Callable[[], str]]) -> None:
    """Write the page of all sections, or print those named on the command line.

    Args:
        script, title: as of `write`.
        sections: makers of the texts, by name.
    """
    if chosen := sys.argv[1:]:
        for name in chosen:
            print(sections[name](), flush=True)
    else:
        write(script, title, (make() for make in sections.values()))
