"""Access control of the page: requests of other sites are refused, and only the operator's clicks count.

The rules stand in front of the whole application (ASGI), so that they hold for pages, files and the connection by which
browsers send clicks. Who only looks gets a page without a single control, so there is nothing of his to obey.
"""

import hmac
import http
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

_HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+)(:\d{1,5})?")
_PROTECTION = (
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
)
"""Headers of every answer: no other site shows the page in a frame of its own, or learns its address."""

_MOST_VIEWED = 100
"""Every window of a viewer holds one connection, and some requests for a moment; a process may open 1024 files."""


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


@dataclass(frozen=True)
class PageAccess:
    """Rules of a page that is served at ``host``.

    Everybody who reaches it may look. The operator opens it with the ``token`` in the address, which the browser keeps
    in a ``cookie`` of this name: cookies are shared by all ports of a machine.
    """

    host: str
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16))
    cookie: str = field(default_factory=lambda: f"uwlts-operator-{secrets.token_hex(4)}")

    def refusal(self, headers: Headers, *, page_port: int | None = None) -> str | None:
        """Why a request is refused: its Host is not this machine's, as after DNS rebinding, or another site sent it.

        ``page_port`` is the port of the page whose requests are accepted, if it is another port than the request's.
        """
        hosts, origins = headers.getlist("Host"), headers.getlist("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return f"this page is not at {', '.join(hosts) or 'an address without Host'}: open the address it printed"
        own, foreign = [hosts[0].lower()], {"cross-site", "same-site"}
        if page_port is not None:
            name = _HOST.sub(r"\1", own[0])
            # Browsers leave out port 80, and count another port of one machine to the same site.
            own, foreign = [f"{name}:{page_port}", *[name] * (page_port == 80)], {"cross-site"}
        for origin in origins:
            parts = urlsplit(origin)
            if parts.scheme not in ("http", "https") or parts.netloc.lower() not in own:
                return f"requests of other sites ({origin}) are refused"
        sites, modes = headers.getlist("Sec-Fetch-Site"), headers.getlist("Sec-Fetch-Mode")
        if foreign & set(sites) and modes != ["navigate"]:
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
        for line in headers.getlist("Cookie"):
            try:
                kept = SimpleCookie(line).get(self.cookie)
            except CookieError:
                continue
            if kept is not None and self._is_token(kept.value):
                return True
        return False

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self.token.encode())

    def answer(self, scope: Scope) -> Response | None:
        """Answer to a request that is refused or has the token in its address; None for the application's own."""
        headers = Headers(scope=scope)
        if (why := self.refusal(headers)) is not None:
            return PlainTextResponse(f"{why}\n", http.HTTPStatus.FORBIDDEN)
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token")
        if given is None or scope["type"] != "http":
            return None
        if len(given) != 1 or not self._is_token(given[0]):
            why = "this token is not the page's: open the address that it printed"
            return PlainTextResponse(f"{why}\n", http.HTTPStatus.FORBIDDEN)
        # A path that begins with two slashes would lead to another site.
        moved = RedirectResponse(f"/{scope['path'].lstrip('/')}", http.HTTPStatus.SEE_OTHER)
        moved.set_cookie(self.cookie, self.token, httponly=True, samesite="strict")
        return moved


class GuardedApp:
    """An ASGI application behind the rules, whose answers are framed by no other site and tell none its address.

    It serves a limited number of viewers' requests and connections at once, and any number of the operator's.
    """

    def __init__(self, app: ASGIApp, access: PageAccess):
        self._app, self._access, self._viewed = app, access, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        answer = self._access.answer(scope)
        viewer = answer is None and not self._access.is_operator(Headers(scope=scope))
        if viewer and self._viewed >= _MOST_VIEWED:
            why = f"{_MOST_VIEWED} requests of viewers are being served: close other windows of this page"
            answer, viewer = PlainTextResponse(f"{why}\n", http.HTTPStatus.SERVICE_UNAVAILABLE), False
        if answer is not None and scope["type"] == "websocket":
            # Before it is accepted: the browser sees status 403.
            await WebSocketClose()(scope, receive, send)
            return

        async def protected(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *_PROTECTION]
            await send(message)

        self._viewed += viewer
        try:
            await (answer or self._app)(scope, receive, protected)
        finally:
            self._viewed -= viewer
