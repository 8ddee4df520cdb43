"""A controller's session with a machine, from the first call to the result."""

import contextlib
import math
import os
import time as clock
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.dynamics.native_functions import one_blas_thread
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.live.checks import check_whole_motion
from stewart_drake.live.contact import Contact, await_free, call, open_endpoint, parse_address
from stewart_drake.live.design import (
    Design,
    Learned,
    as_seen,
    check_controller,
    design,
    read_learned,
)
from stewart_drake.live.endpoint import Address, Endpoint, now
from stewart_drake.live.governor import FASTEST, PACE, Governor, Steering, Way
from stewart_drake.live.loop import CrankLoop, LiveLoop, turn_and_way
from stewart_drake.live.options import LiveOptions
from stewart_drake.live.protocol import (
    NOTHING,
    SECOND,
    ControllerFlags,
    MachineFlags,
    MachineMessage,
)
from stewart_drake.live.viewer import Viewer
from stewart_drake.loop.cautions import delays_apart, overconfidence
from stewart_drake.loop.controller_margin import ControllerMargin, controller_margin, over_wire
from stewart_drake.loop.peer import check_samples, identity_of
from stewart_drake.loop.preparation import Experiment, known_dynamics
from stewart_drake.loop.recording import summarize
from stewart_drake.loop.results import LEAST_MEASURED, LiveSummary, SimulationResult
from stewart_drake.reporting.document import templates
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.link_config import NetworkConfig, WireConfig
from stewart_drake.scenario.loading import scenario_yaml
from stewart_drake.scenario.run_log import Background, RunLog, UdpMirror, open_log
from stewart_drake.scenario.signals import NUM_TORQUES, POSE
from stewart_drake.studies.verdict import Verdict, delay_range, milliseconds
from stewart_drake.types import Array

_MOST: Final = 0.5
"""Share of a period above which a step counts as slow."""


class Ready(NamedTuple):
    """A machine that was found, and the law for it, before anything moves."""

    endpoint: Endpoint[MachineMessage]
    contact: Contact
    design: Design  # law for the scenario over the link that was found
    margin: ControllerMargin  # stability margin of the loop with a constant delay eta
    link: WireConfig | NetworkConfig  # of the scenario, before the one that was found

    @property
    def simulated(self) -> bool:
        return MachineFlags.SIMULATION in self.contact.machine.flags

    @property
    def jitter_problem(self) -> str | None:
        """Reason why the jitter of the link may destabilise the loop, or None."""
        if self.margin.stable is False:
            apart = delays_apart(self.design.experiment, self.margin)
            return apart or "the loop is unstable even without jitter: the plate may be lost"
        spread, link = self.contact.link.spread, self.design.experiment.scenario.link
        if link.kind == "network" or not spread > self.margin.delay_margin:
            return None  # a torque that comes early waits for its play-out time
        return (
            f"round trips vary by {milliseconds(spread)} (standard deviation), more than the "
            f"{milliseconds(self.margin.delay_margin)} of delay error that the loop is stable for, "
            "and the machine has no play-out buffer: jitter that reaches the motors makes errors "
            "grow until the plate is lost"
        )


def prepare_session(
    scenario: Scenario,
    address: Address,
    key: bytes | None = None,
    learned: Learned = None,
    say: Callable[[str], None] | None = None,
) -> Ready:
    """Find a machine, measure the link and design the law for it. The caller closes the endpoint.

    What was learned is by default that of `controller.learned`.

    Raises:
        ConfigError: no machine there, or one that does not fit the scenario.
    """
    check_samples(scenario)
    endpoint = open_endpoint(address, key)
    if say is not None:
        say("calling {}:{}".format(*address))
    try:
        contact = Contact(endpoint, address, identity_of(scenario))
        call(contact)
        await_free(contact)  # before the design, which takes seconds
        machine = contact.machine
        check_controller(scenario)
        link = scenario.link
        with one_blas_thread:
            scenario, read = read_learned(scenario)
            made = design(as_seen(scenario, contact.link, machine), machine, learned or read)
            margin = _margin(made.experiment)
        return Ready(endpoint, contact, made, margin, link)
    except BaseException:
        endpoint.close()
        raise


def _margin(experiment: Experiment) -> ControllerMargin:
    """Judge the loop; a calibrated machine counts instead of the scenario's plant."""
    calibrated = None if experiment.calibration is None else known_dynamics(experiment)
    return controller_margin(over_wire(experiment), machine=calibrated)


