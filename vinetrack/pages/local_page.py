"""What both pages share: a server that answers this machine only, style, and frames as JPEG."""

from __future__ import annotations

import contextlib
import logging
import secrets
import signal
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop
from tornado.netutil import bind_sockets
from tornado.routing import Router
from tornado.web import Application, ErrorHandler

from vinetrack.core.problems import UserError

LOOPBACK = "127.0.0.1"

TEMPLATES = Path(__file__).with_name("templates")
TOKENS_CSS = Path(__file__).parents[1] / "report" / "templates" / "page_tokens.css"  # Colours of either scheme


def page_frame() -> str:
    """Return the style of page, heading and cards, with the colours of a light and a dark scheme."""
    return TOKENS_CSS.read_text(encoding="utf-8") + (TEMPLATES / "page_frame.css").read_text(encoding="utf-8")


class PageServer:
    """A server of the application that `make` returns for the first part of its paths, which is random, so that only
    who was told the address has access. It has a port, but answers nothing until its loop runs.
    """

    def __init__(self, make: Callable[[str], Application], port: int | None) -> None:
        self.loop = IOLoop.current()
        # Chosen: ports that no well-known service uses; 30 pages on one machine, then any free port
        for number in [port] if port is not None else [*range(5070, 5100), 0]:
            with contextlib.suppress(OSError):
                sockets = bind_sockets(number, LOOPBACK)
                break
        else:
            raise UserError(f"Port {port} is in use: give another with --port, or omit --port to use a free one.")
        self.secret, self.port = f"/{secrets.token_urlsafe(16)}", int(sockets[0].getsockname()[1])
        self.address = f"http://{LOOPBACK}:{self.port}{self.secret}/"
        application = make(self.secret)
        hosts = (f"{LOOPBACK}:{self.port}", f"localhost:{self.port}")

        class OwnPageOnly(Router):
            """Answers 403 to the page of another site, whose name may resolve to this machine (DNS rebinding)."""

            def find_handler(self, request: Any, **given: Any) -> Any:
                origins = (None, *(f"http://{host}" for host in hosts))
                if request.headers.get("Host") in hosts and request.headers.get("Origin") in origins:
                    return application.find_handler(request, **given)
                return application.get_handler_delegate(request, ErrorHandler, {"status_code": 403})

        # 20 MB: chosen: a sheet of ten thousand rows takes a few megabytes
        self._http = HTTPServer(OwnPageOnly(), max_body_size=20_000_000)
        self._http.add_sockets(sockets)

    def run(self, name: str, say: Callable[[str], None], *, browser: bool) -> None:
        """Serve until Ctrl-C or SIGTERM, which end it between two iterations of its loop."""
        say(f"{name}: {self.address}")
        say("For this machine only. Ctrl-C ends it.")
        for library in ("bokeh", "tornado"):
            logging.getLogger(library).setLevel(logging.ERROR)
        if browser:
            threading.Thread(target=webbrowser.open, args=(self.address,), daemon=True).start()

        def end(*_: object) -> None:
            self.loop.add_callback_from_signal(self.loop.stop)

        previous = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            self.loop.start()
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
        self.stop()
        say(f"{name} ended.")

    def stop(self) -> None:
        """Let its port go."""
        self._http.stop()


def jpeg(picture: NDArray[Any], widest: int | None = None, white: float | None = None) -> bytes:
    """Return a grey picture as JPEG. Shapes: picture (height, width)."""
    if picture.dtype != np.uint8:
        scale = 255 / max(float(picture.max()) if white is None else white, 1.0)
        picture = (np.nan_to_num(picture.astype(np.float32)) * scale).clip(0, 255).astype(np.uint8)
    height, width = picture.shape
    if widest is not None and width > widest:
        picture = cv2.resize(picture, (widest, max(1, round(height * widest / width))), interpolation=cv2.INTER_AREA)
    # JPEG quality, 0 to 100; chosen: at 90 a mark on a ruler shows no blocks under the magnifier
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1])
