"""Laser off while strangers on the same machine keep the page's server busy, judged by the controller's light.

The page runs in a process of its own, with as many open files as systems usually allow. Its stage is the twin's
controller, whose laser another one has lit: nothing but Laser off makes it dark. Only the loopback address is attacked.
"""

import http.client
import json
import os
import re
import resource
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from urllib.parse import urlsplit

import pytest

from tests.preloaded import Preloaded
from tests.system.attacked_page import serve_page
from tests.system.test_page_access import Browser, Place, asked, cookie
from tests.waiting import suspend, within
from twin.devices.grbl_controller import GrblController
from uwlts.desk.laser_listener import HEAD_BYTES, HEAD_S
from uwlts.hardware.grbl import GrblStage

OFF_S = 2.0
"""Time limit of a press on a busy machine; on an idle one it takes some ms. Without limits it took 7 s or more."""
HALF = 1300
LONG_LINE_BYTES = 120 * 2**20


def light(controller: GrblController, *, steady_s: float = 0.5) -> None:
    """Switch the laser on as another program at the controller would: only a reset ends the light.

    Both processes send one for each press; on a busy machine the second is late. Therefore the light must be steady.
    """

    def lit() -> bool:
        with controller._lock:
            controller._firmware.hear(b"G1F100M3S1000\n")
        return within(0.5, lambda: controller.state().laser_on) and not within(
            steady_s, lambda: not controller.state().laser_on
        )

    assert within(20.0, lit)


@dataclass(frozen=True)
class Operated(Place):
    """A page whose stage's laser is lit, its operator's cookie, and the port and process that obey Laser off."""

    cookie: str
    port: int
    process: int
    program: Preloaded
    controller: GrblController

    @property
    def page_port(self) -> int:
        return urlsplit(self.address).port

    def press(self, name: str = "off-1", **headers: str) -> int:
        """Press as the page does; the status of the answer."""
        own = {"Cookie": self.cookie, "Origin": self.address}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        connection.request("POST", f"/{name}", headers=own | {k.replace("_", "-"): v for k, v in headers.items()})
        status = connection.getresponse().status
        connection.close()
        return status

    def dark_after_s(self, at_most_s: float = OFF_S) -> float | None:
        """Return the time in s until the light is off; None if it stays on for longer than ``at_most_s``."""
        began = time.monotonic()
        return time.monotonic() - began if within(at_most_s, lambda: not self.controller.state().laser_on) else None

    def go_on(self) -> str:
        """Let the program continue to its next output."""
        self.program.stdin.write("\n")
        self.program.stdin.flush()
        return self.program.stdout.readline()

    def said(self) -> str:
        """End the program; the lines of its board."""
        self.go_on()
        return self.go_on() + self.program.stdout.read()


@pytest.fixture
def operated() -> Iterator[Operated]:
    with GrblController(settings={22: 0}, resets_when_opened=False) as controller:
        program = Preloaded(serve_page, controller.port)
        try:
            address, operator_address, process = program.stdout.readline().split()
            kept = cookie(Place(address, operator_address))
            text = asked(Place(address, operator_address), Cookie=kept).body
            port = int(re.search(rb"hostname}:(\d+)", text)[1])
            page = Operated(address, operator_address, kept, port, int(process), program, controller)
            light(controller)
            yield page
        finally:
            program.kill()
            program.communicate()