def plans(ready: Ready, duration: float, scenario: str) -> list[str]:
    """Return lines about the machine, the link and the law, for before the begin."""
    made, contact = ready.design, ready.contact
    text = (
        templates()
        .get_template("live_plan.txt.j2")
        .render(
            ready=ready,
            made=made,
            contact=contact,
            machine=contact.machine,
            margin=ready.margin,
            delay=Verdict.of(ready.margin),
            duration=duration,
            scenario=scenario,
            period=made.experiment.scenario.controller.period,
            second=SECOND,
            infinity=math.inf,
            most=_MOST,
            ms=milliseconds,
            delay_range=delay_range,
            advice=_queue_advice(made.experiment.scenario),
            weak=made.experiment.weak_motors(made.torque_limit),
        )
    )
    return [" ".join(line.split()) for line in text.split("\n\n") if line.strip()]


def _queue_advice(scenario: Scenario) -> str | None:
    """Return the line about a queue that is too short over a network, or None."""
    if scenario.link.kind == "wire" or scenario.queue != "reference":
        return None
    better = "equilibrium" if scenario.plant.gravity else "zero"  # zero lets the plate fall
    return (
        "queue: reference fills only the machine's own link; then it has no torques until those of "
        f"this controller act: better --set start=rest --set queue={better}, on both sides"
    )


