"""Results that are read back: a damaged one is refused or done again, never believed."""

import dataclasses
import io
import json
import logging
import random
import zlib
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5netcdf
import numpy as np
import pytest
import xarray as xr

import stewart_drake as sd
from stewart_drake.files.arrayio import write_netcdf
from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.families import paper_grid
from stewart_drake.studies.robustness import RobustnessOptions, study_robustness
from stewart_drake.studies.runs import read_outcome
from stewart_drake.tuning.data import assemble, load_data, read_condition
from tests.faults import complaint, put, refusal, written
from tests.test_robustness import contents, short

DEEP = "[" * 50_000 + "]" * 50_000

# ---------------------------------------------------------------- run files of studies

BAD_OUTCOMES: list[tuple[str, Any]] = [
    ("outcome.status", None),
    ("outcome.status", "interrupted"),
    ("outcome.reason", None),
    ("outcome.reason", "out of reach"),
    ("outcome.leg", [1]),
    ("outcome.leg", 7),
    ("outcome.leg", 3),
    ("outcome.time", 1.0),
    ("outcome.error", None),
    ("outcome.error", -1.0),
    ("outcome.error", 10**400),
    ("outcome.error", True),
    ("outcome.error", "9.1"),
    ("outcome.tuner_fallbacks", -1),
    ("outcome", [1]),
    ("draw", None),
    ("draw.note", "\ud800"),
]


OUTCOME = {"status": "completed", "reason": "", "leg": None, "time": None, "error": 9.1}
RUN_FILE = {
    "draw": {"payload": 0.1},
    "outcome": {**OUTCOME, "peak_torque": 0.6, "tuner_fallbacks": 2},
}
RUN_ARRAYS: dict[str, Any] = {
    "samples": np.zeros((1, 100, 18)),
    "health": np.zeros((1, 100, 18), dtype=np.float32),
    "status": np.array(["completed"]),
    "stopped": np.array([np.nan]),
    **dict.fromkeys(("J", "accumulated_error", "cost", "rms_torque"), np.ones(1)),
    **dict.fromkeys(("peak_torque", "torque_variation"), np.full(1, 2.0)),
}


def read_one_run(path: Path) -> dict[str, Any]:
    """Return the content of the file of a condition with one gain."""
    return read_condition(path, 1)


def sealed_text(document: Any) -> bytes:
    """Return a document with its right checksum, so that a reader goes on to what it says."""
    text = json.dumps(document).encode()
    return b'{"crc32": "%08x", ' % zlib.crc32(text[1:]) + text[1:]


def npz_of_a_run() -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **RUN_ARRAYS)  # type: ignore[arg-type]
    return stream.getvalue()


@lru_cache(maxsize=1)
def some_signals() -> xr.Dataset:
    """Return the signals of a short run."""
    settings = ("plant.kind=exact", "duration=0.1", "start=on_reference", "queue=reference")
    return sd.simulate(sd.load_scenario("paper", settings=settings), judge_stability=False).signals


@lru_cache(maxsize=1)
def some_data() -> xr.Dataset:
    """Return a data set of two runs."""
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


@pytest.mark.parametrize(("field", "value"), BAD_OUTCOMES, ids=str)
def test_a_damaged_outcome_is_refused(field, value, tmp_path):
    path = written(tmp_path / "run000000.json", sealed_text(put(RUN_FILE, field, value)))
    with pytest.raises(ConfigError) as caught:
        read_outcome(path)
    said = str(caught.value)
    assert said.startswith(str(path)) and len(said.splitlines()) == 1 and len(said) < 400
    if field.startswith("outcome."):
        assert field.partition(".")[2] in said or "any float" in said or "JSON" in said


def test_a_sound_outcome_is_read(tmp_path):
    path = written(tmp_path / "run.json", sealed_text(RUN_FILE))
    one = read_outcome(path)
    assert one.status == "completed" and one.error == 9.1 and np.isnan(one.time)
    failed = {"status": "left_workspace", "reason": "leg 3 out of reach", "leg": 3, "time": 0.5}
    failed |= {"error": None, "peak_torque": None}
    one = read_outcome(written(path, sealed_text({"draw": {}, "outcome": failed})))
    assert one.leg == 3 and np.isnan(one.error) and one.time == 0.5
    for field, value in (("reason", ""), ("error", 1.0), ("time", None)):
        wrong = {"draw": {}, "outcome": failed | {field: value}}
        with pytest.raises(ConfigError, match=field):
            read_outcome(written(path, sealed_text(wrong)))


