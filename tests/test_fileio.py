"""Reading up to a limit, writing whole or not: kinds of file, temporary names, permissions."""

import contextlib
import errno
import json
import os
import resource
import signal
import stat
import time
from concurrent.futures import ThreadPoolExecutor

import matplotlib.image
import numpy as np
import pytest
import xarray as xr

from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes, remove_partials, replacing
from stewart_drake.files.jsonio import write_json
from stewart_drake.studies.jobs import run_jobs
from tests.copies import copied, kill, status_of
from tests.faults import tree
from tests.test_jobs import SETTINGS, numbered, text


def hidden(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


# ---------------------------------------------------------------- reading


def test_only_regular_files_are_read_and_up_to_a_limit(tmp_path):
    (tmp_path / "file").write_bytes(b"x" * 1000)
    os.symlink("file", tmp_path / "link")
    assert read_bytes(tmp_path / "link", 1000, "a file") == b"x" * 1000
    os.mkfifo(tmp_path / "pipe")
    os.symlink("/dev/zero", tmp_path / "zero")
    os.symlink("/dev/stdin", tmp_path / "stdin")
    for name in (".", "pipe", "zero"):
        with pytest.raises(ConfigError, match="is not a file; expected a file"):
            read_bytes(tmp_path / name, 1000, "a file")
    with pytest.raises(ConfigError, match="is larger than 0 kB"):
        read_bytes(tmp_path / "file", 999, "a file")


# ---------------------------------------------------------------- temporary names


def test_a_planted_link_is_not_followed(tmp_path):
    os.symlink(tmp_path / "made", tmp_path / ".lock")
    with pytest.raises(OSError, match="symbolic link"):
        run_jobs(numbered(1), text, tmp_path, settings=SETTINGS)
    assert not (tmp_path / "made").exists()


def test_writers_at_the_same_time_do_not_meet(tmp_path):
    contents = [str(number) * 100_000 for number in range(8)]

    def write(content):
        for _ in range(10):
            with replacing(tmp_path / "out.json") as partial:
                partial.write_text(content)
            assert (tmp_path / "out.json").read_text() in contents

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(write, contents))
    assert not hidden(tmp_path)
    with replacing(tmp_path / ("é" * 120)) as partial:  # 240 bytes, of 255 that a name may have
        partial.write_text("long")


def test_permissions_are_the_usual_ones(tmp_path):
    path = tmp_path / "out.json"
    before = os.umask(0o027)
    try:
        write_json(path, 1)
        assert stat.S_IMODE(path.stat().st_mode) == 0o640
        for mode in (0o600, 0o664, 0o444, 0o755):
            path.chmod(mode)
            write_json(path, mode)
            assert stat.S_IMODE(path.stat().st_mode) == mode
            assert path.read_text() == f"{mode}\n"
    finally:
        os.umask(before)


def test_errors_name_the_file_and_leave_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "out.json"
    path.write_text("old")

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*/out\.json'$"),
        replacing(path) as partial,
    ):
        partial.write_text("new")
    monkeypatch.undo()
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO):
        with pytest.raises(OSError, match=r"out\.json'$") as caught, replacing(path):
            raise OSError(number, os.strerror(number))
        assert caught.value.errno == number and caught.value.filename == str(path)
    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError, match=r"/folder'$"):
        write_json(tmp_path / "folder", 1)
    (tmp_path / "folder").rmdir()
    with pytest.raises(OSError, match=r"^what a library says$"), replacing(path):
        raise OSError("what a library says")
    with pytest.raises(OSError, match=r"out\.json'$") as caught, replacing(path) as partial:
        partial.unlink()
        partial.read_text()
    assert ".part" not in str(caught.value)
    with pytest.raises(FileNotFoundError, match=r"nowhere/out\.json'$"):
        write_json(tmp_path / "nowhere" / "out.json", 1)
    assert tree(tmp_path) == {"out.json": b"old"}


def test_what_kill_9_leaves_is_removed(tmp_path):
    def work():
        with replacing(tmp_path / "out.json") as partial:
            partial.write_text("half")
            (tmp_path / "ready").touch()
            time.sleep(60)

    with copied(work) as copy:
        limit = time.monotonic() + 20
        while not (tmp_path / "ready").exists():
            assert time.monotonic() < limit
            time.sleep(0.01)
        kill(copy)
    mine = tmp_path / ".mine.part"
    mine.touch()
    assert len(hidden(tmp_path)) == 2 and not (tmp_path / "out.json").exists()
    remove_partials(tmp_path)
    assert hidden(tmp_path) == [mine.name]


EXACT = ("--set", "plant.kind=exact", "--set", "duration=0.1", "--set", "delay.steps=1")


def check_whole(folder):
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


def said_at(largest, folder, *options):
    """Return the error of a run that may not write files larger than that."""

    def work():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))
        with said.open("w") as file, contextlib.redirect_stderr(file):
            return main(["simulate", *EXACT, "--quiet", *options])

    said = folder / "said"
    assert status_of(work) == 2
    return said.read_text()


@pytest.mark.parametrize("name", ["run.csv", "run.mcap"])
def test_a_full_disk_under_a_log_is_not_called_the_standard_output(name, tmp_path):
    said = said_at(8_000, tmp_path, "--log", str(tmp_path / name))
    assert said.endswith(f"File too large: '{tmp_path / name}'\n") and said.count("\n") == 1


@pytest.mark.parametrize("largest", [1_000, 20_000, 60_000])
def test_a_full_disk_is_one_line_and_leaves_no_half_file(largest, tmp_path):
    """A limit on the sizes of files stands for the disk; it holds in a copy of a process only."""

    out = tmp_path / "out"
    out.mkdir()
    assert f"File too large: '{out}/" in said_at(largest, tmp_path, "--out", str(out))
    check_whole(out)
    assert not list(out.glob(".*.part"))
    there = {path.name for path in out.iterdir()}
    assert "states.png" not in there and ("summary.json" in there) <= ("signals.nc" in there)
