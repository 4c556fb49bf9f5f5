"""Limits of size, time and number of connections in front of the parser of requests.

Other clients cannot block the operator: if too many connections wait, the oldest is closed, never the newest.
"""

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_BYTES = 64 * 1024
"""Longest head of a request. Browsers send some KB, including cookies of other programs on the machine."""
HEAD_S = 5.0
"""Longest time from the first byte, or the connection, to the end of a request's head, even in a slow network."""
BACKLOG = 64
"""Connections accepted at once. Below the limits, so that the newest request is read before one is closed."""
_OF_ONE_PEER, _IN_ALL = 128, 256
"""Connections that wait for a head, of one peer and in total. A browser has 6; a process may open 1024 files."""
TOO_LONG = "431 Request Header Fields Too Large"


class PendingHeads:
    """Connections that have not yet sent the head of a request. Used in the thread of one event loop."""

    def __init__(self) -> None:
        self._peers: dict[asyncio.Transport, str] = {}
        self._ends: dict[asyncio.Transport, asyncio.TimerHandle] = {}

    def add(self, transport: asyncio.Transport) -> None:
        """Add a waiting connection; if there are too many, close the oldest of its peer, or of all."""
        self.remove(transport)
        peer = self._peers[transport] = (transport.get_extra_info("peername") or [""])[0]
        of_peer = [each for each, its in self._peers.items() if its == peer]
        for waiting, most in ((of_peer, _OF_ONE_PEER), (list(self._peers), _IN_ALL)):
            if len(waiting) > most:
                self.remove(waiting[0])
                waiting[0].abort()

    def limit_time(self, transport: asyncio.Transport) -> None:
        """Close a connection whose head is not complete in time, counted from the first call."""
        if transport not in self._ends:
            self._ends[transport] = asyncio.get_running_loop().call_later(HEAD_S, transport.abort)

    def remove(self, transport: asyncio.Transport) -> None:
        """Remove a connection that no longer waits."""
        self._peers.pop(transport, None)
        if (end := self._ends.pop(transport, None)) is not None:
            end.cancel()


class LimitedHttp(H11Protocol):
    """HTTP with limited heads: uvicorn's parser limits their length; this class adds status, time and number."""

    def __init__(self, heads: PendingHeads, **settings: Any):
        super().__init__(**settings)
        self._heads = heads

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first head."""
        super().connection_made(transport)
        self._heads.add(transport)
        self._heads.limit_time(transport)

    def data_received(self, data: bytes) -> None:
        """Receive a part of a request."""
        super().data_received(data)
        if self.conn.their_state is h11.IDLE:
            self._heads.limit_time(self.transport)
        elif self.cycle is not None and not self.cycle.response_complete:
            self._heads.remove(self.transport)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand the connection over to the websocket."""
        self._heads.remove(self.transport)
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        """Wait for the next head; the response may still be in transmission, without a limit."""
        self._heads.add(self.transport)
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection."""
        self._heads.remove(self.transport)
        super().connection_lost(exc)

    def send_400_response(self, msg: str) -> None:
        """Refuse an invalid or too long request."""
        if len(self.conn.trailing_data[0]) <= HEAD_BYTES:
            super().send_400_response(msg)
            return
        self.transport.write(f"HTTP/1.1 {TOO_LONG}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode())
        self.transport.close()
