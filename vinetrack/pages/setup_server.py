"""HTTP server of the set-up page, on the loopback address only: files, requests, pictures of clips, saving."""

from __future__ import annotations

import base64
import contextlib
import json
import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import ExperimentError, Problem, UserError
from vinetrack.core.records import Correction, Trial
from vinetrack.core.tables import parse_yaml, read_table, safe_join, with_value
from vinetrack.core.units import UNITS, or_nan, other_units, split_unit
from vinetrack.experiment.folder import SETTINGS, check_experiment, read_corrections
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.settings import in_sheet_units, read_experiment_settings
from vinetrack.experiment.sheet import REQUIRED_COLUMNS, SHEET, make_trial, read_row
from vinetrack.figures.style import page_frame
from vinetrack.pages.draft_files import (
    Draft,
    cells_of,
    column_of,
    draft_folder,
    files_stamp,
    list_pictures,
    list_tables,
    open_draft,
    place_block,
    quantity,
    read_sheet,
    shared_values,
    with_shared,
    write_draft,
)
from vinetrack.pages.local_page import (
    LOOPBACK,
    THREAD_PREFIX,
    is_from_page,
    jpeg,
    secret_path,
    serve_on_free_port,
    serve_until_stopped,
)
from vinetrack.pipeline.workflow import check_folder
from vinetrack.tracks.importers import TrackError, read_pressure_trace
from vinetrack.video.axis import Axis
from vinetrack.video.calibration import find_board
from vinetrack.video.curved_axis import axis_entry, axis_through
from vinetrack.video.frames import Frames, Recording, RecordingError, inspect_recording, iterate_frames, read_frames
from vinetrack.video.survey import given_axis, measure_recording, proposed_axis, size_problems, tracked_facts
from vinetrack.video.track import Tracking, track_frames, track_recording

# ------------------------------------------------------------------------------
# Views of a recording for the page: frames as JPEG, the proposed axis, and the result of tracking.

STRIP_PX = 1600  # Longest side of a strip; chosen: twice the page's width on a common screen


def decoded_clip(path: Path, _changed_ns: int) -> tuple[tuple[bytes, ...], dict[str, Any]]:
    """Decode a recording: its frames as JPEG, and their number and size with the axis found from the motion, or the
    reason why there is none.
    """
    frames = read_frames(path)
    height, width = frames.luma.shape[1:]
    found: dict[str, Any] = {"axis": None, "no_axis": ""}
    try:
        found["axis"] = axis_json(proposed_axis(frames.luma))
    except RecordingError as error:
        found["no_axis"] = str(error)
    top = float(np.quantile(frames.luma[0], 0.999)) if frames.luma.dtype != np.uint8 else 255.0
    pictures = tuple(jpeg(luma, white=top) for luma in frames.luma)
    return pictures, {"frames": len(pictures), "width": width, "height": height, **found}


def first_frame(path: Path) -> NDArray[Any]:
    """Return a single picture, or the first frame of a film, as grey levels. Shape (height, width)."""
    frame = next(iterate_frames(inspect_recording(path)), None)
    if frame is None:
        raise RecordingError("no frame can be decoded", name=path.name)
    return frame


def board_in(path: Path, name: str) -> dict[str, Any] | None:
    """The printed board in a picture or at the beginning of a film, as `experiment.yaml` names it, without sizes; None
    if there is no board.
    """
    if (target := find_board(first_frame(path))) is None:
        return None
    markers = {"dictionary": target.dictionary, "marker_share": round(target.marker_share, 3)}
    board = {"kind": target.kind, "image": name, "squares": list(target.squares)}
    return board | (markers if target.kind == "charuco" else {})


def axis_json(axis: Axis) -> dict[str, Any]:
    """Return an axis for the page, px to a hundredth; for a curve with equally spaced points along it, `path_px`."""
    entry = {name: np.round(points, 2).tolist() for name, points in axis_entry(axis).items()}
    if axis.bends:
        # 4.0: spacing of the points of a curve sent to the page, px (chosen)
        along = np.linspace(0.0, axis.length_px, max(2, round(axis.length_px / 4.0)))
        entry["path_px"] = axis.points(along).round(2).tolist()
    return {**entry, "width_px": _rounded(axis.width_px, 2)}


