"""The process that obeys Laser off, within this process, with a pipe as the controller's line."""

import asyncio
import json
import os
import socket
from contextlib import suppress
from dataclasses import asdict

import pytest

from uwlts.desk import laser_listener
from uwlts.desk.access import PageAccess
from uwlts.desk.laser_listener import LaserListener

RESET = b"\x18"


def received(line: int) -> bytes:
    with suppress(BlockingIOError):
        return os.read(line, 2**20)
    return b""


@pytest.mark.parametrize("lost", [False, True])
def test_resets_are_repeated_beyond_a_line_that_is_full_for_a_moment(monkeypatch, lost):
    """A line that accepts nothing ends a press after its time limit, and not before."""
    for name, seconds in (("_AGAIN_S", 0.02), ("_WATCH_S", 0.02), ("_GIVE_UP_S", 1.0)):
        monkeypatch.setattr(laser_listener, name, seconds)

    async def press() -> tuple[bytes, bytes]:
        line, port = os.pipe()
        os.set_blocking(line, False)
        os.set_blocking(port, False)
        program, lent = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        answers, presses = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        access, listening = PageAccess("127.0.0.1"), socket.create_server(("127.0.0.1", 0))
        program.send(json.dumps({"access": asdict(access), "page_port": 8000}).encode())
        serving = asyncio.create_task(LaserListener(lent, presses).serve(listening))
        socket.send_fds(program, [b"port"], [port])
        reader, writer = await asyncio.open_connection(*listening.getsockname())
        headers = f"Host: 127.0.0.1\r\nOrigin: http://127.0.0.1:8000\r\nCookie: {access.cookie}={access.token}"
        writer.write(f"POST /off-1 HTTP/1.1\r\n{headers}\r\n\r\n".encode())
        answer = await reader.read()
        # Longer than the time limit of a press: the moment comes after it.
        await asyncio.sleep(1.5)
        before = received(line)
        with suppress(BlockingIOError):
            while True:
                os.write(port, b"x" * 4096)
        await asyncio.sleep(2.0 if lost else 0.1)
        received(line)
        await asyncio.sleep(0.3)
        after = received(line)
        answers.send(b"off-1")
        program.shutdown(socket.SHUT_RDWR)
        await asyncio.wait_for(serving, 10)
        for each in (line, port):
            os.close(each)
        for each in (program, lent, answers, presses, listening):
            each.close()
        writer.close()
        assert answer.startswith(b"HTTP/1.1 204 ")
        return before, after

    before, after = asyncio.run(press())
    assert set(before) == set(RESET)
    assert set(after) == (set() if lost else set(RESET))
