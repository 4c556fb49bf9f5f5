"""The browser of the tests: it opens served pages, runs their scripts, draws with WebGL and has fonts."""

import asyncio
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from tests import browser
from uwlts.errors import SetupError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PAGE = """\
<!DOCTYPE html>
<html><body style="margin: 0; background: white; font: 40px sans-serif; color: black">
<div id="wide">WWWW</div><div id="narrow">iiii</div>
<script>document.title = "sum " + [1, 2, 3].reduce((a, b) => a + b)</script>
</body></html>
"""

TRIANGLE = """
() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (gl === null) return null;
  const program = gl.createProgram();
  for (const [kind, text] of [
    [gl.VERTEX_SHADER, "in vec2 at; void main() { gl_Position = vec4(at, 0, 1); }"],
    [gl.FRAGMENT_SHADER, "precision highp float; out vec4 c; void main() { c = vec4(1.0, 0.4, 0.2, 1.0); }"],
  ]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, "#version 300 es\\n" + text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1]), gl.STATIC_DRAW);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  gl.enableVertexAttribArray(0);
  gl.clearColor(0, 0, 1, 1);
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  const at = (x, y) => {
    const pixel = new Uint8Array(4);
    gl.readPixels(x, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    return Array.from(pixel);
  };
  return [at(10, 10), at(gl.drawingBufferWidth - 10, gl.drawingBufferHeight - 10)];
}
"""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *message: object) -> None:
        pass


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of the served page."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "index.html").write_text(PAGE, encoding="utf-8")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


@pytest.fixture
def page(chromium: "Browser", address: str) -> "Iterator[Page]":
    page = chromium.new_page(viewport={"width": 400, "height": 200})
    page.goto(address)
    yield page
    page.close()


def test_a_script_of_a_served_page_runs(page: "Page"):
    assert page.title() == "sum 6"


def test_webgl_draws_a_triangle(page: "Page"):
    inside, outside = page.evaluate(TRIANGLE)
    # 0.4 and 0.2 of 255 are the whole numbers 102 and 51.
    assert inside == [255, 102, 51, 255]
    assert outside == [0, 0, 255, 255]


def test_text_is_drawn_in_letters(page: "Page"):
    """Letters differ in width and blackness; without a font they are missing, or all are the same box."""
    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    ink = []
    for name in ("wide", "narrow"):
        box = page.locator(f"#{name}").bounding_box()
        assert box is not None
        top, bottom = round(box["y"]), round(box["y"] + box["height"])
        ink.append(np.count_nonzero(picture[top:bottom] < 128))
    assert ink[0] > 2 * ink[1] > 0
    assert (picture[-20:] == 255).all()


def test_the_event_loop_ends_with_the_browser():
    """Also while another browser of this module is open, as each thread has its own."""
    after: list[object] = []

    def use_one() -> None:
        with browser.open_chromium(browser.find_chromium()) as own:
            after.append(own.is_connected())
        after.append(asyncio.run(asyncio.sleep(0, "ran")))

    thread = threading.Thread(target=use_one)
    thread.start()
    thread.join()
    assert after == [True, "ran"]


def test_the_users_choice_is_used_or_refused_and_never_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    found = browser.find_chromium()
    monkeypatch.setenv(browser.VARIABLE, str(found))
    assert browser.find_chromium() == found
    for choice, fault in ((tmp_path / "none", "it is not there"), (Path("/bin/true"), "it is no Chromium")):
        monkeypatch.setenv(browser.VARIABLE, str(choice))
        with pytest.raises(SetupError, match=f"variable CHROMIUM names {choice}: {fault}"):
            browser.find_chromium()


def test_the_message_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv(browser.VARIABLE, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SetupError) as caught:
        browser.find_chromium()
    expected = ("there is no Chromium", "Found: none", "apt-get install", browser.VARIABLE)
    assert [part for part in expected if part not in str(caught.value)] == []
