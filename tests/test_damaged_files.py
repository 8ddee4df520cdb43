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

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.robustness import study_robustness
from stewart_drake.studies.runs import read_outcome
from stewart_drake.studies.study_options import RobustnessOptions
from stewart_drake.tuning.data import assemble, read_condition
from stewart_drake.tuning.families import paper_grid
from tests.faults import put, written
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
