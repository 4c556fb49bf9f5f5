"""Access control of the page: requests of other sites are refused, and only the operator can control anything.

The rules apply in front of the whole application (ASGI): to pages, files and the connection for the browsers' events.
Viewers get a page without controls, so that they cannot send events.
"""

import hmac
import http
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass, field
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers
from starlette.requests import cookie_parser
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

_HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+)(:\d{1,5})?")
MOST_VIEWERS = 16
"""Windows of viewers at once. Each is updated five times a second, and 40 delayed the operator's page by 20 s."""
_PROTECTION = (
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
)
"""Headers of every response: no other site can show the page in a frame, or learn its address."""
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'none'; connect-src 'self'"
)
"""Nothing is loaded from another site or sent to it. NiceGUI compiles its pages in the browser."""


def is_local(host: str) -> bool:
    """Return whether a host is reachable from this machine only."""
    address = _parse_address(host)
    return host == "localhost" or (address is not None and address.is_loopback)


def _parse_address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


@dataclass(frozen=True)
class PageAccess:
    """Access rules of a page that is served at ``host``.

    Everybody who can reach it may view it. The operator opens it with the ``token`` in the address. The browser then
    keeps the token in the ``cookie``, which has a unique name because all ports of a machine share cookies.
    """

    host: str
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16))
    cookie: str = field(default_factory=lambda: f"uwlts-operator-{secrets.token_hex(4)}")

    def refusal(self, headers: Headers, *, page_port: int | None = None) -> str | None:
        """Return why a request is refused: a foreign Host, as after DNS rebinding, or a request from another site.

        ``page_port`` is the port of the page whose requests are accepted, if it differs from the request's port.
        """
        hosts, origins = headers.getlist("Host"), headers.getlist("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return f"this page is not at {', '.join(hosts) or 'an address without Host'}: open the address it printed"
        hosts_here, foreign = [hosts[0].lower()], {"cross-site", "same-site"}
        if page_port is not None:
            name = _HOST.sub(r"\1", hosts_here[0])
            # Browsers omit port 80, and treat another port of the same machine as the same site.
            hosts_here, foreign = [f"{name}:{page_port}", *[name] * (page_port == 80)], {"cross-site"}
        for origin in origins:
            parts = urlsplit(origin)
            if parts.scheme not in ("http", "https") or parts.netloc.lower() not in hosts_here:
                return f"requests of other sites ({origin}) are refused"
        sites, modes = headers.getlist("Sec-Fetch-Site"), headers.getlist("Sec-Fetch-Mode")
        return "requests of other sites are refused" if foreign & set(sites) and modes != ["navigate"] else None

    def _is_own(self, host: str) -> bool:
        """Return whether a Host, with or without port, is this page's; port forwarding may change the port."""
        found = _HOST.fullmatch(host)
        if not found:
            return False
        name = found[1].strip("[]").lower()
        if is_local(name):
            return True
        bound = _parse_address(self.host)
        if is_local(self.host):
            return False
        if bound is not None and bound.is_unspecified:
            # After DNS rebinding the Host is still the attacker's name, never an IP address.
            machine = socket.gethostname().lower()
            return _parse_address(name) is not None or name in (machine, f"{machine}.local")
        return name == self.host.lower() or (bound is not None and _parse_address(name) == bound)

    def is_operator(self, headers: Headers) -> bool:
        """Return whether a request has the token's cookie."""
        lines = headers.getlist("Cookie")
        return any(self._is_token(cookie_parser(line).get(self.cookie, "")) for line in lines)

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self.token.encode())

    def answer(self, scope: Scope) -> Response | None:
        """Return the response to a refused request, or to one with the token; None if the application responds."""
        headers = Headers(scope=scope)
        if (why := self.refusal(headers)) is not None:
            return PlainTextResponse(f"{why}\n", http.HTTPStatus.FORBIDDEN)
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token")
        if given is None or scope["type"] != "http":
            return None
        if len(given) != 1 or not self._is_token(given[0]):
            why = "this token is not the page's: open the address that it printed"
            return PlainTextResponse(f"{why}\n", http.HTTPStatus.FORBIDDEN)
        # A path that begins with two slashes would redirect to another site.
        moved = RedirectResponse(f"/{scope['path'].lstrip('/')}", http.HTTPStatus.SEE_OTHER)
        moved.set_cookie(self.cookie, self.token, httponly=True, samesite="strict")
        return moved


class GuardedApp:
    """An ASGI application behind the access rules, with protective headers in all responses.

    ``laser_port`` is the port of the process that obeys Laser off, to which the page may send. At most `MOST_VIEWERS`
    connections for events are those of viewers.
    """

    def __init__(self, app: ASGIApp, access: PageAccess, *, laser_port: int | None = None):
        self._app, self._access, self._laser_port = app, access, laser_port
        self._viewers = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        answer, connects = self._access.answer(scope), scope["type"] == "websocket"
        views = connects and not self._access.is_operator(Headers(scope=scope))
        if connects and (answer is not None or (views and self._viewers >= MOST_VIEWERS)):
            # Closed before it is accepted: the browser sees status 403.
            await WebSocketClose()(scope, receive, send)
            return

        async def protected(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = [*message["headers"], *_PROTECTION]
                # A report has a stricter policy of its own.
                has_policy = any(name == b"content-security-policy" for name, _ in given)
                message["headers"] = given if has_policy else [*given, (b"content-security-policy", policy.encode())]
            await send(message)

        host = _HOST.fullmatch(Headers(scope=scope).get("Host", ""))
        policy = _POLICY
        if self._laser_port is not None and host is not None:
            policy += f" http://{host[1]}:{self._laser_port}"
        self._viewers += views
        try:
            await (answer or self._app)(scope, receive, protected)
        finally:
            self._viewers -= views