def closed(line: socket.socket) -> bool:
    """Return whether the other side has closed a connection that it sends nothing on."""
    try:
        return line.recv(1, socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


@pytest.fixture
def half_requests() -> Iterator[Callable[[int], list[socket.socket]]]:
    """Open many connections to a port, each with an incomplete request."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (limits[1], limits[1]))
    with ExitStack() as lines:

        def opened(port: int) -> list[socket.socket]:
            found = []
            for _ in range(HALF):
                found.append(lines.enter_context(socket.create_connection(("127.0.0.1", port), timeout=20)))
                with suppress(OSError):
                    found[-1].sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
            return found

        yield opened
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


class LongLine:
    """Sends a header line of 120 MB within a ``with``, until it is refused."""

    def __init__(self, port: int):
        self.sent, self.answer, self._ended = 0, b"", threading.Event()
        self._thread = threading.Thread(target=self._send, args=(port,), daemon=True)

    def _send(self, port: int) -> None:
        with socket.create_connection(("127.0.0.1", port), timeout=20) as line, suppress(OSError):
            line.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Long: ")
            while self.sent < LONG_LINE_BYTES and not self._ended.is_set():
                self.sent += line.send(b"x" * 2**20)

    def __enter__(self) -> "LongLine":
        self._thread.start()
        time.sleep(0.5)
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(20)


def test_laser_off_does_not_need_the_program(operated):
    controller = operated.controller
    suspend(operated.program.pid)
    try:
        assert operated.press() == 204
        assert operated.dark_after_s() is not None
        # Earlier commands of the program may switch it on again; resets are repeated.
        # Without resets the light would stay. On an overloaded machine one may be late.
        light(controller, steady_s=0.0)
        assert operated.dark_after_s(5.0) is not None
    finally:
        os.kill(operated.program.pid, signal.SIGCONT)
    # After the program's answer nothing more is sent.
    light(controller, steady_s=2.0)


def test_escape_switches_off_what_is_in_use(operated):
    assert operated.press("escape-1") == 204
    assert operated.dark_after_s() is not None


def test_only_the_operators_own_page_is_obeyed(operated):
    other_ports = [f"http://127.0.0.1:{operated.page_port + 1000}", f"http://127.0.0.1:{operated.port}"]
    for origin in ("http://evil.example", "null", f"http://localhost:{operated.page_port}", *other_ports):
        assert operated.press(Origin=origin) == 403
    for host in ("evil.example", f"192.168.1.7:{operated.port}"):
        assert operated.press(Host=host) == 403
    for kept in ("", "uwlts-operator=x", operated.cookie[:-1], f"{operated.cookie}x"):
        assert operated.press(Cookie=kept) == 403
    assert operated.press(Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="cors") == 403
    for name in ("", "on-1", "off-", "off-x", f"off-{'1' * 41}"):
        assert operated.press(name) == 404
    for first in ("POST /off-1 HTTP/1.1", "GET /off-1 HTTP/1.1", "", "\xff"):
        with socket.create_connection(("127.0.0.1", operated.port), timeout=20) as line:
            line.sendall(f"{first}\r\nHost: 127.0.0.1:{operated.port}\r\n\r\n".encode())
            assert line.recv(100).split()[1] == b"403"
    assert operated.dark_after_s() is None
    # As the page's requests are, to another port of its machine.
    assert operated.press(Sec_Fetch_Site="same-site", Sec_Fetch_Mode="cors") == 204
    assert operated.dark_after_s() is not None


def test_a_press_by_both_ways_is_obeyed_once(operated):
    assert operated.press("off-7") == 204
    assert operated.dark_after_s() is not None
    light(operated.controller)
    with Browser(operated, Cookie=operated.cookie) as browser:
        number, listener = browser.buttons()["Laser off"]
        for name, dark in (("off-7", False), ("off-8", True)):
            event = {"id": number, "client_id": browser.client, "listener_id": listener, "args": [json.dumps(name)]}
            browser.connection.send(f"42{json.dumps(['event', event])}")
            assert (operated.dark_after_s() is not None) == dark
    assert operated.said().count("by hand") == 2


def test_without_its_process_the_page_says_so_and_laser_off_works(operated):
    os.kill(operated.process, signal.SIGKILL)
    with Browser(operated, Cookie=operated.cookie) as browser:
        browser.click(browser.buttons()["Laser off"])
        assert operated.dark_after_s() is not None
    assert "listens for Laser off has ended" in operated.said()


@pytest.mark.parametrize("stopped", [False, True])
def test_the_port_is_given_back(operated, stopped):
    """A port that a process keeps open cannot be opened again."""
    if stopped:
        suspend(operated.process)
    assert operated.go_on() == "closed\n"
    with GrblStage(operated.controller.port) as again:
        assert again.position_mm() == again.position_mm()


def test_a_long_header_line_is_refused_and_holds_up_no_press(operated):
    with Browser(operated, Cookie=operated.cookie) as browser:
        for port in (operated.page_port, operated.port):
            with LongLine(port) as line:
                assert operated.press(f"off-{port}") == 204
                directly_s = operated.dark_after_s()
                light(operated.controller)
                browser.click(browser.buttons()["Laser off"])
                by_the_server_s = operated.dark_after_s()
                light(operated.controller)
            print(f"dark after {directly_s} s, by the page's server {by_the_server_s} s")
            assert directly_s is not None and by_the_server_s is not None
            # The contents of the line's buffers are sent before the end of the connection arrives.
            assert line.sent < LONG_LINE_BYTES / 4
    for port, status in ((operated.page_port, b"400"), (operated.port, b"431")):
        with socket.create_connection(("127.0.0.1", port), timeout=20) as long:
            long.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Long: " + b"x" * HEAD_BYTES)
            assert long.recv(100).split()[1] == status


def test_half_requests_end_and_lock_nobody_out(operated, half_requests):
    held = half_requests(operated.port)
    assert operated.press() == 204
    assert operated.dark_after_s() is not None
    light(operated.controller)
    opened_s = time.monotonic()
    with Browser(operated, Cookie=operated.cookie) as browser:
        print(f"page opened in {time.monotonic() - opened_s:.2f} s beside {len(held)} half requests")
        browser.click(browser.buttons()["Laser off"])
        assert operated.dark_after_s() is not None
        assert sum(map(closed, held)) >= HALF - 256
    # A request that is sent slowly has the same time limit as one that stops.
    for _ in range(50):
        with suppress(OSError):
            held[-1].sendall(b"X: y\r\n")
        time.sleep((HEAD_S + 1.0) / 50)
    assert within(20.0, lambda: all(map(closed, held)))
    assert asked(operated).status == 200
