"""Random files: what comes out of a loader is the thing itself or a one-line ConfigError.

Briefly here; `make soak` goes on for five minutes with fresh seeds. What it finds becomes a case
of the tables in test_bad_input.py and test_bad_files.py.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from stewart_drake.config import ReferenceConfig
from stewart_drake.errors import ConfigError
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.reference_files import read_csv, read_waypoints
from stewart_drake.scenario_loading import load_controller, load_scenario
from stewart_drake.trajectories import evaluate, make_reference
from stewart_drake.tuner.network import load_network, save_network
from tests.faults import yaml_text
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
    trajectory = make_reference(ReferenceConfig(kind="csv", file=str(path)), 0.1)
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
