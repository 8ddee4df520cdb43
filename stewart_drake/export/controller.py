"""Export of a scenario's controller as a folder of C, with a test that replays a run of it.

The sources are copies of those in core/ that the law uses. The configuration is generated. The test
replays inputs of the law that were recorded in Python, and compares its outputs.
"""

import math
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from functools import cache, partial
from hashlib import sha256
from importlib.metadata import distribution
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from stewart_drake.core.build import FOLDER, compiler
from stewart_drake.core.library import core
from stewart_drake.dynamics.workspace import LEAST, home_sign
from stewart_drake.export.recording import Recorded, record
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import replacing
from stewart_drake.files.yamlio import yaml_text
from stewart_drake.law.channel import Packets
from stewart_drake.law.compiled import Compiled, address_of
from stewart_drake.law.core_law import CompiledLaw
from stewart_drake.law.motion import KnownMotion
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.servos import ServoPreview
from stewart_drake.loop.controller_margin import ControllerMargin, controller_margin
from stewart_drake.loop.law_design import control_law
from stewart_drake.loop.peer import MOST_ROWS, MOST_SAMPLES, Fault, identity_of
from stewart_drake.loop.preparation import Experiment, prepare
from stewart_drake.loop.servos import servo_law
from stewart_drake.loop.tuner import weights_source
from stewart_drake.mechanism.trajectories import rows_along
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import Accepted, differing
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.scenario.timing import event_time
from stewart_drake.studies.verdict import loop_verdict
from stewart_drake.types import Array, ArrayLike

SOURCES: Final = (
    *("real.h", "short.h", "equations.h", "packets.h"),
    *("observer.h", "law.h", "legs.h", "kinematics.h"),
    *("matrix", "dynamics", "machine", "reach.c", "riccati", "design", "timeline.c"),
)
"""Sources of core/ that every law needs; a name without a suffix stands for header and source."""
LINK: Final = ("link.h", "link.c")
"""Additional sources of core/ for the machine."""
MOTION: Final = ("motion.h", "motion.c")
"""Additional sources of core/ for the scenario's motion."""
MOTION_TEMPLATES: Final = ("stewart_motion.c", "stewart_motion.h")
PROTOCOL: Final = ("protocol.h", "protocol.c")
"""Additional sources of core/ for datagrams."""
OVER_UDP: Final = (
    *("protocol_test.c", "udp.c", "udp.h"),
    *("stewart_example.c", "stewart_example.h", "stewart_udp.c"),
)
"""Templates of the controller over UDP, see `_no_udp_reason`."""
MACHINE: Final = ("stewart_machine.c", "stewart_board.c", "stewart_board.h")
"""Templates of the machine, see `_no_machine_reason`."""
DIGESTS: Final = "exported.sha256"
"""Digests of the written files, for `sha256sum -c`."""
TEMPLATES: Final = Path(__file__).with_name("templates")
README: Final = "README.md"
TOLERANCES: Final = {"double": 1e-9, "float": 1e-3}
"""Tolerance of the replay, as a share of the peak."""
MOST_IN_SINGLE: Final = 100
"""Largest number of samples of a replay in single precision.

Later errors in `gravity` over a network exceed 1e-3: half an ulp of the measured height, predicted
over the delay, times the gain, is up to 2e-3 of the peak torque.
"""


class Clock(NamedTuple):
    """Processor for which times are estimated, at one instruction per cycle."""

    name: str
    mhz: float