def track_row(folder: Path, index: int) -> dict[str, Any]:
    """Track the recording of one row, which may be incomplete: strip, edge and notes. Without a scale positions are in
    pixels, without a rate times are in frames, see `scaled` and `timed`.
    """
    settings = read_experiment_settings(folder / SETTINGS)
    table = in_sheet_units(read_table(folder / SHEET), SHEET)[0]
    trial = make_trial(read_row(table, index, settings), folder, settings)
    trial = replace(trial, corrections=read_corrections(folder)[0].get(trial.name, ()))
    timed = math.isfinite(trial.capture_fps)
    scaled = settings.calibration is not None or math.isfinite(trial.m_per_px)
    if not timed and trial.video is not None:
        rate = inspect_recording(trial.video).capture_fps
        timed = rate is not None
        trial = replace(trial, capture_fps=rate or 1.0, exposure_s=trial.exposure_s if timed else math.nan)
    remarks: list[str] = []
    growth_mm = m_per_px = math.nan
    if scaled:
        measurement = measure_recording(trial, settings, folder)
        tracking, m_per_px, facts = measurement.tracking, measurement.m_per_px, tracked_facts(trial, measurement)
        growth_mm, remarks = facts.growth_mm, [problem.reason for problem in size_problems(trial, facts)]
    else:
        # Widths are in millimetres: without a scale the axis has none.
        tracking = track_recording(trial, given_axis(trial, settings, math.nan))
    track = tracking.track
    return {
        "strip": _strip_url(tracking),
        "length_px": round(tracking.axis.length_px, 2),
        "axis": axis_json(tracking.axis),
        "time_s": _numbers(track.time_s, 6),
        "edge_px": _numbers(track.edge_px, 2),
        "position_mm": _numbers(1e3 * track.lead_position_m, 3),
        "tracked_px": _numbers(track.edge_px if track.tracked_px is None else track.tracked_px, 2),
        "flag": [str(flag) for flag in track.flag],
        "shake_px": _numbers(tracking.shake_px, 2),
        "mm_per_px": _rounded(1e3 * m_per_px, 6),
        "growth_mm": _rounded(growth_mm, 2),
        "tube_width_mm": _rounded(1e3 * m_per_px * tracking.tube_width_px, 2),
        "timed": timed,
        "scaled": scaled,
        "notes": [*remarks, *track.notes],
        "pressure": _pressure_json(trial),
    }


def warm_up() -> None:
    """Track a rendered bar, so that the tracker is compiled before the user needs it."""
    rng = np.random.default_rng(1)
    luma = rng.normal(60, 2, (30, 64, 240)).clip(0, 255).astype(np.uint8)
    for i, frame in enumerate(luma):
        frame[24:40, : 20 + max(0, i - 6) * 7] = 180
    recording = Recording(Path("warm-up"), "container", 240, 64, 8, len(luma))
    frames = Frames(recording, luma, np.arange(len(luma)), np.zeros(len(luma), dtype=bool))
    try:
        track_frames(frames, Trial(name="warm-up", capture_fps=1000.0), 1000.0)
    except RecordingError:
        # Only the compilation matters.
        return


def _strip_url(tracking: Tracking) -> str:
    strip = tracking.kymograph
    dark, light = np.nanpercentile(strip, [1, 99])
    # Grey level of the strip where no frame was decoded (chosen)
    grey = np.full((len(tracking.track.time_s), strip.shape[1]), 128, np.uint8)
    grey[tracking.strip_rows] = (255 * (strip - dark) / max(float(light - dark), 1.0)).clip(0, 255).astype(np.uint8)
    # Time to the right, growth upwards.
    turned = np.ascontiguousarray(np.flipud(grey.T))
    size = (min(turned.shape[1], STRIP_PX), min(turned.shape[0], STRIP_PX))
    small = cv2.resize(turned, size, interpolation=cv2.INTER_AREA)
    return "data:image/jpeg;base64," + base64.b64encode(jpeg(small)).decode()


