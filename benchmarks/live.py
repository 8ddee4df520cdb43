"""The loop in real time, in two processes: `python benchmarks/live.py [section ...]`.

A named section replaces its part of the page. Sections: minutes (ten, or MINUTES of the
environment), c (the same with the controller of export-c, needs a C compiler and make), kills
(KILLS of them), pauses (PAUSES of either side), page (needs chromium). The machine is that of
`paper` on the exact plant, behind a link of 0.28 to 0.32 s each way that loses 2 % of the packets.
All processes share the cores of one computer, so that the load is given with the figures.
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
from _bench import AMPLITUDE, EXACT, QUICK, RESULTS, section, size, table

import stewart_drake as sd
from stewart_drake.files.versions import versions
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.trajectories import rows_along
from stewart_drake.scenario.signals import POSE

ROOT = Path(__file__).parents[1]
MINUTES = float(os.environ.get("MINUTES", "1" if QUICK else "10"))
SIMULATED = float(os.environ.get("SIMULATED", "1"))
"""Simulated minutes; after the first ten seconds all are alike."""
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
SCALE = 2 * AMPLITUDE
"""Peak to peak of the motion, rad and m."""


class Command:
    """Command in another process; `lines` are its output, with the time of each."""

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
        """Return the time of a line with the pattern, not before `after`, and its first group.

        Raises:
            TimeoutError: there was none.
        """
        end = time.monotonic() + patience
        while time.monotonic() < end:
            for at, line in list(self.lines):
                found = re.search(pattern, line)
                if found and at >= after:
                    return at, found.group(1) if found.groups() else line
            time.sleep(0.01)
        text = "\n".join(line for _, line in self.lines)
        raise TimeoutError(f"{pattern!r} is not in:\n{text}")

    def has(self, pattern: str, after: float) -> bool:
        """Return whether a line with the pattern came after a time."""
        return any(re.search(pattern, line) for at, line in list(self.lines) if at >= after)

    def kill(self) -> float:
        """Kill the process; return the time."""
        self.process.kill()
        self.process.wait()
        return time.monotonic()

    def end(self) -> None:
        """End the process as by Ctrl-C, which a process in the background may not receive."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(30)
            except subprocess.TimeoutExpired:
                self.kill()
        self._reader.join(30)


def machine(*more: str) -> tuple[Command, str]:
    """Start a machine; return it and its address."""
    started = Command("machine", "paper", "--port", "0", "--set", EXACT, *more)
    _, where = started.wait_for(r" at (127\.0\.0\.1:\d+)")
    return started, where


def live(where: str, *more: str) -> Command:
    """Start a controller without a page."""
    return Command("live", "paper", "--machine", where, "--no-browser", *more)


def before_others(process: subprocess.Popen[str]) -> bool:
    """Return whether the process got real-time priority, as `live` gives itself."""
    try:
        os.sched_setscheduler(process.pid, os.SCHED_RR, os.sched_param(1))
    except (AttributeError, OSError):
        return False
    return True


