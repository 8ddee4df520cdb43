"""A controller's session with a machine, from the first call to what it leaves behind."""

import contextlib
import math
import os
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Final, NamedTuple

from stewart_drake.dynamics.threads import one_blas_thread
from stewart_drake.files.errors import ConfigError
from stewart_drake.live.connect import call, open_endpoint
from stewart_drake.live.contact import Contact
from stewart_drake.live.design import Design, as_seen, check_controller, design
from stewart_drake.live.endpoint import Address, Endpoint
from stewart_drake.live.governor import Governor
from stewart_drake.live.loop import LiveLoop, Nobody, Viewer
from stewart_drake.live.protocol import NOTHING, SECOND, ControllerFlags, MachineFlags
from stewart_drake.live.steering import Steering, Way
from stewart_drake.loop.peer import identity_of
from stewart_drake.loop.recording import summarize
from stewart_drake.loop.results import LiveSummary, SimulationResult
from stewart_drake.scenario.config import NetworkConfig, Scenario

_MOST: Final = 0.5
"""Share of a period that a step may take."""


class Ready(NamedTuple):
    """A machine that has been found, and the law for it; nothing has moved yet.

    Attributes:
        endpoint, contact: through which it is found.
        design: of the scenario over the link as it was found.
    """

    endpoint: Endpoint
    contact: Contact
    design: Design

    @property
    def simulated(self) -> bool:
        """Whether the machine says that it is a simulation."""
        last = self.contact.last
        return last is not None and MachineFlags.SIMULATION in last.flags


def prepare_session(
    scenario: Scenario,
    address: Address,
    key: bytes | None = None,
) -> Ready:
    """Find a machine, find out about the link, and make the law for it.

    Args:
        scenario: whose law and motion it shall be.
        address: of the machine.
        key: shared with it; None for loopback.

    Raises:
        ConfigError: one line, whatever does not fit.
    """
    endpoint = open_endpoint(address, key)
    try:
        contact = Contact(endpoint, address, identity_of(scenario))
        machine = call(contact)
        check_controller(scenario)
        with one_blas_thread:
            made = design(as_seen(scenario, contact.link, machine), machine)
        return Ready(endpoint, contact, made)
    except BaseException:
        endpoint.close()
        raise


def plans(ready: Ready, duration: float, scenario: str) -> list[str]:
    """What will happen, in lines, before anything moves."""
    contact, made = ready.contact, ready.design
    machine, link, sc = contact.last, contact.link, made.experiment.scenario
    assert machine is not None
    host, port = contact.session.address
    kind = "a simulation" if ready.simulated else "A REAL MACHINE: it will move"
    eta = made.law.timeline.eta
    limit = "without a limit" if math.isinf(made.torque_limit) else f"{made.torque_limit:g} N m"
    rate = "" if machine.rate == 1 else f", {machine.rate:g} of its seconds in one"
    packets = "each torque as it is computed, on a simulated wire"
    if isinstance(sc.link, NetworkConfig):
        c = sc.controller
        packets = f"packets of {c.packet_repeats + c.packet_torques} torques"
    until = "until it is stopped" if math.isinf(duration) else f"for {duration:g} s"
    safe = "the last torque" if MachineFlags.SAFE_HOLDS in machine.flags else "no torque"
    return [
        f"machine at {host}:{port}: {kind}{rate}",
        f"link: {1e3 * link.typical:.0f} ms there and back ({1e3 * link.shortest:.0f} to "
        f"{1e3 * link.longest:.0f}), {100 * link.loss_there:.0f} % lost there, "
        f"{100 * link.loss_back:.0f} % back",
        f"torques act {eta:g} s after the measurement that they rest on: {packets}, every "
        f"{1e3 * sc.controller.period:g} ms, motors {limit}",
        f"motion: {scenario}, {until}; after {machine.watchdog / SECOND:g} s without a word the "
        f"machine goes to {safe}",
        *_cautions(made),
    ]


def _cautions(made: Design) -> list[str]:
    """How long a step takes, and what will go worse than in the scenario, in lines."""
    sc, (step, backend) = made.experiment.scenario, made.step
    period = sc.controller.period
    slow = f"; more than {_MOST:.0%}: expect missed deadlines" if step > _MOST * period else ""
    lines = [
        f"law: {backend}, a step takes {1e3 * step:.1f} ms of a period of {1e3 * period:g} ms{slow}"
    ]
    advice = _queue_advice(sc)
    return lines if advice is None else [*lines, advice]


