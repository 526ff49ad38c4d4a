"""What both pages share: address, port and shutdown of their servers, and frames as JPEG."""

from __future__ import annotations

import contextlib
import secrets
import signal
import threading
import webbrowser
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from vinetrack.core.problems import UserError

if TYPE_CHECKING:
    from numpy.typing import NDArray

LOOPBACK = "127.0.0.1"
FIRST_PORT, PORTS = 5070, 30  # Chosen: not used by well-known services; 30 pages on one machine, then any free port

THREAD_PREFIX = "vinetrack-"  # Prefix of the names of a page's threads that need not finish before the process exits

Server = TypeVar("Server")


def secret_path() -> str:
    """Return a random first part of a page's path, so that only users who know the address have access."""
    return f"/{secrets.token_urlsafe(16)}"


def is_from_page(headers: Any, port: int) -> bool:
    """Whether the `Host` and the `Origin` of a request are those of a server's own page; others indicate a page of
    another site (DNS rebinding).
    """
    hosts = (f"{LOOPBACK}:{port}", f"localhost:{port}")
    return headers.get("Host") in hosts and headers.get("Origin") in (None, *(f"http://{host}" for host in hosts))


def serve_on_free_port(serve: Callable[[int], Server], port: int | None) -> Server:
    """Start a server on a port, or on the first free one."""
    ports = [port] if port is not None else [*range(FIRST_PORT, FIRST_PORT + PORTS), 0]
    for number in ports:
        with contextlib.suppress(OSError):
            return serve(number)
    raise UserError(f"Port {port} is in use: give another with --port, or omit --port to use a free one.")


def serve_until_stopped(
    name: str,
    address: str,
    run: Callable[[], object],
    end: Callable[[], object],
    say: Callable[[str], None],
    *,
    browser: bool,
) -> None:
    """Run a server whose page is at `address` until Ctrl-C or SIGTERM, which call `end` between two iterations of its
    loop.
    """
    say(f"{name}: {address}")
    say("For this machine only. Ctrl-C ends it.")
    if browser:
        threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
    previous = {number: signal.signal(number, lambda *_: end()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        run()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    say(f"{name} ended.")


def jpeg(picture: NDArray[Any], widest: int | None = None, white: float | None = None) -> bytes:
    """Return a grey picture as JPEG. Shapes: picture (height, width)."""
    import cv2
    import numpy as np

    if picture.dtype != np.uint8:
        scale = 255 / max(float(picture.max()) if white is None else white, 1.0)
        picture = (np.nan_to_num(picture.astype(np.float32)) * scale).clip(0, 255).astype(np.uint8)
    height, width = picture.shape
    if widest is not None and width > widest:
        picture = cv2.resize(picture, (widest, max(1, round(height * widest / width))), interpolation=cv2.INTER_AREA)
    # JPEG quality, 0 to 100; chosen: at 90 a mark on a ruler shows no blocks under the magnifier
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1])
