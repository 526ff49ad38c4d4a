"""HTTP server of the set-up page, on the loopback address only: files, requests, pictures of clips, saving."""

from __future__ import annotations

import base64
import contextlib
import json
import logging
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import ExperimentError, Problem, UserError
from vinetrack.core.records import Correction, Trial
from vinetrack.core.tables import list_recordings, parse_yaml, safe_join, with_value
from vinetrack.core.units import UNITS, split_unit
from vinetrack.experiment.folder import SETTINGS, check_experiment, corrections_text, read_corrections
from vinetrack.experiment.schema import COLUMNS, SHARED
from vinetrack.experiment.settings import ExperimentSettings, read_experiment_settings
from vinetrack.experiment.sheet import REQUIRED_COLUMNS, SHEET, read_row
from vinetrack.pages.draft_files import (
    Draft,
    SheetDraft,
    draft_folder,
    files_stamp,
    list_pictures,
    list_tables,
    open_draft,
    place_block,
    read_draft,
    same_cells,
    shared_values,
    units_of,
    with_shared,
    write_draft,
)
from vinetrack.pages.local_page import (
    LOOPBACK,
    THREAD_PREFIX,
    allowed_hosts,
    jpeg,
    secret_path,
    serve_on_free_port,
    serve_until_stopped,
)
from vinetrack.tracks.importers import TrackError, read_pressure_trace
from vinetrack.video.axis import Axis
from vinetrack.video.calibration import find_board
from vinetrack.video.curved_axis import CurvedAxis, axis_through
from vinetrack.video.frames import RecordingError, inspect_recording, iterate_frames, read_frames
from vinetrack.video.survey import Measurement, measure_recording, proposed_axis, size_problems, tracked_facts
from vinetrack.video.track import Tracking, track_recording

# ------------------------------------------------------------------------------
# Views of a recording for the page: frames as JPEG, the proposed axis, and the result of tracking.

STRIP_PX = 1600  # Longest side of a strip; chosen: twice the page's width on a common screen


@dataclass(frozen=True)
class DecodedClip:
    """A decoded recording: its frames as JPEG, and the axis found from the motion, or the reason why there is none."""

    frames: tuple[bytes, ...]
    width: int
    height: int
    axis: Axis | None
    no_axis: str
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return what the page needs before it requests a frame."""
        axis = None if self.axis is None else axis_json(self.axis)
        size = {"frames": len(self.frames), "width": self.width, "height": self.height}
        return {**size, "axis": axis, "no_axis": self.no_axis, "notes": list(self.notes)}


class ClipStore:
    """Cache of decoded recordings of a folder. Thread-safe."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._clips: OrderedDict[tuple[str, int], DecodedClip] = OrderedDict()
        self._lock = threading.Lock()

    def clip(self, recording: str) -> DecodedClip:
        """Return a decoded recording, from the cache if possible."""
        path = safe_join(self.folder, recording)
        key = (recording, path.stat().st_mtime_ns if path.exists() else 0)
        with self._lock:
            if key not in self._clips:
                self._clips[key] = _decoded(path)
                # Recordings whose frames are cached; chosen: the current and the previous one
                while len(self._clips) > 2:
                    self._clips.popitem(last=False)
            self._clips.move_to_end(key)
            return self._clips[key]

    def thumbnail(self, recording: str) -> bytes:
        """Return the first frame as a small JPEG, without decoding more."""
        # Width of the pictures in the list; chosen: as wide as its column
        return jpeg(_first_frame(safe_join(self.folder, recording)), 220)

    def picture(self, name: str) -> NDArray[Any]:
        """Return a single picture, or the first frame of a film, as grey levels. Shape (height, width)."""
        return _first_frame(safe_join(self.folder, name))

    def board(self, name: str) -> dict[str, Any] | None:
        """The printed board in a picture or at the beginning of a film, as `experiment.yaml` names it, without sizes.
        Returns mapping of JSON types; None if there is no board.
        """
        target = find_board(self.picture(name))
        if target is None:
            return None
        board: dict[str, Any] = {"kind": target.kind, "image": name, "squares": list(target.squares)}
        if target.kind == "charuco":
            board |= {"dictionary": target.dictionary, "marker_share": round(target.marker_share, 3)}
        return board


