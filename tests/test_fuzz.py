"""Wrong and random files: a loader returns the thing itself or raises a one-line ConfigError."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.reporting.csv_file import read_signals, signals_csv
from stewart_drake.scenario.loading import load_controller, load_scenario
from stewart_drake.scenario.reference_config import CsvConfig, WaypointsConfig
from stewart_drake.scenario.trajectories import evaluate, make_reference
from stewart_drake.studies.runs import read_outcome
from stewart_drake.tuner.network import load_network, save_network
from stewart_drake.tuning.data import load_data
from tests.faults import complaint, written, yaml_text
from tests.test_bad_input import PAPER
from tests.test_damaged_files import (
    RUN_FILE,
    netcdf,
    npz_of_a_run,
    read_one_run,
    sealed_text,
    some_data,
    some_signals,
)
from tests.test_network import small_network

SCALARS = (
    st.none() | st.booleans() | st.integers(-(10**400), 10**400) | st.floats() | st.text(max_size=8)
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=7) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)
HEADER = "time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m]"
SAMPLES = "\n".join([HEADER, *(f"{k / 10},0,0,0,0,0,0.38" for k in range(6))]) + "\n"
WAYPOINTS = "times: [0.0, 1.0]\nposes: [[0, 0, 0, 0, 0, 0.38], [0, 0, 0, 0, 0, 0.4]]\n"
SCENARIO = {
    "duration": 1.0,
    "reference": {"kind": "sine", "amplitude": [0.1] * 6, "offset": [0.0] * 6, "frequency": 1.0},
    "plant": {"kind": "exact", "gravity": True, "torque_bias": [0.0] * 6},
    "delay": {"steps": 3, "fraction": 0.5},
    "controller": {"period": 0.1, "delay_steps": None, "catch_up": 0.3},
    "sensor": {"noise_std": [0.0] * 12, "seed": 1},
}
YAML_TEXT = st.text(alphabet="ab:0123456789.[]{}-,&*!<>|%?#'\"\\\n\t ~\0\u2028é", max_size=80)


def places(document, at=()):
    """Return the way to everything inside nested dicts and lists."""
    items = ()
    if isinstance(document, dict):
        items = document.items()
    elif isinstance(document, list):
        items = enumerate(document)
    return [at, *(way for key, value in items for way in places(value, (*at, key)))]


def changed(document, way, value):
    """Return a copy with what is at the end of `way` replaced."""
    if not way:
        return value
    copy = dict(document) if isinstance(document, dict) else list(document)
    copy[way[0]] = changed(copy[way[0]], way[1:], value)
    return copy


@st.composite
def mutants(draw, document):
    """Draw a good document with one to three parts replaced by anything."""
    for _ in range(draw(st.integers(1, 3))):
        document = changed(document, draw(st.sampled_from(places(document))), draw(VALUES))
    return document


@st.composite
def spoiled(draw, raw):
    """Draw a good file with a piece taken out, doubled, or replaced by anything."""
    start = draw(st.integers(0, len(raw)))
    end = draw(st.integers(start, min(len(raw), start + 20)))
    middle = draw(st.binary(max_size=6) | st.just(raw[start:end] * 2))
    return raw[:start] + middle + raw[end:]


@st.composite
def restructured(draw, good):
    """Draw a sound NetCDF file of another content; HDF5 may crash on one with damaged bytes."""
    data = good()
    name = draw(st.sampled_from(sorted(map(str, data.variables))))
    variable = data[name]
    change = draw(st.sampled_from(["drop", "text", "empty", "reverse", "nan", "number"]))
    if change == "drop":
        data = data.drop_vars(name)
    elif change == "text":
        data = data.assign({name: variable.astype("U9")})
    elif change in ("empty", "reverse") and variable.dims:
        part = slice(0, 0) if change == "empty" else slice(None, None, -1)
        data = data.isel({variable.dims[0]: part})
    elif change == "nan" and variable.dtype.kind == "f":
        data = data.assign({name: variable * np.nan})
    elif name not in data.dims:
        data = data.assign({name: 3.0})
    return netcdf(data)


def csv_motion(path):
    trajectory = make_reference(CsvConfig(file=str(path)), 0.1)
    assert all(abs(value) < 1e12 for value in evaluate(trajectory, 0.05))


def waypoint_motion(path):
    make_reference(WaypointsConfig(file=str(path)), 0.1)


def exported(path):
    rows = signals_csv(read_signals(path)).splitlines()
    assert len({row.count(",") for row in rows}) == 1


def network():
    with TemporaryDirectory() as folder:
        save_network(small_network(2), Path(folder) / "n.json")
        return dict(json.loads((Path(folder) / "n.json").read_text()))


LOADERS = {
    "scenario": (load_scenario, "f.yaml", mutants(SCENARIO).map(yaml_text)),
    "text": (load_scenario, "f.yaml", YAML_TEXT | st.binary(max_size=60)),
    "controller": (load_controller, "f.yaml", mutants(SCENARIO["controller"]).map(yaml_text)),
    "mechanism": (load_mechanism, "f.yaml", mutants(PAPER).map(yaml_text)),
    "waypoints": (waypoint_motion, "f.yaml", spoiled(WAYPOINTS.encode())),
    "csv": (csv_motion, "f.csv", spoiled(SAMPLES.encode())),
    "network": (load_network, "f.json", st.deferred(lambda: mutants(network())).map(json.dumps)),
    "run": (read_outcome, "f.json", mutants(RUN_FILE).map(sealed_text)),
    "npz": (read_one_run, "f.npz", spoiled(npz_of_a_run())),
    "signals": (exported, "f.nc", restructured(some_signals)),
    "data set": (load_data, "f.nc", restructured(some_data)),
}


def fuzz(name, folder, examples, number=None):
    """Load random files of one kind; `number` is the seed, None the usual one."""
    load, file, contents = LOADERS[name]
    path = folder / file

    def attempt(content):
        raw = content if isinstance(content, bytes) else content.encode(errors="surrogatepass")
        path.write_bytes(raw)
        try:
            load(path)
        except ConfigError as error:
            assert len(str(error).splitlines()) == 1 and str(path) in str(error)

    checked = settings(
        max_examples=examples,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.explicit, Phase.generate],
    )(given(content=contents)(attempt))
    (checked if number is None else seed(number)(checked))()


@pytest.mark.parametrize("name", LOADERS)
def test_a_random_file_loads_or_is_refused(name, tmp_path):
    fuzz(name, tmp_path, examples=10 if name in ("signals", "data set") else 40)


@pytest.mark.soak
@pytest.mark.parametrize("name", LOADERS)
def test_two_thousand_random_files_of_each_kind(name, tmp_path):
    fuzz(name, tmp_path, examples=2000, number=1)


YAML_THAT_ACTS = [
    "!!python/object/apply:os.system ['touch {mark}']",
    "!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path ['{mark}']]",
    "!!python/name:os.system ''",
    "!<tag:yaml.org,2002:python/object/new:subprocess.check_call> [[touch, {mark}]]",
    "%TAG ! tag:yaml.org,2002:python/\n---\n!object/apply:os.system ['touch {mark}']",
    "{{=1:1}}",
]


@pytest.mark.parametrize("kind", ["scenario", "waypoints"])
def test_yaml_executes_nothing(kind, tmp_path):
    load, name, _ = LOADERS[kind]
    mark = tmp_path / "mark"
    for text in YAML_THAT_ACTS:
        for whole in (text, f"duration: {text}", f"- {text}", f"? {text}\n: 1"):
            complaint(load, written(tmp_path / name, whole.replace("{mark}", str(mark))))
            assert not mark.exists()
