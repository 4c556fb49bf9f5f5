"""Access control of live pages: requests of other sites are refused, and one operator's clicks count.

The pages are served by viser, whose server takes no filter of requests. Its connections are made by the websockets
package, which does; so the filter is put there while viser starts its server. A proxy in front would leave viser's own
port open to the same requests, as viser listens on TCP only.
"""

import functools
import hmac
import http
import ipaddress
import re
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from uwlts.model.errors import SetupError

Handler = Callable[[ServerConnection], Awaitable[None]]
Filter = Callable[[ServerConnection, Request], Response | None]

_HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+)(:\d{1,5})?")
_PROTECTION = {"X-Frame-Options": "DENY", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}
"""Headers of every answer: no other site shows the page in a frame of its own, or learns its address."""
_patching = threading.Lock()


def is_local(host: str) -> bool:
    """Whether an address to serve at can be reached from this machine only."""
    return host == "localhost" or _is_loopback(host)


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def _is_loopback(name: str) -> bool:
    address = _address(name)
    return address is not None and address.is_loopback


class PageAccess:
    """Rules of a page that is served at ``host``.

    Everybody who reaches it may look. The operator opens it with the ``token`` in the address, which the browser keeps
    in a cookie; messages of all others are thrown away, and those of an operator whose page was opened once more.
    """

    def __init__(self, host: str):
        self.host, self.token = host, secrets.token_urlsafe(16)
        # Cookies are shared by all ports of a machine.
        self._cookie = f"uwlts-operator-{secrets.token_hex(4)}"
        self._operator: ServerConnection | None = None

    def refusal(self, headers: Headers) -> str | None:
        """Why a request is refused: its Host is not this machine's, as after DNS rebinding, or another site sent it."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return f"this page is not at {', '.join(hosts) or 'an address without Host'}: open the address it printed"
        for origin in origins:
            parts = urlsplit(origin)
            if parts.scheme not in ("http", "https") or parts.netloc.lower() != hosts[0].lower():
                return f"requests of other sites ({origin}) are refused"
        sites, modes = headers.get_all("Sec-Fetch-Site"), headers.get_all("Sec-Fetch-Mode")
        if {"cross-site", "same-site"} & set(sites) and modes != ["navigate"]:
            return "requests of other sites are refused"
        return None

    def _is_own(self, host: str) -> bool:
        """Whether a Host, with or without port, is this page's. Port forwarding may change the port."""
        found = _HOST.fullmatch(host)
        if not found:
            return False
        name = found[1].strip("[]").lower()
        if is_local(name):
            return True
        bound = _address(self.host)
        if is_local(self.host):
            return False
        if bound is not None and bound.is_unspecified:
            # A page that was rebound to this machine still has its own name, never a number.
            own = socket.gethostname().lower()
            return _address(name) is not None or name in (own, f"{own}.local")
        return name == self.host.lower() or (bound is not None and _address(name) == bound)

    def is_operator(self, headers: Headers) -> bool:
        """Whether a request has the token's cookie."""
        for line in headers.get_all("Cookie"):
            try:
                kept = SimpleCookie(line).get(self._cookie)
            except CookieError:
                continue
            if kept is not None and self._is_token(kept.value):
                return True
        return False

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self.token.encode())

    def answer(self, request: Request) -> Response | None:
        """Answer to a request that viser does not see: refused, or with the token in its address; else None."""
        if (why := self.refusal(request.headers)) is not None:
            return _text(http.HTTPStatus.FORBIDDEN, why)
        path, _, query = request.path.partition("?")
        given = parse_qs(query).get("token")
        if given is None:
            return None
        if len(given) != 1 or not self._is_token(given[0]):
            return _text(http.HTTPStatus.FORBIDDEN, "this token is not the page's: open the address that it printed")
        moved = _text(http.HTTPStatus.SEE_OTHER, "operator")
        # A path that begins with two slashes would lead to another site.
        moved.headers["Location"] = f"/{path.lstrip('/')}"
        moved.headers["Set-Cookie"] = f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        return moved

    def filtered(self, before: Filter | None) -> Filter:
        """A filter of requests in front of another one."""

        def process_request(connection: ServerConnection, request: Request) -> Response | None:
            response = self.answer(request)
            if response is None and before is not None:
                response = before(connection, request)
            if response is not None:
                for name, value in _PROTECTION.items():
                    response.headers[name] = value
            return response

        return process_request

    def heard(self, handler: Handler) -> Handler:
        """A handler of connections that gets the operator's messages only."""

        async def handle(connection: ServerConnection) -> None:
            if connection.request is not None and self.is_operator(connection.request.headers):
                self._operator = connection
            receive = connection.recv

            async def recv(*args: Any, **options: Any) -> Any:
                while True:
                    message = await receive(*args, **options)
                    if self._operator is connection:
                        return message

            connection.recv = recv
            await handler(connection)

        return handle


def _text(status: http.HTTPStatus, text: str) -> Response:
    body = f"{text}\n".encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
    return Response(status, status.phrase, headers, body)


class _Server(viser.ViserServer):
    """A server without viser's tunnel, which shows a page to everybody by way of a server in the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """No address is shared."""
        return None


def guarded_server(access: PageAccess, *, port: int) -> viser.ViserServer:
    """A viser server at ``access.host`` that keeps to the rules, at ``port`` or the next free one.

    SetupError where this version of viser makes its connections in another way.
    """
    module, guarded = websockets.asyncio.server, False
    original = module.serve

    @functools.wraps(original, updated=())
    def serve(handler: Handler, *args: Any, process_request: Filter | None = None, **options: Any) -> Any:
        nonlocal guarded
        guarded = True
        return original(access.heard(handler), *args, process_request=access.filtered(process_request), **options)

    with _patching:
        setattr(module, "serve", serve)  # noqa: B010 - type checkers know it as a class
        try:
            server = _Server(host=access.host, port=port, verbose=False)
        finally:
            setattr(module, "serve", original)  # noqa: B010
    if not guarded:
        server.stop()
        raise SetupError(f"viser {viser.__version__} serves pages in a way that cannot be guarded: install viser 1.1")
    return server
