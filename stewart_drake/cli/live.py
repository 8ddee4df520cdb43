"""Commands of the loop in real time: live, and machine, a simulated machine."""

import contextlib
import ctypes
import math
import multiprocessing
import os
import shlex
import signal
import sys
import webbrowser
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, Final

import typer

from stewart_drake.cli.common import SIGNALS, Chosen, Delivery, check_log, command_line
from stewart_drake.cli.options import Given, command
from stewart_drake.files.errors import ConfigError
from stewart_drake.live.options import LiveOptions, MachineOptions
from stewart_drake.reporting.document import PAGE, counted
from stewart_drake.reporting.terminal import echo

if TYPE_CHECKING:
    from stewart_drake.loop.results import SimulationResult
    from stewart_drake.reporting.results import AnalysisResult
    from stewart_drake.scenario.config import Scenario

LOG: Final = "log.csv"
_EACH_WAY: Final = (0.35, 0.4)
"""Transit time of the demo's link each way, as a share of the scenario's delay."""
_RESERVE: Final = 0.05
"""Least part of the delay that is left for computing and a busy computer, s."""
_LOST: Final = 0.02
_MANY_DRY: Final = 0.05
"""Share of dry periods from which they are named as a possible cause of a loss."""
_REFUSED: Final = {
    "malformed": "malformed",
    "version": "of another version",
    "key": "with another key",
    "foreign": "of another session",
    "replayed": "repeated",
    "late": "too old for use",
    "rate": "above the rate of requests",
}
"""Words for the causes of `live.protocol.Refusal`."""


@command(LiveOptions)
def live(
    *,
    chosen: Chosen,
    machine: str | None = typer.Option(None, metavar="HOST:PORT", help="Address of the machine."),
    demo: bool = typer.Option(
        False,
        "--demo",
        help="Start a simulated machine too, with up to 0.4 of the delay each way.",
    ),
    no_browser: bool = typer.Option(False, "--no-browser", help="Serve no page."),
    given: Given,
    delivery: Delivery,
) -> int:
    """Drive a machine over UDP in real time.

    The law is that of `simulate`; a page in the browser has sliders for the pose. Ctrl-C brings the
    plate to rest and ends the run; Ctrl-C again, or Stop on the page, stops it at once.
    """
    if (machine is None) != demo:
        raise ConfigError(
            f"--machine, --demo: got {'both' if demo else 'neither'}; expected one of them"
        )
    options = given.options()
    with given.named():
        options.check_learned()
    loaded, name = _in_real_time(chosen), chosen.title
    span = math.inf if options.duration is None else options.duration
    if options.learn:
        typed = {"machine": machine, "demo": demo, **given.words}
        line = chosen.line("live", **{k: v for k, v in typed.items() if v}, out=delivery.out)
        return _learn(chosen, loaded, machine, options, delivery, line)

    from stewart_drake.live.contact import parse_address
    from stewart_drake.live.endpoint import read_key
    from stewart_drake.live.page import PageViewer
    from stewart_drake.mechanism.files import load_mechanism

    key = read_key(options.key)
    check_log(options.log)
    for option, address in (("--machine", machine), ("--mirror", options.mirror)):
        if address is not None:
            parse_address(address, option)
    with contextlib.ExitStack() as running:
        viewer = None
        if not no_browser:  # its process starts while the machine is being contacted
            page = PageViewer(load_mechanism(loaded.mechanism), f"live: {name}")
            viewer = running.enter_context(contextlib.closing(page))
        where = machine or running.enter_context(_demo_machine(chosen, loaded.eta))
        from stewart_drake.live import session

        ready = session.prepare_session(loaded, parse_address(where), key, say=delivery.say)
        running.enter_context(contextlib.closing(ready.endpoint))
        delivery.say_wrapped(*session.plans(ready, span, name))
        if not ready.simulated and not options.armed:
            delivery.say_wrapped(session.readings(ready))
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
        how["log"] = None if delivery.out is None else delivery.out / LOG
        how["logs"] = session.open_logs(ready, options, delivery.say_wrapped)
        with _ending() as ending:
            result = session.drive(
                ready, span, ending=ending, say=delivery.say_wrapped, accept_jitter=True, **how
            )
    if options.log is not None:
        show = command_line("replay", str(options.log))
        delivery.say(f"log written to {options.log}: {show}")
    return _delivered(delivery, result, LOG, "log.yaml")


def _in_real_time(chosen: Chosen) -> "Scenario":
    """Return the scenario; refuse a setting of its duration, which has no effect in real time."""
    for setting in chosen.settings:
        name, _, value = setting.partition("=")
        if name.strip() == "duration":
            raise ConfigError(f"--set: duration: got {value!r}; expected --duration SECONDS")
    return chosen.load()


