"""The set-up page: what it asks of a folder of recordings, pictures of clips, saving, and its server."""

from __future__ import annotations

import json
import logging
import math
import shlex
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial
from http import HTTPStatus
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic_core import to_json
from tornado.ioloop import IOLoop
from tornado.web import Application, HTTPError, RequestHandler, StaticFileHandler

from vinetrack.core.problems import ExperimentError, InputError, Problem, UserError
from vinetrack.core.process import THREAD_PREFIX
from vinetrack.core.records import Correction
from vinetrack.core.tables import parse_yaml, read_table, read_text, safe_join
from vinetrack.core.units import UNITS, or_nan, other_units, split_unit
from vinetrack.experiment.folder import (
    CORRECTIONS_FILE,
    REQUIRED_COLUMNS,
    SETTINGS,
    SHEET,
    check_experiment,
    make_trial,
    read_corrections,
    read_row,
)
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.settings import in_sheet_units, read_experiment_settings
from vinetrack.figures.motion_figures import draw_strip
from vinetrack.figures.style import render
from vinetrack.pages import draft_files as files
from vinetrack.pages.local_page import TEMPLATES, TOKENS_CSS, PageServer, jpeg, page_frame
from vinetrack.pipeline.workflow import check_folder, identity
from vinetrack.report.build import TOKENS, base64_uri
from vinetrack.tracks.importers import attach_pressure, read_pressure_trace
from vinetrack.video.axis import Axis, SmallPictures, axis_entry, axis_through, find_growth_axis
from vinetrack.video.calibration import find_board
from vinetrack.video.frames import RecordingError, inspect_recording, iterate_frames, read_frames
from vinetrack.video.survey import Keep, measure_recording, size_problems, tracked_facts
from vinetrack.video.track import Tracking

# ------------------------------------------------------------------------------
# Views of a recording for the page: frames as JPEG, the proposed axis, and the result of tracking.


def decoded_clip(path: Path, _changed_ns: int) -> tuple[tuple[bytes, ...], dict[str, Any]]:
    """Decode a recording: its frames as JPEG; their number and size, with the axis found, or why there is none."""
    frames = read_frames(path)
    height, width = frames.luma.shape[1:]
    found: dict[str, Any] = {"axis": None, "no_axis": ""}
    try:
        found["axis"] = axis_json(find_growth_axis(SmallPictures(frames.luma)))
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


def target_in(picture: NDArray[Any], name: str) -> dict[str, Any] | None:
    """The printed board in a picture, as `experiment.yaml` names it, without sizes; else the marks of a ruler."""
    if (target := find_board(picture)) is None:
        return ruler_in(picture)
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
    return {**entry, "width_px": round(axis.width_px, 2)}


def track_row(folder: Path, index: int, keep: Keep) -> dict[str, Any]:
    """Track the recording of one row, in pixels without a scale, in frames without a rate: see `scaled` and `timed`."""
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
    if not scaled:
        # The unit of length is a pixel, in which no size is known; nor is the width of a given axis.
        trial = replace(trial, m_per_px=1.0, diameter_m=math.nan, length_m=math.nan)
        trial = replace(trial, axis=trial.axis and replace(trial.axis, width_m=math.nan))
        shared = settings.axis and settings.axis.model_copy(update={"width_mm": None})
        settings = settings.model_copy(update={"axis": shared})
    measurement = measure_recording(trial, settings, folder, keep)
    tracking, mm_per_px = measurement.tracking, 1e3 * measurement.m_per_px if scaled else math.nan
    facts = tracked_facts(trial, measurement)
    notes = [problem.reason for problem in size_problems(trial, facts) if scaled]
    track = tracking.track
    if timed and trial.pressure_trace is not None:
        try:
            track = attach_pressure(track, *read_pressure_trace(trial.pressure_trace))
        except (InputError, OSError) as error:
            notes.append(f"pressure_trace {error}")
    # Without a rate the figure counts frames.
    drawn = track if timed else replace(track, time_s=np.full_like(track.time_s, np.nan))
    fig = draw_strip(trial.name, replace(tracking, track=drawn), mm_per_px / 1e3, trial.pressure_unit)
    _, _, bottom_in, top_in = fig.axes[0].images[0].get_extent()
    # In the colours of the screen: a filter as elsewhere would turn the greys of the recording too.
    svg = render(fig, ["svg"])["svg"].decode()
    for colour, token in TOKENS.items():
        svg = svg.replace(colour, f"var({token})")
    svg = svg.replace("<defs>", f"<style>{TOKENS_CSS.read_text(encoding='utf-8')}</style><defs>", 1)
    return {
        "strip": base64_uri("image/svg+xml", svg.encode()),
        # Where in the figure its frames are, from above, as shares of its height
        "frames_at": [1 - top_in / fig.get_figheight(), 1 - bottom_in / fig.get_figheight()],
        "frames": [int(tracking.strip_rows[0]), int(tracking.strip_rows[-1])],
        "length_px": round(tracking.axis.length_px, 2),
        "axis": axis_json(tracking.axis),
        "time_s": np.round(track.time_s, 6).tolist(),
        "edge_px": np.round(track.edge_px, 2).tolist(),
        "position_mm": np.round(1e3 * track.lead_position_m, 3).tolist(),
        "flag": [str(flag) for flag in track.flag],
        "shake_px": np.round(tracking.shake_px, 2).tolist(),
        "growth_mm": round(facts.growth_mm, 2),
        "tube_width_mm": round(mm_per_px * tracking.tube_width_px, 2),
        "timed": timed,
        "scaled": scaled,
        "notes": [*notes, *track.notes],
    }


