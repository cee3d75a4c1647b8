"""Who may ask the server of a page: its own addresses, pages of its own, and each token once.

A page elsewhere can make a browser ask a server on this computer, by a name of its own that it lets
point here (DNS rebinding). The browser then says that name as `Host`, and as `Origin` of a
websocket. So a request whose host is another than the server's, or whose origin is another than its
host, gets no answer, and the token of a page opens one websocket only. Nor does a page elsewhere
get this one as its script or within a frame, where a reader could be led to click.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Awaitable
from urllib.parse import urlsplit

from tornado.httputil import (
    HTTPConnection,
    HTTPHeaders,
    HTTPMessageDelegate,
    HTTPServerConnectionDelegate,
    RequestStartLine,
    ResponseStartLine,
)

LOOPBACK = "127.0.0.1"
MOST = 10_000  # tokens that are remembered


class Doors(HTTPServerConnectionDelegate):
    """A server's application, of Tornado, behind these rules; address: where it listens."""

    def __init__(self, application: HTTPServerConnectionDelegate, address: str):
        self.application, self.address = application, address
        self.used: dict[str, None] = {}

    def start_request(
        self, server_conn: object, request_conn: HTTPConnection
    ) -> HTTPMessageDelegate:
        inner = self.application.start_request(server_conn, request_conn)
        return _Request(self, inner, request_conn)

    def refuses(self, headers: HTTPHeaders) -> str:
        """Why a request gets no answer; an empty text for one that does."""
        host, origin = headers.get_list("Host"), headers.get_list("Origin")
        if len(host) != 1 or not self._is_own(host[0]):
            return "this is not an address of this page"
        if origin and (len(origin) > 1 or urlsplit(origin[0]).netloc != host[0]):
            return "another page may not ask this one"
        elsewhere = headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin")
        if elsewhere and headers.get("Sec-Fetch-Dest") != "document":
            return "another page may not ask this one"
        if headers.get("Upgrade", "").lower() != "websocket":
            return ""
        if not origin:
            return "a websocket needs an origin"
        token = headers.get("Sec-WebSocket-Protocol", "").rpartition(",")[2].strip()
        if token in self.used:
            return "this page was opened already; load it again"
        self.used[token] = None
        while len(self.used) > MOST:
            del self.used[next(iter(self.used))]
        return ""

    def _is_own(self, host: str) -> bool:
        """Whether a host is this computer: by name or, beyond the loopback, by any address."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name in (self.address, "localhost", LOOPBACK, "::1"):
            return True
        if self.address in (LOOPBACK, "localhost", "::1"):
            return False
        try:
            ipaddress.ip_address(name)  # nobody else can let an address point here
        except ValueError:
            return name == socket.gethostname().lower()
        return True


class _Request(HTTPMessageDelegate):
    """One request, which is given on once its headers are seen."""

    def __init__(self, doors: Doors, inner: HTTPMessageDelegate, connection: HTTPConnection):
        self.doors, self.inner, self.connection = doors, inner, connection
        self.refused = False

    def headers_received(
        self, start_line: RequestStartLine | ResponseStartLine, headers: HTTPHeaders
    ) -> Awaitable[None] | None:
        said = self.doors.refuses(headers)
        self.refused = bool(said)
        if not said:
            return self.inner.headers_received(start_line, headers)
        body = said.encode()
        answer = {"Content-Length": str(len(body)), "Content-Type": "text/plain"}
        start = ResponseStartLine("HTTP/1.1", 403, "Forbidden")
        self.connection.write_headers(start, HTTPHeaders(answer), body)
        self.connection.finish()
        return None

    def data_received(self, chunk: bytes) -> Awaitable[None] | None:
        return None if self.refused else self.inner.data_received(chunk)

    def finish(self) -> None:
        if not self.refused:
            self.inner.finish()

    def on_connection_close(self) -> None:
        if not self.refused:
            self.inner.on_connection_close()
