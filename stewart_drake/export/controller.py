"""Export of a scenario's controller as a folder of C, with a test that replays a run of it.

The sources are copies of those in core/ that the law uses. The configuration is generated, and so
are the recorded inputs and outputs of the law in Python, for the test.
"""

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import numpy as np
from jinja2 import Environment, StrictUndefined

from stewart_drake.core.build import FOLDER, compiler
from stewart_drake.core.library import core
from stewart_drake.dynamics.workspace import LEAST, home_sign
from stewart_drake.export.recording import TOLERANCE, Recorded, knots, record
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import replacing
from stewart_drake.law.compiled import Compiled, address_of
from stewart_drake.law.core_law import CompiledLaw
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.law_design import control_law
from stewart_drake.loop.peer import FAULTS, identity_of
from stewart_drake.loop.preparation import Experiment, prepare
from stewart_drake.loop.tuner import weights_source
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_yaml
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array, ArrayLike

SOURCES: Final = (
    *("real.h", "short.h", "equations.h", "packets.h"),
    *("observer.h", "law.h", "legs.h", "kinematics.h"),
    *("matrix", "dynamics", "machine", "reach.c", "riccati", "design", "timeline.c"),
)
"""Sources of core/ that every law needs; a name without a suffix stands for header and source."""
MACHINE: Final = ("link.h", "link.c")
"""Additional sources of core/ for the example of a machine."""
EXAMPLES: Final = (
    *("protocol.c", "protocol.h", "protocol_test.c", "udp.c", "udp.h"),
    *("stewart_example.c", "stewart_example.h", "stewart_machine.c", "stewart_udp.c", *MACHINE),
    *("stewart_board.c", "stewart_board.h"),
)
"""Sources of the examples over UDP, see `_is_example`."""
DIGESTS: Final = "exported.sha256"
"""Digests of the written files, for `sha256sum -c`."""
TEMPLATES: Final = Path(__file__).with_name("templates")
TOLERANCES: Final = {"double": 1e-9, "float": 1e-3}
"""Tolerance of the replay, as a share of the peak."""
_README: Final = Environment(
    variable_start_string="@",
    variable_end_string="@",
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_UNMEASURED: Final = "Not compiled here: run `make size` and `make test`.\n"


def exported(scenario: Scenario, single: bool = False, measured: bool = True) -> dict[str, str]:
    """Return the text of the files of an export, by name.

    Args:
        scenario: whose controller it is.
        single: whether numbers have single precision.
        measured: whether to compile and run it here, for the sizes in its README.
    """
    recorded, experiment = record(scenario), prepare(scenario)
    compiled, suffix = CompiledLaw(recorded.law), "f" if single else ""
    law, tuner = recorded.law, None
    if isinstance(law, PredictiveLqi):
        source = weights_source(experiment, law)
        tuner = None if source is None else source.compiled
    files = {name: (FOLDER / name).read_text("utf-8") for name in _sources(compiled, tuner)}
    if single:
        defined = "#define STEWART_FLOAT\n\n#include"
        files["real.h"] = files["real.h"].replace("#include", defined, 1)
    over_udp = _is_example(recorded, tuner)
    values = {
        "SCENARIO": scenario_yaml(scenario).replace("*/", "* /").strip(),
        "PERIOD": f"{law.timeline.period:g}",
        "TOLERANCE": f"{TOLERANCES['float' if single else 'double']:g}",
        "REAL": "float" if single else "double",
        "ESTIMATES": _estimates(scenario),
        "OWN_WEIGHTS": numbers(experiment.scenario.controller.weights, suffix),
        "TESTS": "stewart_test protocol_test" if over_udp else "stewart_test",
        "TEST_OBJECTS": "stewart_motion.o" if recorded.moves else "",
    }
    values |= _workspace(experiment)
    values |= _configuration(recorded, compiled, tuner, suffix)
    values |= _replay(recorded, experiment, tuner, suffix)
    kind = "torques" if isinstance(law, PredictiveLqi) else "servos"
    names = {path.name for path in TEMPLATES.iterdir() if not path.name.startswith("replay_")}
    if over_udp or recorded.moves:
        values |= _example_data(experiment, recorded, suffix)
    else:
        names -= {"stewart_motion.c", "stewart_motion.h"}
    if over_udp:
        files |= {name: (FOLDER / name).read_text("utf-8") for name in MACHINE}
    else:
        names -= set(EXAMPLES)
    texts = {name: (TEMPLATES / name).read_text("utf-8") for name in sorted(names)}
    texts["replay.h"] = (TEMPLATES / f"replay_{kind}.h").read_text("utf-8")
    readme = _README.from_string(texts.pop("README.md"))
    files |= {name: _filled(text, values) for name, text in texts.items()}
    values["SIZES"] = _sizes(files) if measured else _UNMEASURED
    kinds = {
        "servos": kind == "servos",
        "tuned": tuner is not None,
        "over_udp": over_udp,
        "moves": recorded.moves,
        "law": law,
        "scenario": scenario,
    }
    return files | {"README.md": readme.render(values | kinds)}


def _estimates(scenario: Scenario) -> str:
    names = [name.replace("_", " ") for name in scenario.controller.estimate]
    if scenario.controller.delay_estimator != "none":
        names.append("delay")
    return ", ".join(names) or "no parameters"


def _workspace(experiment: Experiment) -> dict[str, str]:
    """Return the limits of `stewart_measures`, to three digits."""
    names = {"LEAST_SINE": LEAST[0], "LEAST_PARALLEL": LEAST[-2], "LEAST_PITCH": LEAST[-1]}
    sign = {"SIGN": f"{home_sign(experiment.mechanism):g}"}
    return {name: f"{value:.3g}" for name, value in names.items()} | sign


def _is_example(recorded: Recorded, tuner: Compiled | None) -> bool:
    """Return whether the examples over UDP support this law.

    They have a measured state, a known delay, fixed weights, and one torque per sample.
    """
    law = recorded.law
    if not isinstance(law, PredictiveLqi) or tuner is not None or law.finds_delay:
        return False
    return law.sensing.size == NUM_STATE and law.channel.torques == 1


def _sources(compiled: CompiledLaw, tuner: Compiled | None) -> list[str]:
    """Return the files of core/ that a law and its tuner need."""
    found: dict[str, None] = {}
    for name in (*SOURCES, *compiled.sources, *([] if tuner is None else ["tuner"])):
        found |= dict.fromkeys([name] if "." in name else [f"{name}.h", f"{name}.c"])
    return list(found)


def objects(files: Mapping[str, str]) -> list[str]:
    """Return the objects of the controller in an export, as its Makefile names them."""
    found = re.search(r"^STEWART = (.*)$", files["Makefile"], re.MULTILINE)
    assert found is not None
    return found[1].split()


def _configuration(
    recorded: Recorded, compiled: CompiledLaw, tuner: Compiled | None, suffix: str
) -> dict[str, str]:
    """Return the constants of a law in C, and the sizes of its memory."""
    written = Constants(compiled.keep, compiled.tables, suffix)
    torques, c = isinstance(recorded.law, PredictiveLqi), core()
    text = written.struct(compiled.data[0], "stewart_law")
    law = compiled.data if torques else compiled.data.law
    sources = _sources(compiled, tuner)
    headers = (name for name in sources if name.endswith(".h") and name != "equations.h")
    made = [name.replace(".c", ".o") for name in sources if name.endswith(".c")]
    queue = np.atleast_2d(recorded.first)
    values = {
        "INCLUDES": "\n".join(f'#include "{name}"' for name in headers),
        "HEADER": "law.h" if torques else "servo.h",
        "OBJECTS": " ".join([*made, "stewart_config.o"]),
        "KIND": "stewart_law" if torques else "stewart_servo",
        "CONFIGURATION": text,
        "MEMORY": str(compiled.data.memory),
        "SCRATCH": str(compiled.scratch),
        "ROWS": str(law.rows),
        "MEASURED": str(law.measured),
        "QUEUE": numbers(queue if queue.size else [0.0], suffix),
        "QUEUE_ROWS": str(len(queue) if queue.size else 0),
        "QUEUE_MEANING": (
            "torques under way at the start, the oldest first"
            if torques
            else "the command that was sent last"
        ),
        "TUNER": "",
        "TUNER_DECLARATION": "",
    }
    if tuner is not None:
        kept = [array for array in tuner.keeps if isinstance(array, np.ndarray)]
        own = Constants(kept, {}, suffix)
        text = own.struct(tuner.it[0], "tuner")
        lines = [*own.before, f"const stewart_tuner stewart_own_tuner = {text};"]
        values["TUNER"] = "\n" + "\n".join(lines)
        values["TUNER_DECLARATION"] = (
            "extern const stewart_tuner stewart_own_tuner;\n#define STEWART_TUNER_MEMORY "
            f"{c.lib.stewart_tuner_memory(tuner.it)} /* numbers that the tuner remembers */\n"
        )
        values["HEADER"] = "tuner.h"
        values["SCRATCH"] = str(c.lib.stewart_tuned_step_scratch(compiled.data))
    return values | {"CONSTANTS": "\n".join(written.before)}


def _replay(
    recorded: Recorded, experiment: Experiment, tuner: Compiled | None, suffix: str
) -> dict[str, str]:
    """Return the recorded steps that the test replays."""
    steps, period = recorded.steps, recorded.law.timeline.period
    rows = partial(_rows, suffix=suffix)
    values = {
        "STEPS": str(len(steps)),
        "MEASUREMENT": rows(step.measurement for step in steps),
        "AGE": ", ".join(str(step.age) for step in steps),
        "STATUS": ", ".join(str(step.status) for step in steps),
        "ANSWERS": rows(step.answer for step in steps),
        "PREVIEW_ROWS": rows(step.preview for step in steps),
        "UNIT": "N m",
    }
    if not isinstance(recorded.law, PredictiveLqi):
        reports = [np.asarray(step.report) for step in steps]
        size = {"REPORT_SIZE": str(reports[0].size), "SERVO_REPORTS": rows(reports)}
        return values | size | {"UNIT": "rad, rad/s or N m"}
    wanted = (evaluate(experiment.reference, k * period)[:NUM_STATE] for k in range(len(steps)))
    return values | {
        "WEIGHTS": rows(step.weights for step in steps),
        "SENT": rows(step.sent for step in steps),
        "TORQUES": str(recorded.law.channel.torques),
        "REPORTS": _reports([step.report for step in steps], suffix),
        "MOVES": str(int(recorded.moves)),
        "TUNED": str(int(tuner is not None)),
        "WANTED": "" if tuner is None else rows(wanted),
    }


def _reports(reports: list[Any], suffix: str) -> str:
    """Return the reports of a run in C, and the function that returns the k-th one."""
    head = "static const stewart_report *report_of(int k)"
    if not any(reports):
        return f"{head}\n{{\n    (void)k;\n    return NULL;\n}}\n"
    lines, rows = [], []
    for k, report in enumerate(reports):
        if report is None:
            rows.append("{0, 0, 0, 0, -1}")
            continue
        arrived, acted = report.arrived.astype(float), report.acted
        lines += [f"static const real arrived_{k}[] = {numbers(arrived, suffix)};"]
        lines += [f"static const real acted_{k}[] = {numbers(acted.ravel(), suffix)};"]
        sizes = len(arrived), len(acted)
        rows.append(f"{{{sizes[0]}, arrived_{k}, {sizes[1]}, acted_{k}, {report.age}}}")
    table = ",\n    ".join(rows)
    lines += [f"static const stewart_report reports[STEPS] = {{\n    {table}}};\n", head]
    return "\n".join([*lines, "{\n    return reports[k].age < 0 ? NULL : &reports[k];\n}\n"])


def _example_data(experiment: Experiment, recorded: Recorded, suffix: str) -> dict[str, str]:
    """Return the data of the scenario that the examples need."""
    scenario = experiment.scenario
    rows = recorded.motion
    if rows is None:
        motion, times = control_law(experiment)[1], recorded.law.preview_times
        rows = knots(motion, scenario.duration + max(0.0, float(times.max())))
    return {
        "DURATION": repr(float(scenario.duration)),
        "START": numbers(experiment.start, suffix),
        "LEAST": numbers(LEAST, suffix),
        "HOME_SIGN": numbers(home_sign(experiment.mechanism), suffix),
        "IDENTITY": ",\n    ".join(
            f'{{{{{", ".join(f"0x{b:02x}" for b in part.digest)}}}, "{part.name}"}}'
            for part in identity_of(scenario)
        ),
        "FAULTS": ",\n    ".join(
            f'"{words.replace("{:", "%").replace("}", "")}"' for words in FAULTS.values()
        ),
        "KNOTS": str(len(rows)),
        "MOTION": _rows(rows),
        "GOAL": _goal(recorded.goal),
        "MOTION_TOLERANCE": f"{TOLERANCE:g}",
    }


def _rows(rows: Iterable[Array], suffix: str = "") -> str:
    return ",\n    ".join(numbers(row, suffix) for row in rows)


def _goal(rows: Array | None) -> str:
    if rows is None:
        return "void stewart_goal(double t, real *reference) { stewart_reference(t, reference); }\n"
    number = len(rows)
    return (
        f"\nstatic const double goal[{number}][1 + STEWART_REFERENCE] = {{\n"
        f"    {_rows(rows)}}};\n\n"
        f"void stewart_goal(double t, real *reference) {{ along({number}, goal, t, reference); }}\n"
    )


def write(files: Mapping[str, str], folder: Path) -> list[Path]:
    """Write files to an existing folder or, on an error, none; return the paths of the written.

    Files that were `changed` since the last export are kept, others that this export has not are
    removed.

    Raises:
        ConfigError: another file would be replaced that no export has written.
    """
    before, kept = _digests(folder), changed(folder)
    for name, text in files.items():
        path = folder / name
        if name not in before and path.exists() and path.read_bytes() != text.encode():
            raise ConfigError(
                f"{path}: no export has written it; expected another folder, or one of an export "
                "of this version"
            )
    after = {name: before[name] for name in kept}
    after |= {name: sha256(text.encode()).hexdigest() for name, text in files.items()}
    listed = "".join(f"{digest}  {name}\n" for name, digest in after.items())
    written = {name: text for name, text in files.items() if name not in kept} | {DIGESTS: listed}
    with ExitStack() as replacements:
        for name, text in written.items():
            replacements.enter_context(replacing(folder / name)).write_text(text, "utf-8")
    for name in before.keys() - after.keys():
        (folder / name).unlink(missing_ok=True)
    return [folder / name for name in written]


def changed(folder: Path) -> list[str]:
    """Return the names of the exported files in a folder that were changed since their export."""
    return [
        name
        for name, digest in _digests(folder).items()
        if (folder / name).is_file() and sha256((folder / name).read_bytes()).hexdigest() != digest
    ]


def _digests(folder: Path) -> dict[str, str]:
    """Return the digest of each exported file in a folder, as it was written."""
    listed = folder / DIGESTS
    lines = listed.read_text("utf-8").splitlines() if listed.exists() else []
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def _filled(text: str, values: Mapping[str, str]) -> str:
    """Replace each @NAME@ that has a value."""
    return re.sub(r"@([A-Z_]+)@", lambda found: values.get(found[1], found[0]), text)


def _sizes(files: Mapping[str, str]) -> str:
    """Return the output of `make size` and `make test`, or without a compiler how to get it."""
    command = compiler()
    if command is None or shutil.which("make") is None:
        return _UNMEASURED
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files.items():
            Path(folder, name).write_text(text, "utf-8")
        outputs = [_make(folder, command, target) for target in ("size", "test")]
    return "```text\n" + "\n".join(outputs) + "\n```\n"


def _make(folder: str, command: Iterable[str], target: str) -> str:
    environment: dict[str, Any] = os.environ | {"LC_ALL": "C"}
    arguments = ["make", "-s", target, f"CC={' '.join(command)}"]
    done = subprocess.run(
        arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise ConfigError(f"export-c: make {target} failed: {done.stdout}{done.stderr}".strip())
    return done.stdout.strip()


# ---------------------------------------------------------------- structures as text


class Constants:
    """Initialisers of C structures, and definitions of the data that they point to.

    Args:
        keep: arrays and C structures that a pointer may refer to.
        tables: names of the core's tables of functions, by address.
        suffix: of a number, `f` in single precision.

    Attributes:
        before: definitions that must precede the initialisers.
    """

    def __init__(self, keep: Iterable[Any], tables: dict[int, str], suffix: str) -> None:
        self._tables, self._suffix = tables, suffix
        self._arrays, self._structures = {}, {}
        for kept in keep:
            if isinstance(kept, np.ndarray):
                self._arrays[kept.ctypes.data] = kept
            else:
                self._structures[address_of(kept)] = kept
        self.before: list[str] = []

    def struct(self, data: Any, about: str) -> str:
        fields = core().ffi.typeof(data).fields
        parts = (
            f".{name} = {self._value(getattr(data, name), field.type, f'{about}_{name}')}"
            for name, field in fields
        )
        return "{" + ", ".join(parts) + "}"

    def _value(self, value: Any, kind: Any, about: str) -> str:
        if kind.kind == "struct":
            return self.struct(value, about)
        if kind.kind == "array":
            return "{" + ", ".join(self._value(v, kind.item, about) for v in value) + "}"
        if kind.kind in ("pointer", "function"):
            return self._pointed(value, about)
        return number(value, self._suffix) if kind.cname == "double" else str(int(value))

    def _pointed(self, value: Any, about: str) -> str:
        """Return the initialiser of a pointer, and define its target."""
        address = address_of(value)
        if address == 0:
            return "0"
        if address in self._tables:
            return f"&{self._tables[address]}"
        if address in self._arrays:
            values = numbers(self._arrays[address].ravel(), self._suffix)
            self.before.append(f"static const real {about}[] = {values};")
            return about
        pointer = self._structures[address]
        kind = core().ffi.typeof(pointer).item.cname
        text = self.struct(pointer[0], about)
        self.before.append(f"static const {kind} {about} = {text};")
        return f"&{about}"


def numbers(values: ArrayLike, suffix: str) -> str:
    """Return an array as an initialiser in braces, a scalar as a number."""
    array = np.asarray(values, dtype=np.float64)
    found = [number(value, suffix) for value in array.ravel().tolist()]
    return found[0] if array.ndim == 0 else f"{{{', '.join(found)}}}"


def number(value: float, suffix: str) -> str:
    """Return a number in C, exact in double precision."""
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
    return f"{value!r}{suffix}"
