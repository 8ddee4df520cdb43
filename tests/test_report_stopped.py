"""A report that is stopped in the middle, by Ctrl-C or kill -9, leaves no half file."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

SETTINGS = ("--set", "plant.kind=exact", "--set", "duration=2.0")


def started(code: str, folder: Path) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", code, str(folder)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=Path(__file__).parents[1],
    )


def test_ctrl_c_ends_it_with_nothing_written(tmp_path):
    code = (
        "import sys; from stewart_drake.cli import main;"
        f"sys.exit(main(['report', *{SETTINGS!r}, '--out', sys.argv[1]]))"
    )
    process = started(code, tmp_path)
    time.sleep(8.0)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err
    assert os.listdir(tmp_path) == []


def test_kill_9_leaves_no_half_page(tmp_path):
    """Killed at some moment while pages of several MB are written over and over."""
    code = """if True:
        import sys
        from pathlib import Path
        from stewart_drake.report.page import Page, Provenance, Section, write_page
        folder = Path(sys.argv[1])
        page = Page("t", "v", [Section("s", listing="x" * 20_000_000)], Provenance("c"))
        while True:
            write_page(page, folder / "report.html")
    """
    for wait in (0.0, 0.013, 0.037, 0.071):
        process = started(code, tmp_path)
        before = time.time()
        while process.poll() is None and not any(
            path.stat().st_mtime > before for path in tmp_path.glob("report.html")
        ):
            time.sleep(0.001)
        time.sleep(wait)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=60)
        assert (tmp_path / "report.html").read_text().rstrip().endswith("</html>")
