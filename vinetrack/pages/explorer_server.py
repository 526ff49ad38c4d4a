"""Server of the page, on the loopback address only and without external resources."""

from __future__ import annotations

import logging
import socket
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server
from tornado.web import ErrorHandler

from vinetrack.pages.campaign import BackgroundFit, Campaign, read_campaign
from vinetrack.pages.local_page import (
    LOOPBACK,
    allowed_hosts,
    secret_path,
    serve_on_free_port,
    serve_until_stopped,
)
from vinetrack.pages.page import Page


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
    shown = [background]

    def open_page(document: Document) -> None:
        Page(shown[-1], document, shown.append)

    server = Server(
        {"/": Application(FunctionHandler(open_page, trap_exceptions=False))},
        prefix=secret_path(),
        address=LOOPBACK,
        port=free_port,
        allow_websocket_origin=sorted(hosts),
        # Interval of pings to an open page; chosen: a closed page is noticed within half a minute
        keep_alive_milliseconds=20_000,
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


def open_campaign(folder: Path, experiment: Path | None = None) -> Campaign:
    """Open a results folder and its experiment."""
    from vinetrack.pipeline.effects_stage import effects_of
    from vinetrack.results.folder_layout import read_source_experiment

    source = read_source_experiment(folder, experiment)
    return read_campaign(folder, source, effects_of(source.folder))


def explore(
    folder: Path, experiment: Path | None, say: Callable[[str], None], port: int | None, *, browser: bool
) -> None:
    """Serve the page of a results folder until Ctrl-C (or SIGTERM)."""
    from vinetrack.core.terminal import waiting

    with waiting(f"opening {folder}"):
        background = BackgroundFit(open_campaign(folder, experiment))
    for name in ("bokeh", "tornado"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # A background fit would otherwise delay the page.
    sys.setswitchinterval(1e-3)  # Thread switch interval
    server = start_server(background, port)
    background.begin()
    loop = server.io_loop
    end = partial(loop.add_callback_from_signal, loop.stop)
    serve_until_stopped("Explorer", address(server), loop.start, end, say, browser=browser)
    server.stop()