def _first_frame(path: Path) -> NDArray[Any]:
    frame = next(iterate_frames(inspect_recording(path)), None)
    if frame is None:
        raise RecordingError("no frame can be decoded", name=path.name)
    return frame


def _decoded(path: Path) -> DecodedClip:
    frames = read_frames(path)
    height, width = frames.luma.shape[1:]
    try:
        axis, no_axis = proposed_axis(frames.luma), ""
    except RecordingError as error:
        axis, no_axis = None, str(error)
    top = float(np.quantile(frames.luma[0], 0.999)) if frames.luma.dtype != np.uint8 else 255.0
    pictures = tuple(jpeg(luma, white=top) for luma in frames.luma)
    return DecodedClip(pictures, width, height, axis, no_axis, frames.notes)


def axis_json(axis: Axis) -> dict[str, Any]:
    """Return an axis for the page, px to a hundredth. Returns mapping of JSON types: `from_px`, `to_px`, for a curve
    `via_px` and equally spaced points along it, `path_px`; and: `width_px`, None if unknown.
    """
    width = round(axis.width_px, 2) if math.isfinite(axis.width_px) else None
    ends: dict[str, Any] = {"from_px": [round(v, 2) for v in axis.from_px], "to_px": [round(v, 2) for v in axis.to_px]}
    if isinstance(axis, CurvedAxis):
        ends["via_px"] = [[round(v, 2) for v in point] for point in axis.via_px]
        # 4.0: spacing of the points of a curve sent to the page, px (chosen)
        along = np.linspace(0.0, axis.length_px, max(2, round(axis.length_px / 4.0)))
        ends["path_px"] = axis.points(along).round(2).tolist()
    return {**ends, "width_px": width}


def track_row(folder: Path, index: int) -> dict[str, Any]:
    """Track the recording of one row, which may be incomplete: strip, edge and notes. Returns mapping of JSON types:
    Without a scale positions are in pixels, without a rate times are in frames, see `scaled` and `timed`.
    """
    from vinetrack.core.tables import read_table
    from vinetrack.experiment.settings import in_sheet_units

    settings = read_experiment_settings(folder / SETTINGS)
    table = in_sheet_units(read_table(folder / SHEET), SHEET)[0]
    trial = _trial_of(read_row(table, index, settings).values, folder)
    given = read_corrections(folder)[0].get(table.rows[index].get("trial", ""), ())
    trial = replace(trial, corrections=given)
    timed = math.isfinite(trial.capture_fps)
    scaled = settings.calibration is not None or math.isfinite(trial.m_per_px)
    if not timed and trial.video is not None:
        rate = inspect_recording(trial.video).capture_fps
        timed = rate is not None
        trial = replace(trial, capture_fps=rate or 1.0, exposure_s=trial.exposure_s if timed else math.nan)
    remarks: list[str] = []
    measurement = None
    if scaled:
        measurement = measure_recording(trial, settings, folder)
        tracking = measurement.tracking
        remarks = [problem.reason for problem in size_problems(trial, tracked_facts(trial, measurement))]
    else:
        tracking = track_recording(trial, _axis_of(trial, settings))
    return {
        **_track_json(tracking),
        **_scale_json(measurement),
        "timed": timed,
        "scaled": scaled,
        "notes": [*remarks, *tracking.track.notes],
        "pressure": _pressure_json(trial),
    }