def test_no_file_with_a_changed_digit_is_read_as_sound(tmp_path):
    """Without a checksum 146 of 500 were."""
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


# ---------------------------------------------------------------- arrays


def saved(folder: Path, **changes: Any) -> Path:
    """A run's file with some arrays changed; None leaves one out."""
    arrays = {k: v for k, v in ({**RUN_ARRAYS, **changes}).items() if v is not None}
    np.savez(folder / "run.npz", **arrays)
    return folder / "run.npz"


@pytest.mark.parametrize(
    "changes",
    [
        {"samples": np.zeros((1, 3, 18))},
        {"samples": np.full((1, 100, 18), "text")},
        {"samples": np.full((1, 100, 18), np.inf)},
        {"samples": np.full((1, 100, 18), np.nan)},
        {"samples": np.array([{"a": 1}], dtype=object)},
        {"samples": None},
        {"status": np.array(["nonsense"])},
        {"status": np.array(["left_workspace"])},
        {"status": np.zeros(1)},
        {"stopped": np.ones(1)},
        {"accumulated_error": np.full(1, np.nan)},
        {"cost": np.full(1, -1.0)},
        {"J": np.full(1, np.nan)},
        {"peak_torque": np.array([1.0, 2.0])},
        {"extra": 1.0},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_a_run_of_another_content_is_refused(changes, tmp_path):
    complaint(read_one_run, saved(tmp_path, **changes))


DATE = np.datetime64("2020-01-01", "ns")
OTHER_SIGNALS: dict[str, Any] = {
    "a dimension more": lambda s: s.assign(pose=s.pose.expand_dims(extra=2)),
    "a dimension less": lambda s: s.assign(pose=s.pose.isel(coordinate=0, drop=True)),
    "text poses": lambda s: s.assign(pose=s.pose.astype("U9")),
    "dates": lambda s: s.assign(pose=(s.pose.dims, np.full(s.pose.shape, DATE))),
    "times of the clock": lambda s: s.assign_coords(
        time=DATE + np.arange(s.sizes["time"]) * np.timedelta64(20, "ms")
    ),
    "times in ms": lambda s: s.assign_coords(time=("time", s.time.values, {"units": "ms"})),
    "no time": lambda s: s.drop_vars("time"),
    "time that goes back": lambda s: s.isel(time=slice(None, None, -1)),
    "five legs": lambda s: s.isel(leg=slice(0, 5)),
    "no poses": lambda s: s.drop_vars("pose"),
}


@pytest.mark.parametrize("name", OTHER_SIGNALS)
def test_signals_of_another_structure_are_refused(name, tmp_path, capsys):
    path = tmp_path / "other.nc"
    write_netcdf(path, OTHER_SIGNALS[name](some_signals()))
    assert "other.nc" in refusal(["export", str(path)], capsys)


def test_a_file_that_declares_a_huge_array_is_refused(tmp_path):
    path = tmp_path / "dataset.nc"
    with h5netcdf.File(path, "w") as file:
        file.dimensions = {"run": 10**6, "sample": 10**6, "input": 18}
        file.create_variable("samples", ("run", "sample", "input"), "f8", chunks=(1, 10, 18))
    assert path.stat().st_size < 100_000
    assert "MB" in complaint(load_data, path)


def test_a_data_set_that_is_not_whole_is_refused(tmp_path):
    data, path = some_data(), tmp_path / "dataset.nc"
    load_data(written(path, netcdf(data)))
    wrong: dict[str, xr.Dataset] = {
        "status": data.drop_vars("status"),
        "a weight": data.assign(weights=-data.weights),
        "valid": data.assign(valid=~data.valid),
        "E_ac": data.assign(accumulated_error=np.nan * data.accumulated_error),
        "settings": data.assign_attrs(settings="{"),
        "samples": data.assign(samples=data.samples.astype("U9")),
        "sample": data.isel(input=slice(0, 5)),
    }
    for word, one in wrong.items():
        assert word in complaint(load_data, written(path, netcdf(one)))
