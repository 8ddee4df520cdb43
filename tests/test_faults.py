"""A full disk: what is written is whole, and one line says what is not."""

import contextlib
import json
import resource
import signal

import matplotlib.image
import numpy as np
import pytest
import xarray as xr

from stewart_drake.cli import main
from tests.copies import status_of

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


@pytest.mark.parametrize("largest", [1_000, 20_000, 60_000])
def test_a_full_disk_is_one_line_and_leaves_no_half_file(largest, tmp_path):
    """A limit on the sizes of files stands for the disk; it holds in a copy of a process only."""

    def work():
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
