"""Server of the page in its own thread, at the requested port or the next free one."""

import errno
import logging
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any, Self

import numpy as np
import uvicorn
from fastapi import FastAPI
from nicegui import Client, ui
from starlette.requests import Request
from starlette.responses import Response

from uwlts.desk.access import MOST_VIEWERS, GuardedApp, PageAccess, is_local
from uwlts.desk.board_page import build_board
from uwlts.desk.laser_listener import BACKLOG, HEAD_BYTES
from uwlts.desk.laser_switch import LaserSwitch
from uwlts.desk.shown_state import Board, pack
from uwlts.errors import Error, SetupError

_START_S, _END_S = 30.0, 5.0
_PORTS = 100
"""Number of ports that are tried."""
_MOST_CONNECTIONS = 300
"""Connections at once; further requests are refused. A window has up to seven; a process may open 1024 files."""
_NO_PAGES: Any = {"openapi_url": None, "docs_url": None, "redoc_url": None}
_LATEST = {"Cache-Control": "no-store"}
_ALONE = threading.Lock()
"""Held by the page that is served."""


@cache
def _start_nicegui() -> FastAPI:
    """Return the only NiceGUI application of the process; ``state.show`` builds its present page."""
    app = FastAPI(**_NO_PAGES)

    def root(request: Request) -> None:
        app.state.show(request)

    ui.run_with(app, root=root, show_welcome_message=False, reconnect_timeout=10.0, language="en-US")
    return app


class DeskServer:
    """Server of a page that shows a board, from construction until the ``with`` ends. Only one at a time.

    Everybody who opens the ``address`` may view the page. Only the ``operator_address``, which has a token, has
    controls. ``warning`` is a warning to report if other machines can reach the page, else None. ``app`` is the
    application, for further routes.

    ``build``, a function of the board and of whether the page is for the operator, builds the page at ``host`` and
    ``port``. ``switch`` is a switch with a button on the operator's page; its process listens at the next free port.

    SetupError if no port is free, the address is not one of this machine, or this process already serves a page.
    """

    def __init__(
        self,
        board: Board,
        *,
        build: Callable[[Board, bool], None] | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        switch: LaserSwitch | None = None,
    ):
        self._access, nicegui, self._switch = PageAccess(host), _start_nicegui(), switch
        self.app = FastAPI(**_NO_PAGES, lifespan=nicegui.router.lifespan_context)
        self._add_content(board)
        # Handles all requests that no other route matches.
        self.app.router.default = nicegui

        def show(request: Request) -> None:
            ui.page_title(board.title)
            operator = self.is_operator(request)
            if not operator and len(Client.instances) > 2 * MOST_VIEWERS:
                # A page that costs little: those whose browsers are gone are forgotten within seconds.
                ui.label("too many viewers: try again later")
                return
            (build or build_board)(board, operator)
            if operator and switch is not None:
                switch.show_button()

        if not _ALONE.acquire(blocking=False):
            raise SetupError("this program serves a page already: close that one first")
        try:
            self._socket = _bind(host, port)
            own_port = self._socket.getsockname()[1]
            if switch is not None:
                switch.serve(self._access, _bind(host, (own_port + 1) % 65536), page_port=own_port)
            named = f"[{host}]" if ":" in host else host
            self.address = f"http://{named}:{own_port}"
            self.operator_address = f"{self.address}/?token={self._access.token}"
            self.warning = None
            if not is_local(host):
                self.warning = (
                    f"everybody who reaches {host} in the network can see the page, and what is sent is not encrypted: "
                    "safer is the default host with `ssh -L`"
                )
            self._open = True
            nicegui.state.show = show
            errors: list[str] = []
            log = logging.getLogger("uvicorn.error")
            # Nothing is printed, and the first error is kept.
            log.handlers, log.propagate = [logging.NullHandler()], False
            log.filters = [lambda record: bool(errors or errors.append(record.getMessage()))]
            config = uvicorn.Config(
                GuardedApp(self.app, self._access, laser_port=None if switch is None else switch.port),
                http="h11",
                backlog=BACKLOG,
                limit_concurrency=_MOST_CONNECTIONS,
                h11_max_incomplete_event_size=HEAD_BYTES,
                # Nothing is printed: a browser that disconnects during a response is not an error.
                log_config=None,
                log_level=logging.ERROR,
                ws_max_size=2**20,
            )
            self._start(uvicorn.Server(config), errors)
        except BaseException:
            if switch is not None:
                switch.close()
            _ALONE.release()
            raise

    def _start(self, server: uvicorn.Server, errors: list[str]) -> None:
        """Run a server in a thread of its own, and wait until it answers; SetupError with the first of its errors."""
        self._server = server
        self._thread = threading.Thread(target=server.run, args=([self._socket],), name="page", daemon=True)
        self._thread.start()
        deadline = time.monotonic() + _START_S
        while not server.started:
            if time.monotonic() > deadline or not self._thread.is_alive():
                why = errors[0].strip().rpartition("\n")[2] if errors else "no reason is known"
                raise SetupError(f"the page's server did not start: {why}")
            time.sleep(0.02)

    def _add_content(self, board: Board) -> None:
        """Add the routes for picture, coverage and cloud."""

        @self.app.get("/picture.jpg")
        def picture() -> Response:
            shown = board.picture
            return Response(shown.jpeg if shown else b"", 200 if shown else 204, _LATEST, "image/jpeg")

        @self.app.get("/coverage.png")
        def coverage() -> Response:
            shown = board.coverage
            return Response(shown or b"", 200 if shown else 204, _LATEST, "image/png")

        @self.app.get("/cloud")
        def cloud() -> Response:
            return _answer_with_cloud(board.cloud.points())

        @self.app.get("/cloud/detail")
        def detail(box: str) -> Response:
            look, table = board.detail, None
            with suppress(ValueError, Error):
                low, high = np.array(box.split(","), dtype=float).reshape(2, 3)
                if look is not None and np.isfinite([low, high]).all() and (low < high).all():
                    table = look(low, high)
            return Response(b"", 204, _LATEST) if table is None else _answer_with_cloud(table)

    def is_operator(self, request: Request) -> bool:
        """Return whether a request is the operator's."""
        return self._access.is_operator(request.headers)

    def close(self) -> None:
        """End the page."""
        if not self._open:
            return
        self._open = False
        self._server.should_exit = self._server.force_exit = True
        self._thread.join(_END_S)
        self._socket.close()
        if self._switch is not None:
            self._switch.close()
        # A browser that still shows this page must not reach it through the next one.
        for client in list(Client.instances.values()):
            client.delete()
        _ALONE.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _answer_with_cloud(table: np.ndarray) -> Response:
    """Return points (N, 7) as a response to the browser."""
    origin, data = pack(table)
    headers = _LATEST | {"X-Origin": ",".join(map(str, origin.tolist()))}
    return Response(data, 200, headers, "application/octet-stream")


def _bind(host: str, port: int) -> socket.socket:
    """Return a socket at the port, or at the next free one."""
    try:
        family, *_, place = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise SetupError(f"'{host}' is no address to serve a page at: {error.strerror}") from error
    for wanted in range(port, min(port + _PORTS, 65536)) if port else (0,):
        found = socket.socket(family, socket.SOCK_STREAM)
        # Allows reuse of a port that was just closed.
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            found.bind((place[0], wanted, *place[2:]))
            found.listen()
        except OSError as error:
            found.close()
            if error.errno != errno.EADDRINUSE:
                raise SetupError(f"cannot serve a page at {host}, port {wanted}: {error.strerror}") from error
            continue
        return found
    raise SetupError(f"no free port from {port} on at {host}")
