"""Random files: what comes out of a loader is the thing itself or a one-line ConfigError.

Briefly here; `make soak` goes on for five minutes with fresh seeds. What it finds becomes a case
of the tables in test_bad_input.py and test_bad_files.py.
"""

import dataclasses
import io
import json
import random
import resource
import shutil
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.reporting.csv_file import read_signals, signals_csv
from stewart_drake.scenario.loading import load_controller, load_scenario
from stewart_drake.scenario.reference_config import CsvConfig, WaypointsConfig
from stewart_drake.scenario.reference_files import read_csv, read_waypoints
from stewart_drake.scenario.trajectories import evaluate, make_reference
from stewart_drake.studies.families import paper_grid
from stewart_drake.studies.jobs import _check_manifest, settings_hash
from stewart_drake.studies.runs import read_outcome
from stewart_drake.tuner.network import load_network, save_network
from stewart_drake.tuning.data import assemble, data_hash, load_data, read_condition
from stewart_drake.tuning.training import labels
from tests.copies import copied
from tests.faults import yaml_text
from tests.mutations import (
    NASTY,
    json_bytes,
    other_netcdf,
    other_npz,
    sealed,
    spoiled_bytes,
    spoiled_document,
    yaml_bytes,
)
from tests.test_bad_files import SAMPLES, WAYPOINTS
from tests.test_bad_input import PAPER, WITH_LEGS
from tests.test_network import small_network

SOAK_SECONDS = 300.0

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(-(10**400), 10**400)
    | st.floats()
    | st.text(max_size=8)
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=7) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)
SCENARIO = {
    "duration": 1.0,
    "reference": {"kind": "sine", "amplitude": [0.1] * 6, "offset": [0.0] * 6, "frequency": 1.0},
    "plant": {"kind": "exact", "gravity": True, "torque_bias": [0.0] * 6},
    "delay": {"steps": 3, "fraction": 0.5},
    "controller": {"period": 0.1, "delay_steps": None, "catch_up": 0.3},
    "sensor": {"noise_std": [0.0] * 12, "seed": 1},
}
YAML_TEXT = st.text(alphabet="ab:0123456789.[]{}-,&*!<>|%?#'\"\\\n\t ~\0\u2028é\ud800", max_size=80)
CSV_TEXT = st.text(alphabet='0123456789.,-+enaif"\n\r\0 _;x[]', max_size=120)


