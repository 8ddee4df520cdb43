"""Viewers of a live run: what they are shown, and what they request."""

from typing import Final, NamedTuple

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.live.governor import Request
from stewart_drake.types import Array

_ADVICE: Final = {
    "left_workspace": "Bring the plate back to its start and start live again. With --out the log "
    "shows the loss: stewart-drake replay LOG, stewart-drake identify LOG.",
    "lost_contact": "Datagrams arrive, usable measurements do not. If these are late, relieve both "
    "computers or the network; else check the sensor. --max-missing 1 allows gaps of 1 s.",
    "lost_machine": "Check the machine's process and the network, and the load of its computer. "
    "--max-missing 1 allows gaps of 1 s. The machine goes to its safe torque by itself.",
    "refused": "Correct what is named, then start live again.",
}
"""What to do after a run, by its status."""


class End(NamedTuple):
    """How a run ended: its status (`loop.results.RunSummary`) and the failure, if any."""

    status: str
    stopped: Failure | None

    @property
    def words(self) -> str:
        status = self.status.replace("_", " ")
        return status if self.stopped is None else f"{status}: {self.stopped}"

    @property
    def advice(self) -> str:
        """Advice after a run that was lost; else empty."""
        return _ADVICE.get(self.status, "")


class Snapshot(NamedTuple):
    time: float  # time since the begin, s
    state: Array  # estimated state (12,)
    wanted: Array  # reference (18,)
    torque: Array  # torque that acts (6,), N m
    error: float  # mean pose error, % of peak to peak
    eta: float  # delay from a measurement to its torque as the law assumes it, s
    trip: float  # median round trip, s
    spread: float  # standard deviation of the round trips, s
    lost: float  # share of the datagrams that are lost, there and back
    missed: int  # number of missed deadlines
    safe: str | None  # why the safe torque acts, or None
    by_hand: bool  # whether the target is set by hand
    limit: str | None  # limit that prevents the requested motion, or None


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