CLOCKS: Final = {False: Clock("Cortex-M7", 400.0), True: Clock("Cortex-M4", 168.0)}
"""By whether numbers have single precision."""
LINE: Final = 110
"""Length from which on a comment is above its line."""
MILLIONS: Final = {
    "ideal": {False: (1.99, 7.76), True: (2.24, 6.58)},
    "ideal, without estimator": {False: (1.61, 1.94), True: (1.72, 2.05)},
    "encoders": {False: (2.54, 8.17), True: (2.80, 7.02)},
    "delay estimator": {False: (2.67, 42.0), True: (2.92, 42.0)},
    "network": {False: (4.97, 5.45)},
    "servos": {False: (0.03, 0.03)},
    "servos, estimator": {False: (5.71, 136.18)},
}
"""Million instructions of a step, median and most, from the table of `make board`.

By row, and by whether numbers have single precision; a row without single precision counts for it
too. The most of a delay estimator is not in that table: it is of a new search for the delay. Servos
are those of `reachy_mini`, other rows control `paper`.
"""
STACKS: Final = {
    "ideal": 14,
    "ideal, without estimator": 13,
    "encoders": 14,
    "network": 14,
    "delay estimator": 17,
    "servos": 5,
    "servos, estimator": 14,
}
"""Stack of a step in double precision, kB, from the same table."""
TIGHT: Final = 1e-4, 0.01
"""Errors of the delay, s, and of motor gains; a warning if a loop is unstable within them."""
_MACHINE: Final[Accepted] = {
    "sensor.kind": "state",
    "actuator.kind": "torque",
    "controller.delay_estimator": "none",
}
"""Values of the fields that the machine in C supports."""
_STRUCTURE: Final = re.compile(r"^(?:typedef )?struct ?(\w*) \{\n(.*?)^\} ?(\w*);", re.M | re.S)
_FIELD: Final = re.compile(r"^    [\w ]+[ *](\w+)(?:\[[^\]]*\])*; *(/\*.*?\*/)", re.M | re.S)
"""Fields with a comment, one declared at a time."""
_UNMEASURED: Final = "Not compiled here: run `make size` and `make test`.\n"