def places(document: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The way to everything inside nested dicts and lists."""
    items: Any = ()
    if isinstance(document, dict):
        items = document.items()
    elif isinstance(document, list):
        items = enumerate(document)
    return [at, *(way for key, value in items for way in places(value, (*at, key)))]


def changed(document: Any, way: tuple[Any, ...], value: Any) -> Any:
    """A copy with what is at the end of `way` replaced."""
    if not way:
        return value
    copy = dict(document) if isinstance(document, dict) else list(document)
    copy[way[0]] = changed(copy[way[0]], way[1:], value)
    return copy


@st.composite
def mutants(draw: Any, documents: list[Any]) -> Any:
    """A good document with one to three parts replaced by anything."""
    document = draw(st.sampled_from(documents))
    for _ in range(draw(st.integers(1, 3))):
        document = changed(document, draw(st.sampled_from(places(document))), draw(VALUES))
    return document


@st.composite
def spoiled(draw: Any, text: str) -> bytes:
    """A good text with a piece taken out, doubled, or replaced by anything."""
    raw = text.encode()
    start = draw(st.integers(0, len(raw)))
    end = draw(st.integers(start, min(len(raw), start + 20)))
    middle = draw(st.binary(max_size=6) | st.just(raw[start:end] * 2) | CSV_TEXT.map(str.encode))
    return raw[:start] + middle + raw[end:]


def loads_or_refuses(load: Callable[[Path], Any], path: Path, content: bytes | str) -> Any:
    """What the file is, or None where it is refused in one line."""
    raw = content if isinstance(content, bytes) else content.encode(errors="surrogatepass")
    path.write_bytes(raw)
    try:
        return load(path)
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1 and str(error).startswith(str(path))
        return None


NETWORK: dict[str, Any] = {}


def network() -> dict[str, Any]:
    """A good network as plain data, made once."""
    if not NETWORK:
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            save_network(small_network(2), Path(folder) / "n.json")
            NETWORK.update(json.loads((Path(folder) / "n.json").read_text()))
    return NETWORK


def motion(path: Path) -> Any:
    """A CSV file all the way to a reference, which must be finite."""
    read_csv(path)
    trajectory = make_reference(CsvConfig(file=str(path)), 0.1)
    assert all(abs(value) < 1e12 for value in evaluate(trajectory, 0.05))
    return trajectory


FUZZERS: dict[str, tuple[Callable[[Path], Any], str, Any]] = {
    "scenario": (load_scenario, "f.yaml", mutants([SCENARIO]).map(yaml_text)),
    "scenario text": (load_scenario, "f.yaml", YAML_TEXT | st.binary(max_size=60)),
    "controller": (load_controller, "f.yaml", mutants([SCENARIO["controller"]]).map(yaml_text)),
    "mechanism": (load_mechanism, "f.yaml", mutants([PAPER, WITH_LEGS]).map(yaml_text)),
    "mechanism text": (load_mechanism, "f.yaml", spoiled(yaml_text(PAPER))),
    "waypoints": (read_waypoints, "f.yaml", spoiled(WAYPOINTS)),
    "csv": (motion, "f.csv", spoiled(SAMPLES)),
    "csv rows": (motion, "f.csv", CSV_TEXT.map(lambda text: SAMPLES[:53] + text)),
    "weights": (load_network, "f.json", mutants([network()]).map(json.dumps)),
    "weights text": (load_network, "f.json", st.deferred(lambda: spoiled(json.dumps(network())))),
}


def fuzz(name: str, folder: Path, examples: int, number: int | None = None) -> None:
    """Try so many files of one kind; with a number as seed, else with the project's usual ones."""
    load, file, contents = FUZZERS[name]

    def attempt(content: bytes | str) -> None:
        loads_or_refuses(load, folder / file, content)

    checked = settings(
        max_examples=examples, deadline=None, suppress_health_check=list(HealthCheck)
    )(given(content=contents)(attempt))
    (checked if number is None else seed(number)(checked))()


@pytest.mark.parametrize("name", FUZZERS)
def test_a_random_file_loads_or_is_refused(name, tmp_path):
    fuzz(name, tmp_path, examples=40)


@pytest.mark.soak
def test_five_minutes_of_random_files(tmp_path):
    end, number = time.monotonic() + SOAK_SECONDS, 0
    while time.monotonic() < end:
        for name in FUZZERS:
            fuzz(name, tmp_path, examples=100, number=number)
        number += 1


# ---------------------------------------------------------------- files of every kind, guarded

FILES = 2000
"""Of each kind, in `make soak`."""
PATIENCE = 180.0
"""s that one file may take on a machine that has much else to do."""
ROOM = 2_000_000_000
"""Bytes beyond what the process has that reading a file may take."""
LONGEST = 700
"""Letters of a message, the path aside."""


class Kind(NamedTuple):
    """How files of a kind are read, and where damaged ones come from."""

    read: Callable[[Path], Any]
    file: str
    good: Callable[[Path], bytes]
    other: Callable[[random.Random], bytes] | None = None
    """Sound files of another content; None: those of `document`."""
    document: Any = None
    write: Callable[[Any, random.Random], bytes] = json_bytes
    briefly: int = 30
    """Files of this kind in the ordinary tests."""


def exported(path: Path) -> None:
    """Signals all the way to a table."""
    rows = signals_csv(read_signals(path)).splitlines()
    assert len({row.count(",") for row in rows}) == 1


def read_one_run(path: Path) -> dict[str, Any]:
    """The file of a condition with one gain."""
    return read_condition(path, 1)


def labelled(path: Path) -> None:
    data = load_data(path)
    data_hash(data)
    labels(data, "best_in_cell_torque")


def resumed(path: Path) -> None:
    """The manifest of a folder that is gone on with."""
    _check_manifest(path.parent, MANIFEST_SETTINGS, ".none")


def waypoint_motion(path: Path) -> None:
    make_reference(WaypointsConfig(file=str(path)), 0.1)


def mechanism_loads(path: Path) -> None:
    load_mechanism(path)


MANIFEST_SETTINGS = {"scenario": {"duration": 1.0, "poses": [[0.0] * 6]}, "seed": 0}
MANIFEST_FILE = {"hash": settings_hash(MANIFEST_SETTINGS), "settings": MANIFEST_SETTINGS}
OUTCOME = {"status": "completed", "reason": "", "leg": None, "time": None, "error": 9.1}
RUN_FILE = {
    "draw": {"payload": 0.1},
    "outcome": {**OUTCOME, "peak_torque": 0.6, "tuner_fallbacks": 2},
}
RUN_ARRAYS = {
    "samples": np.zeros((1, 100, 18)),
    "health": np.zeros((1, 100, 18), dtype=np.float32),
    "status": np.array(["completed"]),
    "stopped": np.array([np.nan]),
    **dict.fromkeys(("J", "accumulated_error", "cost", "rms_torque"), np.ones(1)),
    **dict.fromkeys(("peak_torque", "torque_variation"), np.full(1, 2.0)),
}


def npz_of_a_run() -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **RUN_ARRAYS)  # type: ignore[arg-type]
    return stream.getvalue()