# ------------------------------------------------------------------------------
# Marks of a ruler in a picture: a line along which grey levels repeat. The picture is turned degree by degree, and the
# strongest line in the spectrum of a row, against that of other rows, proposes a direction and a spacing. Along it
# every mark must look like the others, which tells a ruler from texture; the phase of the spacing gives their places.

FEWEST_SPACINGS = 20  # Chosen: in texture up to 13 places look alike
NOTES = (".txt", ".md", ".tsv", ".csv")  # Files of notes, as accepted by the page


def ruler_in(picture: NDArray[Any]) -> dict[str, Any] | None:
    """Find the longest row of equally spaced marks in a picture of shape (height, width): two far marks, px, the number
    of spacings between them, and by what share the last is longer than the first. None if there is no such row.
    """
    grey = picture.astype(np.float32)
    small = min(1.0, 1000 / max(grey.shape))  # 1000: size at which directions are searched, px (chosen)
    shrunk = cv2.resize(grey, None, fx=small, fy=small, interpolation=cv2.INTER_AREA)
    shrunk = shrunk - cv2.GaussianBlur(shrunk, (0, 0), 0.03 * max(shrunk.shape))
    shrunk = np.tanh(shrunk / (2 * shrunk.std() + 1e-6))  # one strong edge must not outweigh marks
    middle, side = (np.array(shrunk.shape[::-1]) - 1) / 2, math.ceil(math.hypot(*shrunk.shape))
    lines = []
    for degrees in range(-90, 90):
        turn: NDArray[Any] = np.array(cv2.getRotationMatrix2D(middle.tolist(), degrees, 1.0))
        turn[:, 2] += (side - 1) / 2 - middle
        rows = cv2.blur(cv2.warpAffine(shrunk, turn, (side, side)), (1, 3))[1::2]
        power = np.abs(np.fft.rfft(rows, axis=1)) ** 2
        power /= cv2.blur(power.mean(axis=0)[None], (9, 1)) + 1e-9 * power.max() + 1e-9
        power[:, :FEWEST_SPACINGS] = 0.0
        row, k = np.unravel_index(np.argmax(power), power.shape)
        back = cv2.invertAffineTransform(turn)
        lines.append((float(power[row, k]), back @ [side / 2, 2 * row + 1, 1] / small, back[:, 0], k / side * small))
    lines = sorted(lines, key=lambda line: -line[0])[:12]  # 12: lines looked at (chosen)
    found = [ruler for line in lines if line[0] > 0 and (ruler := _marks_along(grey, *line[1:]))]
    return max(found, key=lambda ruler: ruler["spacings"], default=None)


