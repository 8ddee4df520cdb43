"""Wrong and random files: a loader returns the thing itself or raises a one-line ConfigError."""

import dataclasses
import io
import json
import logging
import random
import zlib
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.trajectories import evaluate, make_reference
from stewart_drake.reporting.csv_file import read_signals, signals_csv
from stewart_drake.scenario.loading import load_controller, load_scenario
from stewart_drake.scenario.reference_config import CsvConfig, WaypointsConfig
from stewart_drake.studies.robustness import study_robustness
from stewart_drake.studies.runs import read_outcome
from stewart_drake.studies.study_options import RobustnessOptions
from stewart_drake.tuner.network import load_network, save_network
from stewart_drake.tuning.data import assemble, load_data, read_condition
from stewart_drake.tuning.families import paper_grid
from tests.faults import complaint, put, written, yaml_text
from tests.test_bad_input import PAPER
from tests.test_network import small_network
from tests.test_robustness import contents, short

DEEP = "[" * 50_000 + "]" * 50_000

# ---------------------------------------------------------------- run files of studies

OUTCOME = {"status": "completed", "reason": "", "leg": None, "time": None, "error": 9.1}
RUN_FILE = {
    "draw": {"payload": 0.1},
    "outcome": {**OUTCOME, "peak_torque": 0.6, "tuner_fallbacks": 2},
}
RUN_ARRAYS = {
    "samples": np.zeros((1, 100, 18)),
    "used": np.ones((1, 100, 2)),
    "health": np.zeros((1, 100, 18), dtype=np.float32),
    "status": np.array(["completed"]),
    "loop": np.array(["native"]),
    "fallbacks": np.zeros(1, dtype=int),
    "stopped": np.array([np.nan]),
    **dict.fromkeys(("J", "accumulated_error", "cost", "rms_torque"), np.ones(1)),
    **dict.fromkeys(("peak_torque", "torque_variation"), np.full(1, 2.0)),
}


def read_one_run(path):
    """Return the content of the file of a condition with one gain."""
    return read_condition(path, 1)


def sealed_text(document):
    """Return a document with its right checksum, so that a reader goes on to what it says."""
    text = json.dumps(document).encode()
    return b'{"crc32": "%08x", ' % zlib.crc32(text[1:]) + text[1:]


def npz_of_a_run():
    stream = io.BytesIO()
    np.savez(stream, **RUN_ARRAYS)
    return stream.getvalue()


@lru_cache(maxsize=1)
def some_signals():
    """Return the signals of a short run."""
    settings = ("plant.kind=exact", "duration=0.1", "start=on_reference", "queue=reference")
    return sd.simulate(sd.load_scenario("paper", settings=settings), judge_stability=False).signals


@lru_cache(maxsize=1)
def some_data():
    """Return a data set of two runs."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.npz"
        path.write_bytes(npz_of_a_run())
        grid = paper_grid(load_scenario("paper", "delay_lqi"))
        some = dict(list(grid.conditions.items())[:2])
        family = dataclasses.replace(grid, conditions=some, gains={"wQ1_wR1": (1.0, 1.0)})
        settings = {"data": "paper", "scenario": {}}
        return assemble(family, dict.fromkeys(some, read_one_run(path)), settings)


def netcdf(data):
    content = data.to_netcdf(engine="h5netcdf")
    return bytes(content)


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


def test_a_sound_outcome_is_read(tmp_path):
    path = written(tmp_path / "run.json", sealed_text(RUN_FILE))
    one = read_outcome(path)
    assert one.status == "completed" and one.error == 9.1 and np.isnan(one.time)
    failed = {"status": "left_workspace", "reason": "leg 3 out of reach", "leg": 3, "time": 0.5}
    failed |= {"error": None, "peak_torque": None}
    one = read_outcome(written(path, sealed_text({"draw": {}, "outcome": failed})))
    assert one.leg == 3 and np.isnan(one.error) and one.time == 0.5
    for field, value in (("status", "lost"), ("error", -1.0), ("leg", 7)):
        wrong = {"draw": {}, "outcome": failed | {field: value}}
        with pytest.raises(ConfigError, match=field):
            read_outcome(written(path, sealed_text(wrong)))


def test_no_file_with_a_changed_digit_is_read_as_sound(tmp_path):
    """146 of 500 damaged files were read before there was a checksum."""
    study_robustness(short(), tmp_path, RobustnessOptions(runs=1, workers=1))
    path, dice = tmp_path / "runs" / "run000000.json", random.Random(0)
    good = path.read_text()
    assert read_outcome(path).status == "completed"
    digits = [i for i, letter in enumerate(good) if letter.isdigit()]
    for _ in range(500):
        at = dice.choice(digits)
        other = dice.choice([d for d in "0123456789" if d != good[at]])
        with pytest.raises(ConfigError, match=r"checksum|JSON|run of a study"):
            read_outcome(written(path, good[:at] + other + good[at + 1 :]))


def test_a_damaged_run_is_done_again_with_a_word(tmp_path, caplog):
    """A run of status null and no reason was a success: "100 % completed"."""
    study_robustness(short(), tmp_path, RobustnessOptions(runs=3, workers=1))
    whole = contents(tmp_path)
    runs = tmp_path / "runs"
    good = json.loads((runs / "run000001.json").read_text())
    nothing = put(put(good, "outcome.status", None), "outcome.reason", "")
    del nothing["crc32"]
    written(runs / "run000001.json", sealed_text(nothing))
    written(runs / "run000002.json", DEEP)
    old = json.loads((runs / "run000000.json").read_text())
    del old["crc32"]  # as 0.2 wrote it
    written(runs / "run000000.json", json.dumps(old))
    with caplog.at_level(logging.WARNING, "stewart_drake"):
        study = study_robustness(short(), tmp_path, RobustnessOptions(runs=3, workers=1))
    assert contents(tmp_path) == whole and len(study.outcomes) == 3
    (record,) = caplog.records
    said = record.getMessage()
    assert "run000000.json" in said and "has no checksum" in said
    assert "done again (and 2 more)" in said and "\n" not in said