def windows(times: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return E_ac of each WINDOW, % s, on the controller's samples.

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
    """Simulate `paper` with some settings; return its status and its `windows`."""
    shorter = f"duration={min(60 * MINUTES, 60 * SIMULATED):g}"
    run = sd.simulate(sd.load_scenario("paper", settings=(EXACT, *settings, shorter)))
    return run.status, windows(run.signals.time.values, run.signals.error.values)


def windows_table(rows: dict[str, np.ndarray]) -> str:
    """Return a table of the `windows` of runs."""
    lines = []
    for name, each in rows.items():
        rest = np.sort(each[1:])
        cells = (each[0], np.median(rest), rest[-2], rest[-1])
        lines.append([name, *(f"{cell:.4g}" for cell in cells)])
    heads = ["E_ac of 10 s, % s", "first", "median of the others", "second worst", "worst"]
    return table(heads, lines)


def load() -> str:
    return f"Load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."


def loads_until(ended: Callable[[], bool]) -> str:
    """Wait; return the load of the computer during this time."""
    loads = [os.getloadavg()[0]]
    while not ended():
        time.sleep(1.0)
        loads.append(os.getloadavg()[0])
    return f"load {np.mean(loads):.1f} (up to {max(loads):.1f}) on {os.cpu_count()} cores"


# ---------------------------------------------------------------- ten minutes


def minutes() -> str:
    """Return E_ac of every ten seconds, compared with simulations under the same link."""
    with tempfile.TemporaryDirectory() as folder:
        began, where = machine("--set", LINK)
        before_others(began.process)
        run = live(where, "--duration", f"{60 * MINUTES:g}", "--out", folder)
        loads = loads_until(lambda: run.process.poll() is not None)
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
    counts, s = summary["live"], summary["controller_step_ms"]
    late = counts["sent_after_due_ms"]
    return section(
        f"{MINUTES:g} minutes",
        f"Ended: {summary['status']}; simulated for {SIMULATED:g} min: {status}, "
        f"{status_seen}. Both processes ran in {counts['scheduled']}. "
        f"{counts['samples']} samples, {counts['deadlines_missed']} deadlines missed, "
        f"{summary['counts']['measurements_missing']} measurements missing, "
        f"{counts['periods_dry']} periods dry, {counts['recoveries']} plans. Torques went out "
        f"{late['median']:.0f} ms after the soonest measurement (99 %: {late['p99']:.0f}, worst "
        f"{late['worst']:.0f}), the law's step took {s['median']:.1f} ms (worst {s['worst']:.0f}); "
        f"{loads}.",
        windows_table(rows),
        "The like-for-like simulation is the one as the controller sees the link: a measurement "
        "comes before the torque that rests on it leaves, and what is under way counts there and "
        "back. In the other one the first torque leaves at t = 0, before any measurement can have "
        "come, and acts at 0.5 s instead of 0.8 s: its first ten seconds are easier.",
    )


# ---------------------------------------------------------------- ten minutes, in C


def exported(folder: Path, duration: float) -> Path:
    """Export the controller of `paper` for torques 0.5 s ahead and measurements 0.4 s late."""
    late = f"sensor.delay={4 * PERIOD:g}"
    settings = (EXACT, f"duration={duration:g}", "delay.steps=5", late)
    said = [word for setting in settings for word in ("--set", setting)]
    export = Command("export-c", "paper", "--out", str(folder), *said)
    assert export.process.wait() == 0, export.lines
    subprocess.run(["make", "-s", "udp"], cwd=folder, check=True)
    return folder / "stewart_udp"


def minutes_in_c() -> str:
    """Return the same with the controller of export-c; the machine is the one in Python."""
    duration = 60 * MINUTES
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program, log = exported(folder, duration), folder / "log"
        began, where = machine("--set", LINK)
        words = [str(program), *where.split(":"), f"seconds={duration:g}", f"log={log}"]
        run = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        scheduled = before_others(began.process) and before_others(run)
        loads = loads_until(lambda: run.poll() is not None)
        assert run.stdout is not None
        output = run.stdout.read().splitlines()
        began.end()
        print("\n".join([*output, *(line for _, line in began.lines[-4:])]))
        rows = np.loadtxt(log, delimiter=",", skiprows=1)
    reference = prepare(sd.load_scenario("paper", settings=(EXACT,))).reference
    # The last column is the age of the measurement in periods; missing ones are NaN.
    measured = rows[np.isfinite(rows[:, 1:7]).all(axis=1)]
    times = measured[:, 0] - PERIOD * measured[:, -1]
    wanted = rows_along(reference, times)[:, POSE]
    status, as_injected = simulated(LINK)
    found = {
        "C over the link": windows(times, measured[:, 1:7] - wanted),
        "simulated, the same link each way": as_injected,
    }
    each, typical = found["C over the link"], np.median(as_injected[1:])
    dry = next(line for _, line in began.lines if "periods dry" in line)
    return section(
        f"{MINUTES:g} minutes in C",
        f"The C controller on the Python machine: {output[-2]}; {dry}; both with "
        f"{'real-time' if scheduled else 'usual'} priority; {loads}. Simulated in Python "
        f"for {SIMULATED:g} min: {status}. {np.sum(each[1:] > 2 * typical)} of the "
        f"{len(each) - 1} windows after the first are over twice the simulated median.",
        windows_table(found),
        "E_ac of each ten seconds in C: " + ", ".join(f"{one:.4g}" for one in each) + ".",
    )


# ---------------------------------------------------------------- kills


def kills() -> str:
    """Kill either side at random; return the reaction of the other one, and who takes over."""
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
            spare.wait_for("^motion:")  # it waits for five seconds
            wait = min(wait, 3.0)
        time.sleep(wait)
        if first.process.poll() is not None:  # the load was too high before the kill
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
    return section(
        f"{KILLS} kills",
        f"The controller was killed {len(safe)} times, the machine {len(found['lost'])} times, at "
        f"random; {void} runs had ended before that. {load()}",
        "\n".join(
            [
                f"- The machine was at its safe torque after {min(safe):.2f} to {max(safe):.2f} s; "
                "its limit is 1 s after the last packet, which takes up to 0.32 s.",
                f"- A controller that waited took over {len(taken)} times: "
                + ", ".join(
                    f"{sum(t == kind for t in taken)} {kind}" for kind in ("at rest", "in motion")
                )
                + f"; refused {len(refused)} times"
                + (f" ({'; '.join(refused)})" if refused else "")
                + ".",
                f"- Without its machine a controller stopped after {min(found['lost']):.1f} to "
                f"{max(found['lost']):.1f} s.",
            ]
        ),
    )


def _controller_killed(
    began: Command, spare: Command, killed: float, restart: str, found: dict[str, list[Any]]
) -> None:
    at, _ = began.wait_for("the safe torque|begins at rest|in motion", after=killed)
    found["safe"].append(at - killed)
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if spare.has("no reference from the present pose|^refused|error", killed):
            line = next(
                t
                for _, t in spare.lines
                if re.search("no reference from the present pose|^refused|error", t)
            )
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


def pauses() -> str:
    """Suspend either process for a second by SIGSTOP; return its message and the end."""
    items = []
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
        items += [f"- The {side}: {line}; {end}." for line, end in zip(lines, ends, strict=True)]
    return section(
        f"{PAUSES} pauses of each side",
        f"Suspended for 1 s each, 5 s after the run began. {load()} E_ac in % s of the first ten "
        "seconds, which is 21.0 undisturbed.",
        "\n".join(items),
    )


# ---------------------------------------------------------------- the page


def page() -> str:
    """Return frames per second in a browser, and the latency of a slider."""
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
    rows = []
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
                rows.append([width, scheme, f"{fps:.0f}", f"{hand:.0f}", f"{there:.0f}"])
                assert b.evaluate("document.documentElement.scrollWidth") <= width
            errors = b.errors
    finally:
        run.end()
    heads = ["width, px", "colours", "frames per second", "slider to loop, ms"]
    words = f"Errors in the browser: {len(errors)}. Rendered in software. {load()}"
    return section("The page", table([*heads, "ring at the target, ms"], rows), words)


SECTIONS = {
    "minutes": ("minutes", minutes),
    "c": ("in C", minutes_in_c),
    "kills": ("kills", kills),
    "pauses": ("of each side", pauses),
    "page": ("page", page),
}
"""By name: end of the heading of a section, and the function that makes it."""


def main() -> None:
    path = RESULTS / "live.md"
    for name in sys.argv[1:] or list(SECTIONS):
        ending, make = SECTIONS[name]
        made = make()
        print(made)
        text = path.read_text() if path.exists() else ""
        found = re.split(r"(?m)^(?=## )", text)[1:]
        parts = {part.splitlines()[0]: part.strip() for part in found}
        parts = {head: part for head, part in parts.items() if not head.endswith(ending)}
        parts[made.splitlines()[0]] = made.strip()
        head = f"Written by `python benchmarks/live.py`, with Drake {versions()['drake']}."
        RESULTS.mkdir(parents=True, exist_ok=True)
        pieces = ["# The loop in real time", head, *parts.values()]
        path.write_text("\n\n".join(pieces) + "\n")


if __name__ == "__main__":
    main()