def exported(scenario: Scenario, single: bool = False, measured: bool = True) -> dict[str, str]:
    """Return the text of the files of an export, by name.

    Args:
        single: whether numbers have single precision.
        measured: whether to judge the loop, and to compile and run the controller here, for the
            margins and the sizes in its README.
    """
    recorded, experiment = record(scenario), prepare(scenario)
    law, compiled, suffix = recorded.law, CompiledLaw(recorded.law), "f" if single else ""
    servos = isinstance(law, ServoPreview)
    source = None if isinstance(law, ServoPreview) else weights_source(experiment, law)
    tuner = None if source is None else source.compiled
    no_udp_reason = _no_udp_reason(scenario, law)
    no_machine_reason = no_udp_reason or _no_machine_reason(scenario)
    over_udp, has_motion = not no_udp_reason, not no_udp_reason or recorded.moves
    sources = _sources(compiled, tuner)
    copied = *sources, *(() if no_machine_reason else LINK), *(MOTION if has_motion else ())
    copied += PROTOCOL if over_udp else ()
    omitted = {
        *(() if over_udp else OVER_UDP),
        *(MACHINE if no_machine_reason else ()),
        *(() if has_motion else MOTION_TEMPLATES),
    }
    templates = {path.name for path in TEMPLATES.iterdir()} - omitted
    files = {name: (FOLDER / name).read_text("utf-8") for name in copied}
    package = distribution("stewart-drake")
    files["LICENSE"] = (
        package.read_text("licenses/LICENSE") or package.metadata["License-Expression"]
    )
    if single:
        del recorded.steps[MOST_IN_SINGLE:]
        defined = "#define STEWART_FLOAT\n\n#include"
        files["real.h"] = files["real.h"].replace("#include", defined, 1)
    values: dict[str, Any] = {
        "law": law,
        "scenario": scenario,
        "experiment": experiment,
        "scenario_yaml": _described(scenario),
        "version": package.version,
        "real": "float" if single else "double",
        "tolerance": f"{TOLERANCES['float' if single else 'double']:g}",
        "servos": servos,
        "encoders": scenario.sensor.kind == "encoders",
        "network": isinstance(law, PredictiveLqi) and isinstance(law.channel, Packets),
        "finds_delay": scenario.controller.delay_estimator != "none",
        "wait": law.longest_wait if isinstance(law, PredictiveLqi) else 0,
        "over_udp": over_udp,
        "no_udp_reason": no_udp_reason,
        "no_machine_reason": no_machine_reason,
        "moves": recorded.moves,
        "sampled": event_time(law.timeline.period),
        "steps": recorded.steps,
        "gap": math.floor(1e3 * recorded.gap) / 1e3,
        "queue": np.atleast_2d(recorded.first),
        "headers": [name for name in sources if name.endswith(".h") and name != "equations.h"],
        "objects": [f"{name[:-2]}.o" for name in (*sources, "stewart_config.c") if ".c" in name],
        "configuration": Constants(
            compiled.keep_alive, core().symbols, suffix, compiled.data[0], "stewart_law"
        ),
        "memory": compiled.torques_law.memory,
        "scratch": compiled.scratch,
        "sizes": compiled.torques_law,
        "tuner": None,
        "least": LEAST,
        "home_sign": home_sign(experiment.mechanism),
        "clock": CLOCKS[single],
        "single": single,
        "mechanism": Path(str(scenario.mechanism)).name,
        "machine": compiled.torques_law.machine,
        "period_ms": 1e3 * law.timeline.period,
    }
    kind = _kind(values)
    by_precision = MILLIONS[kind]
    values["millions"] = by_precision.get(single, by_precision[False])
    values["stack"] = STACKS[kind]
    values["clocked"] = "reachy_mini" if servos else "paper"
    if tuner is not None:
        values |= _tuner(tuner, compiled, recorded, experiment, suffix)
    if has_motion:
        values["motion"] = _motion(experiment, law)
    if over_udp:
        # Number of samples in memory, a power of two: those of a report and of the wait for it.
        kept = 1 << (2 * values["wait"] + 63).bit_length()
        faults = [fault.text for fault in Fault]
        values |= {"identity": identity_of(scenario), "faults": faults, "kept": kept}
    environment = _environment(suffix)
    files |= {name: environment.get_template(name).render(values) for name in templates - {README}}
    values["measured_sizes"] = _sizes(files) if measured else _UNMEASURED
    margin = controller_margin(experiment) if measured and not servos else None
    values["stability"] = "" if margin is None else loop_verdict(margin)
    values["tight"] = margin is not None and _is_tight(margin)
    return files | {README: environment.get_template(README).render(values)}


def _is_tight(margin: ControllerMargin) -> bool:
    """Return whether a small error of delay or motor gain makes a stable loop unstable."""
    delay, gain = TIGHT
    m = margin.margins
    return bool(margin.stable) and (
        margin.delay_margin < delay or m.gain_down > 1 - gain or m.gain_up < 1 + gain
    )


def _described(scenario: Scenario) -> str:
    """Return a scenario for a comment in C; its files lose their folders, which only exist here."""
    data = _without_folders(scenario_to_dict(scenario))
    return yaml_text(data).replace("*/", "* /").strip()


def _without_folders(data: Any) -> Any:
    if isinstance(data, dict):
        return {name: _without_folders(value) for name, value in data.items()}
    if isinstance(data, list):
        return [_without_folders(value) for value in data]
    return Path(data).name if isinstance(data, str) and Path(data).is_absolute() else data


def _kind(values: Mapping[str, Any]) -> str:
    """Return the row of a law in MILLIONS, from the values of the templates."""
    if values["servos"]:
        return "servos" if values["law"].observer.settings is None else "servos, estimator"
    if values["finds_delay"]:
        return "delay estimator"
    if values["network"]:
        return "network"
    if values["law"].observer.settings is None:
        return "ideal, without estimator"
    return "encoders" if values["encoders"] else "ideal"


def _environment(suffix: str) -> Environment:
    """Return the environment of the templates, with filters for arrays."""
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        variable_start_string="@",
        variable_end_string="@",
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "c": partial(numbers, suffix=suffix),
        "rows": partial(_rows, suffix=suffix),
    }
    return environment


