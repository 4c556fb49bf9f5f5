"""Process that listens for the operator's Laser off and sends it to the controller, even if the page's server hangs.

`uwlts.desk.laser_switch` starts it with a listening socket and two sockets to the program. The first one brings the
access rules, and lends the open serial port of a stage. The second one passes the name of each press to the program,
which returns the name when the laser is off and cannot be switched on any more. Until then Ctrl-X is repeated.
"""

import asyncio
import json
import os
import re
import socket
import sys
import time
from contextlib import suppress
from http import HTTPStatus

from starlette.datastructures import Headers

from uwlts.desk.access import PageAccess

HEAD_BYTES = 64 * 1024
"""Longest head of a request. Browsers send some KB, including cookies of other programs on the machine."""
HEAD_S = 5.0  # longest duration of a request, even in a slow network
BACKLOG = 64  # Connections accepted at once. Below the limit, so that the newest request is read before one is closed.
_MOST_REQUESTS = 256
"""Requests at once; the oldest is closed, so that others cannot block the operator. A process may open 1024 files."""
PRESS = re.compile(r"(off|escape)-\d{1,40}")
"""Name of a press, made by the page. It reaches the program on two paths, and is obeyed once."""
MESSAGE_BYTES = 4096  # longer than every message between the two processes
_SOFT_RESET = b"\x18"
_ESCAPE_S = 0.2
"""Escape also closes menus. Within this time the program may answer; otherwise the laser is switched off."""
_AGAIN_S = 0.2  # interval between repetitions of Ctrl-X: a command in progress may have switched the laser on again
_GIVE_UP_S = 2.0  # a press has failed if no port has accepted Ctrl-X and the program has not answered for this time
_WATCH_S = 0.2  # period in which its state is looked at


class LaserListener:
    """Obeys presses with the lent port, and passes their names to the program."""

    def __init__(self, lending: socket.socket, presses: socket.socket):
        self._lending, self._presses = lending, presses
        self._port: int | None = None
        self._answers: dict[str, asyncio.Event] = {}
        self._ended = False
        rules = json.loads(lending.recv(MESSAGE_BYTES))
        self.access, self.page_port = PageAccess(**rules["access"]), int(rules["page_port"])
        self.requests: dict[asyncio.Transport, asyncio.TimerHandle] = {}

    async def serve(self, listening: socket.socket) -> None:
        """Listen until the program ends; sockets alone do not show that, because a forked child may keep them open."""
        loop, parent = asyncio.get_running_loop(), os.getppid()
        for each, read in ((self._lending, self._lend), (self._presses, self._wait_for_answer)):
            each.setblocking(False)
            loop.add_reader(each, read)
        await loop.create_server(lambda: _Request(self), sock=listening, backlog=BACKLOG)
        self._lending.send(b"listening")
        while os.getppid() == parent and not self._ended:
            await asyncio.sleep(_WATCH_S)

    def _lend(self) -> None:
        message, descriptors, *_ = socket.recv_fds(self._lending, MESSAGE_BYTES, 1)
        if self._port is not None:
            os.close(self._port)
        self._port = descriptors[0] if descriptors else None
        if message:
            self._lending.send(message)
        else:
            self._ended = True
            asyncio.get_running_loop().remove_reader(self._lending)

    def _wait_for_answer(self) -> None:
        name = self._presses.recv(MESSAGE_BYTES).decode()
        if not name:
            asyncio.get_running_loop().remove_reader(self._presses)
        elif (answered := self._answers.get(name)) is not None:
            answered.set()

    async def obey(self, name: str, request: "_Request") -> None:
        """Obey a press, and answer its request when Ctrl-X is sent or the program has switched the laser off."""
        answered = self._answers.setdefault(name, asyncio.Event())
        deadline, wait_s = time.monotonic() + _GIVE_UP_S, 0.0
        # A program that hangs accepts no more names; it is not needed.
        with suppress(OSError):
            self._presses.send(name.encode())
        if name.startswith("escape"):
            wait_s = _ESCAPE_S
        while not await _wait_within(wait_s, answered):
            if self._reset():
                request.answer(HTTPStatus.NO_CONTENT)
                deadline = time.monotonic() + _GIVE_UP_S
            elif time.monotonic() > deadline:
                break
            wait_s = _AGAIN_S
        self._answers.pop(name, None)
        request.answer(HTTPStatus.NO_CONTENT if answered.is_set() else HTTPStatus.SERVICE_UNAVAILABLE)

    def _reset(self) -> bool:
        """Send Ctrl-X, and return whether a port is lent and accepted it."""
        with suppress(OSError):
            return self._port is not None and os.write(self._port, _SOFT_RESET) > 0
        return False


async def _wait_within(wait_s: float, event: asyncio.Event) -> bool:
    with suppress(TimeoutError):
        await asyncio.wait_for(event.wait(), wait_s)
    return event.is_set()


class _Request(asyncio.Protocol):
    """One request without a body; the connection ends with the answer."""

    def __init__(self, listener: LaserListener):
        self._listener, self._head, self._headers = listener, b"", Headers()
        self._task: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self._transport = transport
        requests = self._listener.requests
        requests[transport] = asyncio.get_running_loop().call_later(HEAD_S, transport.abort)
        if len(requests) > _MOST_REQUESTS:
            oldest = next(iter(requests))
            requests.pop(oldest).cancel()
            oldest.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        if (end := self._listener.requests.pop(self._transport, None)) is not None:
            end.cancel()

    def data_received(self, data: bytes) -> None:
        if self._task is not None:
            return
        self._head += data
        head, end, _ = self._head.partition(b"\r\n\r\n")
        if len(head) > HEAD_BYTES:
            self.answer(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE)
        elif end:
            self._parse(head)

    def _parse(self, head: bytes) -> None:
        first, *lines = head.split(b"\r\n")
        fields = [line.partition(b":") for line in lines]
        self._headers = Headers(raw=[(name.lower(), value.strip()) for name, _, value in fields])
        access, headers = self._listener.access, self._headers
        why = access.refusal(headers, page_port=self._listener.page_port)
        if why is not None or "Origin" not in headers or not access.is_operator(headers):
            self.answer(HTTPStatus.FORBIDDEN)
        elif not (found := re.fullmatch(rf"POST /({PRESS.pattern}) HTTP/1\.[01]", first.decode("latin-1"))):
            self.answer(HTTPStatus.NOT_FOUND)
        else:
            self._task = asyncio.create_task(self._listener.obey(found[1], self))

    def answer(self, status: HTTPStatus) -> None:
        """Answer once, and end the connection."""
        if self._transport.is_closing():
            return
        lines = [f"HTTP/1.1 {status.value} {status.phrase}", "Connection: close"]
        if status == HTTPStatus.NO_CONTENT:
            # Allow the page to read the answer.
            origin = self._headers["Origin"]
            lines += [f"Access-Control-Allow-Origin: {origin}", "Access-Control-Allow-Credentials: true"]
        else:
            lines.append("Content-Length: 0")
        self._transport.write("\r\n".join([*lines, "", ""]).encode("latin-1"))
        self._transport.close()


if __name__ == "__main__":
    _listening, _lending, _presses = (socket.socket(fileno=int(each)) for each in sys.argv[1:])
    asyncio.run(LaserListener(_lending, _presses).serve(_listening))
