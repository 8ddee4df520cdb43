"""The log of a live run: rows as they come, a killed process, a full disk, memory."""

import gc
import math
import os
import resource
import signal
import threading
import time
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest

from stewart_drake.identification.servo_logs import read_servo_log
from stewart_drake.law.motion import KnownMotion
from stewart_drake.law.sensing import Measurement
from stewart_drake.live.log import LiveRecord, RowFile
from stewart_drake.live.session import drive, prepare_session
from stewart_drake.loop import results as metrics
from stewart_drake.loop.law_design import control_law, first_queue
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.recording import summarize
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.servos import servo_law
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.reporting.csv_file import signals_csv
from stewart_drake.scenario import run_log
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.run_log import open_log, read_log
from stewart_drake.scenario.signals import POSE
from stewart_drake.studies.learn import lacking_angles
from tests.copies import Command, status_of
from tests.test_live import FROM_REST, OVER_A_NETWORK, SETTINGS, paper_machine, scenario_of


def lines_of(path):
    """Cells of the rows below the header, all of one length."""
    text = path.read_text()
    assert text.endswith("\n")
    header, *rows = (line.split(",") for line in text.splitlines())
    assert all(len(row) == len(header) for row in rows)
    return header, rows


# ---------------------------------------------------------------- the file


def test_rows_are_exact_and_nobody_waits_for_the_disk(tmp_path, monkeypatch):
    path, goes_on, write = tmp_path / "log.csv", threading.Event(), os.write
    file = RowFile(path, ["a", "b", "c"], print)
    monkeypatch.setattr(os, "write", lambda *those: goes_on.wait() and write(*those))
    rows = np.random.default_rng(3).normal(size=(300, 3))
    rows[7, 1], rows[8, 2] = math.nan, -0.0
    for row in rows:
        file.append(row)  # with a disk that stands still
    assert path.read_text() == "a,b,c\n"
    goes_on.set()
    np.testing.assert_array_equal(file.close(), rows)
    assert lines_of(path)[1][7][1] == ""


def test_a_disk_that_stands_still_ends_the_file_and_not_the_run(tmp_path, monkeypatch):
    goes_on, write, said = threading.Event(), os.write, []
    file = RowFile(tmp_path / "log.csv", ["a"], said.append)
    monkeypatch.setattr(os, "write", lambda *those: goes_on.wait() and write(*those))
    for k in range(5000):
        file.append(np.array([float(k)]))
    assert len(said) == 1 and f"{tmp_path / 'log.csv'}: the disk is too slow" in said[0]
    goes_on.set()
    kept = file.close()[:, 0]
    np.testing.assert_array_equal(kept, np.arange(len(kept)))


def test_a_full_disk_ends_the_log_in_a_line_and_the_run_goes_on(tmp_path):
    """A limit on file sizes; a copy of a process has it alone."""
    path, told = tmp_path / "log.csv", tmp_path / "told"

    def work():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        said = []
        file = RowFile(path, ["time[s]", "value"], said.append)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
        for k in range(400):
            file.append(np.array([k, 1 / (k + 1)]))
        kept = len(file.close())
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
        told.write_text("\n".join([str(kept), *said]))

    assert status_of(work) == 0
    kept, *said = told.read_text().splitlines()
    assert len(said) == 1 and said[0].startswith(f"{path}: File too large; the run goes on")
    _, rows = lines_of(path)
    assert 20 < len(rows) == int(kept) < 60
    assert [float(time) for time, _ in rows] == list(range(len(rows)))


# ---------------------------------------------------------------- runs


class Shadow(LiveRecord):
    """Keeps in memory what is read back from the file."""

    def sample(self, number, memory, measurement, wanted, seconds, late, packets):
        super().sample(number, memory, measurement, wanted, seconds, late, packets)
        if not hasattr(self, "shadow"):
            self.shadow = [], [], []
        state = measurement.values if self.usable else memory.belief.state
        error = state[POSE] - wanted[POSE]
        self.shadow[0].append([number * self._period, *error, *wanted[POSE]])
        self.shadow[1].append([*error, *memory.torque, *memory.in_flight[-1], seconds])
        self.shadow[2].append(late)

    def count(self, memory):
        self.usable = super().count(memory)
        return self.usable


@pytest.mark.slow
def test_figures_from_the_file_are_those_from_memory(tmp_path, monkeypatch):
    records = []

    def recorded(*those):
        records.append(Shadow(*those))
        return records[0]

    monkeypatch.setattr("stewart_drake.live.loop.LiveRecord", recorded)
    path = tmp_path / "log.csv"
    with paper_machine(rate=2.0) as running:
        ready = prepare_session(scenario_of(), running.address)
        how = {"accept_jitter": True, "say": lambda line: None, "log": path}
        result = drive(ready, 3.0, **how)
    assert result.status == "completed"
    grid, samples, late = map(np.array, records[0].shadow)
    time_, error = grid[:, 0], grid[:, 1:7]
    errors, asked, sent = np.split(samples[:, :18], 3, axis=1)
    experiment = ready.design.experiment
    c = experiment.scenario.controller
    found = metrics.figures(time_, error, experiment.scale, errors, asked, sent, c, True)
    summary = result.summary
    for name, value in found._asdict().items():
        assert summary[name] == value, name
    assert summary["controller_step_ms"]["median"] == 1e3 * np.median(samples[:, 18])
    assert summary["live"]["sent_after_due_ms"]["worst"] >= 1e3 * max(late)
    header, rows = lines_of(path)
    named = signals_csv(result.signals).splitlines()[0].split(",")
    assert [name for name in named if not name.startswith("error")] == header[:-2]
    assert header[-2:] == ["step[s]", "late[s]"] and len(rows) == len(time_)


