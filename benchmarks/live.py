"""The loop in real time, in two processes: `python benchmarks/live.py [section ...]`.

Writes benchmarks/results/live.md. Sections: minutes (ten, or MINUTES of the environment), c (the
same with the controller of export-c, needs a C compiler and make), kills (KILLS of them), pauses
(PAUSES of either side), page (needs chromium). The machine is that of `paper` on the exact plant,
behind a link of 0.28 to 0.32 s each way that loses 2 % of the packets; every process shares this
computer's cores with whatever else runs on it, so that the load is told beside the figures.
"""

import itertools
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
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from _bench import QUICK, RESULTS, size

import stewart_drake as sd
from stewart_drake.files.versions import versions
from stewart_drake.loop.preparation import prepare
from stewart_drake.scenario.signals import POSE
from stewart_drake.scenario.trajectories import evaluate

ROOT = Path(__file__).parents[1]
MINUTES = float(os.environ.get("MINUTES", "1" if QUICK else "10"))
SIMULATED = float(os.environ.get("SIMULATED", "1"))
"""Of them, min; one ten seconds is as another after the first."""
KILLS = size("KILLS", 20)
PAUSES = size("PAUSES", 3)
SEED = 29
WAY = "low: 0.28, high: 0.32, loss: 0.02"
"""Evenly 20 ms to either side of 0.3 s."""
LINK = f"link={{kind: network, {WAY}, seed: {SEED}, return: {{{WAY}}}}}"
WINDOW = 10.0
"""s"""
PERIOD = 0.1
"""s, of the controller."""
SCALE = 2 * np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])
"""How far the motion goes, rad and m."""


