"""Server of a page on this computer only.

A request must carry the token of the page's address, which other pages in the same browser do not
know. Its Host must be a name of this computer: another name may resolve to 127.0.0.1, too.
"""

import secrets
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from stewart_drake.reporting.page import environment

_MAX_BODY: Final = 4096
"""Largest content of a POST request, bytes."""


class LocalServer(ThreadingHTTPServer):
    """Server on a free port of 127.0.0.1, in background threads.

    Args:
        template: name of the page's template.
        values: variables of the template; `token` is added.
        get: by path, a function that returns another page, or the events of a stream.
        post: function of path and data that returns JSON, or None for a malformed request.
    """

    daemon_threads = True

    def __init__(
        self,
        template: str,
        values: Mapping[str, Any],
        get: Mapping[str, Callable[[], str | Iterator[str]]],
        post: Callable[[str, bytes], str | None],
    ) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.token = secrets.token_urlsafe(24)
        page = environment().get_template(template).render(token=self.token, **values)
        self.get, self.post = {"/": lambda: page, **get}, post
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/?token={self.token}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error, unless the browser has closed its connection."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: LocalServer

    def log_message(self, *_: Any) -> None:
        pass

    def do_GET(self) -> None:
        try:
            parts = urlsplit(self.path)
        except ValueError:  # such as http://[
            self.send_error(400)
            return
        if not self._allowed(parse_qs(parts.query).get("token", [""])[0]):
            return
        if parts.path not in self.server.get:
            self.send_error(404)
            return
        answer = self.server.get[parts.path]()
        if isinstance(answer, str):
            self._answer("text/html; charset=utf-8", answer)
        else:
            self._stream(answer)

    def do_POST(self) -> None:
        if not self._allowed(self.headers.get("X-Token", "")):
            return
        length = self.headers.get("Content-Length", "")
        # int() raises for thousands of digits.
        is_short = len(length) <= len(str(_MAX_BODY))
        if not (is_short and length.isdecimal() and int(length) <= _MAX_BODY):
            self.send_error(413)
            return
        answer = self.server.post(self.path, self.rfile.read(int(length)))
        if answer is None:
            self.send_error(400)
        else:
            self._answer("application/json", answer)

    def _allowed(self, token: str) -> bool:
        """Return whether Host and token are right; answer 403 if not."""
        host = self.headers.get("Host", "").rpartition(":")[0]
        expected = self.server.token.encode()
        allowed = host in ("127.0.0.1", "localhost")
        allowed = allowed and secrets.compare_digest(token.encode(), expected)
        if not allowed:
            self.send_error(403)
        return allowed

    def _answer(self, content_type: str, text: str) -> None:
        data = text.encode()
        self.send_response(200)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(data)

    def _stream(self, events: Iterator[str]) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        with suppress(OSError):  # the browser is gone
            for text in events:
                self.wfile.write(f"data: {text}\n\n".encode())
                self.wfile.flush()