def _queue_advice(scenario: Scenario) -> str | None:
    """Return the line about a queue that is too short over a network, or None."""
    if not isinstance(scenario.link, NetworkConfig) or scenario.queue != "reference":
        return None
    better = "equilibrium" if scenario.plant.gravity else "zero"  # zero lets the plate fall
    return (
        "queue: reference ends with the machine's own link, and its buffer is dry until this "
        f"controller's torques act: better --set start=rest --set queue={better}, on both sides"
    )


def check_armed(ready: Ready, armed: bool) -> None:
    """Refuse a machine that is no simulation, unless that was asked for.

    Raises:
        ConfigError: one line.
    """
    if not ready.simulated and not armed:
        ready.endpoint.close()
        raise ConfigError(
            "--arm: got none, for a machine that does not say that it is a simulation; expected "
            "--arm, with nobody in its reach"
        )


@contextlib.contextmanager
def before_others() -> Iterator[str]:
    """Let this process run before all that are not in real time, where the system permits it.

    Yields:
        `real time`, or `usual`.
    """
    try:
        policy, given = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (AttributeError, OSError):  # another system, or no right to
        yield "usual"
        return
    try:
        yield "real time"
    finally:
        os.sched_setscheduler(0, policy, given)


def drive(
    ready: Ready,
    duration: float = math.inf,
    *,
    armed: bool = False,
    viewer: Viewer | None = None,
    ending: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = print,
) -> SimulationResult:
    """Run the loop; the machine moves.

    Args:
        ready: of `prepare_session`; its socket is closed in the end.
        duration: s, or infinite.
        armed: whether a machine that is no simulation may be driven.
        viewer: who watches.
        ending: whether to come to rest and end.
        say: is told in a line what happens.

    Raises:
        ConfigError: not armed for a real machine, or one that does not begin.
    """
    check_armed(ready, armed)
    made, contact = ready.design, ready.contact
    governor = Governor(made.law.plant.dynamics, made.torque_limit)
    steering = Steering(governor, made.experiment.reference, Way.along(made.planned))
    loop = LiveLoop(made, steering, contact, viewer or Nobody(), say)
    started = clock.perf_counter()
    try:
        with one_blas_thread, before_others() as scheduled:
            loop.begin(ControllerFlags.ARMED if armed and not ready.simulated else NOTHING)
            status, stopped = loop.run(duration, ending)
    except TimeoutError as error:
        raise ConfigError(f"--machine: {error}; expected one that does") from None
    finally:
        ready.endpoint.close()
    wall, samples = clock.perf_counter() - started, len(loop.record.samples)
    period = made.experiment.scenario.controller.period
    as_run = replace(made.experiment.scenario, duration=max(samples - 1, 1) * period)
    as_run = replace(as_run, log_period=period)
    loop.record.ran(as_run)
    experiment = made.experiment._replace(scenario=as_run)
    summary = summarize(experiment, loop.record, status, stopped, wall, None)
    told = _told(loop, contact) | {"scheduled": scheduled}
    return SimulationResult(
        scenario=as_run,
        status=status,
        stopped=stopped,
        signals=loop.record.dataset(),
        summary=LiveSummary(**summary, live=told),
    )


def _told(loop: LiveLoop, contact: Contact) -> dict[str, Any]:
    """For summary.json."""
    link, last = contact.link, contact.last
    return loop.pace.summary() | {
        "taken_over": loop.taken_over,
        "recoveries": loop.recoveries,
        "round_trip_ms": {
            "median": 1e3 * link.typical,
            "shortest": 1e3 * link.shortest,
            "longest": 1e3 * link.longest,
        },
        "lost_there": link.loss_there,
        "lost_back": link.loss_back,
        "periods_played": 0 if last is None else last.played,
        "periods_dry": 0 if last is None else last.dry,
        "refused": contact.refused,
        "refused_by_machine": 0 if last is None else last.refused,
        "unsent": contact.unsent,
    }