def _pressure_json(trial: Trial) -> dict[str, Any] | None:
    """The pressure trace of a trial, or the reason why it cannot be read; None if there is none."""
    if trial.pressure_trace is None:
        return None
    try:
        time_s, pressure_Pa = read_pressure_trace(trial.pressure_trace)
    except (TrackError, OSError) as error:
        return {"words": str(error)}
    every = max(1, len(time_s) // STRIP_PX)
    return {"time_s": _numbers(time_s[::every], 6), "pressure_kPa": _numbers(pressure_Pa[::every] / 1e3, 4)}


def _numbers(values: NDArray[Any], digits: int) -> list[float | None]:
    return [_rounded(float(value), digits) for value in values]


def _rounded(value: float, digits: int) -> float | None:
    """A number for JSON, None for NaN."""
    return round(value, digits) if math.isfinite(value) else None


# ------------------------------------------------------------------------------
# Data exchanged between page and files: available columns, cells, settings, and problems with their fields.


def page_state(folder: Path) -> dict[str, Any]:
    """Return the initial state of the page, of JSON types."""
    draft, present = open_draft(folder), read_sheet(folder)
    content = parse_yaml(draft.settings, SETTINGS).content
    sheet = draft.sheet
    # Columns that the page shows whether or not the sheet has them
    optional = ["payload_g", "growth_angle_deg", "chamber_l", "exposure_us", "pressure_trace"]
    known = {}
    for name in [name for name in COLUMNS if name not in ("trial", "video")]:
        units = [split_unit(name)[1], *other_units(name).values()]
        known[name] = {key: getattr(COLUMNS[name], key) for key in ("kind", "meaning", "measured", "default", "shared")}
        known[name] |= {"quantity": quantity(name), "units": units if len(units) > 1 else []}
    return {
        "name": folder.resolve().name,
        "folder": str(folder),
        "stamp": draft.stamp,
        "known": known,
        "units": {key: unit.text for key, unit in UNITS.items()},
        "offered": ["capture_fps", *REQUIRED_COLUMNS, *optional],
        "sheet": {"columns": list(sheet.columns), "rows": list(sheet.rows), "decimal": sheet.decimal},
        "kept": list(present.columns) if present.rows else ["trial", "video"],
        "unsaved": not (folder / SETTINGS).exists() or not present.rows or cells_of(present) != cells_of(sheet),
        "shared": {key: str(value) for key, value in shared_values(draft.settings).items()},
        "calibration": content.get("calibration"),
        "axis": content.get("axis"),
        "corrections": {
            trial: [vars(point) | {"edge_px": _rounded(point.edge_px, 2)} for point in given]
            for trial, given in draft.corrections.items()
        },
        "pictures": list_pictures(folder),
        "traces": list_tables(folder),
    }


def draft_from_json(folder: Path, content: Mapping[str, Any]) -> Draft:
    """Return the draft sent by the page; comments and keys unknown to the page come from the files."""
    from_files = open_draft(folder)
    columns = tuple(map(str, content["sheet"]["columns"]))
    rows = tuple({name: str(row.get(name, "")) for name in columns} for row in content["sheet"]["rows"])
    sheet = replace(from_files.sheet, columns=columns, rows=rows)
    text = with_shared(from_files.settings, {str(key): str(cell) for key, cell in content["shared"].items()})
    present = parse_yaml(text, SETTINGS).content
    for key in ("calibration", "axis"):
        value = content.get(key)
        if value is not None or present.get(key) is not None:
            text = with_value(text, key, value, SETTINGS)
    corrections = {}
    for trial, points in content.get("corrections", {}).items():
        given = [Correction(int(one["frame"]), str(one["action"]), or_nan(one["edge_px"])) for one in points]
        if given:
            corrections[str(trial)] = tuple(sorted(given, key=lambda correction: correction.frame))
    return Draft(sheet, text, str(content["stamp"]), corrections)


def draft_problems(folder: Path, draft: Draft, thorough: bool = False) -> dict[str, Any]:
    """Return the messages of `vinetrack check` for a draft, of JSON types: `problems`, each with the field concerned,
    `notes`, and what was `understood` of each recording.
    """
    with draft_folder(folder, draft) as copy:
        checked = check_folder(copy) if thorough else None
        problems = [*check_experiment(copy), *_scale_missing(draft)] if checked is None else checked.problems
    return {
        "problems": [_problem_json(problem, draft.sheet.columns) for problem in problems],
        "notes": list(checked.notes) if checked else [],
        "understood": list(checked.recording_lines) if checked else [],
    }


def _scale_missing(draft: Draft) -> list[Problem]:
    """The problem that the check of recordings would report for a missing scale."""
    content = parse_yaml(draft.settings, SETTINGS).content
    has_scale = content.get("calibration") is not None or content.get("mm_per_px") is not None
    if has_scale or not any(row.get("video") and not row.get("mm_per_px") for row in draft.sheet.rows):
        return []
    remedy = "click two marks on a ruler, or choose a picture of a printed board"
    message = "is missing: no recording has a scale"
    return [Problem("missing", message, "calibration", file=SETTINGS, remedy=remedy)]


def _problem_json(problem: Problem, columns: Sequence[str] = ()) -> dict[str, Any]:
    """A problem with its field: a cell of the sheet, a row, a value for all trials, the scale, the axis, or `whole`;
    its column is that of the sheet, which may have another unit.
    """
    column = problem.column
    if column.split(".")[0] in ("calibration", "axis") and not problem.trial:
        field = column.split(".")[0]
    elif problem.trial:
        field = "cell" if column else "row"
    else:
        field = "shared" if column_of(column, COLUMNS) in COLUMNS else "whole"
    told = {key: getattr(problem, key) for key in ("severity", "trial", "code", "of_a_measurement")}
    return {**told, "field": field, "column": column_of(column, columns), "text": problem.reason}


log = logging.getLogger(__name__)

TEMPLATES = Path(__file__).with_name("templates")


class SetupServer(ThreadingHTTPServer):
    """A server for one folder, bound to the loopback address."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, folder: Path, port: int) -> None:
        super().__init__((LOOPBACK, port), _Handler)
        self.folder = folder
        self.secret = secret_path()
        self.tracking, self._decoding = threading.Lock(), threading.Lock()
        self._decoded = lru_cache(2)(decoded_clip)  # of the current and the previous recording

    @property
    def address(self) -> str:
        """The address of the page."""
        return f"http://{LOOPBACK}:{self.server_port}{self.secret}/"

    def clip(self, recording: str) -> tuple[tuple[bytes, ...], dict[str, Any]]:
        """Return what `decoded_clip` returns of a recording as it is now."""
        path = safe_join(self.folder, recording)
        with self._decoding:
            return self._decoded(path, path.stat().st_mtime_ns if path.exists() else 0)

    def frame(self, recording: str, number: int) -> bytes:
        """Return a frame as JPEG; beyond the last or before the first, that one."""
        frames, _ = self.clip(recording)
        return frames[min(max(number, 0), len(frames) - 1)]

    def picture(self, name: str, widest: int | None = None) -> bytes:
        """Return a single picture or the first frame of a film as JPEG, without decoding more."""
        return jpeg(first_frame(safe_join(self.folder, name)), widest)

    def check(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Return the problems of a draft, and its files."""
        draft = draft_from_json(self.folder, content)
        texts = dict(zip(("sheet_text", "settings_text", "corrections_text"), draft.texts().values(), strict=True))
        if not draft.corrections:
            texts["corrections_text"] = ""
        return draft_problems(self.folder, draft, thorough=bool(content.get("thorough"))) | texts

    def track(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Track the recording of one row of a draft."""
        draft = draft_from_json(self.folder, content)
        with self.tracking, draft_folder(self.folder, draft) as copy:
            return track_row(copy, int(content["row"]))

    def save(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Write a draft."""
        written = write_draft(self.folder, draft_from_json(self.folder, content))
        return {"written": written, "stamp": files_stamp(self.folder)}


# Answers by method and path, from the query or the JSON of a request: bytes are a JPEG, all else is JSON
ANSWERS: dict[str, Callable[[SetupServer, Mapping[str, Any]], bytes | Mapping[str, Any] | None]] = {
    "GET /api/state": lambda server, _: page_state(server.folder),
    "GET /api/clip": lambda server, given: server.clip(given["recording"])[1],
    "GET /api/frame": lambda server, given: server.frame(given["recording"], int(given["frame"])),
    # 220: width of the pictures in the list; chosen: as wide as its column
    "GET /api/thumbnail": lambda server, given: server.picture(given["recording"], 220),
    "GET /api/picture": lambda server, given: server.picture(given["picture"]),
    "GET /api/curve": lambda _, given: axis_json(axis_through([p.split(",") for p in given["points"].split(";")])),
    "GET /api/board": lambda server, given: board_in(safe_join(server.folder, given["picture"]), given["picture"]),
    "POST /api/check": SetupServer.check,
    "POST /api/paste": lambda _, given: dict(zip(("cells", "notes"), place_block(**given), strict=True)),
    "POST /api/track": SetupServer.track,
    "POST /api/save": SetupServer.save,
}


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
        name = "setup.html" if url.path == "/" else url.path.removeprefix("/")
        kind = {"js": "text/javascript", "css": "text/css", "html": "text/html"}.get(name.rpartition(".")[2])
        if kind and "/" not in name and (TEMPLATES / name).is_file():
            frame = page_frame().encode() if name.endswith(".css") else b""
            self._send(HTTPStatus.OK, frame + (TEMPLATES / name).read_bytes(), f"{kind}; charset=utf-8")
        else:
            self._answer(f"GET {url.path}", lambda: dict(parse_qsl(url.query)))

    def do_POST(self) -> None:
        """Check, track or save a draft."""
        if not self._is_authorised():
            return
        length = int(self.headers.get("Content-Length") or 0)
        # Header required for requests that change or compute something
        # 20 MB: chosen: a sheet of ten thousand rows takes a few megabytes
        if self.headers.get("X-Vinetrack") != "setup" or not 0 < length <= 20_000_000:
            self._refuse()
            return
        body = self.rfile.read(length)
        self._answer(f"POST {self.path.removeprefix(self.server.secret)}", lambda: json.loads(body))

    def _is_authorised(self) -> bool:
        """Whether the request comes from this server's page and has its secret."""
        has_secret = self.path.startswith(f"{self.server.secret}/")
        if has_secret and is_from_page(self.headers, self.server.server_port):
            return True
        self._refuse()
        return False

    def _refuse(self) -> None:
        self.close_connection = True
        self._send(HTTPStatus.FORBIDDEN)

    def _answer(self, route: str, given: Callable[[], Mapping[str, Any]]) -> None:
        """Send an answer; errors of the input are sent as a sentence."""
        if route not in ANSWERS:
            self._send(HTTPStatus.NOT_FOUND)
            return
        status = HTTPStatus.UNPROCESSABLE_ENTITY
        content: bytes | Mapping[str, Any] | None
        try:
            content, status = ANSWERS[route](self.server, given()), HTTPStatus.OK
        except ExperimentError as error:
            content = {"problems": [_problem_json(problem) for problem in error.problems], "words": str(error)}
        except (UserError, RecordingError) as error:
            content = {"words": str(error)}
        except (KeyError, ValueError, TypeError, OSError) as error:
            log.exception("%s", self.path)
            content, status = {"words": f"{type(error).__name__}: {error}"}, HTTPStatus.BAD_REQUEST
        if isinstance(content, bytes):
            self._send(status, content, "image/jpeg")
        else:
            self._send(status, json.dumps(content, ensure_ascii=False).encode(), "application/json")

    def _send(self, status: HTTPStatus, data: bytes = b"", kind: str = "text/plain; charset=utf-8") -> None:
        sources = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'"
        headers = {"Content-Type": kind, "Content-Length": str(len(data))}
        # Nothing is kept, and nothing is asked of another server
        headers |= {"Cache-Control": "no-store", "Content-Security-Policy": sources}
        headers |= {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)


def start_server(folder: Path, port: int | None = None) -> SetupServer:
    """Return a server for a folder that does not answer requests yet."""
    return serve_on_free_port(lambda number: SetupServer(folder, number), port)


def serve(folder: Path, say: Callable[[str], None], port: int | None = None, *, browser: bool = True) -> None:
    """Serve until Ctrl-C (or SIGTERM)."""
    page_state(folder)
    server = start_server(folder, port)
    threading.Thread(target=warm_up, daemon=True, name=f"{THREAD_PREFIX}warm-up").start()
    # A shutdown from the serving thread would wait for itself.
    end = threading.Thread(target=server.shutdown, daemon=True).start
    try:
        serve_until_stopped(
            "Set-up", server.address, lambda: server.serve_forever(poll_interval=0.2), end, say, browser=browser
        )
    finally:
        server.server_close()


# ------------------------------------------------------------------------------
# The command `vinetrack setup` without its page: the two files with blanks to fill.


def write_templates(folder: Path, say: Callable[[str], None]) -> None:
    """Write the sheet and settings of a folder of recordings, with blanks to fill; existing content is kept."""
    draft = open_draft(folder)
    written = write_draft(folder, draft)
    rows = draft.sheet.rows
    filled = [name for name in draft.sheet.columns if name not in ("trial", "video") and any(r.get(name) for r in rows)]
    for name in written:
        say(f"Written: {folder / name}")
    if not written:
        say(f"{SHEET} and {SETTINGS} of {folder} already contain every recording.")
    say(f"{len(rows)} trials; from the names of recordings: {', '.join(filled) if filled else 'nothing'}.")
    problems = [*check_experiment(folder), *_scale_missing(draft)]
    errors = [problem for problem in problems if problem.severity == "error" and problem.column]
    missing = {problem.column for problem in errors if problem.code in ("missing", "blank")}
    blanks = [*(name for name in COLUMNS if name in missing), *sorted(missing - COLUMNS.keys())]
    if blanks:
        say(f"To fill in: {', '.join(blanks)}. A value that all trials share goes into {SETTINGS}.")
    say(f"Then: vinetrack check {folder}")