def _no_udp_reason(scenario: Scenario, law: PredictiveLqi | ServoPreview) -> str:
    """Return the first field that the protocol does not cover, and why; empty if it covers all."""
    samples = scenario.sensor.samples or 1
    if scenario.actuator.kind == "servo":
        return "`actuator.kind: servo`: rows of a datagram have six numbers, commands have 18"
    if isinstance(law, ServoPreview) and scenario.controller.estimate:
        return "`controller.estimate`: datagrams do not report the torques of servos"
    if samples > MOST_SAMPLES:
        return f"`sensor.samples: {samples}`: a datagram has up to {MOST_SAMPLES}"
    if isinstance(law, PredictiveLqi) and isinstance(law.channel, Packets):
        rows = law.channel.repeats + law.channel.torques
        if rows > MOST_ROWS:
            return f"`controller.packet_torques`: {rows} rows; a datagram has up to {MOST_ROWS}"
    return ""


def _no_machine_reason(scenario: Scenario) -> str:
    """Return the first field that the machine in C does not support; empty if it supports all."""
    found = differing(scenario, _MACHINE)
    return f"`{found.field}: {found.got}`" if found else ""


def _sources(compiled: CompiledLaw, tuner: Compiled | None) -> list[str]:
    """Return the files of core/ that a law and its tuner need."""
    found: dict[str, None] = {}
    for name in (*SOURCES, *compiled.sources, *([] if tuner is None else ["tuner"])):
        found |= dict.fromkeys([name] if "." in name else [f"{name}.h", f"{name}.c"])
    return list(found)


def _tuner(
    tuner: Compiled, compiled: CompiledLaw, recorded: Recorded, experiment: Experiment, suffix: str
) -> dict[str, Any]:
    """Return the constants of a tuner in C, sizes of memory, and the reference of each sample."""
    c, period = core(), recorded.law.timeline.period
    arrays = [array for array in tuner.keep_alive if isinstance(array, np.ndarray)]
    times = period * np.arange(len(recorded.steps))
    return {
        "tuner": Constants(arrays, {}, suffix, tuner.pointer[0], "tuner"),
        "tuner_memory": c.lib.stewart_tuner_memory(tuner.pointer),
        "scratch": c.lib.stewart_tuned_step_scratch(compiled.data),
        "wanted": rows_along(experiment.reference, times)[:, :NUM_STATE],
    }


def _motion(experiment: Experiment, law: Any) -> "Constants":
    """Return the planned motion and the reference, a `stewart_known_motion`."""
    planned = (servo_law if isinstance(law, ServoPreview) else control_law)(experiment)[1]
    motions = planned, experiment.reference
    known = KnownMotion(*motions, 0.0).compiled()
    keep = [kept for one in motions for kept in one.keep_alive]  # type: ignore[attr-defined]
    return Constants(keep, {}, "", known[0], "motion", "double")


def _rows(rows: Iterable[Array], suffix: str) -> str:
    return ",\n    ".join(numbers(row, suffix) for row in rows)


def write(files: Mapping[str, str], folder: Path) -> list[Path]:
    """Write files to an existing folder or, on an error, none; return the paths of those written.

    Files that were `changed` since the last export are kept. Unchanged files of that export which
    this one does not have are removed.

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
    """Return the digest of each exported file in a folder, as it was at the export."""
    listed = folder / DIGESTS
    lines = listed.read_text("utf-8").splitlines() if listed.exists() else []
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


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
        said = "; ".join((done.stdout + done.stderr).splitlines())
        raise ConfigError(f"export-c: make {target} failed: {said}")
    return done.stdout.rstrip().lstrip("\n")


@cache
def _comments() -> dict[tuple[str, str], str]:
    """Return the comment of each field of the core's structures, by structure and field."""
    found = {}
    for path in sorted(FOLDER.glob("*.h")):
        for tag, body, name in _STRUCTURE.findall(path.read_text("utf-8")):
            for field, comment in _FIELD.findall(body):
                found[name or tag, field] = " ".join(comment.split())
    return found


