"""A disk that is full: a clear line, no half file, and the work goes on once there is room."""

import contextlib
import ctypes
import io
import os
import resource
import signal
import subprocess
import traceback
from collections.abc import Callable
from pathlib import Path

import pytest

from stewart_drake.cli import main
from stewart_drake.tuning.data import data_hash, load_data
from tests.copies import status_of
from tests.test_faults import EXACT, check_whole, finished_runs, little_dataset


def on_small_disk(folder: Path, body: Callable[[Callable[[int], None]], None]) -> None:
    """Run `body` in a copy of a process that alone sees a disk mounted on `folder`.

    It is handed a function that gives the disk so many kB. Whatever happens, nothing stays mounted.
    """
    folder.mkdir()
    trace = folder.parent / "trace"

    def sized(kilobytes: int) -> None:
        remount = "remount," if os.path.ismount(folder) else ""
        options = f"{remount}size={kilobytes}k"
        subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)

    def work() -> int:
        new_mounts = 0x00020000  # CLONE_NEWNS
        if ctypes.CDLL(None).unshare(new_mounts) or subprocess.call(
            ["mount", "--make-rprivate", "/"]
        ):
            return 77
        try:
            body(sized)
        except BaseException:
            trace.write_text(traceback.format_exc())
            raise
        return 0

    status = status_of(work)
    if status == 77:
        pytest.skip("a small disk can only be mounted by root, where namespaces are allowed")
    assert status == 0, trace.read_text()


def fill(folder: Path) -> None:
    """Leave not a byte."""
    with pytest.raises(OSError), (folder / "filling").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))


@pytest.mark.slow
def test_a_full_disk_stops_a_data_set_that_then_goes_on(tmp_path):
    whole, disk = tmp_path / "whole", tmp_path / "disk"
    little_dataset(whole)

    def body(sized: Callable[[int], None]) -> None:
        sized(100)
        with pytest.raises(OSError, match=r"No space left on device: '.*\.npz'"):
            little_dataset(disk)
        kept = finished_runs(disk, "conditions/*.npz")
        assert 0 < len(kept) < 2 and not list(disk.rglob(".*.part"))
        sized(10_000)
        little_dataset(disk)
        after = finished_runs(disk, "conditions/*.npz")
        assert {name: after[name] for name in kept} == kept
        assert data_hash(load_data(disk)) == data_hash(load_data(whole))

    on_small_disk(disk, body)


@pytest.mark.slow
def test_a_full_disk_leaves_no_half_result(tmp_path):
    """From no room at all to room for the signals, the summary and some of the figures."""
    arguments = ["simulate", *EXACT, "--quiet", "--out"]
    disk = tmp_path / "disk"
    assert main([*arguments, str(tmp_path / "whole")]) == 0
    pages = {p.name: -(-p.stat().st_size // 4096) for p in (tmp_path / "whole").iterdir()}
    pictures = {name for name in pages if name.endswith((".png", ".svg"))}
    results = {"signals.nc", "summary.json"}
    needed = 4 * sum(pages[name] for name in results)
    figures = 4 * sum(pages[name] for name in pictures)
    assert pages["signals.nc"] > 4

    def body(sized: Callable[[int], None]) -> None:
        for room in (4, needed // 2, needed + figures // 2):
            sized(room)
            if room == 4:
                fill(disk)
            with contextlib.redirect_stderr(io.StringIO()) as said:
                assert main([*arguments, str(disk)]) == 2
            err = said.getvalue()
            assert err.startswith("error: ") and err.count("\n") == 1, err
            assert f"No space left on device: '{disk}/" in err, err
            (disk / "filling").unlink(missing_ok=True)
            check_whole(disk)
            there = {path.name for path in disk.iterdir()}
            assert not list(disk.glob(".*.part"))
            assert (results <= there) == (room > needed)
            assert there & pictures < pictures
        sized(10_000)
        assert main([*arguments, str(disk)]) == 0
        check_whole(disk)

    on_small_disk(disk, body)


@pytest.mark.parametrize("largest", [1_000, 20_000, 60_000])
def test_a_limit_on_file_sizes_is_one_line_as_well(largest, tmp_path):
    """Which needs no root; the limit holds in a copy of a process only."""

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
