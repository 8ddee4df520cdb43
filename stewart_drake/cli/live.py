"""Commands of the loop in real time: live, and machine, a simulated machine."""

import contextlib
import ctypes
import math
import signal
import subprocess
import sys
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from stewart_drake.cli.common import (
    AsJson,
    Controller,
    Delivery,
    Out,
    Quiet,
    ScenarioName,
    Settings,
    check_log,
)
from stewart_drake.cli.options import Given, with_options
from stewart_drake.files.errors import ConfigError
from stewart_drake.live.options import LiveOptions, MachineOptions
from stewart_drake.reporting.terminal import echo
from stewart_drake.scenario.loading import load_scenario

if TYPE_CHECKING:
    from stewart_drake.live.page import PageViewer
    from stewart_drake.loop.results import SimulationResult
    from stewart_drake.scenario.config import Scenario

LOG: Final = "log.csv"
_EACH_WAY: Final = (0.35, 0.4)
"""Transit time of the demo's link each way, as a share of the scenario's delay."""
_LOST: Final = 0.02
"""Loss of the demo's link each way."""
_REQUESTS: Final = (signal.SIGINT, signal.SIGTERM)


@with_options(LiveOptions)
def live(
    *,
    scenario: ScenarioName = "paper",
    machine: str | None = typer.Option(None, metavar="HOST:PORT", help="Address of the machine."),
    demo: bool = typer.Option(
        False,
        "--demo",
        help="Start a simulated machine too, with 0.35 to 0.4 of the delay each way.",
    ),
    no_browser: bool = typer.Option(False, "--no-browser", help="Open no page."),
    given: Given,
    controller: Controller = None,
    settings: Settings = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Drive a machine over UDP in real time.

    The law is that of `simulate`; a page in the browser has sliders for the pose. Ctrl-C brings the
    plate to rest and ends the run; Ctrl-C again, or Stop on the page, stops it at once.
    """
    if (machine is None) != demo:
        raise ConfigError("--machine: expected either --machine HOST:PORT or --demo")
    options = given.options()
    with given.named():
        options.check_learned()
    loaded = load_scenario(scenario, controller, settings or ())
    delivery = Delivery(out, quiet, as_json)
    span = math.inf if options.duration is None else options.duration
    name = Path(scenario).stem
    if options.learn:
        if options.hold or {options.duration, options.log, options.mirror} != {None}:
            raise ConfigError(
                "--learn: expected none of --duration, --log, --mirror and --hold with it"
            )
        return _learn(scenario, loaded, machine, options, (controller, settings or ()), delivery)

    from stewart_drake.live.contact import address_of
    from stewart_drake.live.endpoint import read_key

    key = read_key(options.key)
    check_log(options.log)
    for option, address in (("--machine", machine), ("--mirror", options.mirror)):
        if address is not None:
            address_of(address, option)
    with contextlib.ExitStack() as running:
        viewer = None if no_browser else running.enter_context(_page(loaded, name))
        where = machine or running.enter_context(
            _demo_machine(scenario, loaded.eta, controller, settings or ())
        )
        from stewart_drake.live import session

        delivery.say(f"calling {where}")
        ready = session.prepare_session(loaded, address_of(where), key)
        delivery.say_wrapped(*session.plans(ready, span, name))
        session.check_armed(ready, options.armed)
        # The demo's machine is simulated and needs no consent.
        problem = None if options.accept_jitter or demo else ready.jitter_problem
        session.check_jitter(ready, problem is None or _agreed(problem))
        if viewer is not None:
            url = viewer.opened()
            echo(f"page: {url}", error=True)  # also with --quiet
            if sys.stdout.isatty():
                webbrowser.open(url)
        if not ready.simulated and sys.stdin.isatty():
            input("Enter begins, Ctrl-C leaves it alone")
        delivery.discard("signals.nc")
        how: Any = options.model_dump(include={"armed", "max_missing", "hold"}) | {"viewer": viewer}
        how["log"] = None if out is None else out / LOG
        how["logs"] = session.open_logs(ready, options, delivery.say_wrapped)
        with _Ending() as ending:
            result = session.drive(
                ready, span, ending=ending, say=delivery.say_wrapped, accept_jitter=True, **how
            )
    if options.log is not None:
        delivery.say(f"log written to {options.log}")
    return _delivered(delivery, result)


def _learn(
    scenario: str,
    loaded: "Scenario",
    machine: str | None,
    options: LiveOptions,
    more: tuple[str | None, Sequence[str]],
    delivery: Delivery,
) -> int:
    """Learn torques or setpoints, and deliver the run."""
    from stewart_drake.live.learning import learn_live
    from stewart_drake.studies.learn import check_learning

    check_learning(loaded)
    with contextlib.ExitStack() as running:
        where = machine or running.enter_context(_demo_machine(scenario, loaded.eta, *more))
        delivery.say(f"calling {where}")
        consent = options if machine else options.model_copy(update={"accept_jitter": True})
        with _Ending() as ending:
            result = learn_live(loaded, where, consent, delivery.say_wrapped, ending)
    return _delivered(delivery, result)


def _agreed(problem: str) -> bool:
    """Ask at a terminal whether to go on; elsewhere the answer is no."""
    if not sys.stdin.isatty():
        return False
    echo(f"{problem}; go on? [y/N]", error=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


@contextlib.contextmanager
def _page(scenario: "Scenario", name: str) -> Iterator["PageViewer"]:
    """Start the process of the page while the machine is being contacted."""
    from stewart_drake.live.page import PageViewer
    from stewart_drake.mechanism.files import load_mechanism

    viewer = PageViewer(load_mechanism(scenario.mechanism), f"live: {name}")
    try:
        yield viewer
    finally:
        viewer.close()


def _delivered(delivery: Delivery, result: "SimulationResult") -> int:
    """Write and print the result, and return the exit status."""
    from stewart_drake.reporting.run import run_document

    summary: Any = result.summary
    s = summary["live"]
    if result.stopped is not None:
        delivery.say_wrapped(f"{result.status.replace('_', ' ')}: {result.stopped}")
    if result.status == "completed":
        delivery.say(run_document(result).plain())
    late = s["sent_after_due_ms"]
    delivery.say_wrapped(
        f"{s['samples']} samples, {s['deadlines_missed']} deadlines missed; torques went out "
        f"{late['median']:.0f} ms after the soonest measurement (99 %: {late['p99']:.0f}, worst "
        f"{late['worst']:.0f}); {s['periods_played']} periods played, {s['periods_dry']} dry"
    )
    if delivery.out is not None:
        result.save(delivery.out)
        delivery.wrote("summary.json", "signals.nc", LOG)
    lost = result.status in ("lost_machine", "lost_contact", "refused", "left_workspace")
    return delivery.end(result.summary, result.status == "interrupted") or int(lost)


def _end_with_parent() -> Callable[[], None] | None:
    """Return a function that ends a child process with its parent, or None without Linux."""
    if sys.platform != "linux":
        return None
    prctl, set_death_signal = ctypes.CDLL(None).prctl, 1
    return lambda: prctl(set_death_signal, signal.SIGTERM)


@contextlib.contextmanager
def _demo_machine(
    scenario: str, eta: float, controller: str | None, settings: Sequence[str]
) -> Iterator[str]:
    """Run a simulated machine in another process, on a free port, over another link."""
    low, high = (share * eta for share in _EACH_WAY)
    way = f"low: {low:g}, high: {high:g}, loss: {_LOST}"
    words = ["machine", scenario, "--port", "0"]
    words += [] if controller is None else ["--controller", controller]
    link = f"link={{kind: network, {way}, return: {{{way}}}}}"
    for setting in (*settings, "plant.kind=exact", link):
        words += ["--set", setting]
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "stewart_drake", *words],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for the controller, which stops it
        preexec_fn=_end_with_parent(),
    )
    try:
        # Imported while the machine starts, which takes as long.
        from stewart_drake.live import session  # noqa: F401

        assert process.stdout is not None
        named = (line for line in process.stdout if line.startswith("machine "))
        _, _, rest = next(named, "").partition(" at ")
        if not rest:
            raise ConfigError("--demo: the simulated machine did not start")
        yield rest.split(": ", 1)[0]
    finally:
        process.terminate()
        process.communicate()


class _Ending:
    """Whether Ctrl-C or SIGTERM asks for rest; a second one raises KeyboardInterrupt."""

    def __init__(self) -> None:
        self._asked = False
        self._before: list[Any] = []

    def __call__(self) -> bool:
        return self._asked

    def __enter__(self) -> "_Ending":
        self._before = [signal.signal(number, self._ask) for number in _REQUESTS]
        return self

    def __exit__(self, *_: object) -> None:
        for number, before in zip(_REQUESTS, self._before, strict=True):
            signal.signal(number, before)

    def _ask(self, *_: Any) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True


# ---------------------------------------------------------------- the machine


@with_options(MachineOptions)
def machine(
    *,
    scenario: ScenarioName = "paper",
    given: Given,
    controller: Controller = None,
    settings: Settings = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Simulate a machine in real time, or drive a robot, for a controller over UDP.

    Plant, sensor, delay, link and limits are those of the scenario. Ctrl-C ends it.
    """

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    from stewart_drake.live.reachy import open_chosen

    options, loaded = given.options(), load_scenario(scenario, controller, settings or ())
    delivery, interrupted = Delivery(None, quiet, as_json), False
    check_log(options.log)
    with given.named(), open_chosen(loaded, options, delivery.say_wrapped) as (running, address):
        delivery.say_link(loaded)
        before = signal.signal(signal.SIGTERM, interrupt)
        try:
            moved = f"simulated by {running.simulated_by}"
            if options.reachy is not None:
                moved = f"drives the robot behind {options.reachy}"
            delivery.say(
                f"machine {scenario} at {address[0]}:{address[1]}: {moved}, "
                f"every {1e-6 * running.period:g} ms\n"
                "waits for a controller; Ctrl-C ends it"
            )
            running.run(options.duration or math.inf)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            signal.signal(signal.SIGTERM, before)
    if options.log is not None:
        delivery.say(f"log written to {options.log}")
    s: Any = running.summary()
    refused = ", ".join(f"{number} {cause}" for cause, number in s["refused"].items() if number)
    delivery.say_wrapped(
        f"ended after {s['time_s']:.1f} s: {s['sessions']} sessions, {s['runs']} runs, "
        f"{s['silences']} silences, at most {1e3 * s['longest_lag_s']:.0f} ms behind",
        f"datagrams: {s['received']} received, {s['sent']} sent, {s['unsent']} not sent, "
        f"{s['lost'] + s['measurements_lost']} lost by the simulated link; refused: "
        f"{refused or 'none'}",
        f"torques: {s['played']} played, {s['dry']} periods dry",
    )
    return delivery.end(s, interrupted)
