"""Pages in a real browser. It takes a minute of software rendering, so it runs only when asked for:

EDSLAM_CHROMIUM=/usr/bin/chromium pytest -n 0 tests/viewer/test_chromium.py
EDSLAM_SCREENSHOTS=DIR also keeps pictures of the pages, EDSLAM_SECONDS=30 is for a slow machine
"""

import base64
import contextlib
import itertools
import json
import os
import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("viser", reason="viser (extra viewer) is not installed")

CHROMIUM = os.environ.get("EDSLAM_CHROMIUM", "")
if not Path(CHROMIUM).is_file():
    pytest.skip(f"EDSLAM_CHROMIUM names no browser ('{CHROMIUM}')", allow_module_level=True)
SECONDS = float(os.environ.get("EDSLAM_SECONDS", "5"))  # from the first frame until all is shown
# Clicks the check box beside a text.
CHECK = """(() => {
    let part = [...document.querySelectorAll("*")].filter(e => e.innerText == "%s").at(-1);
    while (!part.querySelector("input[type=checkbox]")) part = part.parentElement;
    part.querySelector("input[type=checkbox]").click();
})()"""
PICTURES = os.environ.get("EDSLAM_SCREENSHOTS", "")
FLAGS = [
    *("--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--no-first-run", "--disable-quic", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--remote-debugging-port=0", "--window-size=1000,700", "--hide-scrollbars"),
]


class Browser:
    """A headless Chromium that is told what to do over its debugging protocol."""

    def __init__(self, profile: Path) -> None:
        from websockets.sync.client import connect

        self._process = subprocess.Popen(
            [CHROMIUM, *FLAGS, f"--user-data-dir={profile}"], stderr=subprocess.DEVNULL
        )
        told = profile / "DevToolsActivePort"
        until(lambda: told.is_file() and told.read_text().count("\n") > 0, 60)
        port = told.read_text().splitlines()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(target for target in json.load(answer) if target["type"] == "page")
        self._socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self._numbers = itertools.count(1)

    def do(self, method: str, **parameters: Any) -> Any:
        """Send a command and return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            if answer.get("id") == number:
                return answer.get("result")  # None: the browser could not

    def ask(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        return self.do("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def text(self) -> str:
        """Return what can be read on the page."""
        return str(self.ask("document.body ? document.body.innerText : ''"))

    def picture(self, name: str) -> np.ndarray:  # [H, W, 3] BGR
        """Return what the page looks like."""
        while (shot := self.do("Page.captureScreenshot")) is None:  # it is too busy with the page
            time.sleep(0.5)
        data = base64.b64decode(shot["data"])
        if PICTURES:
            (Path(PICTURES) / f"{name}.png").write_bytes(data)
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        return picture

    def close(self) -> None:
        """End it."""
        self._socket.close()
        self._process.terminate()
        self._process.wait(timeout=30)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    browser = Browser(tmp_path / "profile")
    yield browser
    browser.close()


def until(condition: Any, seconds: float) -> float:
    """Wait for a condition; return how long it took."""
    started = time.perf_counter()
    while not condition():
        assert time.perf_counter() - started < seconds, "it did not happen in time"
        time.sleep(0.1)
    return time.perf_counter() - started


@contextlib.contextmanager
def served(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a command; give it and the address of its page, and end it afterwards."""
    code = "from edslam_ti.commands import main; main()"
    command = [sys.executable, "-c", code, *arguments, "--viewer", "--viewer-port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        found = (re.search(r"page: (http://\S+)", line) for line in process.stdout)
        address = next((match[1] for match in found if match), None)
        assert address is not None, "it served no page"
        yield process, address
    finally:
        process.terminate()
        process.wait(timeout=60)


def scene(picture: np.ndarray) -> np.ndarray:
    """Return the part of a picture of the page that shows the scene."""
    return picture[150:, : picture.shape[1] * 2 // 3]


def colour_share(picture: np.ndarray, bgr: tuple[int, int, int]) -> float:
    return float((np.abs(picture.astype(int) - bgr).max(-1) < 30).mean())


@pytest.mark.timeout(900)
def test_live_page_shows_a_run_and_follows_and_the_finished_run_flies(
    browser: Browser, tmp_path: Path
) -> None:
    few = ("--mapping.final-iterations", "20", "--out", str(tmp_path))
    with served("slam", "--scene", "office0", *few) as (run, address):
        browser.do("Page.navigate", url=address)
        number = re.compile(r"frame (\d+) of")
        until(lambda: number.search(browser.text()) is not None, 200)
        wide = "[...document.images].filter(i => i.naturalWidth > 100).length"
        numbers, has_path = set[str](), False

        def is_shown() -> bool:
            numbers.update(number.findall(browser.text()))
            return browser.ask(wide) >= 2 and bool(scene(browser.picture("live")).std() > 20)

        print(f"splats and images {until(is_shown, SECONDS):.1f} s after the first frame on the page")
        while run.poll() is None and not (len(numbers) > 1 and has_path):
            numbers |= set(number.findall(browser.text()))
            has_path = colour_share(scene(browser.picture("live")), (178, 114, 0)) > 2e-4
        assert len(numbers) > 1
        assert has_path
        assert run.wait(timeout=600) == 0

    with served("view", str(tmp_path / "builtin/office0/ed_slam/latest")) as (_, address):
        browser.do("Page.navigate", url=address)
        until(lambda: scene(browser.picture("finished")).std() > 20, 120)
        browser.ask(CHECK % "Fly with the camera")
        time.sleep(5)
        before = scene(browser.picture("flight_begins"))
        browser.ask("[...document.querySelectorAll('button')].find(b => b.innerText == 'Play').click()")
        time.sleep(5)
        after = scene(browser.picture("flight_ends"))
        assert before.std() > 20
        assert np.abs(after.astype(int) - before).mean() > 5
