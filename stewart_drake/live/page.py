"""The page of a live run: the machine in Meshcat, readouts, sliders, and the button that stops it.

It is served by a process of its own, so that neither drawing nor a browser takes time from the
loop. Both servers listen on this computer alone. What asks the machine to do something must bring
the token that is in the page's address: other pages in the same browser, which can send to this
computer too, do not know it.
"""

import json
import logging
import multiprocessing
import secrets
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing.connection import Connection
from typing import Any, Final, NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.jsonio import jsonable
from stewart_drake.live.loop import Seen
from stewart_drake.live.steering import Wish
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.reporting.page import environment
from stewart_drake.reporting.style import FACTORS
from stewart_drake.reporting.viewer import slider_range
from stewart_drake.scenario.signals import COORDINATE_NAMES, NUM_COORDINATES, POSE, RATES
from stewart_drake.types import Array

_FRAME: Final = 1 / 30
"""s between two frames."""
_TOLD: Final = 0.1
"""s between two readouts."""
_LAST: Final = 0.5
"""s for which the page is served after the loop is gone."""
_START: Final = 60.0
"""s in which the page must be there."""
_LONGEST: Final = 4096
"""Bytes of what a browser may send."""
_AHEAD: Final = 0.2
"""s for which the plate is drawn on its way between two samples, at the most."""


class Opened(NamedTuple):
    """Of the page's process, once it is there."""

    url: str


class Ended(NamedTuple):
    """How the run ended, in words."""

    words: str


class Asked(NamedTuple):
    """What was asked for on the page."""

    target: Array | None
    stop: bool


class PageViewer:
    """A `live.loop.Viewer`: the page, in a process of its own.

    Args:
        mechanism: to be shown.
        title: of the page.
    """

    def __init__(self, mechanism: Mechanism, title: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=serve, args=(other, mechanism, title), daemon=True)
        self._process.start()
        other.close()
        self._wish, self._stop, self._there, self._credit = Wish(), False, True, True

    def opened(self) -> str:
        """The page's address, with its token; once, waits for it.

        Raises:
            ConfigError: the page's process did not start.
        """
        with suppress(EOFError):
            if self._connection.poll(_START):
                return str(self._connection.recv().url)
        raise ConfigError("--no-browser: not given, and the page did not start; expected it")

    def show(self, seen: Seen) -> None:
        """See `Viewer`: what the page has no time for is left out."""
        self._read()
        if self._credit and self._there:
            self._credit = False
            with self._gone():
                self._connection.send(seen)

    def wish(self) -> Wish:
        """See `Viewer`."""
        self._read()
        return self._wish

    def stopped(self) -> bool:
        """See `Viewer`."""
        return self._stop

    def ended(self, words: str) -> None:
        """See `Viewer`: the page says so, and its process stays until it was sent."""
        self._read()
        if self._there:
            with self._gone():
                self._connection.send(Ended(words))

    def close(self) -> None:
        """End the page's process."""
        self._connection.close()
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.terminate()

    def _read(self) -> None:
        with self._gone():
            while self._there and self._connection.poll():
                said = self._connection.recv()
                if isinstance(said, Asked):
                    self._wish, self._stop = Wish(said.target), self._stop or said.stop
                else:
                    self._credit = True

    @contextmanager
    def _gone(self) -> Iterator[None]:
        """Where the page's process has ended the loop goes on without it, and the motion leads."""
        try:
            yield
        except (EOFError, OSError):
            self._there, self._wish = False, Wish()


# ---------------------------------------------------------------- the page's process


class _Board:
    """What the loop last said, for the threads that serve browsers."""

    def __init__(self) -> None:
        self.news = threading.Condition()
        self.said: str = "{}"
        self.number = 0

    def put(self, said: dict[str, Any]) -> None:
        with self.news:
            self.said = json.dumps(jsonable(said), allow_nan=False)
            self.number += 1
            self.news.notify_all()

    def after(self, number: int) -> tuple[str, int]:
        with self.news:
            self.news.wait_for(lambda: self.number != number, timeout=5.0)
            return self.said, self.number


def serve(connection: Connection, mechanism: Mechanism, title: str) -> None:
    """Serve the page until the loop is gone.

    Args:
        connection: to the loop.
        mechanism: to be shown.
        title: of the page.
    """
    import signal

    from pydrake.geometry import Meshcat, MeshcatParams

    from stewart_drake.loop.scene import Scene

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the loop, which then closes this
    logging.getLogger("drake").setLevel(logging.WARNING)  # the address that counts is the page's
    meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    scene, board = Scene(mechanism, meshcat), _Board()
    token, lock = secrets.token_urlsafe(24), threading.Lock()

    low, high = slider_range(mechanism)

    def ask(asked: Asked) -> None:
        if asked.target is not None:
            asked = asked._replace(target=np.clip(asked.target, low / FACTORS, high / FACTORS))
        with lock, suppress(OSError):
            connection.send(asked)

    sliders = [
        {"name": name, "unit": "deg" if i < 3 else "mm", "low": low[i], "high": high[i]}
        for i, name in enumerate(COORDINATE_NAMES)
    ]
    page = environment().get_template("live.html.j2")
    text = page.render(title=title, meshcat=meshcat.web_url(), token=token, sliders=sliders)
    server = _Server(("127.0.0.1", 0), _handler(text, token, board, ask))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with lock:
        connection.send(Opened(f"http://127.0.0.1:{server.server_port}/?token={token}"))
    with suppress(EOFError, OSError):
        _draw(connection, lock, scene, board)
    time.sleep(_LAST)  # for the browsers to hear how it ended
    server.shutdown()
    scene.close()


