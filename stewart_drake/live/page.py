"""The page of a live run: the machine in Meshcat, readouts, sliders and a stop button.

A separate process serves it, so that neither drawing nor a browser delays the loop. Both servers
listen on this computer only (`reporting.local_page`).
"""

import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.jsonio import jsonable
from stewart_drake.live.governor import Request
from stewart_drake.live.viewer import End, Snapshot, Viewer
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.reporting.local_page import LocalServer
from stewart_drake.reporting.page import environment
from stewart_drake.reporting.style import FACTORS
from stewart_drake.reporting.viewer import slider_range
from stewart_drake.scenario.signals import COORDINATE_NAMES, POSE, RATES

_FRAME: Final = 1 / 30
"""Time between two frames, s."""
_READOUT: Final = 0.1
"""Time between two readouts, s."""
_LAST: Final = 0.5
"""Time for which the page is served after the end of the loop, s."""
_START: Final = 60.0
"""Longest wait for the page, s."""
_AHEAD: Final = 0.2
"""Longest extrapolation of the pose between two samples, s."""


class PageViewer(Viewer):
    def __init__(self, mechanism: Mechanism, title: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=serve, args=(other, mechanism, title), daemon=True)
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self._process.start()  # ignores Ctrl-C: that ends the loop, which closes the page
        finally:
            signal.signal(signal.SIGINT, handler)
        other.close()
        self._request, self._stop, self._open, self._ready = Request(), False, True, True

    def opened(self) -> str:
        """Wait for the page; return its address with the token. To be called once."""
        with suppress(EOFError):
            if self._connection.poll(_START):
                return str(self._connection.recv())
        raise ConfigError("the browser page did not start; run with --no-browser")

    def show(self, snapshot: Snapshot) -> None:
        """Send a sample to the page, or leave it out while the page draws another one."""
        self._read()
        if self._ready and self._open:
            self._ready = False
            with self._until_closed():
                self._connection.send(snapshot)

    def request(self) -> Request:
        self._read()
        return self._request

    def stopped(self) -> bool:
        return self._stop

    def ended(self, end: End) -> None:
        self._read()
        if self._open:
            with self._until_closed():
                self._connection.send(end)

    def close(self) -> None:
        self._connection.close()
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.terminate()

    def _read(self) -> None:
        with self._until_closed():
            while self._open and self._connection.poll():
                received = self._connection.recv()
                if received is None:
                    self._ready = True
                else:
                    target, stop = received
                    self._request, self._stop = Request(target), self._stop or stop

    @contextmanager
    def _until_closed(self) -> Iterator[None]:
        """Go on without the page, on the scenario's motion, if its process has ended."""
        try:
            yield
        except (EOFError, OSError):
            self._open, self._request = False, Request()


# ---------------------------------------------------------------- the page's process


class PageRequest(BaseModel):
    """Request of a browser: `target`, six numbers in degrees and mm or null, and `stop`."""

    target: Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)] | None = None
    stop: bool = False


class Readouts:
    """The newest readouts as JSON, for the threads that serve browsers."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._text, self._number = "{}", 0

    def put(self, values: dict[str, Any]) -> None:
        with self._changed:
            self._text = json.dumps(jsonable(values), allow_nan=False)
            self._number += 1
            self._changed.notify_all()

    def events(self) -> Iterator[str]:
        """Yield the readouts whenever they change, at least every 5 s."""
        seen = -1
        while True:
            with self._changed:
                if self._number == seen:
                    self._changed.wait(5.0)
                text, seen = self._text, self._number
            yield text


def serve(connection: Connection, mechanism: Mechanism, title: str) -> None:
    """Serve the page until the loop closes the connection."""
    from stewart_drake.loop.scene import Scene
    from stewart_drake.reporting.replay import quiet_meshcat, scene_page

    os.setsid()  # signals to the group end the loop, which closes this
    meshcat = quiet_meshcat()
    scene, readouts = Scene(mechanism, meshcat), Readouts()
    lock, (low, high) = threading.Lock(), slider_range(mechanism)

    def ask(_: str, data: bytes) -> str | None:
        try:
            asked = PageRequest.model_validate_json(data, strict=True)
        except ValidationError:
            return None
        target = None if asked.target is None else np.clip(asked.target, low, high) / FACTORS
        with lock, suppress(OSError):
            connection.send((target, asked.stop))
        return "{}"

    sliders = [
        {"name": name, "unit": "deg" if i < 3 else "mm", "low": low[i], "high": high[i]}
        for i, name in enumerate(COORDINATE_NAMES)
    ]
    link = environment().get_template("live_scene.html.j2").render(socket=meshcat.ws_url())
    shown = scene_page(meshcat, link, title)
    get: dict[str, Any] = {"/events": readouts.events, "/scene": lambda: shown}
    server = LocalServer("live.html.j2", {"title": title, "sliders": sliders}, get, ask)
    with suppress(EOFError, OSError):  # the loop is gone
        with lock:
            connection.send(server.url)
        _draw(connection, lock, scene, readouts)
    time.sleep(_LAST)  # for browsers to receive the end
    server.shutdown()
    scene.close()


def _draw(connection: Connection, lock: threading.Lock, scene: Any, readouts: Readouts) -> None:
    """Draw the snapshots, and extrapolate between them."""
    from stewart_drake.loop.scene import full_color, torque_shares

    seen, came, largest, written = None, 0.0, list[float](), 0.0
    ended: dict[str, Any] = {}
    while True:
        started = time.monotonic()
        if connection.poll(_FRAME if seen is None else 0):
            received = connection.recv()
            if isinstance(received, End):
                ended = {"ended": received.words, "advice": received.advice}
                ended["failed"] = received.failed
                readouts.put(ended if seen is None else _values(seen) | ended)
                continue
            seen, came = received, started
            with lock:
                connection.send(None)  # ready for the next
            largest = [*largest[-1000:], float(np.abs(seen.torque).max())]
            scene.paint(torque_shares(seen.torque, full_color(np.array(largest))))
        if seen is None:
            continue
        ahead = min(started - came, _AHEAD)
        pose, wanted = (x[POSE] + ahead * x[RATES] for x in (seen.state, seen.wanted))
        if np.all(np.isfinite(pose)):
            scene.show(pose, wanted)
        if started - written >= _READOUT:
            written = started
            readouts.put(_values(seen) | ended)
        time.sleep(max(0.0, _FRAME - (time.monotonic() - started)))


def _values(seen: Snapshot) -> dict[str, Any]:
    """Return the readouts in degrees, mm, ms and %."""
    return {
        "time": round(seen.time, 2),
        "wanted": np.round(FACTORS * seen.wanted[POSE], 2).tolist(),
        "pose": np.round(FACTORS * seen.state[POSE], 2).tolist(),
        "torque": np.round(seen.torque, 4).tolist(),
        "error": float(f"{seen.error:.3g}"),
        **{name: round(1e3 * getattr(seen, name), 1) for name in ("eta", "trip", "spread")},
        "lost": round(100 * seen.lost, 1),
        "missed": seen.missed,
        "unmeasured": round(seen.unmeasured, 2),
        "recoveries": seen.recoveries,
        "safe": seen.safe,
        "byHand": seen.by_hand,
        "resting": seen.resting,
        "limit": seen.limit,
    }
