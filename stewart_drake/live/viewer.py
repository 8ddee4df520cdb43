"""Viewers of a live run: what they are shown, and what they request."""

from collections.abc import Mapping
from typing import Final, NamedTuple

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.live.governor import Request
from stewart_drake.reporting.document import sentence
from stewart_drake.types import Array

_ADVICE: Final = {
    "left_workspace": "Bring the plate back to its start and start live again; a larger "
    "controller.w_R tolerates more.",
    "lost_contact": "Datagrams arrive, usable measurements do not. If the "
    "machine reports a fault, see its terminal; if measurements are late, relieve both "
    "computers or the network; else check the sensor. --max-missing SECONDS allows longer gaps.",
    "lost_machine": "Check the machine's process and the network, and the load of its computer. "
    "--max-missing SECONDS allows longer gaps.",
    "refused": "Correct what is named, or bring the plate to its start; then start live again.",
}
"""What to do after a run, by its status."""
_ANY_LOG: Final = "LOG"
"""Name of a log in advice that does not know it."""


class End(NamedTuple):
    """How a run ended: its status (`loop.results.RunSummary`) and the failure, if any.

    `then` says what becomes of the plate, unless it left its workspace; `log` is the path of the
    run's log, or None.
    """

    status: str
    stopped: Failure | None
    then: str = ""
    log: str | None = _ANY_LOG

    @property
    def failed(self) -> bool:
        return self.status in _ADVICE

    @property
    def words(self) -> str:
        status = self.status.replace("_", " ")
        return status if self.stopped is None else f"{status}: {self.stopped}"

    @property
    def advice(self) -> str:
        """What becomes of the plate, and advice after a run that was lost."""
        then, of_log = self.then and sentence(self.then), ""
        if self.status == "left_workspace" and self.log is not None:
            which = "A log (--out or --log)" if self.log == _ANY_LOG else "The log"
            of_log = (
                f"{which} shows the loss: stewart-drake replay {self.log}. If it is 2 s longer "
                f"than the delay: stewart-drake identify {self.log} --mechanism FILE; else add "
                "coulomb to controller.estimate."
            )
        return " ".join(filter(None, (then, _ADVICE.get(self.status), of_log)))


class Snapshot(NamedTuple):
    time: float  # time since the begin, s
    state: Array  # estimated state (12,)
    wanted: Array  # reference (18,)
    torque: Array  # torque that acts (6,), N m
    error: float  # mean pose error, % of peak to peak; NaN while `unmeasured` exceeds the delay
    eta: float  # delay from a measurement to its torque as the law assumes it, s
    trip: float  # median round trip, s
    spread: float  # standard deviation of the round trips, s
    lost: float  # share of the datagrams that are lost, there and back
    missed: int  # number of missed deadlines
    unmeasured: float  # time since the last usable measurement, s
    recoveries: int  # number of new references that were planned
    safe: str | None  # why the safe torque acts, or None
    by_hand: bool  # whether the target is set by hand
    limit: str | None  # limit that prevents the requested motion, or None
    resting: bool = False  # whether the run is over and the plate comes to rest, or is held there
    estimates: Mapping[str, float] = {}  # estimated parameters by name


class Viewer:
    """Shows a run and passes on requests; this one does neither."""

    def show(self, snapshot: Snapshot) -> None:
        """Show the loop at a sample, without waiting."""

    def request(self) -> Request:
        return Request()

    def stopped(self) -> bool:
        """Return whether an immediate stop is requested."""
        return False

    def finished(self) -> bool:
        """Return whether the run is complete before its duration."""
        return False

    def ended(self, end: End) -> None:
        """Show how the run ended; the last call."""
