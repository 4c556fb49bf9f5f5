"""Requests to a page from browsers, other sites and bystanders: refusals, and whose clicks count."""

import html
import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from itertools import product
from urllib.parse import parse_qs, urlencode, urlsplit

import numpy as np
import pytest
from nicegui import ui
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from tests import preloaded
from tests.waiting import within
from uwlts.desk.access import MOST_VIEWERS, PageAccess
from uwlts.desk.board_page import BoardView, update_regularly
from uwlts.desk.guided import answer_buttons
from uwlts.desk.guided_screen import BoardScreen
from uwlts.desk.laser_switch import LaserSwitch
from uwlts.desk.server import DeskServer
from uwlts.desk.shown_state import Board, Picture
from uwlts.errors import SetupError

SOCKET = "/_nicegui_ws/socket.io/"
PROTECTION = {"X-Frame-Options": "DENY", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}


@dataclass(frozen=True)
class Place:
    """Addresses of a page for viewers and for its operator."""

    address: str
    operator_address: str


@dataclass(frozen=True)
class Page(Place):
    """A page with the controls of a guided calibration, and what was pressed on it."""

    board: Board
    screen: BoardScreen
    server: DeskServer


def guarded(title: str, **options: object) -> Page:
    """Serve such a page."""
    board = Board(title)
    screen = BoardScreen(board, LaserSwitch(board, lambda: screen.laser_off()))

    def build(shown: Board, operator: bool) -> None:
        view = BoardView(shown)
        view.header()
        with ui.element("main"):
            view.image()
            view.cloud()
            view.log()
            if operator:
                answer_buttons(shown, screen.press)
        update_regularly(view.refresh)

    server = DeskServer(board, build=build, switch=screen.switch, **({"port": 0} | options))
    return Page(server.address, server.operator_address, board, screen, server)


@pytest.fixture
def page() -> Iterator[Page]:
    opened = guarded("guarded")
    yield opened
    opened.server.close()


@dataclass(frozen=True)
class Answer:
    status: int
    headers: http.client.HTTPMessage
    body: bytes


