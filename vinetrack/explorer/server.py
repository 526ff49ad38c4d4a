"""The page served: on this machine's own address alone, everything it needs included, until Ctrl-C."""

from __future__ import annotations

import logging
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server
from tornado.web import ErrorHandler

from vinetrack.core.local_page import LOOPBACK, allowed_hosts, secret_path, serve_on_free_port, stop_on_signals
from vinetrack.explorer.fitting import BackgroundFit

QUIET = ("bokeh", "tornado")
SWITCH_S = 1e-3
"""Between threads; chosen: with Python's 5 ms each move of a slider waits as long while a fit runs."""

KEEP_ALIVE_MS = 20_000
"""Between two pings of an open page; chosen: a page that was closed is noticed within half a minute."""


def application(ground: BackgroundFit) -> Application:
    """A page for whoever opens one.

    Parameters
    ----------
    ground : the background that all pages share.

    Returns
    -------
    Application
    """
    from vinetrack.explorer.page import Page

    shown = [ground]

    def open_page(document: Document) -> None:
        Page(shown[-1], document, shown.append)

    return Application(FunctionHandler(open_page, trap_exceptions=False))


def start_server(ground: BackgroundFit, port: int | None = None) -> Server:
    """A server that is bound to the loopback address and answers no page from elsewhere.

    Parameters
    ----------
    port
        The port to take, 0 for any that is free; None looks for the first free one from `FIRST_PORT`.
    ground : the background that all pages share.

    Returns
    -------
    Server

    Raises
    ------
    PageError
        If it is taken.
    """
    return serve_on_free_port(lambda number: _serve(ground, number), port)


def _serve(ground: BackgroundFit, port: int) -> Server:
    # Found first, so that the port is known before it is said who may connect to it.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((LOOPBACK, port))
        free_port = int(probe.getsockname()[1])
    hosts = allowed_hosts(free_port)
    server = Server(
        {"/": application(ground)},
        prefix=secret_path(),
        address=LOOPBACK,
        port=free_port,
        allow_websocket_origin=sorted(hosts),
        keep_alive_milliseconds=KEEP_ALIVE_MS,
        check_unused_sessions_milliseconds=5_000,
        unused_session_lifetime_milliseconds=10_000,
        use_index=False,
    )
    _refuse_other_hosts(server, hosts)
    server.start()
    return server


def _refuse_other_hosts(server: Server, hosts: frozenset[str]) -> None:
    """Answer 403, on every route and to the socket, to whoever asks under another name than this machine's own.

    Bokeh looks at the origin of a socket alone: a name elsewhere that is made to lead here has a fitting origin.
    """
    tornado = server._tornado
    routed = tornado.find_handler

    def find_handler(request: Any, **given: Any) -> Any:
        if request.host in hosts:
            return routed(request, **given)
        return tornado.get_handler_delegate(request, ErrorHandler, {"status_code": 403})

    tornado.find_handler = find_handler


def address(server: Server) -> str:
    """Where the page is.

    Parameters
    ----------
    server : that runs.

    Returns
    -------
    str
    """
    return f"http://{LOOPBACK}:{server.port}{server.prefix}/"


def serve(ground: BackgroundFit, say: Callable[[str], None], port: int | None = None, *, browser: bool = True) -> None:
    """Serve until Ctrl-C (or SIGTERM), then leave without a word more than needed.

    Parameters
    ----------
    ground : the background that all pages share.
    say : prints a line.
    port : as of `start_server`.
    browser : whether a browser is opened.

    Raises
    ------
    PageError
        If the port is taken.
    """
    for name in QUIET:
        logging.getLogger(name).setLevel(logging.ERROR)
    # A fit in the background then hands over between two strokes of a pen, not after.
    sys.setswitchinterval(SWITCH_S)
    server = start_server(ground, port)
    where = address(server)
    ground.begin()
    say(f"Explorer: {where}")
    say("For this machine alone. Ctrl-C ends it.")
    if browser:
        threading.Thread(target=webbrowser.open, args=(where,), daemon=True).start()
    with stop_on_signals(lambda: server.io_loop.add_callback_from_signal(server.io_loop.stop)):
        server.io_loop.start()
    server.stop()
    say("Explorer ended.")