def _marks_along(grey: NDArray[Any], start: NDArray[Any], way: NDArray[Any], rate: float) -> dict[str, Any] | None:
    """The marks along a line through a point, about `rate` a pixel; the line is turned until it is square to them."""
    reach = sum(grey.shape) // 2
    u = np.arange(-reach, reach + 1)
    for _ in range(4):  # 4: turns of the line; the last is below 0.01 degrees (measured)
        side = np.array([-way[1], way[0]])
        levels = np.array([_levels(grey, start + aside * side, way, u, 2 / rate) for aside in (-2, 0, 2)])
        level = levels.sum(axis=0)
        near = slice(int(0.95 * rate * u.size), int(1.05 * rate * u.size) + 2)
        rate = (near.start + int(np.argmax(np.abs(np.fft.rfft(level)[near])))) / u.size
        # What is strongest across rows may be a multiple of the marks' own rate, which is stronger still along them.
        rate /= max((1, 2, 3), key=lambda n: float(abs(np.exp(-2j * np.pi * rate / n * u) @ level)))
        if u.size * rate < FEWEST_SPACINGS:
            return None
        window = np.hanning(round(4 / rate) | 1)
        waves = [np.convolve(one * np.exp(-2j * np.pi * rate * u), window, "same") for one in (*levels, level)]
        strong = np.abs(waves[3]) > 0.5 * np.quantile(np.abs(waves[3]), 0.98)
        first, last = max(np.flatnonzero(np.diff(np.r_[0, strong, 0])).reshape(-1, 2), key=np.ptp, default=(0, 1))
        run, before = slice(first + round(1 / rate), last - round(1 / rate)), (start, way)
        lean = np.angle(waves[2][run] @ waves[0][run].conj()) / (8 * np.pi * rate)
        start, way = start + u[(first + last) // 2] * way, (way + lean * side) / math.hypot(1, lean)
    start, way = before
    at, level_there = u[run], level[run]
    if (last - first) * rate < FEWEST_SPACINGS + 2:
        return None
    phase = np.polynomial.Polynomial.fit(at, np.unwrap(np.angle(waves[3][run])) / (2 * np.pi), 2)
    # Marks are what is narrow: dark on light, or light on dark.
    count = rate * at + phase(at) + (0.5 if ((level_there - level_there.mean()) ** 3).sum() < 0 else 0.0)
    places = np.interp(np.arange(math.ceil(count[0]), math.floor(count[-1]) + 1), count, at)
    shapes = np.interp(places[1:-1, None] + np.arange(-8, 8) / (16 * rate), u, level)
    rest = shapes.sum(axis=0) - shapes
    likeness = np.quantile([np.corrcoef(*pair)[0, 1] for pair in zip(shapes, rest, strict=True)], 0.25)
    if len(places) <= FEWEST_SPACINGS or not likeness > 0.7:  # chosen
        return None
    gaps = np.diff(places)
    return {
        "from_px": (start + places[0] * way).round(2).tolist(),
        "to_px": (start + places[-1] * way).round(2).tolist(),
        "spacings": len(gaps),
        "uneven": float(gaps[-1] / gaps[0] - 1),
    }


def _levels(
    grey: NDArray[Any], start: NDArray[Any], way: NDArray[Any], u: NDArray[Any], smooth_px: float
) -> NDArray[Any]:
    """Grey levels along a line, without their slow change; 0 outside the picture."""
    x, y = (start[:, None] + u * way[:, None]).astype(np.float32)[:, None]
    seen = (x > 0) & (x < grey.shape[1] - 1) & (y > 0) & (y < grey.shape[0] - 1)
    level = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    level = np.where(seen, level - cv2.GaussianBlur(level, (0, 0), smooth_px, sigmaY=0.1), 0.0)[0]
    return level.clip(-3 * level.std(), 3 * level.std())


# ------------------------------------------------------------------------------
# Data exchanged between page and files: available columns, cells, settings, and problems with their fields.


def page_state(folder: Path) -> dict[str, Any]:
    """Return the initial state of the page, of JSON types."""
    draft, present = files.open_draft(folder), files.read_sheet(folder)
    content = parse_yaml(draft.settings, SETTINGS).content
    sheet = draft.sheet
    # Columns that the page shows whether or not the sheet has them
    optional = ["payload_g", "growth_angle_deg", "film_density_kg_m3", "chamber_l", "inlet_mm", "pressure_trace"]
    known = {}
    for name in [name for name in COLUMNS if name not in ("trial", "video")]:
        units = [split_unit(name)[1], *other_units(name).values()]
        known[name] = {key: getattr(COLUMNS[name], key) for key in ("kind", "meaning", "measured", "default", "shared")}
        known[name] |= {"base": name, "quantity": files.quantity(name), "units": units if len(units) > 1 else []}
        known |= dict.fromkeys(other_units(name), known[name])
    return {
        "name": folder.resolve().name,
        "next": shlex.join(["vinetrack", "run", str(folder)]),
        "stamp": draft.stamp,
        "known": known,
        "units": {key: unit.text for key, unit in UNITS.items()},
        "offered": ["capture_fps", "exposure_us", *REQUIRED_COLUMNS, *optional],
        "sheet": {"columns": list(sheet.columns), "rows": list(sheet.rows), "decimal": sheet.decimal},
        "kept": list(present.columns) if present.rows else ["trial", "video", "track"],
        "unsaved": not (
            (folder / SETTINGS).exists() and present.rows and files.cells_of(present) == files.cells_of(sheet)
        ),
        "shared": {key: str(value) for key, value in files.shared_values(draft.settings).items()},
        "calibration": content.get("calibration"),
        "axis": content.get("axis"),
        "corrections": {
            trial: [vars(point) | {"edge_px": round(point.edge_px, 2)} for point in given]
            for trial, given in draft.corrections.items()
        },
        "pictures": files.list_pictures(folder),
        "traces": files.list_tables(folder),
        "notes": files.list_tables(folder, NOTES),
    }


def draft_from_json(folder: Path, content: Mapping[str, Any]) -> files.Draft:
    """Return the draft sent by the page; comments and keys unknown to the page come from the files."""
    from_files = files.open_draft(folder)
    columns = tuple(map(str, content["sheet"]["columns"]))
    rows = tuple({name: str(row.get(name, "")) for name in columns} for row in content["sheet"]["rows"])
    sheet = replace(from_files.sheet, columns=columns, rows=rows)
    text = files.with_shared(from_files.settings, {str(key): str(cell) for key, cell in content["shared"].items()})
    present = parse_yaml(text, SETTINGS).content
    for key in ("calibration", "axis"):
        value = content.get(key)
        if value is not None or present.get(key) is not None:
            text = files.with_value(text, key, value, SETTINGS)
    corrections = {}
    for trial, points in content.get("corrections", {}).items():
        given = [Correction(int(one["frame"]), str(one["action"]), or_nan(one["edge_px"])) for one in points]
        if given:
            corrections[str(trial)] = tuple(sorted(given, key=lambda correction: correction.frame))
    return files.Draft(sheet, text, str(content["stamp"]), corrections)


def draft_problems(folder: Path, draft: files.Draft, thorough: bool = False) -> dict[str, Any]:
    """What `vinetrack check` says of a draft, of JSON types, with the field of each problem; the text of each file."""
    with files.draft_folder(folder, draft) as copy:
        checked = check_folder(copy) if thorough else None
        problems = [*(check_experiment(copy) if checked is None else checked.problems)]
    problems += _scale_missing(draft) if "calibration" not in {problem.column for problem in problems} else []
    # What is noted, such as a unit, was chosen on the page.
    told = [_problem_json(one, draft.sheet.columns) for one in problems if one.severity != "note"]
    return {
        "problems": [one for i, one in enumerate(told) if one not in told[:i]],
        "notes": list(checked.notes) if checked else [],
        "understood": list(checked.recording_lines) if checked else [],
        "texts": draft.texts() | ({} if draft.corrections else {CORRECTIONS_FILE: ""}),
    }


def _scale_missing(draft: files.Draft) -> list[Problem]:
    """The problem that the check of recordings would report for a missing scale."""
    content = parse_yaml(draft.settings, SETTINGS).content
    has_scale = content.get("calibration") is not None or content.get("mm_per_px") is not None
    if has_scale or not any(row.get("video") and not row.get("mm_per_px") for row in draft.sheet.rows):
        return []
    remedy = "click two marks on a ruler, or choose a picture of a printed board"
    message = "is missing: no recording has a scale"
    return [Problem("missing", message, "calibration", file=SETTINGS, remedy=remedy)]


def _problem_json(problem: Problem, columns: Sequence[str] = ()) -> dict[str, Any]:
    """A problem with its field: a cell, a row, a value for all trials, the scale, the axis, or `whole`."""
    column = problem.column
    if column.split(".")[0] in ("calibration", "axis") and not problem.trial:
        field = column.split(".")[0]
    elif problem.trial and (problem.of_a_measurement or problem.file != SETTINGS):
        field = "cell" if column else "row"
    else:
        field = "shared" if files.column_of(column, COLUMNS) in COLUMNS else "whole"
    told = {key: getattr(problem, key) for key in ("severity", "code", "of_a_measurement")}
    told |= {"trial": problem.trial if field in ("cell", "row") else ""}
    return {**told, "field": field, "column": files.column_of(column, columns), "text": problem.reason}


log = logging.getLogger(__name__)


class Desk:
    """What the page asks of one folder, from several threads at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.threads = folder, ThreadPoolExecutor(thread_name_prefix=THREAD_PREFIX)
        self._tracking, self._decoding = threading.Lock(), threading.Lock()
        self._decoded = lru_cache(2)(decoded_clip)  # of the current and the previous recording
        self._tracked: tuple[str, Tracking] | None = None  # the last that was tracked, in pixels

    def _keep(self, film: Path, inputs: tuple[Any, ...], make: Callable[[], Tracking]) -> Tracking:
        """Track again only for another recording, axis or choice of frames: not for a correction or a scale."""
        key = repr((film.resolve(), identity(film), inputs))
        if self._tracked is None or self._tracked[0] != key:
            self._tracked = key, make()
        return self._tracked[1]

    def clip(self, recording: str) -> tuple[tuple[bytes, ...], dict[str, Any]]:
        """Return what `decoded_clip` returns of a recording as it is now."""
        path = safe_join(self.folder, recording)
        with self._decoding:
            return self._decoded(path, path.stat().st_mtime_ns if path.exists() else 0)

    def picture(self, name: str, widest: int | None = None) -> bytes:
        """Return a single picture or the first frame of a film as JPEG, without decoding more."""
        return jpeg(first_frame(safe_join(self.folder, name)), widest)

    def check(self, thorough: bool = False, **content: Any) -> dict[str, Any]:
        """Return the problems of a draft, and its files."""
        return draft_problems(self.folder, draft_from_json(self.folder, content), thorough)

    def track(self, row: int, **content: Any) -> dict[str, Any]:
        """Track the recording of one row of a draft."""
        with self._tracking, files.draft_folder(self.folder, draft_from_json(self.folder, content)) as copy:
            return track_row(copy, row, self._keep)

    def paste(self, text: str = "", file: str = "", **table: Any) -> dict[str, Any]:
        """Return which cells a pasted block, or a file of notes, would change, and what matches nothing."""
        block = read_text(safe_join(self.folder, file)) if file else text
        return dict(zip(("cells", "notes"), files.place_block(block, **table), strict=True))

    def save(self, **content: Any) -> dict[str, Any]:
        """Write a draft."""
        written = files.write_draft(self.folder, draft_from_json(self.folder, content))
        return {"written": written, "stamp": files.files_stamp(self.folder)}


# Answers by method and path, from the query or the JSON of a request: bytes are a JPEG, text is a style, all else JSON
ANSWERS: dict[str, Callable[..., bytes | str | Mapping[str, Any] | None]] = {
    "GET frame.css": lambda _: page_frame(),
    "GET state": lambda desk: page_state(desk.folder),
    "GET clip": lambda desk, recording: desk.clip(recording)[1],
    "GET frame": lambda desk, recording, frame: desk.clip(recording)[0][int(frame)],
    # 220: width of the pictures in the list; chosen: as wide as its column
    "GET thumbnail": lambda desk, recording: desk.picture(recording, 220),
    "GET picture": lambda desk, picture: desk.picture(picture),
    "GET curve": lambda _, points: axis_json(axis_through([point.split(",") for point in points.split(";")])),
    "GET target": lambda desk, picture: target_in(first_frame(safe_join(desk.folder, picture)), picture),
    "POST check": Desk.check,
    "POST paste": Desk.paste,
    "POST track": Desk.track,
    "POST save": Desk.save,
}


class _Quiet(RequestHandler):
    """Whose answers are not kept, and ask nothing of another server."""

    def set_default_headers(self) -> None:
        sources = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'"
        self.set_header("Content-Security-Policy", sources)
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Referrer-Policy", "no-referrer")


class _File(_Quiet, StaticFileHandler):
    """A file of the page."""


class _Answer(_Quiet):
    """One of `ANSWERS`, computed in a thread; an error of the input is sent as a sentence."""

    def initialize(self, desk: Desk) -> None:
        self.desk = desk

    async def get(self, name: str) -> None:
        """Answer a question by its query."""
        given = {key: self.get_query_argument(key, strip=False) for key in self.request.query_arguments}
        await self._answer(f"GET {name}", given)

    async def post(self, name: str) -> None:
        """Check, track or save the draft that is sent, with a header that a form of another page cannot have."""
        if self.request.headers.get("X-Vinetrack") != "setup":
            raise HTTPError(HTTPStatus.FORBIDDEN)
        await self._answer(f"POST {name}", json.loads(self.request.body))

    async def _answer(self, route: str, given: Mapping[str, Any]) -> None:
        if route not in ANSWERS:
            raise HTTPError(HTTPStatus.NOT_FOUND)
        self.set_status(HTTPStatus.UNPROCESSABLE_ENTITY)
        content: bytes | str | Mapping[str, Any] | None
        try:
            content = await IOLoop.current().run_in_executor(
                self.desk.threads, partial(ANSWERS[route], self.desk, **given)
            )
            self.set_status(HTTPStatus.OK)
        except ExperimentError as error:
            content = {"problems": [_problem_json(problem) for problem in error.problems], "words": str(error)}
        except UserError as error:
            content = {"words": str(error)}
        except (KeyError, ValueError, TypeError, OSError) as error:
            log.exception("%s", self.request.path)
            self.set_status(HTTPStatus.BAD_REQUEST)
            content = {"words": f"{type(error).__name__}: {error}"}
        kinds: dict[type, str] = {bytes: "image/jpeg", str: "text/css; charset=utf-8"}
        self.set_header("Content-Type", kinds.get(type(content), "application/json"))
        self.finish(content if isinstance(content, bytes | str) else to_json(content, inf_nan_mode="null"))


def start_server(desk: Desk, port: int | None = None) -> PageServer:
    """Return a server for a folder that does not answer requests yet."""
    page = {"path": TEMPLATES, "default_filename": "setup.html"}

    def application(secret: str) -> Application:
        return Application([(f"{secret}/api/(.+)", _Answer, {"desk": desk}), (f"{secret}/(.*)", _File, page)])

    return PageServer(application, port)


def serve(folder: Path, say: Callable[[str], None], port: int | None = None, *, browser: bool = True) -> None:
    """Serve until Ctrl-C (or SIGTERM)."""
    desk, state = Desk(folder), page_state(folder)
    server = start_server(desk, port)
    # The tracker is compiled before the user needs it.
    desk.threads.submit(desk.track, 0, **state)
    server.run("Set-up", say, browser=browser)


# ------------------------------------------------------------------------------
# The command `vinetrack setup` without its page: the two files with blanks to fill.


def write_templates(folder: Path, say: Callable[[str], None]) -> None:
    """Write the sheet and settings of a folder of recordings, with blanks to fill; existing content is kept."""
    present, draft = files.read_sheet(folder), files.open_draft(folder)
    written = files.write_draft(folder, draft)
    columns, added = draft.sheet.columns, draft.sheet.rows[len(present.rows) :]
    filled = [name for name in columns if name not in ("trial", "video", "track") and any(r.get(name) for r in added)]
    there = f"{SHEET} and {SETTINGS} of {folder} already contain every recording."
    for line in [f"Written: {folder / name}" for name in written] or [there]:
        say(line)
    named = f", {len(added)} of them new; from their names: {', '.join(filled) or 'nothing'}" if added else ""
    say(f"{len(draft.sheet.rows)} trials{named}.")
    problems = [*check_experiment(folder), *_scale_missing(draft)]
    errors = [problem for problem in problems if problem.severity == "error" and problem.column]
    missing = {problem.column for problem in errors if problem.code in ("missing", "blank")}
    blanks = [
        *(files.column_of(name, columns) for name in COLUMNS if name in missing),
        *sorted(missing - COLUMNS.keys()),
    ]
    if blanks:
        say(f"To fill in: {', '.join(blanks)}. A value that all trials share goes into {SETTINGS}.")
    tracks, tabled = files.list_tracks(folder), files.list_tables(folder, NOTES)
    if unread := [*(name for name in tabled if name not in tracks), *files.list_pictures(folder)]:
        say(f"Not read here: {', '.join(unread)}. The page reads notes and rulers: vinetrack setup {folder}")
    say(f"Then: vinetrack check {folder}")