def asked(page: Place, path: str = "/", *, method: str = "GET", **headers: str) -> Answer:
    """Answer to a raw request; ``Host`` replaces the page's own."""
    place = urlsplit(page.address)
    connection = http.client.HTTPConnection(place.hostname, place.port, timeout=20)
    connection.putrequest(method, path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return Answer(answer.status, answer.headers, body)


def opened(page: Place, *, client: str = "", **headers: str) -> AbstractContextManager[ClientConnection]:
    """Open the connection of a browser's page for its clicks, or that of a ``client``, as a context."""
    place, origin = urlsplit(page.address), headers.pop("Origin", None)
    query = {"EIO": 4, "transport": "websocket"}
    if client:
        query |= {"client_id": client, "next_message_id": 0, "implicit_handshake": "true"}
        # One tab, which may come back.
        query |= {"tab_id": client, "document_id": str(uuid.uuid4())}
    return connect(
        f"ws://{headers.pop('Host', place.netloc)}{SOCKET}?{urlencode(query)}",
        sock=socket.create_connection((place.hostname, place.port), timeout=20),
        origin=origin,
        additional_headers=headers,
    )


def cookie(page: Place) -> str:
    answer = asked(page, page.operator_address.removeprefix(page.address))
    assert answer.status == 303 and answer.headers["Location"] == "/"
    assert "HttpOnly" in answer.headers["Set-Cookie"] and "SameSite=strict" in answer.headers["Set-Cookie"]
    return answer.headers["Set-Cookie"].split(";")[0]


def port(page: Place) -> int:
    return urlsplit(page.address).port


class Browser:
    """The page as a browser has it: its elements, and a connection that sends clicks."""

    def __init__(self, page: Place, **headers: str):
        text = asked(page, **headers).body.decode()
        self.client = re.search(r"'client_id': '([0-9a-f-]{36})'", text)[1]
        elements = re.search(r"parseElements\(String\.raw`(.*?)`\)", text, re.DOTALL)[1]
        self.elements: dict[str, dict] = json.loads(html.unescape(elements))
        self.place, self._headers, self._closing = page, headers, ExitStack()

    def buttons(self) -> dict[str, tuple[int, str]]:
        """Buttons by their labels: number and listener."""
        found = {
            element["props"]["label"]: (int(number), element["events"][0]["listener_id"])
            for number, element in self.elements.items()
            if element["tag"] == "q-btn"
        }
        # It is not a NiceGUI element; its event comes from the whole page.
        for event in self.elements["0"]["events"]:
            if event["type"] == "laser_off":
                found["Laser off"] = (0, event["listener_id"])
        return found

    def open(self) -> str:
        """Connect; return the server's answer, which begins with 40 if it knows the page."""
        place = self.place
        self._closing.close()
        connecting = opened(place, client=self.client, Origin=place.address, **self._headers)
        self.connection = self._closing.enter_context(connecting)
        assert self.connection.recv(timeout=20).startswith("0{")
        self.connection.send("40")
        return self.connection.recv(timeout=20)

    def __enter__(self) -> "Browser":
        assert self.open().startswith("40{")
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    def click(self, button: tuple[int, str], *, client: str = "") -> None:
        """Send a click on a button, of this browser's page or, forged, of another client's."""
        number, listener = button
        event = {"id": number, "client_id": client or self.client, "listener_id": listener}
        event["args"] = [] if number else [json.dumps(f"off-{time.monotonic_ns()}")]
        self.connection.send(f"42{json.dumps(['event', event])}")


def pressed(page: Page) -> bool:
    """Return whether a button was pressed, even on a busy machine."""
    return within(20.0, lambda: page.screen.answer() == "take")


def ever_pressed(page: Page) -> bool:
    """Return whether a button was pressed that must not be: presses are obeyed within some ms."""
    return within(1.0, lambda: page.screen.answer() is not None)


# Who may reach it


def test_the_page_itself_is_shown_to_this_machine(page):
    for host in ("127.0.0.1", "localhost", "[::1]"):
        assert asked(page, Host=f"{host}:{port(page)}").status == 200
    # The page's own address, another one by port forwarding.
    assert asked(page, Origin=page.address).status == 200
    assert asked(page, Host="localhost:9000", Origin="http://localhost:9000").status == 200
    with opened(page, Host="localhost:9000", Origin="http://localhost:9000") as connection:
        assert connection.recv(timeout=20).startswith("0{")


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "192.168.1.7", "", "localhost@evil.example"]
)
def test_another_host_is_refused(page, host):
    for path in ("/", "/picture.jpg", "/cloud", f"{SOCKET}?EIO=4&transport=polling"):
        assert asked(page, path, Host=f"{host}:{port(page)}").status == 403
    elsewhere = f"{host or 'x'}:{port(page)}".replace("@", ".")
    with pytest.raises(InvalidStatus, match="403"), opened(page, Host=elsewhere):
        pass


def test_a_request_with_no_host_or_two_is_refused(page):
    for hosts in ([], [f"127.0.0.1:{port(page)}", "evil.example"]):
        with socket.create_connection(("127.0.0.1", port(page)), timeout=20) as line:
            line.sendall("".join(["GET / HTTP/1.0\r\n", *(f"Host: {host}\r\n" for host in hosts), "\r\n"]).encode())
            assert line.recv(100).split()[1] in (b"403", b"400")


@pytest.mark.parametrize("origin", ["http://evil.example", "http://localhost:3000", "null", "file://"])
def test_another_origin_is_refused(page, origin):
    # With the operator's cookie too: that is what a forged request would have.
    for headers in ({}, {"Cookie": cookie(page)}):
        assert asked(page, Origin=origin, **headers).status == 403
        for method in ("GET", "POST"):
            polling = f"{SOCKET}?EIO=4&transport=polling"
            assert asked(page, polling, method=method, Origin=origin, **headers).status == 403
        with pytest.raises(InvalidStatus, match="403"), opened(page, Origin=origin, **headers):
            pass


