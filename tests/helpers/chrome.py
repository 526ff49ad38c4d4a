"""Chromium driven over its DevTools protocol, by the websocket client that comes with bokeh's server: no further tool.
What the page complains of and everything it asks the network for is kept, for a test to look at.
"""

import asyncio
import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Self

from tornado.websocket import WebSocketClientConnection, websocket_connect

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--disable-extensions", "--disable-dev-shm-usage",
    "--remote-debugging-port=0", "--remote-allow-origins=*", "--hide-scrollbars", "--force-color-profile=srgb",
)  # fmt: skip


def find_chrome() -> str | None:
    """The browser's program, None where there is none."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class Chrome:
    """One browser with one page. Use it as a context."""

    def __init__(self, folder: Path, width: int = 1400, height: int = 1000) -> None:
        program = find_chrome()
        assert program is not None
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self._loop = asyncio.new_event_loop()
        self._count = 0
        self._answers: dict = {}
        profile = folder / "profile"
        # The browser leaves folders where programs keep what passes; a socket in them wants a short path.
        self._scratch = tempfile.TemporaryDirectory(prefix="browser", ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [program, *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "TMPDIR": self._scratch.name},
        )
        port_file = profile / "DevToolsActivePort"
        until(lambda: port_file.exists() and port_file.read_text().count("\n") >= 1, "the browser to start", 60)
        port = port_file.read_text().splitlines()[0]
        until(lambda: self._pages(port) != [], "the first page", 30)
        address = self._pages(port)[0]["webSocketDebuggerUrl"]
        self._socket = self._loop.run_until_complete(_connect(address))
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        self.size(width, height)

    @staticmethod
    def _pages(port: str) -> list[dict]:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=10) as answer:
            return [page for page in json.load(answer) if page["type"] == "page"]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        end(self._process)
        self._loop.close()
        self._scratch.cleanup()

    def send(self, method: str, **params) -> dict:
        """One command and its answer."""
        self._count += 1
        return self._loop.run_until_complete(self._exchange(self._count, method, params))

    async def _exchange(self, number: int, method: str, params: dict) -> dict:
        await self._socket.write_message(json.dumps({"id": number, "method": method, "params": params}))
        while number not in self._answers:
            text = await asyncio.wait_for(self._socket.read_message(), 60)
            assert isinstance(text, str), "the browser has gone"
            self._take(json.loads(text))
        answer = self._answers.pop(number)
        assert "error" not in answer, f"{method}: {answer['error']}"
        return answer["result"]

    def _take(self, message: dict) -> None:
        if "id" in message:
            self._answers[message["id"]] = message
            return
        method, params = message["method"], message["params"]
        if method == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(params["exceptionDetails"])[:800])
        elif method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.complaints.append(f"{params['entry']['text']} {params['entry'].get('url', '')}")
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.complaints.append(" ".join(str(a.get("value", a.get("description"))) for a in params["args"])[:800])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def size(self, width: int, height: int) -> None:
        """Size of the window, CSS pixels."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def open(self, address: str) -> None:
        """Go to a page and wait until it has loaded."""
        self.send("Page.navigate", url=address)
        self.wait("document.readyState === 'complete'", "the page to load")

    def run(self, script: str):
        """Value of a JavaScript expression; a promise is waited for."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, f"{script[:200]}: {answer['exceptionDetails']}"
        return answer["result"].get("value")

    def wait(self, script: str, what: str, seconds: float = 60):
        """Until an expression is true; its value."""
        return until(lambda: self.run(script), what, seconds)

    def mouse(self, kind: str, x: float, y: float, *, held: bool = False) -> None:
        """Move, press or release the left button at a place of the window."""
        names = {"move": "mouseMoved", "press": "mousePressed", "release": "mouseReleased"}
        down = held or kind != "move"
        button = {"button": "left" if down else "none", "buttons": 1 if down and kind != "release" else 0}
        self.send("Input.dispatchMouseEvent", type=names[kind], x=x, y=y, clickCount=int(kind != "move"), **button)

    def click(self, x: float, y: float) -> None:
        """Click at a place of the window."""
        self.mouse("move", x, y)
        self.mouse("press", x, y)
        self.mouse("release", x, y)

    def picture(self, path: Path) -> None:
        """Save what is seen as PNG."""
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))


def end(process: subprocess.Popen) -> None:
    """End a process that was started here, by force after 20 s."""
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(20)


async def _connect(address: str) -> WebSocketClientConnection:
    return await websocket_connect(address, max_message_size=100_000_000)


def until(asked: Callable, what: str, seconds: float = 60):
    """Ask until the answer is true; an error that names what was waited for, if it never is."""
    end = time.monotonic() + seconds
    while not (answer := asked()):
        assert time.monotonic() < end, f"waited {seconds:g} s for {what}"
        time.sleep(0.05)
    return answer
