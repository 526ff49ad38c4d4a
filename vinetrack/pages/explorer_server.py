"""Server of the page, on the loopback address only and without external resources."""

from __future__ import annotations

import logging
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server
from tornado.web import ErrorHandler

from vinetrack.pages.campaign import BackgroundFit, read_campaign
from vinetrack.pages.local_page import (
    LOOPBACK,
    allowed_hosts,
    secret_path,
    serve_on_free_port,
    stop_on_signals,
)

if TYPE_CHECKING:
    from vinetrack.pages.campaign import Campaign


SILENCED_LOGGERS = ("bokeh", "tornado")
THREAD_SWITCH_S = 1e-3  # Thread switch interval

KEEP_ALIVE_MS = 20_000  # Interval of pings to an open page; chosen: a closed page is noticed within half a minute


def application(background: BackgroundFit) -> Application:
    """Return the application, which creates a page for each visitor."""
    from vinetrack.pages.page import Page

    shown = [background]

    def open_page(document: Document) -> None:
        Page(shown[-1], document, shown.append)

    return Application(FunctionHandler(open_page, trap_exceptions=False))


def start_server(background: BackgroundFit, port: int | None = None) -> Server:
    """Return a server that is bound to the loopback address and refuses requests from other pages."""
    return serve_on_free_port(lambda number: _bind(background, number), port)


def _bind(background: BackgroundFit, port: int) -> Server:
    # Find a free port first, because the allowed hosts include the port.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((LOOPBACK, port))
        free_port = int(probe.getsockname()[1])
    hosts = allowed_hosts(free_port)
    server = Server(
        {"/": application(background)},
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
    """Answer 403, on every route and on the web socket, to requests with another host name (DNS rebinding). Bokeh
    checks only the origin of a web socket, which matches if a foreign name resolves to this machine.
    """
    tornado = server._tornado
    routed = tornado.find_handler

    def find_handler(request: Any, **given: Any) -> Any:
        if request.host in hosts:
            return routed(request, **given)
        return tornado.get_handler_delegate(request, ErrorHandler, {"status_code": 403})

    tornado.find_handler = find_handler


def address(server: Server) -> str:
    """Return the address of the page."""
    return f"http://{LOOPBACK}:{server.port}{server.prefix}/"


def serve(
    background: BackgroundFit, say: Callable[[str], None], port: int | None = None, *, browser: bool = True
) -> None:
    """Serve until Ctrl-C (or SIGTERM)."""
    for name in SILENCED_LOGGERS:
        logging.getLogger(name).setLevel(logging.ERROR)
    # A background fit would otherwise delay the page.
    sys.setswitchinterval(THREAD_SWITCH_S)
    server = start_server(background, port)
    where = address(server)
    background.begin()
    say(f"Explorer: {where}")
    say("For this machine only. Ctrl-C ends it.")
    if browser:
        threading.Thread(target=webbrowser.open, args=(where,), daemon=True).start()
    with stop_on_signals(lambda: server.io_loop.add_callback_from_signal(server.io_loop.stop)):
        server.io_loop.start()
    server.stop()
    say("Explorer ended.")


def open_campaign(folder: Path, experiment: Path | None = None) -> Campaign:
    """Open a results folder and its experiment."""
    from vinetrack.pipeline.effects_stage import effects_of
    from vinetrack.results.folder_layout import read_source_experiment

    source = read_source_experiment(folder, experiment)
    return read_campaign(folder, source, effects_of(source.folder))


def explore(
    folder: Path, experiment: Path | None, say: Callable[[str], None], port: int | None, *, browser: bool
) -> None:
    """Serve the page of a results folder."""
    from vinetrack.core.terminal import waiting

    with waiting(f"opening {folder}"):
        campaign = open_campaign(folder, experiment)
    serve(BackgroundFit(campaign), say, port, browser=browser)
