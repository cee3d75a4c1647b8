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
from urllib.parse import urlsplit

from tornado.httputil import HTTPHeaders, HTTPMessageDelegate, HTTPServerRequest
from tornado.routing import Router
from tornado.web import Application, RequestHandler, stream_request_body

LOOPBACK = "127.0.0.1"
MOST = 10_000  # tokens that are remembered


class Doors(Router):
    """The way to an application of Tornado by these rules; address: what its server listens on."""

    def __init__(self, application: Application, address: str):
        self.application, self.address = application, address
        self.used: dict[str, None] = {}

    def find_handler(
        self, request: HTTPServerRequest, **options: object
    ) -> HTTPMessageDelegate | None:
        if said := self.refuses(request.headers):
            return self.application.get_handler_delegate(request, _Refusal, {"said": said})
        return self.application.find_handler(request, **options)

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


@stream_request_body
class _Refusal(RequestHandler):
    """The answer to a request that gets none, before its body is read."""

    def initialize(self, said: str) -> None:
        self.said = said

    def prepare(self) -> None:
        self.set_status(403)
        self.set_header("Content-Type", "text/plain")
        self.finish(self.said)

    def data_received(self, chunk: bytes) -> None:
        """Leave the body aside."""
