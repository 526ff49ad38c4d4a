"""What local pages have in common: the address they are bound to, their port, and why one cannot be served."""

from __future__ import annotations

import contextlib
import secrets
import signal
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from vinetrack.core.problems import UserError

LOOPBACK = "127.0.0.1"
FIRST_PORT, PORTS = 5070, 30
"""Chosen: free of well-known services; 30 pages on one machine, then any free port."""

TOKEN_BYTES = 16
"""Chosen: 128 bits, which nobody guesses; half would do."""

THREAD_PREFIX = "vinetrack-"
"""Threads of a page whose work need not be waited for when it ends are named so."""

Server = TypeVar("Server")


class PageError(UserError, RuntimeError):
    """The page cannot be served; one sentence with a remedy."""


def secret_path() -> str:
    """A random first part of a page's address, so that only who was told the address can ask for anything.

    Returns
    -------
    path, with a slash before and none behind it.
    """
    return f"/{secrets.token_urlsafe(TOKEN_BYTES)}"


def allowed_hosts(port: int) -> frozenset[str]:
    """Names under which a page of this machine is asked for; another name that leads here is somebody else's page.

    Parameters
    ----------
    port : of the server.

    Returns
    -------
    what the header `Host` of a request may say.
    """
    return frozenset({f"{LOOPBACK}:{port}", f"localhost:{port}"})


def serve_on_free_port(serve: Callable[[int], Server], port: int | None) -> Server:
    """A server on a port, or on the first that is free.

    Parameters
    ----------
    serve : starts one on a port; OSError where it is taken.
    port : to take, 0 for any that is free; None looks for the first free one from `FIRST_PORT`.

    Returns
    -------
    what `serve` returns.

    Raises
    ------
    PageError
        If the port is taken.
    """
    tried = [port] if port is not None else [*range(FIRST_PORT, FIRST_PORT + PORTS), 0]
    for number in tried:
        with contextlib.suppress(OSError):
            return serve(number)
    raise PageError(f"Port {port} is in use: give another with --port, or omit --port to use a free one.")


@contextlib.contextmanager
def stop_on_signals(end: Callable[[], object]) -> Iterator[None]:
    """Ctrl-C and SIGTERM end a server between two turns of its loop, in the middle of nothing.

    Parameters
    ----------
    end : asks the loop to end; called in the thread that serves, it must not wait.

    Yields
    ------
    None : while the signals are taken.
    """

    def ended(_number: int, _frame: Any) -> None:
        end()

    before = {number: signal.signal(number, ended) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