def readings(ready: Ready) -> str:
    """Read the sensors of a parked machine, in a session that does not begin; return a line."""
    contact, experiment = ready.contact, ready.design.experiment
    await_free(contact)
    if MachineFlags.PARKED not in contact.machine.flags:
        return "the sensors were not read: the machine is not parked"
    contact.join()
    values, until = None, now() + 2 * SECOND
    while values is None and now() < until:
        contact.send()
        for message in contact.wait(now() + SECOND // 20):
            values = message.values if values is None else values
    for _ in range(3):
        contact.send(flags=ControllerFlags.STOP)
    if values is None:
        return "the sensors were not read: no measurement came"
    start = experiment.start[POSE]
    if experiment.scenario.sensor.kind == "state":
        away = turn_and_way(np.abs(values[POSE] - start))
        return f"the plate is {away} off the start of the motion"
    cranks = values[-NUM_TORQUES:], experiment.mechanism.crank_angles(start)
    read, known = (", ".join(f"{angle:.1f}" for angle in np.degrees(one)) for one in cranks)
    return f"the cranks read {read} deg; at the start of the motion they are at {known} deg"


def check_armed(ready: Ready, armed: bool) -> None:
    if not ready.simulated and not armed:
        raise ConfigError(
            "--arm: not given, so nothing moved: the link is measured, and the machine does not "
            "report that it is a simulation; expected --arm to drive it, with all people out of "
            "its reach"
        )


def check_jitter(ready: Ready, accepted: bool) -> None:
    problem = ready.jitter_problem
    if problem is not None and not accepted:
        raise ConfigError(
            f"--yes: not given, so nothing moved: {problem}; expected a longer play-out buffer, a "
            "larger controller.w_R, or --yes to start anyway"
        )


@contextlib.contextmanager
def before_others() -> Iterator[str]:
    """Give this process real-time priority if the system permits it.

    Yields:
        The scheduling, `real time` or `usual`.
    """
    try:
        policy, given = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (AttributeError, OSError):  # not on this system, or not permitted
        yield "usual"
        return
    try:
        yield "real time"
    finally:
        os.sched_setscheduler(0, policy, given)


def open_logs(ready: Ready, options: LiveOptions, say: Callable[[str], None]) -> list[RunLog]:
    """Open the logs that the options `log` and `mirror` ask for.

    Raises:
        ConfigError: a file that cannot be written, or no such host.
    """
    scenario, logs = ready.design.experiment.scenario, list[RunLog]()
    if options.mirror is not None:
        logs.append(UdpMirror(parse_address(options.mirror, "--mirror"), scenario))
    if options.log is not None:
        logs.append(Background(open_log(options.log, scenario), str(options.log), say))
    return logs


def drive(
    ready: Ready,
    duration: float = math.inf,
    *,
    armed: bool = False,
    accept_jitter: bool = False,
    viewer: Viewer | None = None,
    ending: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = print,
    max_missing: float | None = None,
    log: Path | None = None,
    logs: Sequence[RunLog] = (),
    hold: bool = False,
    pace: float | None = None,
) -> SimulationResult:
    """Run the loop; the machine moves. In the end the logs are closed.

    Args:
        armed: whether a real machine may be driven.
        accept_jitter: whether to start with more jitter than the loop is stable for.
        ending: whether to bring the plate to rest and end.
        max_missing, log, hold: see `LiveLoop`.
        pace: pole of the governor, 1/s; by default it depends on the torque limit.

    Raises:
        ConfigError: not armed for a real machine, too much jitter, a motion out of reach, or a
            machine that does not begin.
    """
    check_armed(ready, armed)
    check_jitter(ready, accept_jitter)
    check_whole_motion(ready.design.experiment, duration)
    made, contact = ready.design, ready.contact
    # Holds of a period follow no faster one.
    fastest, slowest = min(FASTEST, 1 / made.law.timeline.period), PACE
    if pace is not None:
        fastest = slowest = pace
    if log is not None:  # of a run that is killed there is no summary
        write_whole(log.with_suffix(".yaml"), scenario_yaml(made.experiment.scenario))
    governor = Governor(made.law.plant.dynamics, made.torque_limit, fastest, slowest)
    steering = Steering(governor, made.experiment.reference, Way.along(made.planned))
    kind = CrankLoop if made.cranks else LiveLoop
    loop = kind(made, steering, contact, viewer or Viewer(), say, max_missing, log, logs, hold)
    started = clock.perf_counter()
    try:
        with one_blas_thread, before_others() as scheduled:
            loop.begin(ControllerFlags.ARMED if armed and not ready.simulated else NOTHING)
            status, stopped, *_ = loop.run(duration, ending)
    except TimeoutError as error:
        raise ConfigError(f"--machine: {error}; expected one that does") from None
    finally:
        late = loop.record.finish()
        for one in logs:
            one.close()
    wall, samples = clock.perf_counter() - started, loop.record.sampled
    period = made.experiment.scenario.controller.period
    as_run = replace(made.experiment.scenario, duration=max(samples - 1, 1) * period)
    as_run = replace(as_run, log_period=period)
    loop.record.ran(as_run)
    experiment = made.experiment._replace(scenario=as_run)
    summary = summarize(experiment, loop.record, status, stopped, wall, ready.margin)
    summary["warnings"] += overconfidence(as_run, summary)
    if len(late) < samples:
        summary["warnings"].append(
            f"the log ends {(samples - len(late)) * period:.3g} s before the run; signals and "
            "figures are of the time before that"
        )
    if len(late) < samples or not summary["measured_share"] >= LEAST_MEASURED:
        summary["accumulated_error"] = summary["cost"] = math.nan
    live = _live_summary(loop, contact, late) | {"scheduled": scheduled}
    return SimulationResult(
        scenario=as_run,
        status=status,
        stopped=stopped,
        signals=loop.record.dataset(),
        summary=LiveSummary(**summary, live=live),
    )


def _live_summary(loop: LiveLoop, contact: Contact, recorded: Array) -> dict[str, Any]:
    """Return `live` of summary.json, from the delays (n,) of the recorded steps, s."""
    link, last = contact.link, contact.machine
    played, dry = contact.periods(last)
    late = np.append(recorded, loop.resting)
    late = late if len(late) else np.array([math.nan])
    p99 = float(np.quantile(late, 0.99))
    return {
        "samples": loop.exchange.sent,
        "deadlines_missed": loop.missed,
        "measurements_overtaken": loop.exchange.overtaken,
        "sent_after_due_ms": {
            "median": 1e3 * float(np.median(late)),
            "p99": 1e3 * p99,
            "worst": 1e3 * float(late.max()),
        },
        "jitter_std_ms": 1e3 * float(np.std(np.clip(late, None, p99))),
        "taken_over": loop.taken_over,
        "recoveries": loop.recoveries,
        "round_trip_ms": {
            "median": 1e3 * link.typical,
            "shortest": 1e3 * link.shortest,
            "longest": 1e3 * link.longest,
        },
        "lost_there": link.loss_there,
        "lost_back": link.loss_back,
        "periods_played": played,
        "periods_dry": dry,
        "refused": contact.refused,
        "refused_by_machine": last.refused,
        "unsent": contact.endpoint.unsent,
    }