def warm_up() -> None:
    """Track a rendered bar, so that the tracker is compiled before the user needs it."""
    from vinetrack.video.frames import Frames, Recording
    from vinetrack.video.track import track_frames

    rng = np.random.default_rng(1)
    luma = rng.normal(60, 2, (30, 64, 240)).clip(0, 255).astype(np.uint8)
    for i, frame in enumerate(luma):
        frame[24:40, : 20 + max(0, i - 6) * 7] = 180
    recording = Recording(Path("warm-up"), "container", 240, 64, 8, len(luma))
    frames = Frames(recording, recording.whole, luma, np.arange(len(luma)), np.zeros(len(luma), dtype=bool))
    try:
        track_frames(frames, Trial(name="warm-up", capture_fps=1000.0), 1000.0)
    except RecordingError:
        # Only the compilation matters.
        return


def _trial_of(values: dict[str, Any], folder: Path) -> Trial:
    """A trial made of the readable cells; the others keep their defaults."""
    fields: dict[str, Any] = {}
    for name, value in values.items():
        column = COLUMNS[name]
        if column.kind == "path":
            fields[column.field] = safe_join(folder, value)
        else:
            fields[column.field] = column.to_si(float(value)) if column.kind in ("number", "choice") else value
    return Trial(**{"name": "trial", **fields})


def _axis_of(trial: Trial, settings: ExperimentSettings) -> Axis | None:
    """The given axis without its width, which is in millimetres, because there is no scale."""
    given = trial.axis or settings.axis
    if given is None:
        return None
    return axis_through((given.from_px, *(given.via_px or ()), given.to_px))


def _track_json(tracking: Tracking) -> dict[str, Any]:
    track, strip = tracking.track, tracking.kymograph
    dark, light = np.nanpercentile(strip, [1, 99])
    # Grey level of the strip where no frame was decoded (chosen)
    grey = np.full((len(track.time_s), strip.shape[1]), 128, np.uint8)
    grey[tracking.strip_rows] = (255 * (strip - dark) / max(float(light - dark), 1.0)).clip(0, 255).astype(np.uint8)
    import cv2

    # Time to the right, growth upwards.
    turned = np.ascontiguousarray(np.flipud(grey.T))
    size = (min(turned.shape[1], STRIP_PX), min(turned.shape[0], STRIP_PX))
    small = cv2.resize(turned, size, interpolation=cv2.INTER_AREA)
    return {
        "strip": "data:image/jpeg;base64," + base64.b64encode(jpeg(small)).decode(),
        "length_px": round(tracking.axis.length_px, 2),
        "axis": axis_json(tracking.axis),
        "time_s": _numbers(track.time_s, 6),
        "edge_px": _numbers(track.edge_px, 2),
        "position_mm": _numbers(1e3 * track.lead_position_m, 3),
        "tracked_px": _numbers(track.edge_px if track.tracked_px is None else track.tracked_px, 2),
        "flag": [str(flag) for flag in track.flag],
        "shake_px": _numbers(tracking.shake_px, 2),
    }


def _scale_json(measurement: Measurement | None) -> dict[str, Any]:
    if measurement is None:
        return {"mm_per_px": None, "growth_mm": None, "tube_width_mm": None}
    mm = 1e3 * measurement.m_per_px
    width = mm * measurement.tracking.tube_width_px
    return {
        "mm_per_px": _numbers(np.array([mm]), 6)[0],
        "growth_mm": _numbers(np.array([1e3 * measurement.growth_m]), 2)[0],
        "tube_width_mm": _numbers(np.array([width]), 2)[0],
    }


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
    """Rounded numbers for JSON, with None for NaN."""
    return [round(float(value), digits) if math.isfinite(value) else None for value in np.asarray(values, float)]


# ------------------------------------------------------------------------------
# Data exchanged between page and files: available columns, cells, settings, and problems with their fields.

# Columns that the page always shows, whether or not the sheet has them
OFFERED_COLUMNS = (
    "capture_fps",
    *REQUIRED_COLUMNS,
    "payload_g",
    "growth_angle_deg",
    "chamber_l",
    "exposure_us",
    "pressure_trace",
)


