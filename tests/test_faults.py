"""kill -9, a full disk, dead workers: nothing finished is lost, nothing is half.

Instants are drawn from a seed. Work runs in copies of a process, so that a kill costs no imports;
`make soak` kills dozens of times.
"""

import contextlib
import json
import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import xarray as xr

from stewart_drake.cli import main
from stewart_drake.studies.robustness import RobustnessOptions, study_robustness
from tests.copies import duration, killed, status_of
from tests.faults import refusal
from tests.test_cli import command
from tests.test_robustness import short

KILLS = 1
SOAK_KILLS = 80
EXACT = ("--set", "plant.kind=exact", "--set", "duration=0.1", "--set", "delay.steps=1")
LITTLE = ("plant.kind=exact", "reference.amplitude=[0.01, 0.01, 0.01, 0.001, 0.001, 0.004]")


def kill_times(number: int, longest: float, seed: int) -> Iterator[float]:
    """So many waiting times in s."""
    yield from np.random.default_rng(seed).uniform(0.0, longest, number)


def finished_runs(folder: Path, pattern: str) -> dict[str, tuple[bytes, int]]:
    """Content and time of writing of every finished run."""
    return {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.glob(pattern)}


def kill_and_resume(
    work: Callable[[Path], object],
    folder: Path,
    whole: Path,
    pattern: str,
    number: int,
    longest: float,
) -> None:
    """Kill `work` so often; each time every finished run must be kept, whole, as it should be.

    Where it comes to its end before the next kill, its last run is taken away and it starts again.
    """
    right = {name: content for name, (content, _) in finished_runs(whole, pattern).items()}
    kept: dict[str, tuple[bytes, int]] = {}
    kills = 0
    for after in kill_times(50 * number, longest, seed=number):
        kills += killed(lambda: work(folder), after)
        now = finished_runs(folder, pattern)
        assert {name: now[name] for name in kept} == kept, "a finished run was lost or done again"
        assert all(right[name] == content for name, (content, _) in now.items())
        if kills == number:
            break
        if len(now) == len(right):
            (folder / pattern).parent.joinpath(max(now)).unlink()
            now.pop(max(now))
        kept = now
    assert kills == number
    work(folder)
    final = finished_runs(folder, pattern)
    assert {name: content for name, (content, _) in final.items()} == right
    assert not list(folder.rglob(".*.part"))


# ---------------------------------------------------------------- kill -9


def little_study(folder: Path) -> None:
    study_robustness(short(), folder, RobustnessOptions(runs=6, workers=1))


def kill_study(number: int, tmp_path: Path) -> None:
    longest = duration(lambda: little_study(tmp_path / "whole"))
    kill_and_resume(
        little_study, tmp_path / "killed", tmp_path / "whole", "runs/run0*.json", number, longest
    )
    one, other = ((tmp_path / n / "runs.csv").read_bytes() for n in ("killed", "whole"))
    assert one == other


@pytest.mark.slow
def test_a_monte_carlo_survives_kill_9(tmp_path):
    kill_study(KILLS, tmp_path)


def check_whole(folder: Path) -> None:
    """Every visible file is complete; a summary comes after its signals, what is drawn after it."""
    for path in (p for p in folder.iterdir() if not p.name.startswith(".")):
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".nc":
            with xr.open_dataset(path, engine="h5netcdf") as signals:
                assert np.isfinite(signals.pose.values).all()
        elif path.suffix == ".png":
            assert matplotlib.image.imread(path).shape[2] == 4
        else:
            assert path.read_text().rstrip().endswith(("</svg>", "</html>"))
    summary = folder / "summary.json"
    if any(folder.glob("*.html")) or any(folder.glob("*.png")):
        assert summary.exists()
    if summary.exists() and "counts" in json.loads(summary.read_text()):  # of a run
        assert (folder / "signals.nc").exists()


def kill_writers(number: int, tmp_path: Path) -> None:
    """A run with its figures, and an analysis with its page, over and over in one folder each."""
    arguments = {
        "run": ["simulate", *EXACT, "--replay"],
        "page": ["analyze", "workspace", *EXACT],
    }
    for name, one in arguments.items():
        folder = tmp_path / name

        def work(one: list[str] = one, folder: Path = folder) -> None:
            while main([*one, "--quiet", "--out", str(folder)]) == 0:
                pass

        def once(one: list[str] = one, folder: Path = folder) -> None:
            assert main([*one, "--quiet", "--out", str(folder)]) == 0

        longest = duration(once)
        for after in kill_times(-(-number // 2), longest, seed=number):
            assert killed(work, after)
            check_whole(folder)
        once()
        check_whole(folder)
        assert not list(folder.glob(".*.part"))


@pytest.mark.slow
def test_reports_survive_kill_9(tmp_path):
    kill_writers(KILLS, tmp_path)


@pytest.mark.soak
@pytest.mark.parametrize("kill", [kill_study, kill_writers])
def test_many_kills(kill, tmp_path):
    kill(SOAK_KILLS, tmp_path)


# ---------------------------------------------------------------- a full disk


@pytest.mark.parametrize("largest", [1_000, 20_000, 60_000])
def test_a_full_disk_is_one_line_and_leaves_no_half_file(largest, tmp_path):
    """A limit on the sizes of files stands for the disk; it holds in a copy of a process only."""

    def work() -> int:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))
        with said.open("w") as file, contextlib.redirect_stderr(file):
            return main(["simulate", *EXACT, "--quiet", "--out", str(out)])

    said, out = tmp_path / "said", tmp_path / "out"
    out.mkdir()
    assert status_of(work) == 2
    assert f"File too large: '{out}/" in said.read_text()
    check_whole(out)
    assert not list(out.glob(".*.part"))
    there = {path.name for path in out.iterdir()}
    assert "states.png" not in there and ("summary.json" in there) <= ("signals.nc" in there)


# ---------------------------------------------------------------- workers and neighbours


def children(pid: int) -> list[int]:
    """Processes that this one started and that run its jobs."""
    found = Path(f"/proc/{pid}/task/{pid}/children")
    ids = [int(word) for word in found.read_text().split()]
    return [i for i in ids if b"popen_loky" in Path(f"/proc/{i}/cmdline").read_bytes()]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_a_worker_that_dies_and_a_second_process(tmp_path, capsys):
    """The whole command, on the whole grid, which is stopped long before its end."""
    words = ["tune", "dataset", "--workers", "2", "--controller", "delay_lqi", "--quiet"]
    words += [word for setting in LITTLE for word in ("--set", setting)]
    line = command(*words, "--out", str(tmp_path))

    def wait_for(number: int) -> None:
        limit = time.monotonic() + 120
        while len(list(tmp_path.glob("conditions/*.npz"))) < number:
            assert time.monotonic() < limit and process.poll() is None
            time.sleep(0.02)

    process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, start_new_session=True)
    wait_for(2)
    assert "another command is writing" in refusal([*words, "--out", str(tmp_path)], capsys)
    os.kill(children(process.pid)[0], signal.SIGKILL)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert err.startswith("error: a worker process was killed") and err.count("\n") == 1
    assert len(finished_runs(tmp_path, "conditions/*.npz")) >= 2