def _learn(
    chosen: Chosen,
    loaded: "Scenario",
    machine: str | None,
    options: LiveOptions,
    delivery: Delivery,
    line: str,
) -> int:
    """Learn torques or setpoints, and deliver the run, with the page of `learn`."""
    from stewart_drake.live.learning import learn_live
    from stewart_drake.reporting.learn import document
    from stewart_drake.reporting.page import Provenance
    from stewart_drake.reporting.results import AnalysisResult
    from stewart_drake.studies.learn import check_learning

    check_learning(loaded)
    with contextlib.ExitStack() as running:
        where = machine or running.enter_context(_demo_machine(chosen, loaded.eta))
        delivery.say(f"calling {where}")
        consent = options if machine else options.model_copy(update={"accept_jitter": True})
        with _ending() as ending:
            run, study = learn_live(loaded, where, consent, delivery.say_wrapped, ending)
    found = None
    if study is not None:
        found = AnalysisResult(study, study.summary, document(study), Provenance(line))
    return _delivered(delivery, run, found=found)


def _agreed(problem: str) -> bool:
    """Ask at a terminal whether to go on; elsewhere the answer is no."""
    if not sys.stdin.isatty():
        return False
    echo(f"{problem}; go on? [y/N]", error=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _delivered(
    delivery: Delivery,
    result: "SimulationResult",
    *logs: str,
    found: "AnalysisResult | None" = None,
) -> int:
    """Write and print the result, and the page of `learn`; return the exit status.

    `logs` are the names of files that were written during the run.
    """
    from stewart_drake.live.viewer import End
    from stewart_drake.reporting.run import run_document

    summary: Any = result.summary
    s = summary["live"]
    end = End(result.status, result.stopped)
    if LOG not in logs:
        end = end._replace(log=None)
    elif delivery.out is not None:
        end = end._replace(log=shlex.quote(str(delivery.out / LOG)))
    if result.stopped is not None:
        delivery.say_wrapped(*filter(None, (end.words, end.advice)))
    if result.status == "completed":
        delivery.say(run_document(result).plain())
    late = s["sent_after_due_ms"]
    commands = "setpoints" if result.scenario.controller.command == "cranks" else "torques"
    delivery.say_wrapped(
        f"{counted(s['samples'], 'samples')} with those of coming to rest, "
        f"{counted(s['deadlines_missed'], 'deadlines missed')}; {commands} were sent "
        f"{late['median']:.0f} ms (worst {late['worst']:.0f}) after their measurement came"
        if s["samples"]
        else "no sample, nothing was sent",
        f"the machine had {commands} for {counted(s['periods_played'], 'periods')}, and none (dry) "
        f"for {s['periods_dry']}, with those of coming to rest",
    )
    # Before the first torque can act, the buffer is dry in any run.
    dry = s["periods_dry"] - math.ceil(result.scenario.eta / result.scenario.controller.period)
    if result.stopped is not None and dry > _MANY_DRY * s["periods_played"]:
        delivery.say_wrapped(
            f"{commands} came too late or not at all for many periods: a larger link.playout or "
            "controller.packet_repeats bridges more; stewart-drake analyze link compares bounds"
        )
    judged, jitter = summary["controller_margin"], s["jitter_std_ms"]
    if end.failed and judged and judged["stable"] and result.scenario.link.kind == "wire":
        margin = 1e3 * min(judged["delay_margin_s"])
        if jitter > margin:
            delivery.say_wrapped(
                f"{commands} were late by {jitter:.2g} ms (standard deviation), and the loop is "
                f"stable for {margin:.2g} ms: relieve both computers, or raise controller.w_R"
            )
    if s["recoveries"]:
        delivery.say_wrapped(
            f"the plate was too far off {counted(s['recoveries'], 'times')}: a new path led it "
            "back from where it was"
        )
    if delivery.out is not None:
        delivery.discard(PAGE)  # of an earlier run
        result.save(delivery.out)
        delivery.add_files("summary.json", "signals.nc", *logs)
    if found is not None:
        delivery.draw(PAGE, found.write_page)
    return delivery.end(result.summary, result.status == "interrupted") or int(end.failed)


def _serve(address: Connection, chosen: Chosen) -> None:
    """Simulate a machine in this process; send its address, or why there is none."""
    os.setsid()  # a signal to the group is for the controller, which needs the machine to end
    if sys.platform == "linux":
        set_death_signal = 1
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGTERM)  # it ends with its parent
    from stewart_drake.live.reachy import open_chosen

    try:
        options = MachineOptions(port=0)
        with open_chosen(chosen.load(), options, lambda _: None) as (running, where):
            address.send("{}:{}".format(*where))
            running.run()
    except ConfigError as error:
        address.send(error)


