"""The resumable parallel runner: nothing that has finished is lost, nothing is done twice."""

import errno
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import stewart_drake as sd
from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.files.errors import ConfigError
from stewart_drake.studies import jobs as module
from stewart_drake.studies.jobs import MANIFEST, run_jobs

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = {"gain": 1.0, "names": ["a"]}


def text(*parts):
    return " ".join(map(str, parts)).encode()


def noted(folder, *parts):
    """Leaves a trace of every call."""
    with open(folder, "a") as file:
        file.write(f"{parts[0]}\n")
    return text(*parts)


def slow(number):
    time.sleep(0.4)
    return text(number)


def refuse(number):
    raise ConfigError(f"delay.steps: got {number}")


def die_at_three(number):
    if number == 3:
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGKILL)
    return text(number)


def lacks_a_module(number):
    raise ModuleNotFoundError("No module named 'nowhere'")


def numbered(count):
    return {f"job{i}": (i,) for i in range(count)}


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if not p.name.startswith(".")}


# ---------------------------------------------------------------- what it does


def test_every_job_is_a_file_in_order(tmp_path):
    seen = []
    paths = run_jobs(
        {"b": ("two", 2), "a": ("one", 1)},
        text,
        tmp_path / "new" / "folder",
        settings=SETTINGS,
        suffix=".txt",
        workers=2,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert {key: path.read_text() for key, path in paths.items()} == {"b": "two 2", "a": "one 1"}
    assert list(paths) == ["b", "a"]
    assert seen == [(0, 2), (1, 2), (2, 2)]
    assert set(contents(tmp_path / "new" / "folder")) == {"a.txt", "b.txt", MANIFEST}


def test_a_second_start_does_only_what_is_missing(tmp_path):
    trace, folder = tmp_path / "trace", tmp_path / "runs"
    calls = {str(i): (str(trace), i) for i in range(4)}
    first = {key: calls[key] for key in ("1", "3")}
    run_jobs(first, noted, folder, settings=SETTINGS, workers=1)
    seen = []
    run_jobs(calls, noted, folder, settings=SETTINGS, workers=1, progress=lambda *n: seen.append(n))
    assert trace.read_text().split() == ["1", "3", "0", "2"]
    assert seen == [(2, 4), (3, 4), (4, 4)]


def test_a_refused_job_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"^job0: delay\.steps: got 0$"):
        run_jobs(numbered(1), refuse, tmp_path, settings=SETTINGS, workers=1)


# ---------------------------------------------------------------- settings and locks


def test_a_folder_of_other_settings_is_refused(tmp_path):
    run_jobs(numbered(1), text, tmp_path, settings={"c": {"w": 1, "v": 2}})
    before = contents(tmp_path)
    with pytest.raises(ConfigError, match=r"other settings \(c\.w: 1 there, 3 now\)") as caught:
        run_jobs(numbered(2), text, tmp_path, settings={"c": {"w": 3, "v": 2}})
    assert "\n" not in str(caught.value)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("manifest", ["", "{", "[]", '{"hash": "0"}', None])
def test_a_folder_with_a_bad_manifest_is_refused(tmp_path, manifest):
    (tmp_path / "job0.json").write_text("{}")
    if manifest is not None:
        (tmp_path / MANIFEST).write_text(manifest)
    with pytest.raises(ConfigError, match=MANIFEST):
        run_jobs(numbered(1), text, tmp_path, settings=SETTINGS)
    assert (tmp_path / "job0.json").read_text() == "{}"


def test_two_processes_do_not_share_a_folder(tmp_path):
    with (
        module._locked(tmp_path),
        pytest.raises(ConfigError, match="another process is working in this folder"),
    ):
        run_jobs(numbered(1), text, tmp_path, settings=SETTINGS)
    run_jobs(numbered(1), text, tmp_path, settings=SETTINGS)


# ---------------------------------------------------------------- what can go wrong


def test_leftovers_are_removed_and_a_full_disk_spoils_nothing(tmp_path, monkeypatch):
    (tmp_path / ".job1.json.0123456789abcdef.part").write_text("half a fi")
    run_jobs(numbered(1), text, tmp_path, settings=SETTINGS)
    assert not list(tmp_path.glob(".*.part"))

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        run_jobs(numbered(2), text, tmp_path, settings=SETTINGS, workers=1)
    assert set(contents(tmp_path)) == {"job0.json", MANIFEST}
    assert not list(tmp_path.glob(".*.part"))
    monkeypatch.undo()
    assert len(run_jobs(numbered(2), text, tmp_path, settings=SETTINGS, workers=1)) == 2


def test_a_killed_worker_costs_the_jobs_in_flight_only(tmp_path):
    with pytest.raises(ChildProcessError, match="worker process was killed"):
        run_jobs(numbered(4), die_at_three, tmp_path, settings=SETTINGS, workers=2)
    assert {"job0.json", "job1.json", "job2.json"} <= set(contents(tmp_path))
    run_jobs(numbered(4), text, tmp_path, settings=SETTINGS, workers=2)
    assert (tmp_path / "job3.json").read_bytes() == b"3"


def start(folder):
    """Return a process with two workers on thirty jobs of 0.4 s."""
    code = (
        "import sys\nfrom pathlib import Path\nfrom stewart_drake.studies.jobs import run_jobs\n"
        "from tests.test_jobs import SETTINGS, numbered, slow\n"
        "try:\n    run_jobs(numbered(30), slow, Path(sys.argv[1]), settings=SETTINGS, workers=2)\n"
        "except KeyboardInterrupt:\n    sys.exit(130)\n"
    )
    command, options = [sys.executable, "-c", code, str(folder)], {"cwd": ROOT, "text": True}
    return subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True, **options)