def test_another_site_can_link_to_the_page_but_not_load_it(page):
    assert asked(page, Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate").status == 200
    for path in ("/", "/picture.jpg", "/cloud"):
        assert asked(page, path, Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="no-cors").status == 403


def test_no_answer_can_be_framed_or_tells_the_address(page):
    static = re.search(r'src="(/_nicegui/[^"]+)"', asked(page).body.decode())[1]
    answers = [asked(page, path) for path in ("/", "/picture.jpg", "/coverage.png", "/cloud", "/elsewhere", static)]
    answers += [asked(page, "/?token=wrong"), asked(page, Origin="http://evil.example")]
    answers += [asked(page, page.operator_address.removeprefix(page.address))]
    assert [answer.status for answer in answers] == [200, 204, 204, 200, 200, 200, 403, 403, 303]
    for answer in answers:
        assert {name: answer.headers[name] for name in PROTECTION} == PROTECTION
        assert "default-src 'self'" in answer.headers["Content-Security-Policy"]


def test_a_wrong_token_is_refused_and_the_right_one_does_not_lead_elsewhere(page):
    token = parse_qs(urlsplit(page.operator_address).query)["token"][0]
    assert len(token) >= 20
    for wrong in ("wrong", token[:-1], f"{token}x", "", f"{token}&token={token}", "%ff"):
        answer = asked(page, f"/?token={wrong}&shown=1")
        assert answer.status in (200, 403) and "Set-Cookie" not in answer.headers
        assert b"Laser off" not in answer.body
    assert asked(page, "/?token=wrong").status == 403
    answer = asked(page, f"//evil.example?token={token}")
    assert answer.status == 303 and answer.headers["Location"] == "/evil.example"


# Who may press


def test_only_the_operator_has_controls(page):
    bystander, operator = Browser(page), Browser(page, Cookie=cookie(page))
    assert set(bystander.buttons()) == {"fit"}
    assert set(operator.buttons()) == {"fit", "Laser off", "take", "skip", "done"}
    # No key either.
    texts = [asked(page, **headers).body for headers in ({}, {"Cookie": cookie(page)})]
    assert ["Escape" in text.decode() for text in texts] == [False, True]


def test_the_operators_clicks_are_obeyed_and_no_bystanders_are(page):
    operator = Browser(page, Cookie=cookie(page))
    take, off = (operator.buttons()[label] for label in ("take", "Laser off"))
    with Browser(page) as bystander:
        # With known buttons: in the viewer's own page, and in a made-up one.
        for button in (take, off):
            bystander.click(button)
            bystander.click(button, client=str(uuid.uuid4()))
        assert not ever_pressed(page)
        with operator:
            assert not ever_pressed(page)
            operator.click(take)
            assert pressed(page)
            assert page.board.lines() == []
            operator.click(off)
            assert within(20.0, lambda: "no laser is connected" in "".join(line.text for line in page.board.lines()))


def test_viewers_are_limited_and_keep_no_operator_out(page):
    with ExitStack() as viewers:
        for _ in range(MOST_VIEWERS):
            viewers.enter_context(opened(page, Origin=page.address))
        with pytest.raises(InvalidStatus, match="403"), opened(page, Origin=page.address):
            pass
        with opened(page, Origin=page.address, Cookie=cookie(page)) as connection:
            assert connection.recv(timeout=20).startswith("0{")

    def free() -> bool:
        with suppress(InvalidStatus), opened(page, Origin=page.address):
            return True
        return False

    assert within(20.0, free)


def test_what_is_said_reaches_everybody(page):
    bystander = Browser(page)
    with bystander:
        page.board.say("as loud as <b>this</b>", "warning")
        assert within(20.0, lambda: "as loud as" in bystander.connection.recv(timeout=20))


@pytest.mark.parametrize("value", ["wrong", "", '""', "é"])
def test_a_cookie_with_another_token_is_no_operators(page, value):
    name = cookie(page).split("=")[0]
    assert set(Browser(page, Cookie=f"{name}={value}").buttons()) == {"fit"}


def test_another_pages_cookie_is_no_operators(page):
    kept = cookie(page)
    page.server.close()
    later = guarded("later")
    try:
        assert set(Browser(later, Cookie=kept).buttons()) == {"fit"}
        token = kept.partition("=")[2]
        assert asked(later, f"/?token={token}").status == 403
    finally:
        later.server.close()


def test_everything_comes_from_this_machine(page):
    text = asked(page, Cookie=cookie(page)).body.decode()
    named = re.findall(r'(?:src|href)="([^"]*)"', text) + re.findall(r'from "([^"]+)"', text)
    named += [
        *json.loads(re.search(r'<script type="importmap">(.*?)</script>', text, re.DOTALL)[1])["imports"].values()
    ]
    assert len(named) > 10
    assert [name for name in named if "//" in name] == []


# What it gives


def test_the_latest_image_and_the_cloud_are_fetched_anew(page):
    empty = asked(page, "/picture.jpg")
    assert (empty.status, empty.body) == (204, b"")
    image = np.full((64, 80), 100, np.uint8)
    page.board.show(Picture(image, full_dn=255, caption="grey"))
    shown = asked(page, "/picture.jpg?1")
    assert shown.status == 200 and shown.body == page.board.picture.jpeg
    assert shown.headers["content-type"] == "image/jpeg" and shown.headers["cache-control"] == "no-store"
    page.board.cloud.add(np.array([[1.0, 2.0, 3.0], [1001.0, 2.0, 3.5]]), intensity=np.array([7.0, 8.0]))
    cloud = asked(page, "/cloud")
    origin = np.array([float(x) for x in cloud.headers["x-origin"].split(",")])
    table = np.frombuffer(cloud.body, "<f4").reshape(-1, 7)
    np.testing.assert_allclose(table[:, :3] + origin, [[1, 2, 3], [1001, 2, 3.5]], atol=1e-4)
    assert table[:, 3].tolist() == [7, 8] and np.isnan(table[:, 4:]).all()
    assert cloud.headers["cache-control"] == "no-store"


@pytest.mark.parametrize("path", ["/picture.jpg", "/coverage.png", "/cloud"])
def test_nothing_can_be_sent_to_what_is_only_fetched(page, path):
    for method in ("POST", "PUT", "DELETE", "HEAD"):
        assert asked(page, path, method=method).status == 405


def test_what_is_added_later_is_served_too(page):
    @page.server.app.get("/later/{name}")
    def later(name: str) -> str:
        return f"later: {name}"

    assert json.loads(asked(page, "/later/x").body) == "later: x"
    assert asked(page, "/later/x", Host="evil.example").status == 403


# Where it is served


def test_a_page_for_the_network_takes_its_own_names_and_warns():
    shown = guarded("network", host="0.0.0.0")
    try:
        assert "everybody" in shown.server.warning and "ssh -L" in shown.server.warning
        own = [f"{name}:{port(shown)}" for name in ("192.168.1.7", "localhost", "127.0.0.1")]
        here = Place(f"http://127.0.0.1:{port(shown)}", shown.operator_address)
        assert [asked(here, Host=host).status for host in own] == [200] * 3
        assert asked(here, Host="evil.example").status == 403
    finally:
        shown.server.close()


def test_a_page_for_this_machine_does_not_warn(page):
    assert page.server.warning is None


def test_a_port_in_use_is_passed_over_and_a_foreign_address_refused():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        wanted = taken.getsockname()[1]
        with DeskServer(Board("beside"), port=wanted) as server:
            assert wanted < int(server.address.rpartition(":")[2]) <= wanted + 99
    for host in ("192.0.2.1", "no such host"):
        with pytest.raises(SetupError, match="page at"):
            DeskServer(Board("nowhere"), host=host)


def test_a_server_that_cannot_start_says_why():
    """Here semaphores are forbidden, as in a container whose /dev/shm belongs to somebody else."""
    code = """
import multiprocessing.synchronize as m
from uwlts.desk.shown_state import Board
from uwlts.desk.server import DeskServer

def refuse(*_, **__):
    raise PermissionError(13, "Permission denied")

m.SemLock.__init__ = refuse
DeskServer(Board("page"), port=0)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode != 0
    assert "the page's server did not start: PermissionError: [Errno 13] Permission denied" in done.stderr


def test_one_page_is_served_at_a_time_and_the_next_is_no_continuation(page):
    with pytest.raises(SetupError, match="serves a page already"):
        DeskServer(Board("second"), port=0)
    operator = Browser(page, Cookie=cookie(page))
    with operator:
        page.server.close()
    page.server.close()
    later = guarded("later", port=port(page))
    try:
        assert port(later) == port(page)
        assert "<title>later" in asked(later).body.decode()
        # A browser that still shows the first page comes back, and presses its buttons in vain.
        operator.place = later
        assert operator.open().startswith("44{")
        operator.click(operator.buttons()["take"])
        assert not ever_pressed(page) and not ever_pressed(later)
        operator.connection.close()
        with Browser(later, Cookie=cookie(later)) as again:
            again.click(again.buttons()["take"])
            assert pressed(later)
    finally:
        later.server.close()


# The desk itself


def test_the_desk_shows_bystanders_no_control_and_gives_out_nothing_but_its_folder(tmp_path):
    folder = tmp_path / "tank"
    folder.mkdir()
    (folder / "wall.html").write_text("<p>report</p>", encoding="utf-8")
    (folder / "secret.txt").write_text("secret", encoding="utf-8")
    (tmp_path / "outside.html").write_text("beyond the folder", encoding="utf-8")
    (folder / "link.html").symlink_to(tmp_path)
    (folder / "leak.html").symlink_to(tmp_path / "outside.html")
    desk = preloaded.uwlts("desk", folder, "--port", "0")
    try:
        line = desk.stdout.readline()
        operator, address = re.fullmatch(r"open (\S+) to work, (\S+) to look; Ctrl-C ends it\n", line).groups()

        served = Place(address, operator)
        kept = cookie(served)
        assert set(Browser(served).buttons()) == {"fit"}
        controls = Browser(served, Cookie=kept).buttons()
        assert {"Laser off", "connect", "home", "start", "stop", "length"} <= set(controls)
        report = asked(served, "/files/wall.html")
        assert report.status == 200 and report.body == b"<p>report</p>"
        policy = report.headers["content-security-policy"]
        assert policy.startswith("sandbox") and "same-origin" not in policy
        links, outside = ("link.html", "leak.html"), ("../outside.html", "..%2foutside.html")
        for name, own in product(("secret.txt", *outside, *links, "none.html", "%00.html"), ("", kept)):
            answer = asked(served, f"/files/{name}", **({"Cookie": own} if own else {}))
            assert b"beyond the folder" not in answer.body and b"secret\n" not in answer.body
            assert answer.status == 404 or b"<title>desk: tank" in answer.body, name
        # A browser that is still there is no reason to complain.
        with Browser(served, Cookie=kept):
            desk.send_signal(signal.SIGINT)
            _, said = desk.communicate(timeout=30)
        assert desk.returncode == 0 and said == ""
    finally:
        desk.kill()
        desk.communicate()


@pytest.mark.parametrize(
    ("bound", "host", "own"),
    [
        ("192.168.1.7", "192.168.1.7:80", True),
        ("192.168.1.7", "192.168.1.8", False),
        ("fe80::1", "[FE80:0::1]:8080", True),
        ("bench.lab", "BENCH.lab:8080", True),
        ("bench.lab", "192.168.1.7", False),
        ("localhost", "127.0.0.1", True),
        ("0.0.0.0", "[::1]:1", True),
    ],
)
def test_hosts_are_compared_with_the_address_that_is_served(bound, host, own):
    assert PageAccess(bound)._is_own(host) is own
