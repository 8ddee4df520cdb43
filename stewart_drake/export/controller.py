"""The controller of a scenario as a folder of C, with a test that replays a run of it.

The sources are those of core/, as they are; what is written here is what they are compiled with:
the size of their arrays, the configuration, and what the law in Python was given and answered.
"""

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stewart_drake.core.build import FOLDER, compiler
from stewart_drake.core.law_layout import CONFIG_FIELDS, CONFIG_FLAGS
from stewart_drake.dynamics.workspace import LEAST, home_sign
from stewart_drake.export.motion import TOLERANCE, knots
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import replacing
from stewart_drake.law.channel import Report
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import Motion
from stewart_drake.law.native_law import configuration, uncovered
from stewart_drake.law.observers import NoObserver
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.experiment import prepare
from stewart_drake.loop.law_design import control_law
from stewart_drake.loop.peer import FAULTS, identity_of
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_yaml
from stewart_drake.types import Array

SOURCES: Final = (
    *("stewart_limits.h", "real.h", "scratch.h", "matrix.h", "dynamics.h", "equations.h"),
    *("riccati.h", "stewart.h", "workspace.h"),
    *("matrix.c", "dynamics.c", "riccati.c", "law.c"),
)
CONTROLLER: Final = (*(name for name in SOURCES if name.endswith(".c")), "stewart_config.c")
"""What is compiled of them, with the configuration."""
MACHINE: Final = ("link.h", "link.c")
"""What the example of a machine takes beside those."""
TEMPLATES: Final = Path(__file__).with_name("templates")
MOST_SAMPLES: Final = 100
"""Of a run that the test replays."""
TOLERANCES: Final = {"double": 1e-9, "float": 1e-2}
"""Of the torque that the replay may differ by, as a share of its peak."""
_UNMEASURED: Final = "It was not compiled where it was written: `make size` and `make test` tell.\n"


class Step(NamedTuple):
    """What one sample was given and came to."""

    measurement: Array
    age: int
    preview: Array
    weights: Array
    torque: Array
    sent: Array
    status: int


@dataclass(frozen=True)
class RecordedLqi(PredictiveLqi):
    """A law, in Python, that remembers what it was asked since its memory was begun.

    Attributes:
        steps: of it.
        queue: that it began with.
    """

    steps: list[Step] = field(default_factory=list)
    queue: list[Array] = field(default_factory=list)

    def initial_memory(self, queue: Array) -> Memory:
        """Begins anew."""
        self.steps.clear()
        self.queue[:] = [queue]
        return super().initial_memory(queue)

    def step(
        self,
        memory: Memory,
        measurement: Measurement,
        motion: Motion,
        weights: Array,
        report: Report | None = None,
    ) -> Memory:
        """See `PredictiveLqi.step`."""
        after = super().step(memory, measurement, motion, weights, report)
        if len(self.steps) < MOST_SAMPLES:
            said = measurement.after(np.full(self.sensing.size, np.nan))
            new = np.subtract(after.counts, memory.counts)
            step = Step(
                said,
                round(measurement.age / self.timeline.period),
                motion(self.preview_times),
                weights,
                after.torque,
                after.in_flight[-1],
                int(new @ 2 ** np.arange(len(new))),
            )
            self.steps.append(step)
        return after


def recorded_law(scenario: Scenario) -> RecordedLqi:
    """Return the law of a scenario, with what it did in a run on the exact plant.

    The test replays the controller. The steps of a *multibody* plant are an error that some stable
    loops, such as that of `gravity`, cannot correct.

    Raises:
        ConfigError: it has what the law in C has not, naming the field; or bad input.
    """
    found: list[RecordedLqi] = []

    def recorded(law: PredictiveLqi) -> PredictiveLqi:
        problem = uncovered(law)
        if problem is not None:
            raise ConfigError(
                f"{problem}: is not exported as it is; expected what predictor_lqi has, whose "
                "torques go over a wire"
            )
        parts = {f.name: getattr(law, f.name) for f in fields(law)}
        found.append(RecordedLqi(**parts))
        return found[-1]

    exact = replace(scenario, plant=replace(scenario.plant, kind="exact"))
    result = simulate(exact, modify_law=recorded, judge_stability=False)
    if result.failure is not None:
        raise ConfigError(
            f"scenario: {result.failure}; expected one whose run the test can replay to its end"
        )
    return found[-1]