def wait_for(folder, number):
    limit = time.monotonic() + 180
    while len(list(folder.glob("job*.json"))) < number:
        assert time.monotonic() < limit
        time.sleep(0.02)


def group_is_gone(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize("whole_group", [True, False])
def test_ctrl_c_keeps_what_has_finished(tmp_path, whole_group):
    process = start(tmp_path)
    wait_for(tmp_path, 2)
    (os.killpg if whole_group else os.kill)(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (130, "")
    done = [p.name for p in tmp_path.glob("job*.json")]
    assert 2 <= len(done) < 30
    assert not list(tmp_path.glob(".*.part"))


@pytest.mark.slow
def test_after_kill_9_the_next_start_gives_the_same_files(tmp_path):
    process = start(tmp_path / "killed")
    wait_for(tmp_path / "killed", 3)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=30)  # its workers end too: they hold stderr open
    limit = time.monotonic() + 10
    while not group_is_gone(process.pid):
        assert time.monotonic() < limit
        time.sleep(0.1)
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "killed").glob("job*.json")}
    assert 3 <= len(kept) < 30
    run_jobs(numbered(30), text, tmp_path / "killed", settings=SETTINGS, workers=1)
    run_jobs(numbered(30), text, tmp_path / "whole", settings=SETTINGS, workers=1)
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())


# ---------------------------------------------------------------- a Dask cluster


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as made:
        yield made.scheduler_address


def test_a_cluster_gives_the_same_files(tmp_path, cluster):
    run_jobs(numbered(6), text, tmp_path / "cluster", settings=SETTINGS, scheduler=cluster)
    run_jobs(numbered(6), text, tmp_path / "here", settings=SETTINGS, workers=1)
    assert contents(tmp_path / "cluster") == contents(tmp_path / "here")


@pytest.mark.slow
def test_a_job_that_kills_its_workers_is_given_up(tmp_path, cluster):
    with pytest.raises(ChildProcessError, match="Dask gave up"):
        run_jobs({"job3": (3,)}, die_at_three, tmp_path, settings=SETTINGS, scheduler=cluster)


def test_errors_of_a_cluster_are_one_line(tmp_path, cluster):
    with pytest.raises(ConfigError, match=r"job0: delay\.steps"):
        run_jobs(numbered(1), refuse, tmp_path, settings=SETTINGS, scheduler=cluster)
    with pytest.raises(ConfigError, match="lack a module"):
        run_jobs(numbered(1), lacks_a_module, tmp_path, settings=SETTINGS, scheduler=cluster)


def test_a_cluster_with_threads_or_without_workers_is_refused(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(module, "_CONNECT_TIMEOUT", 1.0)
    for number, threads, said in ((1, 2, "has 2 threads"), (0, 1, "has no workers")):
        options = {"n_workers": number, "threads_per_worker": threads, "processes": False}
        with (
            distributed.LocalCluster(dashboard_address=None, **options) as made,
            pytest.raises(ConfigError, match=said),
        ):
            address = made.scheduler_address
            run_jobs(numbered(1), text, tmp_path, settings=SETTINGS, scheduler=address)


def test_an_address_without_a_scheduler_is_refused(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(module, "_CONNECT_TIMEOUT", 0.2)
    before = set(threading.enumerate())
    for address in ("", "nonsense", "tcp://127.0.0.1:1", "tls://127.0.0.1:1"):
        problem = r"^--scheduler: got [^\n]* expected the address[^\n]*$"
        with pytest.raises(ConfigError, match=problem):
            run_jobs(numbered(1), text, tmp_path, settings=SETTINGS, scheduler=address)
    assert not set(threading.enumerate()) - before, "an event loop is left running"


ON_REFERENCE = ("start=on_reference", "queue=reference")


def variants(duration):
    """Both plants, delays of whole periods and parts, with and without noise, four gains."""
    delays = (("delay.steps=2",), ("delay.steps=1", "delay.fraction=0.5"))
    noises = ((), ("sensor.noise_std=[1e-4,1e-4,1e-4,1e-5,1e-5,1e-5,0,0,0,0,0,0]",))
    plants = (("plant.kind=exact",), ("plant.kind=multibody",))
    # The plants turn over first: neighbours, which run at the same time, are as unlike as can be.
    for w_R, delay, noise, plant in itertools.product(range(1, 6), delays, noises, plants):
        own = (f"duration={duration}", f"controller.w_R={w_R}", f"sensor.seed={w_R}")
        yield (*plant, *delay, *noise, *own, *ON_REFERENCE)


def run(settings):
    return sd.simulate(sd.load_scenario("paper", settings=settings), judge_stability=False).signals


def differing(settings, threads):
    """Return the runs whose signals in threads differ from those alone."""
    functions_of.cache_clear()  # so that the threads also make them at the same time
    with ThreadPoolExecutor(threads) as pool:
        together = list(pool.map(run, settings))
    alone = [run(one) for one in settings]
    pairs = zip(settings, alone, together, strict=True)
    return [one for one, a, b in pairs if not a.identical(b)]


def test_runs_in_threads_are_those_alone():
    assert differing(list(itertools.islice(variants(0.4), 6)), threads=3) == []


@pytest.mark.soak
def test_forty_runs_in_eight_threads_are_those_alone():
    settings = list(variants(1.0))
    assert len(settings) == 40
    assert differing(settings, threads=8) == []