def page_state(folder: Path) -> dict[str, Any]:
    """Return the initial state of the page. Returns mapping of JSON types."""
    draft = open_draft(folder)
    present = read_draft(folder)
    content = parse_yaml(draft.settings, SETTINGS).content
    shared = {key: str(value) for key, value in shared_values(draft.settings).items()}
    return {
        "name": folder.resolve().name,
        "folder": str(folder),
        "stamp": draft.stamp,
        "known": {name: _column_json(name) for name in COLUMNS if name not in ("trial", "video")},
        "units": {key: unit.text for key, unit in UNITS.items()},
        "offered": list(OFFERED_COLUMNS),
        "sheet": {
            "columns": list(draft.sheet.columns),
            "rows": [dict(row) for row in draft.sheet.rows],
            "delimiter": draft.sheet.delimiter,
            "decimal": draft.sheet.decimal,
        },
        "kept": list(present.columns) if present.rows else ["trial", "video"],
        "unsaved": not (folder / SETTINGS).exists() or not present.rows or not same_cells(present, draft.sheet),
        "shared": shared,
        "calibration": content.get("calibration"),
        "axis": content.get("axis"),
        "corrections": {
            trial: [
                vars(correction) | {"edge_px": correction.edge_px if math.isfinite(correction.edge_px) else None}
                for correction in given
            ]
            for trial, given in draft.corrections.items()
        },
        "recordings": list_recordings(folder),
        "pictures": list_pictures(folder),
        "traces": list_tables(folder),
    }


def _column_json(name: str) -> dict[str, Any]:
    column = COLUMNS[name]
    return {
        "quantity": split_unit(name)[0],
        "units": units_of(name),
        "unit": split_unit(name)[1] if units_of(name) else "",
        "kind": column.kind,
        "meaning": column.meaning,
        "measured": column.measured,
        "default": column.default,
        "shared": name in SHARED,
    }


def _correction(point: Mapping[str, Any]) -> Correction:
    """A correction from the JSON of the page."""
    edge_px = math.nan if point["edge_px"] is None else float(point["edge_px"])
    return Correction(int(point["frame"]), str(point["action"]), edge_px)


def draft_from_json(folder: Path, content: Mapping[str, Any]) -> Draft:
    """Return the draft sent by the page; comments and keys unknown to the page come from the files."""
    from_files = open_draft(folder)
    sent = content["sheet"]
    columns = tuple(str(column) for column in sent["columns"])
    rows = tuple({name: str(row.get(name, "")) for name in columns} for row in sent["rows"])
    sheet = SheetDraft(columns, rows, from_files.sheet.delimiter, from_files.sheet.decimal)
    text = with_shared(from_files.settings, {str(key): str(cell) for key, cell in content["shared"].items()})
    present = parse_yaml(text, SETTINGS).content
    for key in ("calibration", "axis"):
        value = content.get(key)
        if value is not None or present.get(key) is not None:
            text = with_value(text, key, value, SETTINGS)
    given = content.get("corrections", {}).items()
    corrections = {
        str(trial): tuple(sorted(map(_correction, points), key=lambda made: made.frame))
        for trial, points in given
        if points
    }
    return Draft(sheet, text, str(content["stamp"]), corrections)


def draft_problems(folder: Path, draft: Draft, thorough: bool = False) -> dict[str, Any]:
    """Return the messages of `vinetrack check` for a draft, each problem with the field concerned. Returns mapping of
    JSON types: `problems` (severity, trial, column, text, field), `notes`, `understood`.
    """
    notes: list[str] = []
    understood: list[str] = []
    with draft_folder(folder, draft) as copy:
        if thorough:
            from vinetrack.pipeline.workflow import check_folder

            checked = check_folder(copy)
            problems, notes, understood = list(checked.problems), list(checked.notes), list(checked.recording_lines)
        else:
            problems = [*check_experiment(copy), *_scale_missing(draft)]
    return {
        "problems": [_problem_json(problem, draft) for problem in problems],
        "notes": notes,
        "understood": understood,
    }


