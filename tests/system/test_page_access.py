"""Requests to a live page as browsers, other sites and bystanders send them: what is refused, whose clicks count."""

import http.client
import socket
from collections.abc import Callable, Iterator
from urllib.parse import parse_qs, urlsplit

import msgspec
import pytest
import viser
from viser import _messages
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from tests.waiting import within
from uwlts.hardware.guided.operator import GuidedPage
from uwlts.hardware.live_view import LivePage
from uwlts.hardware.page_access import PageAccess

Answer = tuple[int, dict[str, str]]


@pytest.fixture(scope="module")
def page() -> Iterator[GuidedPage]:
    opened = GuidedPage("guarded", port=18080)
    yield opened
    opened.close()


def get(page: LivePage, path: str = "/", **headers: str) -> Answer:
    """Status and headers of the answer to a raw request; ``Host`` replaces the page's own."""
    place = urlsplit(page.address)
    connection = http.client.HTTPConnection(place.hostname, place.port, timeout=5)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status, dict(answer.headers)


def opened(page: LivePage, **headers: str) -> ClientConnection:
    place, origin = urlsplit(page.address), headers.pop("Origin", None)
    return connect(
        f"ws://{headers.pop('Host', place.netloc)}",
        sock=socket.create_connection((place.hostname, place.port), timeout=5),
        subprotocols=[f"viser-v{viser.__version__}"],
        origin=origin,
        additional_headers=headers,
    )


def cookie(page: LivePage) -> str:
    status, headers = get(page, page.operator_address.removeprefix(page.address))
    assert status == 303 and headers["Location"] == "/"
    assert "HttpOnly" in headers["Set-Cookie"] and "SameSite=Strict" in headers["Set-Cookie"]
    return headers["Set-Cookie"].split(";")[0]


def port(page: LivePage) -> int:
    return page.server.get_port()


def test_the_page_itself_is_shown_to_this_machine(page):
    for host in ("127.0.0.1", "localhost", "[::1]"):
        status, headers = get(page, Host=f"{host}:{port(page)}")
        assert status == 200 and headers["X-Frame-Options"] == "DENY"
    # The page's own address, another one by port forwarding.
    assert get(page, Origin=page.address)[0] == 200
    assert get(page, Host="localhost:9000", Origin="http://localhost:9000")[0] == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "192.168.1.7", "", "localhost@evil.example"]
)
def test_another_host_is_refused(page, host):
    assert get(page, Host=f"{host}:{port(page)}")[0] == 403
    with pytest.raises(InvalidStatus, match="403"):
        opened(page, Host=f"{host or 'x'}:{port(page)}".replace("@", "."))


@pytest.mark.parametrize("origin", ["http://evil.example", "http://localhost:3000", "null", "file://"])
def test_another_origin_is_refused(page, origin):
    assert get(page, Origin=origin)[0] == 403
    # With the operator's cookie too: that is what a forged request would have.
    with pytest.raises(InvalidStatus, match="403"):
        opened(page, Origin=origin, Cookie=cookie(page))


def test_another_site_can_link_to_the_page_but_not_load_it(page):
    assert get(page, Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0] == 200
    assert get(page, Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="no-cors")[0] == 403


def test_a_wrong_token_is_refused_and_the_right_one_does_not_lead_elsewhere(page):
    assert get(page, "/?token=wrong")[0] == 403
    token = parse_qs(urlsplit(page.operator_address).query)["token"][0]
    status, headers = get(page, f"//evil.example?token={token}")
    assert status == 303 and headers["Location"] == "/evil.example"


CAMERA = _messages.ViewerCameraMessage((1, 0, 0, 0), (0, 0, 0), 1.0, 0.1, 10.0, 480, 640, (0, 0, 1), (0, 1, 0))


def send(connection: ClientConnection, message: _messages.Message) -> None:
    connection.send(msgspec.msgpack.encode(message.as_serializable_dict()))


def soon(condition: Callable[[], bool]) -> bool:
    """Whether a condition comes true on a machine however busy."""
    return within(20.0, condition)


def ever(condition: Callable[[], bool]) -> bool:
    """Whether a condition comes true that must not: what is obeyed is obeyed within some ms."""
    return within(1.0, condition)


def button_of(page: LivePage) -> str:
    """The latest client's button."""
    client = page.server.get_clients()[max(page.server.get_clients())]
    assert soon(lambda: len(client.gui._gui_input_handle_from_uuid) == 1)
    (uuid,) = client.gui._gui_input_handle_from_uuid
    return uuid


def test_only_the_operator_has_a_button_and_only_the_latest_one_is_obeyed(page):
    with opened(page, Origin=page.address) as bystander:
        # What is shown reaches everybody.
        assert bystander.recv(timeout=5)
        send(bystander, CAMERA)
        assert not ever(lambda: bool(page.server.get_clients()))
        with opened(page, Origin=page.address, Cookie=cookie(page)) as operator:
            send(operator, CAMERA)
            assert soon(lambda: len(page.server.get_clients()) == 1)
            click = _messages.GuiUpdateMessage(button_of(page), {"value": True})
            send(bystander, click)
            assert not ever(page.pressed)
            send(operator, click)
            assert soon(page.pressed)
            with opened(page, Origin=page.address, Cookie=cookie(page)) as again:
                send(again, CAMERA)
                assert soon(lambda: len(page.server.get_clients()) == 2)
                send(operator, click)
                assert not ever(page.pressed)
                send(again, _messages.GuiUpdateMessage(button_of(page), {"value": True}))
                assert soon(page.pressed)


def test_a_cookie_with_another_token_is_no_operators(page):
    name = cookie(page).split("=")[0]
    with opened(page, Cookie=f"{name}=wrong") as bystander:
        send(bystander, CAMERA)
        assert not ever(lambda: bool(page.server.get_clients()))


def test_nothing_is_shared_by_way_of_the_internet(page):
    with opened(page, Cookie=cookie(page)) as operator:
        send(operator, _messages.ShareUrlRequest())
        assert not ever(lambda: page.server._share_tunnel is not None)
    assert page.server.request_share_url() is None


def test_a_page_for_the_network_takes_its_own_names_and_warns():
    shown = LivePage("network", host="0.0.0.0", port=18180)
    try:
        assert "everybody" in shown.warning and "ssh -L" in shown.warning
        own = [f"{name}:{shown.server.get_port()}" for name in ("192.168.1.7", "localhost", "127.0.0.1")]
        assert [get(shown, Host=host)[0] for host in own] == [200] * 3
        assert get(shown, Host="evil.example")[0] == 403
    finally:
        shown.close()


def test_a_page_for_this_machine_does_not_warn(page):
    assert page.warning is None


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