def exported(scenario: Scenario, single: bool = False, measured: bool = True) -> dict[str, str]:
    """Name -> text of the files of an export.

    Args:
        scenario: whose controller it is.
        single: numbers of single precision.
        measured: whether it is compiled and run here, for what its README tells.

    Raises:
        ConfigError: see `recorded_law`; single precision with the estimator.
    """
    if single and scenario.controller.estimate:
        raise ConfigError(
            f"controller.estimate: got {scenario.controller.estimate} with --single; expected "
            "[], or double precision: the filter's covariance needs it"
        )
    law = recorded_law(scenario)
    suffix = "f" if single else ""
    files = {name: (FOLDER / name).read_text("utf-8") for name in SOURCES}
    files["stewart_limits.h"] = _limits(files["stewart_limits.h"], law, single)
    values = {
        "OBJECTS": " ".join(name.replace(".c", ".o") for name in CONTROLLER),
        "SCENARIO": scenario_yaml(scenario).replace("*/", "* /").strip(),
        "STEPS": str(len(law.steps)),
        "PREVIEW": str(len(law.preview_times)),
        "PERIOD": f"{law.timeline.period:g}",
        "TOLERANCE": f"{TOLERANCES['float' if single else 'double']:g}",
        "REAL": "float" if single else "double",
        "ESTIMATES": "no" if isinstance(law.observer, NoObserver) else "yes",
    }
    values["CONFIGURATION"] = _configuration(law, suffix)
    values |= _surroundings(scenario, law, suffix)
    values["QUEUE"] = _list(law.queue[0] if law.queue[0].size else [0.0], suffix)
    for name in ("measurement", "preview", "weights", "torque", "sent"):
        rows = [_list(getattr(step, name), suffix) for step in law.steps]
        values["PREVIEW_ROWS" if name == "preview" else name.upper()] = ",\n    ".join(rows)
    for name in ("age", "status"):
        values[name.upper()] = ", ".join(str(getattr(step, name)) for step in law.steps)
    files |= {name: (FOLDER / name).read_text("utf-8") for name in MACHINE}
    for path in sorted(TEMPLATES.iterdir()):
        files[path.name] = _filled(path.read_text("utf-8"), values)
    files["README.md"] = _filled(
        files["README.md"], {"SIZES": _sizes(files) if measured else _UNMEASURED}
    )
    return files


def _surroundings(scenario: Scenario, law: RecordedLqi, suffix: str) -> dict[str, str]:
    """What the examples over UDP know of the scenario beside the controller."""
    experiment = prepare(scenario)
    motion, c = control_law(experiment)[1], scenario.controller
    rows = knots(motion, scenario.duration + max(0.0, float(law.preview_times.max())))
    return {
        "DURATION": repr(float(scenario.duration)),
        "OWN_WEIGHTS": _list([c.w_Q, c.w_R], suffix),
        "START": _list(experiment.start, suffix),
        "LEAST": _list(LEAST, suffix),
        "HOME_SIGN": _list(home_sign(experiment.mechanism), suffix),
        "QUEUE_ROWS": str(len(law.queue[0])),
        "IDENTITY": ",\n    ".join(
            f'{{{{{", ".join(f"0x{b:02x}" for b in part.digest)}}}, "{part.name}"}}'
            for part in identity_of(scenario)
        ),
        "FAULTS": ",\n    ".join(
            f'"{words.replace("{:", "%").replace("}", "")}"' for words in FAULTS.values()
        ),
        "KNOTS": str(len(rows)),
        "MOTION": ",\n    ".join(_list(row, "") for row in rows),
        "MOTION_TOLERANCE": f"{TOLERANCE:g}",
    }


def write(files: Mapping[str, str], folder: Path) -> list[Path]:
    """All of them or, on an error, none; the folder is there."""
    paths = [folder / name for name in files]
    with ExitStack() as all_of_them:
        for path, text in zip(paths, files.values(), strict=True):
            all_of_them.enter_context(replacing(path)).write_text(text, "utf-8")
    return paths


def _limits(text: str, law: PredictiveLqi, single: bool) -> str:
    wanted = {"STEWART_MAX_QUEUE": max(1, law.timeline.queue_length), "STEWART_MAX_KEPT": law.kept}
    for name, value in wanted.items():
        text = re.sub(rf"(#define {name}) \d+", rf"\1 {value}", text)
    return text.replace("\n#define", "\n#define STEWART_FLOAT\n#define", 1) if single else text


def _configuration(law: PredictiveLqi, suffix: str) -> str:
    config = configuration(law)
    lines = [f".{name} = {_list(config[name], suffix)}" for name in CONFIG_FIELDS]
    lines += [f".{name} = {int(config[name])}" for name in CONFIG_FLAGS]
    return ",\n    ".join(lines)


def _list(values: ArrayLike, suffix: str) -> str:
    array = np.asarray(values, dtype=np.float64)
    numbers = [_number(value, suffix) for value in array.ravel().tolist()]
    return numbers[0] if array.ndim == 0 else f"{{{', '.join(numbers)}}}"


def _number(value: float, suffix: str) -> str:
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
    return f"{value!r}{suffix}"


def _filled(text: str, values: Mapping[str, str]) -> str:
    """With each @NAME@ that has a value in its place."""
    return re.sub(r"@([A-Z_]+)@", lambda found: values.get(found[1], found[0]), text)


def _sizes(files: Mapping[str, str]) -> str:
    """What `make test` and `make size` say here, or how to find out."""
    command = compiler()
    if command is None or shutil.which("make") is None:
        return _UNMEASURED
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files.items():
            Path(folder, name).write_text(text, "utf-8")
        said = [_made(folder, command, target) for target in ("size", "test")]
    return "```text\n" + "\n".join(said) + "\n```\n"


def _made(folder: str, command: Iterable[str], target: str) -> str:
    surroundings: dict[str, Any] = os.environ | {"LC_ALL": "C"}
    arguments = ["make", "-s", target, f"CC={' '.join(command)}"]
    done = subprocess.run(
        arguments, cwd=folder, env=surroundings, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise ConfigError(f"export-c: make {target} failed: {done.stdout}{done.stderr}".strip())
    return done.stdout.strip()