@pytest.mark.slow
def test_what_a_full_disk_leaves_of_a_run(tmp_path):
    """The run completes; its figures say that they are of its beginning."""
    path, told = tmp_path / "log.csv", tmp_path / "told"

    def work():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        said = []
        with paper_machine(rate=2.0) as running:
            ready = prepare_session(scenario_of(), running.address)
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
            how = {"accept_jitter": True, "say": said.append, "log": path}
            result = drive(ready, 3.0, **how)
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
        assert result.status == "completed" and math.isnan(result.accumulated_error)
        assert result.summary["measured_share"] > 0.9
        assert any("the log ends" in line for line in result.summary["warnings"])
        result.save(tmp_path)
        told.write_text("\n".join(said))

    assert status_of(work) == 0
    assert told.read_text().count(str(path)) == 1
    _, rows = lines_of(path)
    assert 5 < len(rows) < 25 and (tmp_path / "summary.json").exists()


@pytest.mark.slow
def test_a_killed_run_leaves_all_but_its_last_second(tmp_path):
    settings = (*SETTINGS, *FROM_REST)
    words = [word for setting in settings for word in ("--set", setting)]
    with paper_machine(OVER_A_NETWORK, *FROM_REST) as running:
        where = f"127.0.0.1:{running.address[1]}"
        command = ["live", "paper", "--machine", where, "--no-browser", "--out", str(tmp_path)]
        live = Command(*command, *words)
        try:
            while not running.machine.counts["runs"]:
                assert live.poll() is None
                time.sleep(0.05)
            time.sleep(4.0)
        finally:
            live.kill()
            live.wait()
        began = running.machine.begin
        ran = (running.machine.time() - began) / 1e9
    header, rows = lines_of(tmp_path / "log.csv")
    assert header[:2] == ["time[s]", "pose_roll[rad]"]
    assert {path.name for path in tmp_path.iterdir()} == {"log.csv", "log.yaml"}
    kept = run_log.scenario_of(read_log(tmp_path), tmp_path)
    assert kept.link.kind == "network" and kept.start == "rest"
    times = [float(row[0]) for row in rows]
    assert times[-1] > ran - 1.0
    assert all(b - a == pytest.approx(0.1) for a, b in pairwise(times))


@pytest.mark.parametrize("sensor", ["state", "encoders"])
def test_samples_of_servos_without_a_measurement_are_in_no_error(sensor, tmp_path):
    """As `identify`, which fills short gaps, reads the log."""
    scenario = load_scenario("reachy_mini", settings=("duration=5", f"sensor.kind={sensor}"))
    experiment, path = prepare(scenario), tmp_path / "log.csv"
    law, planned, _ = servo_law(experiment)
    memory = law.initial_memory(law.command(evaluate(planned, 0.0), law.plant.dynamics.parameters))
    record = LiveRecord(experiment, 10.0, None, print, [open_log(path, scenario)])
    lost = {100, 101, 170}
    for k in range(251):
        wanted = evaluate(planned, 0.02 * k)
        seen = wanted[:12] if sensor == "state" else experiment.mechanism.crank_angles(wanted[:6])
        measurement = Measurement.of(seen * (math.nan if k in lost else 1.0))
        nothing = np.full(law.reports.size, np.nan)
        memory = law.step(memory, measurement, lambda _, rows=wanted[None]: rows, nothing)
        record.sample(k, memory, measurement, wanted, 1e-3, 1e-3, np.full(5, np.nan))
    record.finish()
    for log in record._logs:
        log.close()
    record.ran(scenario)
    summary = summarize(experiment, record, "completed", None, 1.0, None)
    assert summary["measured_share"] == pytest.approx(248 / 251)
    assert summary["rms_error"]["angle_deg"] < 1e-4 and max(summary["peak_error"]) < 1e-2
    assert summary["accumulated_error"] < 1e-2
    signals = record.dataset()
    assert set(np.flatnonzero(np.isnan(signals.pose.values).any(axis=1))) == lost
    result = SimulationResult(scenario, "completed", None, signals, summary)
    assert len(lacking_angles(experiment, result, 4.98)[0]) == 246
    read = read_servo_log(path, experiment.mechanism)
    true = experiment.mechanism.crank_angles(evaluate(planned, 2.0)[:6])
    assert len(read.times) == 251 and read.cranks[100] == pytest.approx(true, abs=5e-3)


# ---------------------------------------------------------------- memory


def test_ten_minutes_keep_no_more_than_a_minute():
    """6,000 samples of a record, without real time; a row would take 1.2 kB in memory."""
    experiment = prepare(scenario_of())
    law, planned, _ = control_law(experiment)
    memory = law.initial_memory(first_queue(experiment, law))
    wanted = evaluate(planned, 0.0)
    measurement = Measurement.of(wanted[:12])
    motion = KnownMotion(planned, planned, 0.0)
    memory = law.step(memory, measurement, motion, np.ones(2))
    record, held = LiveRecord(experiment, 10.0, None, print), {}
    tracemalloc.start()
    try:
        for k in range(6_001):
            record.acted({k - 1: np.array(memory.torque)})
            record.sample(k, memory, measurement, wanted, 1e-3, 1e-3, np.full(5, np.nan))
            if k % 1000 == 0:
                while not record._file._log._rows.empty():
                    time.sleep(0.01)
            if k in (1000, 6_000):
                gc.collect()
                held[k] = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert held[6_000] - held[1000] < 20_000
    assert len(record.finish()) == len(record.samples) == record.sampled == 6_001