def _scale_missing(draft: Draft) -> list[Problem]:
    """The problem that the check of recordings would report for a missing scale."""
    content = parse_yaml(draft.settings, SETTINGS).content
    has_scale = content.get("calibration") is not None or content.get("mm_per_px") is not None
    without = [row for row in draft.sheet.rows if row.get("video") and not row.get("mm_per_px")]
    if has_scale or not without:
        return []
    remedy = "click two marks on a ruler, or choose a picture of a printed board"
    return [Problem(message="is missing: no recording has a scale", file=SETTINGS, column="calibration", remedy=remedy)]


def _problem_json(problem: Problem, draft: Draft | None) -> dict[str, Any]:
    """A problem with its field: a cell of the sheet, a value for all trials, the scale, the axis, or `whole`."""
    column = problem.column
    field = "whole"
    if column.split(".")[0] in ("calibration", "axis") and not problem.trial:
        field = column.split(".")[0]
    elif problem.trial and column:
        field = "cell"
    elif problem.trial:
        field = "row"
    elif column in COLUMNS or split_unit(column)[0] in {split_unit(name)[0] for name in COLUMNS}:
        field = "shared"
    if field in ("cell", "shared") and draft is not None:
        column = _as_drafted(column, draft)
    return {
        "severity": problem.severity,
        "field": field,
        "trial": problem.trial,
        "column": column,
        "text": problem.reason,
        "code": problem.code,
        "of_a_measurement": problem.of_a_measurement,
    }


def _as_drafted(column: str, draft: Draft) -> str:
    """The name of a column in the draft, which may have another unit."""
    quantity = split_unit(column)[0]
    return next((name for name in draft.sheet.columns if split_unit(name)[0] == quantity), column)


log = logging.getLogger(__name__)

TEMPLATES = Path(__file__).with_name("templates")
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
        # Chosen: a sheet of ten thousand rows takes a few megabytes
        # Header required for requests that change or compute something
        if self.headers.get("X-Vinetrack") != "setup" or not 0 < length <= 20_000_000:
            self.close_connection = True
            self._send(HTTPStatus.FORBIDDEN, b"", "text/plain")
            return
        body = self.rfile.read(length)
        answers: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "/api/check": self._check,
            "/api/paste": lambda content: vars(place_block(**content)),
            "/api/track": self._track,
            "/api/save": self._save,
        }
        handler = answers.get(self.path.removeprefix(self.server.secret))
        self._answer(None if handler is None else lambda: handler(json.loads(body)))

    def _check(self, content: dict[str, Any]) -> dict[str, Any]:
        draft = draft_from_json(self.server.folder, content)
        return {
            **draft_problems(self.server.folder, draft, thorough=bool(content.get("thorough"))),
            "sheet_text": draft.sheet.text(),
            "settings_text": draft.settings,
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
            self._send_json(
                {"problems": [_problem_json(problem, None) for problem in error.problems], "words": str(error)},
                HTTPStatus.UNPROCESSABLE_ENTITY,
            )
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
            from vinetrack.figures.style import page_frame

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
    missing = {problem.column for problem in _missing(folder) if problem.column}
    blanks = [*(name for name in COLUMNS if name in missing), *sorted(missing - COLUMNS.keys())]
    if blanks:
        say(f"To fill in: {', '.join(blanks)}. A value that all trials share goes into {SETTINGS}.")
    say(f"Then: vinetrack check {folder}")


def _missing(folder: Path) -> list[Problem]:
    """What is still missing in the files."""
    problems = [problem for problem in check_experiment(folder) if problem.severity == "error"]
    missing = [problem for problem in problems if problem.code in ("missing", "blank")]
    with contextlib.suppress(ExperimentError):
        if read_experiment_settings(folder / SETTINGS).calibration is None:
            missing.append(Problem(message="is missing", code="missing", file=SETTINGS, column="calibration"))
    return missing
