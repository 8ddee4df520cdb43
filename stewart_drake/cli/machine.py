"""A simulated machine in real time, for a controller over a link: machine."""

import signal
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stewart_drake.cli.common import AsJson, Controller, Delivery, Quiet, ScenarioName, Settings
from stewart_drake.reporting.document import wrap

if TYPE_CHECKING:
    from stewart_drake.live.machine import Machine


class Safe(StrEnum):
    """The torque of a machine that hears nothing."""

    zero = "zero"
    hold = "hold"


class Restart(StrEnum):
    """Where a new session begins."""

    rest = "rest"
    motion = "motion"


def machine(
    scenario: ScenarioName = "paper",
    port: Annotated[int, typer.Option(min=0, max=65535, help="UDP; 0 is any.")] = 47000,
    host: Annotated[str, typer.Option(help="To listen at; beyond loopback with a key.")] = (
        "127.0.0.1"
    ),
    rate: Annotated[float, typer.Option(help="Seconds of the machine in a second.")] = 1.0,
    key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Whose bytes both sides share.")
    ] = None,
    watchdog: Annotated[
        float, typer.Option(help="Seconds of silence before the safe torque.")
    ] = 1.0,
    safe: Annotated[Safe, typer.Option(help="The safe torque: none, or the last one.")] = Safe.zero,
    restart: Annotated[
        Restart, typer.Option(help="Where a new session begins: put back, or as it is.")
    ] = Restart.rest,
    duration: Annotated[
        float, typer.Option(min=0, help="Seconds of the machine, then it ends; 0: until Ctrl-C.")
    ] = 0.0,
    controller: Controller = None,
    settings: Settings = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Simulate a machine in real time, for a controller over UDP.

    Plant, sensor, delay, link and limits are those of the scenario. Ctrl-C ends it.
    """
    from stewart_drake.live.endpoint import Endpoint, read_key
    from stewart_drake.live.machine import Machine, Settings, check_scenario
    from stewart_drake.live.protocol import ControllerMessage
    from stewart_drake.loop.experiment import prepare
    from stewart_drake.scenario.loading import load_scenario

    chosen = Settings(rate, watchdog, safe.value, restart.value)
    loaded = load_scenario(scenario, controller, settings or ())
    check_scenario(loaded)
    experiment = prepare(loaded)
    delivery = Delivery(None, quiet, as_json)
    delivery.tell_link(loaded)
    endpoint = Endpoint(ControllerMessage, host, port, None if key is None else read_key(key))
    running = Machine(experiment, endpoint, chosen, delivery.tell)
    interrupted = _run(
        running,
        duration or float("inf"),
        lambda: delivery.say(_first_lines(running, scenario, endpoint.address)),
    )
    endpoint.close()
    summary = running.summary()
    delivery.say(_last_lines(summary))
    return delivery.end(summary, interrupted)


def _run(machine: "Machine", duration: float, listens: Callable[[], None]) -> bool:
    """Say that it listens and go on; whether Ctrl-C, or a request to end, came first."""

    def ask_to_end(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, ask_to_end)
    try:
        listens()
        machine.run(duration)
    except KeyboardInterrupt:
        return True
    finally:
        signal.signal(signal.SIGTERM, before)
    return False


def _first_lines(machine: "Machine", scenario: str, address: tuple[str, int]) -> str:
    return (
        f"machine {scenario} at {address[0]}:{address[1]}: simulated by {machine.goes_by}, every "
        f"{1e-6 * machine.period:g} ms\nwaits for a controller; Ctrl-C ends it"
    )


def _last_lines(summary: dict[str, Any]) -> str:
    s = summary
    refused = ", ".join(f"{number} {cause}" for cause, number in s["refused"].items() if number)
    lines = (
        f"ended after {s['time_s']:.1f} s: {s['sessions']} sessions, {s['runs']} runs, "
        f"{s['silences']} silences, at most {1e3 * s['longest_lag_s']:.0f} ms behind",
        f"datagrams: {s['received']} received, {s['sent']} sent, {s['unsent']} not sent, "
        f"{s['lost'] + s['measurements_lost']} lost by the simulated link; refused: "
        f"{refused or 'none'}",
        f"torques: {s['played']} played, {s['dry']} periods dry",
    )
    return "\n".join(wrap(line) for line in lines)
