"""Server of the page, on the loopback address only and without external resources."""

from __future__ import annotations

import importlib.util
import logging
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server
from tornado.web import ErrorHandler

from vinetrack.core.local_page import (
    LOOPBACK,
    PageError,
    allowed_hosts,
    secret_path,
    serve_on_free_port,
    stop_on_signals,
)
from vinetrack.explorer.fitting import BackgroundFit

if TYPE_CHECKING:
    from vinetrack.explorer.campaign import Campaign, ModelChoice


SILENCED_LOGGERS = ("bokeh", "tornado")
THREAD_SWITCH_S = 1e-3  # Thread switch interval

KEEP_ALIVE_MS = 20_000  # Interval of pings to an open page; chosen: a closed page is noticed within half a minute


def application(background: BackgroundFit) -> Application:
    """Return the application, which creates a page for each visitor."""
    from vinetrack.explorer.page import Page

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


# ------------------------------------------------------------------------------
# The command `vinetrack explore`: the page for a results folder, or its functions without the page.


@dataclass(frozen=True)
class ExploreOptions:
    """Options of the command line; see `vinetrack explore --help`."""

    add: Sequence[str] = ()
    drop: Sequence[str] = ()
    sizes: Sequence[str] = ()
    refit: bool = False
    export: Sequence[Path] = ()
    save: bool = False
    port: int | None = None
    browser: bool = True

    @property
    def needs_page(self) -> bool:
        """Whether to open the page: refitting, exporting and saving need none."""
        return not (self.refit or self.export or self.save)


def open_campaign(folder: Path, experiment: Path | None = None) -> Campaign:
    """Open a results folder and its experiment."""
    from vinetrack.explorer.campaign import read_campaign
    from vinetrack.pipeline.effects_stage import effects_of, read_source_experiment

    source = read_source_experiment(folder, experiment)
    return read_campaign(folder, source, effects_of(source.folder))


def explore(folder: Path, experiment: Path | None, options: ExploreOptions, say: Callable[[str], None]) -> None:
    """Serve the page, or carry out the options and print the results."""
    from vinetrack.core.terminal import waiting
    from vinetrack.explorer.campaign import choice_from_options, choice_in_use

    with waiting(f"opening {folder}"):
        campaign = open_campaign(folder, experiment)
        start = choice_in_use(campaign)
        choice = choice_from_options(campaign, start, options.add, options.drop, options.sizes)
    if options.needs_page:
        if importlib.util.find_spec("bokeh") is None:
            raise PageError("The page needs bokeh, which is not installed: pip install 'vinetrack[explorer]'.")
        from vinetrack.explorer.fitting import BackgroundFit

        serve(BackgroundFit(campaign, start if choice == start else choice), say, options.port, browser=options.browser)
        return
    _run_without_page(campaign, start, choice, options, say)


def _run_without_page(
    campaign: Campaign, start: ModelChoice, choice: ModelChoice, options: ExploreOptions, say: Callable[[str], None]
) -> None:
    from vinetrack.core.terminal import waiting
    from vinetrack.explorer.campaign import errors_m, simulate_curves, sized_model
    from vinetrack.explorer.fitting import first_fit, fit_choice, likelihood_change_text, model_text, write_export
    from vinetrack.pipeline.effects_stage import save_model

    with waiting("simulating the trials"):
        before = errors_m(campaign, simulate_curves(campaign, sized_model(campaign, start)))
    if options.refit:
        with waiting("fitting the model in use"):
            first = first_fit(campaign, start)
        with waiting(f"fitting {model_text(choice.effects)}"):
            fitted = fit_choice(campaign, first.fit, choice)
        choice = fitted.choice
        say(str(fitted.fit))
        say(likelihood_change_text(first.fit, fitted.fit))
    curves = simulate_curves(campaign, sized_model(campaign, choice))
    for line in error_lines(campaign, choice, errors_m(campaign, curves), before):
        say(line)
    for path in options.export:
        write_export(campaign, choice, curves, path)
        say(f"Written: {path}")
    if options.save:
        files = campaign.own_files(choice.effects)
        say(f"Saved: {save_model(campaign.experiment.folder, choice.effects, files)}")


def error_lines(campaign: Campaign, choice: ModelChoice, now: dict[str, float], before: dict[str, float]) -> list[str]:
    """Return a table of the error of every condition before and now, with the replicate scatter."""
    from vinetrack.core.terminal import table
    from vinetrack.explorer.campaign import overall_m
    from vinetrack.explorer.fitting import model_text

    def cells(values: dict[str, float]) -> list[str]:
        return [f"{1e3 * values[key]:.3f}" if values[key] == values[key] else "–" for key in ("was", "now", "floor")]

    floors = campaign.floors_m
    rows = [
        (campaign.labels[c], *cells({"was": before[c], "now": now[c], "floor": floors.get(c, float("nan"))}))
        for c in campaign.conditions
    ]
    sums = (overall_m(errors, campaign.conditions) for errors in (before, now, floors))
    rows.append(("all", *cells(dict(zip(("was", "now", "floor"), sums, strict=True)))))
    head = ("condition", "model in use", "now", "replicates")
    return [model_text(choice.effects), *table(rows, head, ("", "mm", "mm", "mm"), align="<>>>")]
