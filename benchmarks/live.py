"""The loop in real time, in two processes: `python benchmarks/live.py [section ...]`.

Writes benchmarks/results/live.md. Sections: minutes (ten, or MINUTES of the environment), kills
(KILLS of them), page (needs chromium). The machine is that of `paper` on the exact plant, behind a
link of 0.28 to 0.32 s each way that loses 2 % of the packets; every process shares this computer's
cores with whatever else runs on it, so that the load is told beside the figures.
"""

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import xarray as xr

import stewart_drake as sd
from stewart_drake.files.versions import versions

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
MINUTES = float(os.environ.get("MINUTES", "10"))
SIMULATED = float(os.environ.get("SIMULATED", "1"))
"""Of them, min; one ten seconds is as another after the first."""
KILLS = int(os.environ.get("KILLS", "20"))
SEED = 29
WAY = "low: 0.28, high: 0.32, loss: 0.02"
"""Evenly 20 ms to either side of 0.3 s."""
LINK = f"link={{kind: network, {WAY}, seed: {SEED}, return: {{{WAY}}}}}"
WINDOW = 10.0
"""s"""
COMMAND = "import sys; from stewart_drake.cli import main; sys.exit(main(sys.argv[1:]))"


class Command:
    """A command in a process of its own; `lines` are what it printed, with the time of day."""

    def __init__(self, *words: str) -> None:
        self.lines: list[tuple[float, str]] = []
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-c", COMMAND, *words],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append((time.monotonic(), line.strip()))

    def wait_for(
        self, pattern: str, patience: float = 120.0, after: float = 0.0
    ) -> tuple[float, str]:
        """When a line came, not before `after`, that has the pattern, and what it has in brackets.

        Raises:
            TimeoutError: it did not.
        """
        end = time.monotonic() + patience
        while time.monotonic() < end:
            for at, line in list(self.lines):
                found = re.search(pattern, line)
                if found and at >= after:
                    return at, found.group(1) if found.groups() else line
            time.sleep(0.01)
        told = "\n".join(line for _, line in self.lines)
        raise TimeoutError(f"{pattern!r} is not in:\n{told}")

    def has(self, pattern: str, after: float) -> bool:
        """Whether such a line came after that."""
        return any(re.search(pattern, line) for at, line in list(self.lines) if at >= after)

    def kill(self) -> float:
        """At once; when."""
        self.process.kill()
        self.process.wait()
        return time.monotonic()

    def end(self) -> None:
        """As by Ctrl-C."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(30)
            except subprocess.TimeoutExpired:
                self.kill()


def machine(*more: str) -> tuple[Command, str]:
    """A machine, and where it listens."""
    started = Command("machine", "paper", "--port", "0", "--set", "plant.kind=exact", *more)
    _, where = started.wait_for(r" at (127\.0\.0\.1:\d+)")
    return started, where


def live(where: str, *more: str) -> Command:
    """A controller without a page."""
    return Command("live", "paper", "--machine", where, "--no-browser", *more)


def windows(signals: xr.Dataset, scale: np.ndarray, period: float) -> np.ndarray:
    """E_ac of each WINDOW, % s, on the controller's samples."""
    times = signals.time.values
    samples = period * np.arange(int(times[-1] / period + 1e-9) + 1)
    error = signals.error.sel(time=samples, method="nearest").values
    share = 100 * np.mean(np.abs(error) / scale, axis=1)
    each = round(WINDOW / period)
    return np.array(
        [
            np.trapezoid(share[i : i + each + 1], dx=period)
            for i in range(0, len(share) - each + 1, each)
        ]
    )


# ---------------------------------------------------------------- ten minutes