class Command:
    """A command in a process of its own; `lines` are what it printed, with the time of day."""

    def __init__(self, *words: str) -> None:
        self.lines: list[tuple[float, str]] = []
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-m", "stewart_drake", *words],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

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
        """As by Ctrl-C, which a process in the background may not hear."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(30)
            except subprocess.TimeoutExpired:
                self.kill()
        self._reader.join(30)


def machine(*more: str) -> tuple[Command, str]:
    """A machine, and where it listens."""
    started = Command("machine", "paper", "--port", "0", "--set", "plant.kind=exact", *more)
    _, where = started.wait_for(r" at (127\.0\.0\.1:\d+)")
    return started, where


def live(where: str, *more: str) -> Command:
    """A controller without a page."""
    return Command("live", "paper", "--machine", where, "--no-browser", *more)


def before_others(process: subprocess.Popen[str]) -> bool:
    """Put it in real time, as `live` does itself; whether the system permits it."""
    try:
        os.sched_setscheduler(process.pid, os.SCHED_RR, os.sched_param(1))
    except (AttributeError, OSError):
        return False
    return True


def windows(times: np.ndarray, error: np.ndarray) -> np.ndarray:
    """E_ac of each WINDOW, % s, on the controller's samples.

    Args:
        times: (n,) s.
        error: (n, 6) of the pose at those.
    """
    number, each = int(times[-1] / PERIOD + 1e-9) + 1, round(WINDOW / PERIOD)
    share = np.interp(
        PERIOD * np.arange(number), times, 100 * np.mean(np.abs(error) / SCALE, axis=1)
    )
    return np.array(
        [np.trapezoid(share[i : i + each + 1], dx=PERIOD) for i in range(0, number - each, each)]
    )


def simulated(*settings: str) -> tuple[str, np.ndarray]:
    """How the simulation of `paper` under some settings ended, and its `windows`."""
    shorter = f"duration={min(60 * MINUTES, 60 * SIMULATED):g}"
    run = sd.simulate(sd.load_scenario("paper", settings=("plant.kind=exact", *settings, shorter)))
    return run.status, windows(run.signals.time.values, run.signals.error.values)


def table(rows: dict[str, np.ndarray]) -> list[str]:
    """Lines of what the `windows` of runs come to."""
    lines = [
        "| E_ac of 10 s, % s | first | median of the others | second worst | worst |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, each in rows.items():
        rest = np.sort(each[1:])
        cells = (each[0], np.median(rest), rest[-2], rest[-1])
        lines.append(f"| {name} | " + " | ".join(f"{cell:.4g}" for cell in cells) + " |")
    return lines


def loads_until(ended: Callable[[], bool]) -> str:
    """Wait, and tell the load of the computer meanwhile."""
    loads = [os.getloadavg()[0]]
    while not ended():
        time.sleep(1.0)
        loads.append(os.getloadavg()[0])
    return f"load {np.mean(loads):.1f} (up to {max(loads):.1f}) on {os.cpu_count()} cores"


# ---------------------------------------------------------------- ten minutes


def minutes() -> list[str]:
    """E_ac of every ten seconds beside that of the simulation under the same link."""
    with tempfile.TemporaryDirectory() as folder:
        began, where = machine("--set", LINK)
        before_others(began.process)
        run = live(where, "--duration", f"{60 * MINUTES:g}", "--out", folder)
        load = loads_until(lambda: run.process.poll() is not None)
        began.end()
        for each in (run, began):
            print("\n".join(line for _, line in each.lines[-4:]))
        summary = json.loads((Path(folder) / "summary.json").read_text())
        with xr.open_dataset(Path(folder) / "signals.nc") as opened:
            signals = opened.load()
    seen = summary["scenario"]["link"]
    one_way = {name: seen[name] for name in ("low", "high", "loss", "playout")}
    text = ", ".join(f"{name}: {value:.9g}" for name, value in one_way.items())
    status, as_injected = simulated(LINK)
    status_seen, as_seen = simulated(
        f"link={{kind: network, {text}, seed: {SEED}}}",
        f"sensor.loss={summary['scenario']['sensor']['loss']:.6g}",
    )
    rows = {
        "live": windows(signals.time.values, signals.error.values),
        "simulated, the same link each way": as_injected,
        "simulated, as the controller sees the link": as_seen,
    }
    told, s = summary["live"], summary["controller_step_ms"]
    late = told["sent_after_due_ms"]
    return [
        f"## {MINUTES:g} minutes",
        "",
        f"Ended: {summary['status']}; simulated for {SIMULATED:g} min: {status}, "
        f"{status_seen}. Both processes ran in {told['scheduled']}. "
        f"{told['samples']} samples, {told['deadlines_missed']} deadlines missed, "
        f"{summary['counts']['measurements_missing']} measurements missing, {told['periods_dry']} "
        f"periods dry, {told['recoveries']} ways planned anew. Torques went out "
        f"{late['median']:.0f} ms after the soonest measurement (99 %: {late['p99']:.0f}, worst "
        f"{late['worst']:.0f}), the law's step took {s['median']:.1f} ms (worst {s['worst']:.0f}); "
        f"{load}.",
        "",
        *table(rows),
        "",
        "The like-for-like simulation is the one as the controller sees the link: a measurement "
        "comes before the torque that rests on it leaves, and what is under way counts there and "
        "back. In the other one the first torque leaves at t = 0, before any measurement can have "
        "come, and acts at 0.5 s instead of 0.8 s: its first ten seconds are easier.",
    ]


# ---------------------------------------------------------------- ten minutes, in C


def exported(folder: Path, duration: float) -> Path:
    """The controller of `paper` in C, for torques 0.5 s ahead and measurements 0.4 s late."""
    late = f"sensor.delay={4 * PERIOD:g}"
    settings = ("plant.kind=exact", f"duration={duration:g}", "delay.steps=5", late)
    said = [word for setting in settings for word in ("--set", setting)]
    export = Command("export-c", "paper", "--out", str(folder), *said)
    assert export.process.wait() == 0, export.lines
    subprocess.run(["make", "-s", "udp"], cwd=folder, check=True)
    return folder / "stewart_udp"


def minutes_in_c() -> list[str]:
    """The same with the controller of export-c; the machine is the one in Python."""
    duration = 60 * MINUTES
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program, log = exported(folder, duration), folder / "log"
        began, where = machine("--set", LINK)
        words = [str(program), *where.split(":"), f"seconds={duration:g}", f"log={log}"]
        run = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        scheduled = before_others(began.process) and before_others(run)
        load = loads_until(lambda: run.poll() is not None)
        assert run.stdout is not None
        told = run.stdout.read().splitlines()
        began.end()
        print("\n".join([*told, *(line for _, line in began.lines[-4:])]))
        rows = np.loadtxt(log, delimiter=",")
    reference = prepare(sd.load_scenario("paper", settings=("plant.kind=exact",))).reference
    # The last column is how many periods ago it was measured; what did not come is not there.
    measured = rows[np.isfinite(rows[:, 1:7]).all(axis=1)]
    times = measured[:, 0] - PERIOD * measured[:, -1]
    wanted = np.array([evaluate(reference, time)[POSE] for time in times])
    status, as_injected = simulated(LINK)
    found = {
        "C over the link": windows(times, measured[:, 1:7] - wanted),
        "simulated, the same link each way": as_injected,
    }
    each, typical = found["C over the link"], np.median(as_injected[1:])
    dry = next(line for _, line in began.lines if "periods dry" in line)
    return [
        f"## {MINUTES:g} minutes in C",
        "",
        f"The C controller on the Python machine: {told[-2]}; {dry}; both with "
        f"{'real-time' if scheduled else 'usual'} priority; {load}. Simulated in Python "
        f"for {SIMULATED:g} min: {status}. {np.sum(each[1:] > 2 * typical)} of the "
        f"{len(each) - 1} windows after the first are over twice the simulated median.",
        "",
        *table(found),
        "",
        "E_ac of each ten seconds in C: " + ", ".join(f"{one:.4g}" for one in each) + ".",
    ]


# ---------------------------------------------------------------- kills


def kills() -> list[str]:
    """Either side is killed at random; what the other one does, and who takes over."""
    draw = random.Random(SEED)
    found: dict[str, list[Any]] = {"safe": [], "taken": [], "refused": [], "lost": []}
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
        f"- Without its machine a controller stopped after {min(found['lost']):.1f} to "
        f"{max(found['lost']):.1f} s.",
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
    at, _ = first.wait_for("lost machine", after=killed)
    found["lost"].append(at - killed)


# ---------------------------------------------------------------- pauses


def pauses() -> list[str]:
    """Either process is suspended for a second, as by SIGSTOP; what it says, and how it ends."""
    told = []
    for side in ("controller", "machine"):
        ends, lines = [], list[str]()
        for _ in range(PAUSES):
            began, where = machine("--set", LINK)
            run = live(where, "--duration", f"{WINDOW + 0.1:g}")
            began.wait_for("the run began")
            time.sleep(5.0)
            suspended = run if side == "controller" else began
            suspended.process.send_signal(signal.SIGSTOP)
            time.sleep(1.0)
            suspended.process.send_signal(signal.SIGCONT)
            _, said = suspended.wait_for("(stood still.*)")
            _, how = run.wait_for(r"(left workspace.*|lost (?:machine|contact).*|E_ac +[\d.]+)", 60)
            ends.append(" ".join(how.split()))
            silent, again = (began.has(words, 0.0) for words in ("safe torque", "act again"))
            lines.append(
                f"{said}{', to its safe torque' * silent}{', which torques ended' * again}"
            )
            run.process.wait(60)
            run.end()
            began.end()
            print(side, lines[-1], ends[-1], flush=True)
        told += [f"- The {side}: {line}; {end}." for line, end in zip(lines, ends, strict=True)]
    return [
        f"## {PAUSES} pauses of each side",
        "",
        f"Suspended for 1 s each, 5 s after the run began. Load {os.getloadavg()[0]:.1f} on "
        f"{os.cpu_count()} cores. E_ac in % s of the first ten seconds, which is 21.0 undisturbed.",
        "",
        *told,
    ]


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
        "| width, px | colours | frames per second | slider to loop, ms | ring at the target, ms |",
        "| --- | --- | --- | --- | --- |",
    ]
    try:
        with browser() as b:
            for width, scheme in itertools.product((1280, 400), ("light", "dark")):
                colors = [{"name": "prefers-color-scheme", "value": scheme}]
                b.call("Emulation.setEmulatedMedia", features=colors)
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
                lines.append(f"| {width} | {scheme} | {fps:.0f} | {hand:.0f} | {there:.0f} |")
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


SECTIONS = {
    "minutes": ("minutes", minutes),
    "c": ("in C", minutes_in_c),
    "kills": ("kills", kills),
    "pauses": ("of each side", pauses),
    "page": ("page", page),
}
"""By name: what the heading of a section ends with, and what finds it out."""


def main() -> None:
    """Run the sections that are asked for, and write those anew."""
    path = RESULTS / "live.md"
    for name in sys.argv[1:] or list(SECTIONS):
        ending, section = SECTIONS[name]
        lines = section()
        print("\n".join(lines))
        text = path.read_text() if path.exists() else ""
        found = re.split(r"(?m)^(?=## )", text)[1:]
        parts = {part.splitlines()[0]: part.strip() for part in found}
        parts = {head: part for head, part in parts.items() if not head.endswith(ending)}
        parts[lines[0]] = "\n".join(lines)
        head = f"Written by `python benchmarks/live.py`, with Drake {versions()['drake']}."
        RESULTS.mkdir(parents=True, exist_ok=True)
        told = "\n\n".join(["# The loop in real time", head, *parts.values()])
        path.write_text(told + "\n")


if __name__ == "__main__":
    main()
