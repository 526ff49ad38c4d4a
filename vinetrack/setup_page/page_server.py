"""HTTP server of the page, on the loopback address only: its files, its requests, and saving."""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import webbrowser
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from vinetrack.core.local_page import (
    LOOPBACK,
    THREAD_PREFIX,
    allowed_hosts,
    secret_path,
    serve_on_free_port,
    stop_on_signals,
)
from vinetrack.core.problems import ExperimentError, UserError
from vinetrack.experiment.corrections import corrections_text
from vinetrack.setup_page.clip_views import ClipStore, jpeg, track_row, warm_up
from vinetrack.setup_page.draft_files import draft_folder, files_stamp, write_draft
from vinetrack.setup_page.page_state import draft_from_json, draft_problems, page_state, problems_json
from vinetrack.video.frames import RecordingError

log = logging.getLogger(__name__)

TEMPLATES = Path(__file__).with_name("templates")
MAX_REQUEST_BYTES = 20_000_000  # Chosen: a sheet of ten thousand rows takes a few megabytes

REQUEST_HEADER = "X-Vinetrack"  # Header required for requests that change or compute something

CONTENT_TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html"}
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'"
)


class SetupServer(ThreadingHTTPServer):
    """A server for one folder, bound to the loopback address."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, folder: Path, port: int) -> None:
        super().__init__((LOOPBACK, port), _Handler)
        self.folder = folder
        self.secret = secret_path()
        self.clips = ClipStore(folder)
        self.tracking = threading.Lock()

    @property
    def address(self) -> str:
        """The address of the page."""
        return f"http://{LOOPBACK}:{self.server_port}{self.secret}/"


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    server: SetupServer
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        log.info(format, *args)

    def do_GET(self) -> None:
        """Serve files of the page, frames and pictures."""
        if not self._is_authorised():
            return
        url = urlsplit(self.path.removeprefix(self.server.secret))
        query = {key: values[0] for key, values in parse_qs(url.query).items()}
        if url.path in ("/", "/setup.css") or url.path.endswith(".js"):
            self._send_file("setup.html" if url.path == "/" else url.path.lstrip("/"))
            return
        clips = self.server.clips
        answers: dict[str, Callable[[], bytes | dict[str, Any] | None]] = {
            "/api/state": lambda: page_state(self.server.folder),
            "/api/clip": lambda: clips.clip(query["recording"]).to_json(),
            "/api/frame": lambda: _frame(clips, query["recording"], int(query["frame"])),
            "/api/thumbnail": lambda: clips.thumbnail(query["recording"]),
            "/api/picture": lambda: jpeg(clips.picture(query["picture"])),
            "/api/board": lambda: clips.board(query["picture"]),
        }
        self._answer(answers.get(url.path))

    def do_POST(self) -> None:
        """Check, track or save a draft."""
        if not self._is_authorised():
            return
        length = int(self.headers.get("Content-Length") or 0)
        if self.headers.get(REQUEST_HEADER) != "setup" or not 0 < length <= MAX_REQUEST_BYTES:
            self.close_connection = True
            self._send(HTTPStatus.FORBIDDEN, b"", "text/plain")
            return
        body = self.rfile.read(length)
        answers: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "/api/check": self._check,
            "/api/track": self._track,
            "/api/save": self._save,
        }
        handler = answers.get(self.path.removeprefix(self.server.secret))
        self._answer(None if handler is None else lambda: handler(json.loads(body)))

    def _check(self, content: dict[str, Any]) -> dict[str, Any]:
        draft = draft_from_json(self.server.folder, content)
        checked = draft_problems(self.server.folder, draft, thorough=bool(content.get("thorough")))
        texts = {"sheet_text": draft.sheet.text(), "settings_text": draft.settings}
        return {
            **checked,
            **texts,
            "corrections_text": corrections_text(draft.corrections) if draft.corrections else "",
        }

    def _track(self, content: dict[str, Any]) -> dict[str, Any]:
        draft = draft_from_json(self.server.folder, content)
        with self.server.tracking, draft_folder(self.server.folder, draft) as copy:
            return track_row(copy, int(content["row"]))

    def _save(self, content: dict[str, Any]) -> dict[str, Any]:
        folder = self.server.folder
        draft = draft_from_json(folder, content)
        written = write_draft(folder, draft)
        return {"written": written, "stamp": files_stamp(folder)}

    def _is_authorised(self) -> bool:
        """Whether the request has the host name and the secret of this server (protects against DNS rebinding)."""
        hosts = allowed_hosts(self.server.server_port)
        origin = self.headers.get("Origin")
        is_ours = self.headers.get("Host") in hosts and (
            origin is None or origin in {f"http://{host}" for host in hosts}
        )
        if is_ours and self.path.startswith(f"{self.server.secret}/"):
            return True
        self.close_connection = True
        self._send(HTTPStatus.FORBIDDEN, b"", "text/plain")
        return False

    def _answer(self, answer: Callable[[], bytes | dict[str, Any] | None] | None) -> None:
        """Send bytes as JPEG and everything else as JSON; errors of the input are sent as a sentence."""
        if answer is None:
            self._send(HTTPStatus.NOT_FOUND, b"", "text/plain")
            return
        try:
            content = answer()
        except ExperimentError as error:
            self._send_json({"problems": problems_json(error), "words": str(error)}, HTTPStatus.UNPROCESSABLE_ENTITY)
        except (UserError, RecordingError) as error:
            self._send_json({"words": str(error)}, HTTPStatus.UNPROCESSABLE_ENTITY)
        except (KeyError, ValueError, TypeError, OSError) as error:
            log.exception("%s", self.path)
            self._send_json({"words": f"{type(error).__name__}: {error}"}, HTTPStatus.BAD_REQUEST)
        else:
            if isinstance(content, bytes):
                self._send(HTTPStatus.OK, content, "image/jpeg")
            else:
                self._send_json(content, HTTPStatus.OK)

    def _send_json(self, content: Any, status: HTTPStatus) -> None:
        self._send(status, json.dumps(content, ensure_ascii=False).encode(), "application/json")

    def _send_file(self, name: str) -> None:
        path = TEMPLATES / name
        if "/" in name or not path.is_file():
            self._send(HTTPStatus.NOT_FOUND, b"", "text/plain")
            return
        data = path.read_bytes()
        if path.suffix == ".css":
            from vinetrack.figures.page_tokens import page_frame

            data = page_frame().encode() + data
        self._send(HTTPStatus.OK, data, CONTENT_TYPES[path.suffix])

    def _send(self, status: HTTPStatus, data: bytes, kind: str) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.send_response(status)
            charset = "; charset=utf-8" if kind.startswith("text/") else ""
            self.send_header("Content-Type", kind + charset)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("Content-Security-Policy", CONTENT_SECURITY_POLICY)
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            self.wfile.write(data)


def _frame(clips: ClipStore, recording: str, number: int) -> bytes:
    frames = clips.clip(recording).frames
    return frames[min(max(number, 0), len(frames) - 1)]


def start_server(folder: Path, port: int | None = None) -> SetupServer:
    """Return a server for a folder that does not answer requests yet."""
    return serve_on_free_port(lambda number: SetupServer(folder, number), port)


def serve(folder: Path, say: Callable[[str], None], port: int | None = None, *, browser: bool = True) -> None:
    """Serve until Ctrl-C (or SIGTERM)."""
    page_state(folder)
    server = start_server(folder, port)
    threading.Thread(target=warm_up, daemon=True, name=f"{THREAD_PREFIX}warm-up").start()
    say(f"Set-up: {server.address}")
    say("For this machine only. Ctrl-C ends it.")
    if browser:
        threading.Thread(target=webbrowser.open, args=(server.address,), daemon=True).start()
    # A shutdown from the serving thread would wait for itself.
    with stop_on_signals(lambda: threading.Thread(target=server.shutdown, daemon=True).start()):
        server.serve_forever(poll_interval=0.2)
    server.server_close()
    say("Set-up ended.")