@lru_cache(maxsize=1)
def some_signals() -> xr.Dataset:
    """Of a short run."""
    settings = ("plant.kind=exact", "duration=0.1", "start=on_reference", "queue=reference")
    return sd.simulate(sd.load_scenario("paper", settings=settings), judge_stability=False).signals


@lru_cache(maxsize=1)
def some_data() -> xr.Dataset:
    """A data set of two runs."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.npz"
        path.write_bytes(npz_of_a_run())
        grid = paper_grid(load_scenario("paper", "delay_lqi"))
        some = dict(list(grid.conditions.items())[:2])
        family = dataclasses.replace(grid, conditions=some, gains={"wQ1_wR1": (1.0, 1.0)})
        settings = {"data": "paper", "scenario": {}}
        return assemble(family, dict.fromkeys(some, read_one_run(path)), settings)


def netcdf(data: xr.Dataset) -> bytes:
    content: Any = data.to_netcdf(engine="h5netcdf")
    return bytes(content)


def plain(document: Any) -> Callable[[Path], bytes]:
    return lambda _: json.dumps(document).encode()


WAYPOINT_FILE = {"times": [0.0, 1.0], "poses": [[0, 0, 0, 0, 0, 0.38], [0, 0, 0, 0, 0, 0.4]]}
KINDS: dict[str, Kind] = {
    "scenario": Kind(load_scenario, "f.yaml", plain(SCENARIO), document=SCENARIO, write=yaml_bytes),
    "controller": Kind(
        *(load_controller, "f.yaml", plain(SCENARIO["controller"])),
        document=SCENARIO["controller"],
        write=yaml_bytes,
    ),
    "mechanism": Kind(
        mechanism_loads, "f.yaml", plain(PAPER), document=PAPER, write=yaml_bytes, briefly=15
    ),
    "waypoints": Kind(
        *(waypoint_motion, "f.yaml", plain(WAYPOINT_FILE)), document=WAYPOINT_FILE, write=yaml_bytes
    ),
    "csv": Kind(motion, "f.csv", lambda _: SAMPLES.encode(), lambda dice: csv_of(dice)),
    "network": Kind(
        load_network,
        "f.json",
        lambda _: json.dumps(network()).encode(),
        lambda dice: json_bytes(spoiled_document(network(), dice), dice),
    ),
    "run": Kind(
        *(read_outcome, "f.json", lambda _: sealed(json.dumps(RUN_FILE).encode())),
        document=RUN_FILE,
        write=lambda document, dice: sealed(json_bytes(document, dice)),
    ),
    "manifest": Kind(resumed, "manifest.json", plain(MANIFEST_FILE), document=MANIFEST_FILE),
    "npz": Kind(
        read_one_run, "f.npz", lambda _: npz_of_a_run(), lambda dice: other_npz(RUN_ARRAYS, dice)
    ),
    "signals": Kind(
        *(exported, "f.nc", lambda _: netcdf(some_signals())),
        lambda dice: other_netcdf(some_signals(), dice),
        briefly=4,
    ),
    "data set": Kind(
        *(labelled, "f.nc", lambda _: netcdf(some_data())),
        lambda dice: other_netcdf(some_data(), dice),
        briefly=4,
    ),
}


def csv_of(dice: random.Random) -> bytes:
    """Samples with cells that are something else."""
    rows = [row.split(",") for row in SAMPLES.splitlines()]
    for _ in range(dice.choice((1, 2, 3))):
        row = dice.choice(rows)
        row[dice.randrange(len(row))] = str(dice.choice(NASTY[:9] + NASTY[11:26]))
    if dice.random() < 0.2:
        dice.shuffle(rows)
    return "\n".join(map(",".join, rows)).encode(errors="surrogatepass")


def damaged(kind: Kind, good: bytes, dice: random.Random) -> bytes:
    """Every other file by bytes, the others by structure."""
    if dice.random() < 0.5:
        return spoiled_bytes(good, dice)
    if kind.other is not None:
        try:
            return kind.other(dice)
        except Exception:  # of three libraries that write
            return b""  # what not even the writer takes
    return kind.write(spoiled_document(kind.document, dice), dice)


def attempt(kind: Kind, path: Path, content: bytes) -> str:
    """`read`, or `refused` in one line of a bounded length that names the file."""
    path.write_bytes(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            kind.read(path)
    except ConfigError as error:
        said = str(error)
        assert len(said.splitlines()) == 1 and len(said) < LONGEST + len(str(path)), said
        # A manifest of other settings is told by its folder.
        assert str(path) in said or str(path.parent) in said, said
        return "refused"
    return "read"


def fuzz_files(name: str, folder: Path, numbers: range) -> Counter[str]:
    """Reads damaged files in copies of a process, which may neither hang nor take much memory.

    Returns:
        How many were read and how many refused.

    Raises:
        AssertionError: anything else; it names the file, which is kept.
    """
    kind, results = KINDS[name], Counter[str]()
    good = kind.good(folder)
    path, log = folder / kind.file, folder / "log"
    attempt(kind, path, good)
    start = numbers.start
    while start < numbers.stop:
        log.touch()
        with copied(partial(_try_all, name, good, path, range(start, numbers.stop), log)) as copy:
            before = -1
            while copy.is_alive() and log.stat().st_size > before:
                before = log.stat().st_size
                copy.join(PATIENCE)
            lines = log.read_text().splitlines()
        log.unlink()
        results.update(lines)
        start += len(lines)
        if start < numbers.stop:
            shutil.copy(path, folder / f"found{start}{path.suffix}")
            trace = folder / "trace"
            told = trace.read_text() if trace.exists() else "hang, crash or memory"
            raise AssertionError(f"{name} {start}, {path}, status {copy.exitcode}: {told}")
    return results


def _try_all(name: str, good: bytes, path: Path, numbers: range, log: Path) -> None:
    """In the copy: a line for every file."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, resource.RLIM_INFINITY))
    kind = KINDS[name]
    try:
        with log.open("a", buffering=1) as lines:
            for number in numbers:
                content = damaged(kind, good, random.Random(f"{name} {number}"))
                print(attempt(kind, path, content), file=lines)
    except BaseException:
        (path.parent / "trace").write_text(traceback.format_exc())
        raise


@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_read_or_refused(name, tmp_path):
    kind = KINDS[name]
    assert fuzz_files(name, tmp_path, range(kind.briefly)).total() == kind.briefly


@pytest.mark.soak
@pytest.mark.parametrize("name", KINDS)
def test_two_thousand_damaged_files_of_each_kind(name, tmp_path):
    results = fuzz_files(name, tmp_path, range(FILES))
    print(name, dict(results))
    assert results.total() == FILES and results["refused"] > FILES / 4