def _draw(connection: Connection, lock: threading.Lock, scene: Any, board: _Board) -> None:
    """Draw what the loop says, and on between its samples."""
    from stewart_drake.loop.scene import full_color, torque_shares

    seen, came, largest, told = None, 0.0, list[float](), 0.0
    ended: dict[str, Any] = {}
    while True:
        started = time.monotonic()
        if connection.poll(_FRAME if seen is None else 0):
            said = connection.recv()
            if isinstance(said, Ended):
                ended = {"ended": said.words}
                board.put(ended if seen is None else _words(seen) | ended)
                continue
            seen, came = said, started
            with lock:
                connection.send(None)  # ready for more
            largest = [*largest[-1000:], float(np.abs(seen.torque).max())]
            scene.paint(torque_shares(seen.torque, full_color(np.array(largest))))
        if seen is None:
            continue
        ahead = min(started - came, _AHEAD)
        pose, wanted = (x[POSE] + ahead * x[RATES] for x in (seen.state, seen.wanted))
        if np.all(np.isfinite(pose)):
            scene.show(pose, wanted)
        if started - told >= _TOLD:
            told = started
            board.put(_words(seen) | ended)
        time.sleep(max(0.0, _FRAME - (time.monotonic() - started)))


def _words(seen: Seen) -> dict[str, Any]:
    """For the page: numbers in degrees and mm, ms, %."""
    return {
        "time": round(seen.time, 2),
        "wanted": np.round(FACTORS * seen.wanted[POSE], 2).tolist(),
        "pose": np.round(FACTORS * seen.state[POSE], 2).tolist(),
        "torque": np.round(seen.torque, 4).tolist(),
        "error": round(seen.error, 3),
        "eta": round(1e3 * seen.eta, 1),
        "trip": round(1e3 * seen.trip, 1),
        "spread": round(1e3 * seen.spread, 1),
        "lost": round(100 * seen.lost, 1),
        "missed": seen.missed,
        "safe": seen.safe,
        "byHand": seen.by_hand,
        "limit": seen.limit,
    }


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report what goes wrong, but for a browser that closes its connection."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def _handler(text: str, token: str, board: _Board, ask: Any) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            """Nothing."""

        def _allowed(self, given: str) -> bool:
            # The name by which it was asked for, too: another site's name may lead here.
            host = self.headers.get("Host", "").rpartition(":")[0]
            good = host in ("127.0.0.1", "localhost") and secrets.compare_digest(
                given.encode(), token.encode()
            )
            if not good:
                self.send_error(403)
            return good

        def do_GET(self) -> None:
            try:
                parts = urlsplit(self.path)
            except ValueError:  # such as http://[
                self.send_error(400)
                return
            if not self._allowed(parse_qs(parts.query).get("token", [""])[0]):
                return
            if parts.path == "/":
                self._answer("text/html; charset=utf-8", text.encode())
            elif parts.path == "/events":
                self._events()
            else:
                self.send_error(404)

        def do_POST(self) -> None:
            if not self._allowed(self.headers.get("X-Token", "")):
                return
            length = self.headers.get("Content-Length", "")
            # Python refuses to convert thousands of digits.
            few = len(length) <= len(str(_LONGEST))
            if not (few and length.isdecimal() and int(length) <= _LONGEST):
                self.send_error(413)
                return
            asked = read_wish(self.rfile.read(int(length)))
            if asked is None:
                self.send_error(400)
                return
            ask(asked)
            self._answer("application/json", b"{}")

        def _answer(self, kind: str, data: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            self.wfile.write(data)

        def _events(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/event-stream")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            with suppress(OSError):  # the browser is gone
                for said in _news(board):
                    self.wfile.write(f"data: {said}\n\n".encode())
                    self.wfile.flush()

    return Handler


def _news(board: _Board) -> Iterator[str]:
    number = -1
    while True:
        said, number = board.after(number)
        yield said


def read_wish(data: bytes) -> Asked | None:
    """What a browser has sent: `target`, six numbers in degrees and mm or null, and `stop`.

    Returns:
        None for what is no such thing.
    """
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):  # thousands of brackets
        return None
    if not isinstance(found, dict) or not isinstance(found.get("stop", False), bool):
        return None
    target = found.get("target")
    if target is None:
        return Asked(None, found.get("stop", False))
    numbers = isinstance(target, list) and len(target) == NUM_COORDINATES
    if not numbers or not all(type(x) in (int, float) for x in target):
        return None
    try:
        pose = np.array(target, dtype=np.float64) / FACTORS
    except OverflowError:  # an integer of hundreds of digits
        return None
    return Asked(pose, found.get("stop", False)) if np.all(np.isfinite(pose)) else None
