"""A simulated machine in real time, for a controller over a link: machine."""

import signal
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from stewart_drake.cli.common import AsJson, Controller, Delivery, Quiet, ScenarioName, Settings
from stewart_drake.cli.options import Given, with_options
from stewart_drake.live.options import MachineOptions
from stewart_drake.reporting.document import wrap

if TYPE_CHECKING:
    from stewart_drake.live.machine import Machine


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
    """Simulate a machine in real time, for a controller over UDP.

    Plant, sensor, delay, link and limits are those of the scenario. Ctrl-C ends it.
    """
    from stewart_drake.live.machine import open_machine
    from stewart_drake.scenario.loading import load_scenario

    options, loaded = given.options(), load_scenario(scenario, controller, settings or ())
    delivery = Delivery(None, quiet, as_json)
    with given.named(), open_machine(loaded, options, delivery.tell) as (running, address):
        delivery.tell_link(loaded)
        interrupted = _run(
            running,
            options.duration or float("inf"),
            lambda: delivery.say(_first_lines(running, scenario, address)),
        )
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
