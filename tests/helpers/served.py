"""A command that serves a page, in a separate process; user actions on the explorer's page in a browser."""

import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Queue
from typing import Self

from chrome import Chrome, end, until
from tornado.ioloop import IOLoop

from vinetrack.pages.local_page import PageServer
from vinetrack.pages.setup_server import Desk, start_server

PROGRAM = "from vinetrack.cli.main import main; main()"


class Served:
    """`vinetrack explore RESULTS --no-browser`, or another command, up to Ctrl-C. Use it as a context."""

    def __init__(self, folder: Path, *arguments: str, command: str = "explore") -> None:
        self._log = tempfile.NamedTemporaryFile()  # noqa: SIM115
        started = [sys.executable, "-c", PROGRAM, command, str(folder), "--no-browser", *arguments]
        self.process = subprocess.Popen(started, stdout=self._log, stderr=subprocess.STDOUT)

    @property
    def lines(self) -> list[str]:
        """What it has printed."""
        return Path(self._log.name).read_text().splitlines()

    @property
    def address(self) -> str:
        """The address of the page that it printed."""

        def found() -> str:
            assert self.process.poll() is None, self.lines
            return next((m.group() for line in self.lines if (m := re.search(r"http://\S+", line))), "")

        return str(until(found, "the server to print its address", 120))

    def interrupt(self) -> int:
        """Ctrl-C; the exit status."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(30)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            end(self.process)
        self._log.close()


@contextmanager
def served_here(clips: Path) -> Iterator[PageServer]:
    """The set-up page of a folder, served by this process."""
    made: Queue[PageServer] = Queue()

    def serve() -> None:
        made.put(start_server(Desk(clips), 0))
        IOLoop.current().start()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    server = made.get(timeout=30)
    try:
        yield server
    finally:
        server.loop.add_callback(server.stop)
        server.loop.add_callback(server.loop.stop)
        thread.join(10)


class Visitor:
    """User actions on the page: widgets are found by name, and used with the mouse."""

    def __init__(self, chrome: Chrome, address: str) -> None:
        self.chrome = chrome
        chrome.open(address)
        chrome.wait("window.Bokeh && Bokeh.documents.length === 1 && Bokeh.documents[0].is_idle", "the page", 90)
        chrome.wait(f"{self.model('model_curves')}.data.xs.length > 0", "the first curves", 240)

    @staticmethod
    def model(name: str) -> str:
        """JavaScript expression of a widget or figure."""
        return f"Bokeh.documents[0].get_model_by_name({name!r})"

    def value(self, name: str, what: str):
        """A property of a widget."""
        return self.chrome.run(f"{self.model(name)}.{what}")

    def text(self, name: str) -> str:
        """The text of a widget."""
        return str(self.value(name, "text"))

    def until(self, script: str, what: str, seconds: float = 120) -> None:
        """Wait for an expression over `model(name)`."""
        self.chrome.wait(re.sub(r"\$(\w+)", lambda m: self.model(m.group(1)), script), what, seconds)

    def place(self, name: str, inside: str) -> list[float]:
        """Scroll an element of a widget into view; return its centre in the window and its width."""
        view = f"Bokeh.index.find_one({self.model(name)})"
        self.chrome.run(f"{view}.el.scrollIntoView({{block: 'center'}})")
        time.sleep(0.2)
        box: list[float] = self.chrome.run(
            f"(() => {{ const r = {view}.shadow_el.querySelector({inside!r}).getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2, r.width]; })()"
        )
        return box

    def click(self, name: str, inside: str = "button") -> None:
        """Click on an element of a widget."""
        x, y, _ = self.place(name, inside)
        self.chrome.click(x, y)

    def drag(self, name: str, path: list[float], after: Callable[[], None]) -> None:
        """Drag a slider by fractions of its width, positive to the right; `after` is called after every move."""
        _, _, whole = self.place(name, ".noUi-target")
        x, y, _ = self.place(name, ".noUi-handle")
        self.chrome.mouse("move", x, y)
        self.chrome.mouse("press", x, y)
        for part in path:
            self.chrome.mouse("move", x + part * whole, y, held=True)
            after()
        self.chrome.mouse("release", x + path[-1] * whole, y)
