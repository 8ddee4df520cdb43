"""Server of a page on this computer only.

A request must carry the token of the page's address, which other pages in the same browser do not
know, and one of this computer's names, since a foreign name may resolve to its address.
"""

import secrets
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar, Final
from urllib.parse import parse_qs, urlsplit

_LONGEST: Final = 4096
"""Longest request of a browser, bytes."""


class LocalServer(ThreadingHTTPServer):
    """Server on a free port of 127.0.0.1."""

    daemon_threads = True

    def __init__(self, handler: "type[LocalHandler]") -> None:
        super().__init__(("127.0.0.1", 0), handler)
        self._token = handler.token

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/?token={self._token}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error, except that a browser has closed its connection."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class LocalHandler(BaseHTTPRequestHandler):
    """Answers of a page; derive from it and set `token` and `text`."""

    token: ClassVar[str]
    text: ClassVar[str]

    def log_message(self, *_: Any) -> None:
        pass

    def get(self, path: str) -> bool:
        """Answer a request for another path than the page; return whether there is such a path."""
        return False

    def post(self, path: str, data: bytes) -> bytes | None:
        """Return the answer to a request with data, in JSON, or None for a malformed one."""
        return None

    def do_GET(self) -> None:
        try:
            parts = urlsplit(self.path)
        except ValueError:  # such as http://[
            self.send_error(400)
            return
        if not self._allowed(parse_qs(parts.query).get("token", [""])[0]):
            return
        if parts.path == "/":
            self._answer("text/html; charset=utf-8", self.text.encode())
        elif not self.get(parts.path):
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
        answer = self.post(self.path, self.rfile.read(int(length)))
        if answer is None:
            self.send_error(400)
            return
        self._answer("application/json", answer)

    def _allowed(self, given: str) -> bool:
        host = self.headers.get("Host", "").rpartition(":")[0]
        good = host in ("127.0.0.1", "localhost") and secrets.compare_digest(
            given.encode(), self.token.encode()
        )
        if not good:
            self.send_error(403)
        return good

    def _answer(self, kind: str, data: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(data)
