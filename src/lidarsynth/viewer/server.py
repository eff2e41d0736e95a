"""The local server: 127.0.0.1 only, a secret in the address, nothing to be had but the page and the scans by number.

A page of another origin can neither ask (Host and Origin must be our own, so a name that is bound to 127.0.0.1 later
does not help it) nor guess the address (a token of 192 random bits). No path of a request ever becomes a path on disk.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from lidarsynth.viewer.packing import Shown, packed
from lidarsynth.viewer.page import LIVE, page, settings_of
from lidarsynth.viewer.series import Series

HOST = "127.0.0.1"
NUMBER = 9  # digits of a scan's number, at most
SAFE = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


@dataclass(frozen=True)
class Show:
    """What is served: series by caption, each stop of the slider one scan of each, under a title."""

    title: str
    series: Mapping[str, Series]
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))


def serve(show: Show, port: int = 0) -> ThreadingHTTPServer:
    """A server on 127.0.0.1 and a free port (or `port`), bound and not yet running; `address` is where the page is.

    Raises ValueError where no scan can be read, or the port cannot be had.
    """
    nonce = secrets.token_urlsafe(12)
    text = page(_settings(show), nonce).encode()
    try:
        server = ThreadingHTTPServer((HOST, port), partial(_Handler, show, text, LIVE.format(nonce)))
    except (OSError, OverflowError) as error:
        raise ValueError(f"expected a free port of 127.0.0.1, found {port}: {error}") from None
    server.daemon_threads = True
    return server


def address(server: ThreadingHTTPServer, show: Show) -> str:
    """Where the page is, token included."""
    return f"http://{HOST}:{server.server_address[1]}/{show.token}/"


def _settings(show: Show) -> dict[str, Any]:
    first = next(iter(show.series.values()))
    shown = _first_whole(first, show.title)
    names = {"names": list(first.names), "count": first.count, "captions": list(show.series)}
    return settings_of(shown, show.title) | names


def _first_whole(series: Series, title: str) -> Shown:
    """The first scan that can be read. Raises ValueError where none can, of the first of them."""
    wrong: Exception | None = None
    number = 0
    while True:
        try:
            return series[number]
        except IndexError:
            raise wrong or ValueError(f"{title}: expected a scan, found none") from None
        except (ValueError, OSError) as error:
            wrong, number = wrong or error, number + 1
            if len(series.names) < number:
                raise wrong from None  # what the scans are read from is broken: there is no next one


class _Handler(BaseHTTPRequestHandler):
    """One request: is it ours, and is it for the page or for a scan?"""

    protocol_version = "HTTP/1.1"
    timeout = 30

    def __init__(self, show: Show, text: bytes, policy: str, *connection: Any):
        self.show, self.text, self.policy = show, text, policy
        super().__init__(*connection)

    def handle(self) -> None:
        """All requests of a connection, which ends where the browser has gone away: that is no fault to print."""
        with suppress(ConnectionError):
            super().handle()

    def do_GET(self) -> None:
        """The page under /TOKEN/, a scan under /TOKEN/scan/NUMBER/VERSION."""
        if not self._ours():
            return self._answer(HTTPStatus.FORBIDDEN, b"expected the address that lidarsynth printed\n")
        match self.path.split("/")[2:]:
            case [""]:
                self._answer(HTTPStatus.OK, self.text, "text/html; charset=utf-8")
            case ["scan", number, version] if _is_number(number) and _is_number(version):
                self._scan(int(number), int(version))
            case _:
                self._answer(HTTPStatus.NOT_FOUND, b"expected / or /scan/NUMBER/VERSION\n")

    def _scan(self, number: int, version: int) -> None:
        series = list(self.show.series.values())
        try:
            content = packed(series[version][number])
        except IndexError:
            return self._answer(HTTPStatus.NO_CONTENT, b"")  # behind the last
        except (ValueError, OSError, ImportError) as error:  # words instead of a scan: the page says them
            return self._answer(HTTPStatus.OK, " ".join(str(error).split()).encode(errors="replace"))
        self._answer(HTTPStatus.OK, content, "application/octet-stream")

    def _ours(self) -> bool:
        """Whether Host, Origin and token are those of this server."""
        port = self.server.server_address[1]  # type: ignore[index]
        hosts = {f"{HOST}:{port}", f"localhost:{port}"}
        host, origin = self.headers.get_all("Host", []), self.headers.get_all("Origin", [])
        asked = self.headers.get("Sec-Fetch-Mode", "navigate")  # a link that is followed may stand anywhere
        site = "none" if asked == "navigate" else self.headers.get("Sec-Fetch-Site", "none")
        token = self.path.split("/")[1] if self.path.startswith("/") else ""
        return (
            len(host) == 1
            and host[0] in hosts
            and origin in ([], [f"http://{host[0]}"])
            and site in ("none", "same-origin")
            and secrets.compare_digest(token.encode(), self.show.token.encode())
        )

    def _answer(self, status: HTTPStatus, content: bytes, kind: str = "text/plain; charset=utf-8") -> None:
        self.send_response(status)
        for name, value in {**SAFE, "Content-Security-Policy": self.policy, "Content-Type": kind}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def version_string(self) -> str:
        """No word on which Python this is."""
        return "lidarsynth"

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the terminal belongs to the verb."""


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= NUMBER