def _explained(text: str, comment: str, indent: str) -> str:
    """Return a line of C with its comment behind it or, if that is too long, above it."""
    if not comment or len(text) + len(comment) < LINE:
        return f"{indent}{text} {comment}".rstrip()
    return f"{indent}{comment}\n{indent}{text}"


class Constants:
    """Initialiser of a C structure, and definitions of the data that it points to.

    Fields that have a comment in the core's headers have it here, too.

    Args:
        targets: arrays and C structures that a pointer may refer to.
        tables: names of the core's tables of functions, by address.
        suffix: of a number, `f` in single precision.
        prefix: beginning of the names of its targets.
        number_type: type in C of the numbers that it points to.

    Attributes:
        text: initialiser of the structure.
        before: definitions that must precede it.
    """

    def __init__(
        self,
        targets: Iterable[Any],
        tables: dict[int, str],
        suffix: str,
        data: Any,
        prefix: str,
        number_type: str = "real",
    ) -> None:
        self._tables, self._suffix, self._number_type = tables, suffix, number_type
        self._arrays, self._structures, self._defined = {}, {}, dict[int, str]()
        for target in targets:
            if isinstance(target, np.ndarray):
                self._arrays[target.ctypes.data] = target
            else:
                self._structures[address_of(target)] = target
        self.before: list[str] = []
        self.text = self._struct(data, prefix)

    def _struct(self, data: Any, name: str, indent: str = "") -> str:
        ctype, inner = core().ffi.typeof(data), indent + "    "
        structure = ctype.cname.removeprefix("struct ")
        comments = [_comments().get((structure, part), "") for part, _ in ctype.fields]
        texts = [
            f".{part} = {self._value(getattr(data, part), field.type, f'{name}_{part}', inner)}"
            for part, field in ctype.fields
        ]
        if not any(comments):
            return "{" + ", ".join(texts) + "}"
        lines = (_explained(f"{a},", b, inner) for a, b in zip(texts, comments, strict=True))
        return "{\n" + "\n".join(lines) + f"\n{indent}}}"

    def _value(self, value: Any, ctype: Any, name: str, indent: str) -> str:
        if ctype.kind == "struct":
            return self._struct(value, name, indent)
        if ctype.kind == "array":
            return "{" + ", ".join(self._value(v, ctype.item, name, indent) for v in value) + "}"
        if ctype.kind in ("pointer", "function"):
            return self._pointer(value, name)
        return number(value, self._suffix) if ctype.cname == "double" else str(int(value))

    def _pointer(self, value: Any, name: str) -> str:
        """Return the initialiser of a pointer; define its target under a name, once."""
        address = address_of(value)
        if address == 0:
            return "0"
        if address in self._tables:
            return f"&{self._tables[address]}"
        if address in self._defined:
            return self._defined[address]
        if address in self._arrays:
            values = numbers(self._arrays[address].ravel(), self._suffix)
            self.before.append(f"static const {self._number_type} {name}[] = {values};")
            return self._defined.setdefault(address, name)
        pointer = self._structures[address]
        ctype = core().ffi.typeof(pointer).item.cname
        text = self._struct(pointer[0], name)
        self.before.append(f"static const {ctype} {name} = {text};")
        return self._defined.setdefault(address, f"&{name}")


def numbers(values: ArrayLike, suffix: str) -> str:
    """Return an array as an initialiser in braces, a scalar as a number."""
    array = np.asarray(values, dtype=np.float64)
    texts = [number(value, suffix) for value in array.ravel().tolist()]
    return texts[0] if array.ndim == 0 else f"{{{', '.join(texts)}}}"


def number(value: float, suffix: str) -> str:
    """Return a number as a constant in C, exact in double precision."""
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
    return f"{value!r}{suffix}"