def minutes() -> list[str]:
    """E_ac of every ten seconds beside that of the simulation under the same link."""
    duration = 60 * MINUTES
    with tempfile.TemporaryDirectory() as folder:
        began, where = machine("--set", LINK)
        with contextlib.suppress(OSError, AttributeError):  # a machine's end has nothing else to do
            os.sched_setscheduler(began.process.pid, os.SCHED_RR, os.sched_param(1))
        run = live(where, "--duration", f"{duration:g}", "--out", folder)
        loads = []
        while run.process.poll() is None:
            loads.append(os.getloadavg()[0])
            time.sleep(5.0)
        began.end()
        for each in (run, began):
            print("\n".join(line for _, line in each.lines[-4:]))
        summary = json.loads((Path(folder) / "summary.json").read_text())
        with xr.open_dataset(Path(folder) / "signals.nc") as opened:
            signals = opened.load()
    shorter = f"duration={min(duration, 60 * SIMULATED):g}"
    settings = ("plant.kind=exact", LINK, shorter)
    simulated = sd.simulate(sd.load_scenario("paper", settings=settings))
    seen = summary["scenario"]["link"]
    one_way = {name: seen[name] for name in ("low", "high", "loss", "playout")}
    text = ", ".join(f"{name}: {value:.9g}" for name, value in one_way.items())
    as_seen = (
        "plant.kind=exact",
        f"link={{kind: network, {text}, seed: {SEED}}}",
        f"sensor.loss={summary['scenario']['sensor']['loss']:.6g}",
        shorter,
    )
    round_trip = sd.simulate(sd.load_scenario("paper", settings=as_seen))
    scale = 2 * np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])
    rows = {
        "live": windows(signals, scale, 0.1),
        "simulated, the same link each way": windows(simulated.signals, scale, 0.1),
        "simulated, as the controller sees the link": windows(round_trip.signals, scale, 0.1),
    }
    told, s = summary["live"], summary["controller_step_ms"]
    late = told["sent_after_due_ms"]
    lines = [
        f"## {MINUTES:g} minutes",
        "",
        f"Ended: {summary['status']}; simulated for {SIMULATED:g} min: {simulated.status}, "
        f"{round_trip.status}. Both processes ran in {told['scheduled']}. "
        f"{told['samples']} samples, {told['deadlines_missed']} deadlines missed, "
        f"{summary['counts']['measurements_missing']} measurements missing, {told['periods_dry']} "
        f"periods dry, {told['recoveries']} ways planned anew. Torques went out "
        f"{late['median']:.0f} ms after the soonest measurement (99 %: {late['p99']:.0f}, worst "
        f"{late['worst']:.0f}), the law's step took {s['median']:.1f} ms (worst {s['worst']:.0f}). "
        f"Load of the computer {np.mean(loads):.1f} (up to {max(loads):.1f}) on "
        f"{os.cpu_count()} cores.",
        "",
        "| E_ac of 10 s, % s | first | median of the others | second worst | worst |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, each in rows.items():
        rest = np.sort(each[1:])
        cells = (each[0], np.median(rest), rest[-2], rest[-1])
        lines.append(f"| {name} | " + " | ".join(f"{cell:.4g}" for cell in cells) + " |")
    return lines


# ---------------------------------------------------------------- kills


def kills() -> list[str]:
    """Either side is killed at random; what the other one does, and who takes over."""
    draw = random.Random(SEED)
    found: dict[str, list[Any]] = {"safe": [], "taken": [], "refused": [], "lost": [], "late": []}
    number = void = 0
    while number < KILLS:
        side = draw.choice(("controller", "machine"))
        wait, restart = draw.uniform(1.0, 6.0), draw.choice(("rest", "motion"))
        options = ("--restart", restart, "--set", LINK)
        began, where = machine(*options)
        first = live(where)
        began.wait_for("the run began")
        spare = live(where) if side == "controller" else None
        if spare is not None:
            spare.wait_for("^motion:")  # it waits for its turn, for five seconds
            wait = min(wait, 3.0)
        time.sleep(wait)
        if first.process.poll() is not None:  # the load was too much before anybody was killed
            void += 1
            for each in (first, began, *([] if spare is None else [spare])):
                each.end()
            continue
        number += 1
        killed = first.kill() if side == "controller" else began.kill()
        if spare is not None:
            _controller_killed(began, spare, killed, restart, found)
        else:
            _machine_killed(first, killed, found)
        for each in (first, began, *([] if spare is None else [spare])):
            each.end()
        print(
            number, side, restart, {name: len(those) for name, those in found.items()}, flush=True
        )
    safe, taken, refused = found["safe"], found["taken"], found["refused"]
    return [
        f"## {KILLS} kills",
        "",
        f"The controller was killed {len(safe)} times, the machine {len(found['lost'])} times, at "
        f"random; {void} runs had ended before that. Load {os.getloadavg()[0]:.1f} on "
        f"{os.cpu_count()} cores.",
        "",
        f"- The machine was at its safe torque after {min(safe):.2f} to {max(safe):.2f} s; it "
        "promises 1 s after the last word, which is up to 0.32 s on its way.",
        f"- A controller that waited took over {len(taken)} times: "
        + ", ".join(f"{sum(t == kind for t in taken)} {kind}" for kind in ("at rest", "in motion"))
        + f"; refused {len(refused)} times"
        + (f" ({'; '.join(refused)})" if refused else "")
        + ".",
        f"- Without its machine a controller said so after {max(found['late']):.1f} s at the most, "
        f"and stopped after {min(found['lost']):.1f} to {max(found['lost']):.1f} s.",
    ]


def _controller_killed(
    began: Command, spare: Command, killed: float, restart: str, found: dict[str, list[Any]]
) -> None:
    at, _ = began.wait_for("the safe torque|begins at rest|in motion", after=killed)
    found["safe"].append(at - killed)
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if spare.has("there is no way|^refused|error", killed):
            line = next(t for _, t in spare.lines if re.search("there is no way|^refused|error", t))
            found["refused"].append(line)
            return
        if began.has("torques act again|the run began", killed):
            time.sleep(4.0)  # and it stays so
            left = began.has("left its workspace", killed)
            found["taken" if not left else "refused"].append(
                ("at rest" if restart == "rest" else "in motion") if not left else "left"
            )
            return
        time.sleep(0.05)
    raise TimeoutError("\n".join(line for _, line in (*spare.lines, *began.lines)))


def _machine_killed(first: Command, killed: float, found: dict[str, list[Any]]) -> None:
    at, _ = first.wait_for("the machine is silent", after=killed)
    found["late"].append(at - killed)
    at, _ = first.wait_for("lost machine", after=killed)
    found["lost"].append(at - killed)


# ---------------------------------------------------------------- the page


def page() -> list[str]:
    """What a browser makes of it: frames per second, and how long a slider waits."""
    sys.path.insert(0, str(ROOT / "tests"))
    from browser import browser

    frames = (
        "new Promise(done => { let n = 0; const t0 = performance.now(); const next = t => "
        "{ n++; t - t0 > 3000 ? done(1000 * n / (t - t0)) : requestAnimationFrame(next); }; "
        "requestAnimationFrame(next); })"
    )
    moved = (
        "new Promise(done => { const s = document.getElementById('s5'), t0 = performance.now(); "
        "const was = window.live.wanted[5]; let hand = 0; "
        "source.addEventListener('message', e => { const now = JSON.parse(e.data); "
        "hand ||= now.byHand ? performance.now() - t0 : 0; "
        "const there = Math.abs(now.wanted[5] - (+s.value)) < 1; "
        "if (hand && there) done([hand, performance.now() - t0]); }); "
        "s.value = 390; s.dispatchEvent(new Event('input')); "
        "setTimeout(() => done([-1, -1]), 20000); })"
    )
    run = Command("live", "--demo", "--duration", "300")
    _, url = run.wait_for(r"page: (\S+)", 180)
    lines = [
        "## The page",
        "",
        "| width, px | frames per second | slider to loop, ms | to the ring at the target, ms |",
        "| --- | --- | --- | --- |",
    ]
    try:
        with browser() as b:
            for width in (1280, 400):
                b.call(
                    "Emulation.setDeviceMetricsOverride",
                    width=width,
                    height=800,
                    deviceScaleFactor=1,
                    mobile=width < 600,
                )
                b.call("Page.navigate", url=url)
                b.wait("window.live !== undefined && window.live.time > 5 && !window.live.byHand")
                time.sleep(3.0)
                fps, (hand, there) = b.evaluate(frames), b.evaluate(moved)
                b.evaluate("document.getElementById('motion').click()")
                time.sleep(4.0)
                lines.append(f"| {width} | {fps:.0f} | {hand:.0f} | {there:.0f} |")
                assert b.evaluate("document.documentElement.scrollWidth") <= width
            errors = b.errors
    finally:
        run.end()
    load = os.getloadavg()[0]
    return [
        *lines,
        "",
        f"Errors in the browser: {len(errors)}. Drawn in software, load {load:.1f}.",
    ]


SECTIONS = {"minutes": minutes, "kills": kills, "page": page}


def main() -> None:
    """Run the sections that are asked for, and write those anew."""
    path = RESULTS / "live.md"
    known = {"minutes": "minutes", "kills": "kills", "page": "The page"}
    for name in sys.argv[1:] or list(SECTIONS):
        lines = SECTIONS[name]()
        print("\n".join(lines))
        text = path.read_text() if path.exists() else ""
        found = re.split(r"(?m)^(?=## )", text)[1:]
        parts = {part.splitlines()[0]: part.strip() for part in found}
        parts = {head: part for head, part in parts.items() if known[name] not in head}
        parts[lines[0]] = "\n".join(lines)
        head = f"Written by `python benchmarks/live.py`, with Drake {versions()['drake']}."
        RESULTS.mkdir(exist_ok=True)
        told = "\n\n".join(["# The loop in real time", head, *parts.values()])
        path.write_text(told + "\n")


if __name__ == "__main__":
    main()