def transit_times(eta: float) -> tuple[float, float]:
    """Return the least and the longest time of the demo's link each way, s, for a delay in s."""
    low, high = (share * eta for share in _EACH_WAY)
    room = min(1.0, max(0.0, eta - _RESERVE) / max(2 * high, 1e-9))
    return room * low, room * high


@contextlib.contextmanager
def _demo_machine(chosen: Chosen, eta: float) -> Iterator[str]:
    """Simulate a machine in another process, over another link; yield its address."""
    low, high = transit_times(eta)
    way = f"low: {low:g}, high: {high:g}, loss: {_LOST}"
    link = f"link={{kind: network, {way}, return: {{{way}}}}}"
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    chosen = chosen._replace(settings=[*chosen.settings, "plant.kind=exact", link])
    process = context.Process(target=_serve, args=(there, chosen), daemon=True)
    with _handled(signal.SIG_IGN, signal.SIGINT):  # Ctrl-C is for the controller
        process.start()
    there.close()
    try:
        # Imported while the machine starts, which takes as long.
        from stewart_drake.live import session  # noqa: F401

        found: str | ConfigError
        try:
            found = here.recv()
        except EOFError:
            found = ConfigError("--demo: the simulated machine did not start")
        if isinstance(found, ConfigError):
            raise found
        yield found
    finally:
        process.terminate()
        process.join()


@contextlib.contextmanager
def _ending() -> Iterator[Callable[[], bool]]:
    """Yield whether Ctrl-C or SIGTERM asks for rest; a second one raises KeyboardInterrupt."""
    asked = False

    def ask(number: int, _frame: object) -> None:
        nonlocal asked
        SIGNALS.add(number)
        if asked:
            raise KeyboardInterrupt
        asked = True

    with _handled(ask, signal.SIGINT, signal.SIGTERM):
        yield lambda: asked


@contextlib.contextmanager
def _handled(handler: Any, *numbers: signal.Signals) -> Iterator[None]:
    """Handle signals in another way for a while."""
    before = [(number, signal.signal(number, handler)) for number in numbers]
    try:
        yield
    finally:
        for number, former in before:
            signal.signal(number, former)


# ---------------------------------------------------------------- the machine


@command(MachineOptions, without=("out",))
def machine(*, chosen: Chosen, given: Given, delivery: Delivery) -> int:
    """Simulate a machine, or drive a robot, over UDP in real time.

    Plant, sensor, delay, link and limits are those of the scenario. Ctrl-C ends it.
    """

    from stewart_drake.live.reachy import open_chosen
    from stewart_drake.scenario.link import link_text

    options, loaded, interrupted = given.options(), chosen.load(), False
    check_log(options.log)
    with given.named(), open_chosen(loaded, options, delivery.say_wrapped) as (running, address):
        if network := link_text(loaded, bound=False):
            delivery.say_wrapped(
                f"simulated link: {network}; the controller chooses the delay of the loop"
            )
        moved = f"simulated by {running.simulated_by}"
        if options.reachy is not None:
            moved = f"drives the robot behind {options.reachy}"
        try:
            delivery.say_wrapped(
                f"machine {chosen.scenario} at {address[0]}:{address[1]}: {moved}, "
                f"a sample every {1e-6 * running.period:g} ms",
                "waits for a controller; Ctrl-C ends it",
            )
            running.run(options.duration or math.inf)
        except KeyboardInterrupt:
            interrupted = True
    if options.log is not None:
        delivery.say(f"log written to {options.log}")
    s: Any = running.summary()
    commands = "setpoints" if loaded.actuator.kind == "position_servo" else "torques"
    refused = ", ".join(f"{n} {_REFUSED[cause]}" for cause, n in s["refused"].items() if n)
    delivery.say_wrapped(
        f"ended after {s['time_s']:.1f} s: {counted(s['sessions'], 'sessions')}, "
        f"{counted(s['runs'], 'runs')}, {counted(s['silences'], 'silences')}, at most "
        f"{1e3 * s['longest_lag_s']:.0f} ms behind",
        f"datagrams: {s['received']} received, {s['sent']} sent, {s['unsent']} not sent, "
        f"{s['lost'] + s['measurements_lost']} lost by the simulated link; refused: "
        f"{refused or 'none'}",
        f"{commands}: {s['played']} played, {counted(s['dry'], 'periods')} without one (dry)",
    )
    return delivery.end(s, interrupted)
