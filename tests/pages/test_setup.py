"""The set-up page without a browser: names, drafts, pasted blocks, and answers of its server."""

import base64
import contextlib
import http.client
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from ruler_picture import ruler_picture
from served import served_here

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import parse_yaml, read_table
from vinetrack.pages import draft_files as draft
from vinetrack.pages import setup_server
from vinetrack.pages.local_page import PageServer
from vinetrack.pages.setup_server import draft_from_json, draft_problems, page_state, ruler_in, write_templates
from vinetrack.video.axis import axis_through

SHEET = "trial;video;pressure_kPa;note\nold;a.mp4;24,5;keep me\n"
SETTINGS = "# of the lab\nyield_pressure_kPa: 3  # measured twice\nthickness_um: 100\n"
FILLED = {"capture_fps": "1000", "thickness_um": "100", "length_mm": "300", "yield_pressure_kPa": "3"}
OURS = {"X-Vinetrack": "setup"}


def test_a_folder_offers_recordings_pictures_and_pressure_traces_in_the_order_of_their_numbers(tmp_path):
    names = "run 10.mp4,run 2.MOV,notes.txt,.hidden.mp4,board.png,calibration/board.mp4,two/1.png,two/2.png"
    names += ",monday/a.avi,trials.csv,corrections.csv,p 10.csv,p 2.csv,traces/a.csv"
    names += ",results/provenance.json,results/overlay.mp4,results/trials.csv"
    for name in (*names.split(","), *(f"burst/{i:03d}.png" for i in range(5))):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    assert sorted(["a10", "a1²3", "a2"], key=draft.natural_order) == ["a1²3", "a2", "a10"]
    assert draft.list_recordings(tmp_path) == ["burst", "monday/a.avi", "run 2.MOV", "run 10.mp4"]
    assert draft.list_pictures(tmp_path) == ["board.png", "calibration/board.mp4"]
    assert draft.list_tables(tmp_path) == ["p 2.csv", "p 10.csv", "traces/a.csv"]


NAMES = {
    "d12_24kPa_1.mp4": {"diameter_mm": "12", "pressure_kPa": "24"},
    "D12 24KPA run 3.mov": {"diameter_mm": "12", "pressure_kPa": "24"},
    "24mm-200um-280mm_30.5kPa_20g.mp4": {"diameter_mm": "24", "thickness_um": "200", "length_mm": "280",
                                         "pressure_kPa": "30.5", "payload_g": "20"},
    "d0p5in_4psi.mp4": {"diameter_in": "0.5", "pressure_psi": "4"},
    "p36_m20_l280_t100_2.avi": {"pressure_kPa": "36", "payload_g": "20", "length_mm": "280", "thickness_um": "100"},
    "l28cm 1000fps.mp4": {"length_cm": "28", "capture_fps": "1000"},
    "d12/24kPa/1.mp4": {"diameter_mm": "12", "pressure_kPa": "24"}, "d12/d24_1.mp4": {"diameter_mm": "24"},
    "GX010042.mp4": {}, "p24kPa_t1.mp4": {"pressure_kPa": "24"}, "2024-05-01 17.22.mp4": {},
    "day3_tube2.mp4": {"day": "3", "specimen": "2"},
}  # fmt: skip


def test_a_name_says_cells_and_a_unit_that_all_share_is_kept_while_mixed_ones_are_converted():
    assert [draft.columns_from_names([name]) for name in NAMES] == [[cells] for cells in NAMES.values()]
    assert draft.columns_from_names(["4psi.mp4", "5psi.mp4"]) == [{"pressure_psi": "4"}, {"pressure_psi": "5"}]
    assert draft.columns_from_names(["4psi.mp4", "30kPa.mp4"]) == [{"pressure_kPa": "27.579"}, {"pressure_kPa": "30"}]


def test_a_folder_of_recordings_gets_both_files_and_a_sheet_that_is_there_keeps_its_cells(tmp_path):
    for name in ("a.mp4", "d12_30kPa_1.mp4", "ruler.jpg", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    sheet, settings = tmp_path / "trials.csv", tmp_path / "experiment.yaml"
    lines: list[str] = []
    write_templates(tmp_path, lines.append)
    assert [(row["diameter_mm"], row["pressure_kPa"]) for row in read_table(sheet).rows] == [("", ""), ("12", "30")]
    assert settings.read_text() == draft.first_settings()
    assert any("capture_fps" in line and "calibration" in line for line in lines if line.startswith("To fill in"))
    assert any("ruler.jpg" in line and "notes.txt" in line for line in lines)

    sheet.write_text(SHEET)
    settings.write_text(SETTINGS)
    write_templates(tmp_path, lines.append)
    text = sheet.read_text()
    assert text.startswith("trial;video;pressure_kPa;note")
    assert "old;a.mp4;24,5;keep me" in text
    assert "d12_30kPa_1;d12_30kPa_1.mp4;30" in text
    assert settings.read_text() == SETTINGS
    sheet.write_text("trial,video\nold,a.mp4,stray\n")  # cells without a column would be lost
    with pytest.raises(ExperimentError):
        draft.open_draft(tmp_path)


def test_shared_values_are_set_in_place_and_in_the_unit_chosen():
    after = draft.with_shared(SETTINGS, {"yield_pressure_psi": "0.5", "thickness_um": "100", "capture_fps": "1069"})
    assert after.startswith("# of the lab\nyield_pressure_psi: 0.5 # measured twice\n")
    assert draft.shared_values(after) == {"thickness_um": 100, "yield_pressure_psi": 0.5, "capture_fps": 1069}
    # A new file has a blank `yield_pressure_kPa:`; that of an older version of the page has both.
    after = draft.with_shared(draft.first_settings(), {"yield_pressure_psi": "0.42", "capture_fps": "1000"})
    assert parse_yaml(after, "").content["yield_pressure_psi"] == 0.42
    assert "yield_pressure_kPa" not in parse_yaml(after, "").content
    both = draft.with_shared("yield_pressure_psi: 0.4\nyield_pressure_kPa:\n", {"yield_pressure_psi": "0.42"})
    assert parse_yaml(both, "").content == {"yield_pressure_psi": 0.42}
    for typed, kPa in (("3", 3), ("0.035 bar", 3.5)):
        kept = parse_yaml(draft.with_shared(after, {"yield_pressure_kPa": typed}), "").content
        assert kept["yield_pressure_kPa"] == kPa


COLUMNS = ["capture_fps", "diameter_mm", "pressure_kPa", "payload_g"]
ROWS = [
    {"trial": "d15_24kPa_1", "video": "d15 24kPa 1.mp4"},
    {"trial": "d15_30kPa_1", "video": "d15 30kPa 1.mp4"},
    {"trial": "late", "video": "monday/d15 36kPa 1.mov"},
]
EXPECTED = {(0, "pressure_psi"): "3.5", (0, "payload_g"): "0", (1, "pressure_psi"): "4.5",
            (1, "payload_g"): "20", (2, "pressure_psi"): "5.3", (2, "payload_g"): "5"}  # fmt: skip


def changed(text: str, at_row: int | str = 0, at_column: str = "trial", decimal: str = ".") -> dict[tuple, str]:
    placed, _ = draft.place_block(text, COLUMNS, ROWS, at_row, at_column, decimal)
    assert len({cell[:2] for cell in placed}) == len(placed)
    return {(row, column): text for row, column, text in placed}


def notes(text: str, at_column: str = "trial") -> int:
    return len(draft.place_block(text, COLUMNS, ROWS, 1, at_column)[1])


@pytest.mark.parametrize("mark", ["\t", ";", ",", "  "])
@pytest.mark.parametrize("header", ["clip{0}pressure (psi){0}load g", "Trial{0}Pressure [psi]{0}Load"])
@pytest.mark.parametrize("at_column", ["trial", "payload_g"])
def test_a_header_names_columns_and_units_and_rows_are_those_of_their_clips(mark, header, at_column):
    lines = [header.format(mark), "monday/d15 36kPa 1.mov|5.3|5", "d15 24kPa 1.mp4|3.5|0", "d15_30kPa_1|4.5|20"]
    text = "\r\n".join(lines).replace("|", mark) + "\r\n"
    assert changed(text, 1, at_column) == EXPECTED
    assert notes(text, at_column) == 0


def test_sentences_above_the_table_of_notes_are_left_out_and_short_headings_known():
    prose = "bench, sat 28 nov, level but for d15_24kPa_1 (down)\nno payload yet, pressure from the big regulator\n"
    table = "clip    psi   payload_g\nd99_1   9    1\nlate   5.3   5\nd15_24kPa_1   3.5  0\nd15_30kPa_1   4.5   20"
    for text in (prose + table, prose + re.sub(" {2,}", "\t", table), prose + table.replace("psi", "P (psi)")):
        assert changed(text) == EXPECTED
        assert notes(text) == 2


def test_cells_of_notes_may_have_units_and_headings_further_words():
    table = "clip|set pressure|tube dia|film\nlate|5.3 psi|1.6 cm|110 um\nd15_24kPa_1|24 kPa|16 mm|0.11 mm\n"
    columns = [*COLUMNS, "thickness_um"]
    expected = {(2, "pressure_kPa", "36.5422"), (2, "diameter_mm", "16"), (2, "thickness_um", "110"),
                (0, "pressure_kPa", "24"), (0, "diameter_mm", "16"), (0, "thickness_um", "110")}  # fmt: skip
    for mark in ("\t", ", "):
        placed, told = draft.place_block("Yield 0.5 psi.\n" + table.replace("|", mark), columns, ROWS, 0, "trial")
        assert (set(placed), len(told)) == (expected, 2)
    assert changed("late 5.3 psi", 0, "pressure_kPa") == {(2, "pressure_psi"): "5.3"}
    assert changed("clip\tpressure\nlate\t5 furlong") == {}
    assert notes("clip\tpressure\nlate\t5 furlong") == 1


def test_what_matches_nothing_is_named_and_changes_nothing():
    text = "clip\tpressure_kPa\tcolour\nd15_24kPa_1\t24\tred\nd99_1\t99\tblue"
    assert changed(text) == {(0, "pressure_kPa"): "24"}
    assert changed("24\n30\n36\n42", 1, "pressure_kPa") == {(1, "pressure_kPa"): "24", (2, "pressure_kPa"): "30"}
    assert changed("1\t2\n3\t4", 0, "trial") == {}
    assert [notes(text), notes("24\n30\n36\n42", "pressure_kPa"), notes("1\t2\n3\t4")] == [3, 2, 1]
    assert notes("24\t0\t5", "pressure_kPa") == 1
    # Below a name columns follow each other; of a file of notes nobody said which is the first.
    assert changed("late\t1069\t15\t36")[2, "pressure_kPa"] == "36"
    assert (changed("late\t1069\t15\t36", at_column=""), notes("late\t36", "")) == ({}, 1)
    # A dash is nothing; a line with another separator than most alone is lost.
    assert changed("clip,kPa,load\nlate,36,-\nd15_24kPa_1;24;5\nd15_30kPa_1,30,2") == {
        (2, "pressure_kPa"): "36", (1, "pressure_kPa"): "30", (1, "payload_g"): "2"}  # fmt: skip
    # A name of two recordings is of neither.
    rows = [{"trial": "a", "video": "x/1.mp4"}, {"trial": "b", "video": "y/1.mp4"}]
    block = "1.mp4\t24\nx/1.mp4\t30"
    assert draft.place_block(block, COLUMNS, rows, 0, "pressure_kPa")[0] == [(0, "pressure_kPa", "30")]


RULERS = (
    {"px_mm": 5.2, "turned_deg": -63, "length_mm": 80, "ink": 220, "wood": 50, "size": (420, 460)},
    # Millimetres are lost between the pixels: the longer marks are found, and not twice as many as there are.
    {"px_mm": 2.1, "turned_deg": 0, "length_mm": 140, "blur_px": 0.4, "every": 5, "size": (380, 200)},
)
MORE_RULERS = (
    {"px_mm": 2.9, "turned_deg": 171.3, "length_mm": 190, "blur_px": 0.8},
    {"px_mm": 4.1, "turned_deg": 90, "length_mm": 100, "marks_mm": 1.5875},
    {"px_mm": 3.7, "turned_deg": 17.2, "length_mm": 140, "askew": 1e-4},
)


@pytest.mark.parametrize("given", [*RULERS, *(pytest.param(one, marks=pytest.mark.slow) for one in MORE_RULERS)])
def test_marks_of_a_ruler_are_found_to_a_thousandth(given):
    found = ruler_in(ruler_picture(1, **{key: value for key, value in given.items() if key != "every"}))
    marks_mm, askew = given.get("marks_mm", 1.0) * given.get("every", 1), given.get("askew", 0.0)
    spacing_px = np.hypot(*np.subtract(found["to_px"], found["from_px"])) / found["spacings"]
    assert spacing_px == pytest.approx(given["px_mm"] * marks_mm, rel=1e-3)
    assert found["spacings"] > 0.9 * given["length_mm"] / marks_mm - 6
    # A spacing is stretched by (1 + askew m)^-2 at either end.
    assert abs(found["uneven"]) == pytest.approx(2 * askew * given["length_mm"], abs=6e-3)


def test_texture_and_nothing_at_all_are_no_ruler():
    rng = np.random.default_rng(11)
    assert [ruler_in(np.full(size, 7, np.uint8)) for size in ((60, 90), (5, 9))] == [None, None]
    for grain_px in (0.5, 1.5, 4.0):
        texture = cv2.GaussianBlur(rng.normal(size=(200, 320)).astype(np.float32), (0, 0), grain_px)
        assert ruler_in(np.clip(128 + 40 * texture / texture.std(), 0, 255).astype(np.uint8)) is None


def sent(folder: Path, **more) -> dict:
    """The content that an unchanged page sends."""
    state = page_state(folder)
    return {key: state[key] for key in ("sheet", "shared", "calibration", "axis", "stamp")} | more


def problems(folder: Path, **more) -> list[dict]:
    return draft_problems(folder, draft_from_json(folder, sent(folder, **more)))["problems"]


def test_problems_name_their_field_in_the_unit_of_the_sheet_and_blanks_are_told_from_what_is_wrong(clips):
    scale = {"kind": "two_points", "from_px": [10, 150], "to_px": [460, 150], "length_mm": 337.5}
    whole = problems(clips, shared=FILLED, calibration=scale)
    assert [one for one in whole if one["severity"] == "error"] == []
    settings = draft_from_json(clips, sent(clips, calibration=scale)).settings
    assert parse_yaml(settings, "").content["calibration"] == scale

    sheet = page_state(clips)["sheet"]
    columns = ["pressure_psi" if name == "pressure_kPa" else name for name in sheet["columns"]]
    rows = [row | {"pressure_psi": "four"} for row in sheet["rows"]]
    found = problems(clips, sheet=sheet | {"columns": columns, "rows": rows}, shared=FILLED)
    assert ("cell", "d15_24kPa_1", "pressure_psi") in {(one["field"], one["trial"], one["column"]) for one in found}

    rows = [{"trial": f"t{k}", "pressure_kPa": f"{20 + k}", "yield_pressure_kPa": "x"} for k in range(12)]
    sheet |= {"columns": [*sheet["columns"], "yield_pressure_kPa"], "rows": rows}
    codes: dict[str, set[str]] = {}
    for one in problems(clips, sheet=sheet, shared={"capture_fps": "1000"}):
        codes.setdefault(one["column"], set()).add(one["code"])
    assert codes["length_mm"] <= {"missing", "blank"}
    assert not codes["yield_pressure_kPa"] & {"missing", "blank"}
    of_all = {"column": "capture_fps", "file": "experiment.yaml", "trial": "a"}
    fields = [setup_server._problem_json(Problem(of_a_measurement=seen, **of_all))["field"] for seen in (False, True)]
    assert fields == ["shared", "cell"]


def test_a_new_folder_is_unsaved_and_a_sheet_that_is_there_is_shown_with_its_unknown_columns(clips):
    assert page_state(clips)["unsaved"]
    (clips / "trials.csv").write_text("trial,video,note\nold,d15 24kPa 1.mp4,of Monday\n")
    state = page_state(clips)
    assert state["kept"] == ["trial", "video", "note"]
    assert state["sheet"]["rows"][0] == {"trial": "old", "video": "d15 24kPa 1.mp4", "note": "of Monday"}
    assert state["sheet"]["rows"][1]["video"] == "d15 30kPa 1.mp4"


@pytest.fixture
def server(clips):
    with served_here(clips) as made:
        yield made


def ask(server: PageServer, path: str, body=None, headers=OURS, secret=None) -> tuple[int, bytes, str]:
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", server.port, timeout=120)) as connection:
        method, data = ("GET", None) if body is None else ("POST", json.dumps(body))
        connection.request(method, (server.secret if secret is None else secret) + path, data, headers)
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.getheader("Content-Type") or ""


def test_the_page_frames_and_the_axis_along_the_tube_are_served(server):
    assert b"<title>vinetrack set-up</title>" in ask(server, "/")[1]
    assert b"--ink" in ask(server, "/api/frame.css")[1]
    assert ask(server, "/table.js")[2].startswith("text/javascript")
    assert ask(server, "/setup_server.py")[0] == 404
    status, data, kind = ask(server, "/api/frame?recording=d15%2024kPa%201.mp4&frame=3")
    assert (status, kind, data[:2]) == (200, "image/jpeg", b"\xff\xd8")
    axis = json.loads(ask(server, "/api/clip?recording=d15%2024kPa%201.mp4")[1])["axis"]
    assert axis["to_px"][0] - axis["from_px"][0] > 300
    assert [axis["from_px"][1], axis["to_px"][1]] == pytest.approx([80, 80], abs=1.5)
    # A curve is drawn as the tracker lays it.
    made = json.loads(ask(server, "/api/curve?points=20,80;200,90;440,80")[1])
    along, across = axis_through([(20, 80), (200, 90), (440, 80)]).along_and_across(np.array(made["path_px"]))
    assert np.abs(across).max() < 0.01
    assert np.diff(along) == pytest.approx(4, abs=0.1)
    assert ask(server, "/api/curve?points=20,80;20,80;20,80")[0] == 422


def test_one_row_is_tracked_before_the_sheet_is_filled_in_and_with_its_pressure(server, clips):
    made = json.loads(ask(server, "/api/track", sent(clips, row=0))[1])
    assert (made["timed"], made["scaled"]) == (False, False)
    edge = np.array([np.nan if value is None else value for value in made["edge_px"]])
    assert np.nanmax(edge) - np.nanmin(edge) == pytest.approx(360, abs=5)
    assert made["strip"].startswith("data:image/svg+xml;base64,")
    assert not (clips / "trials.csv").exists()
    (clips / "p.csv").write_text("time_s,pressure_kPa\n0,24\n0.05,22\n")
    content = sent(clips, row=0)
    content["sheet"]["columns"].append("pressure_trace")
    content["sheet"]["rows"][0]["pressure_trace"] = "p.csv"
    content["shared"] = {"capture_fps": "1000"}
    made = json.loads(ask(server, "/api/track", content)[1])
    assert made["timed"]
    assert b"pressure, up to 24 kPa" in base64.b64decode(made["strip"].partition(",")[2])


def test_saving_writes_two_files_and_no_file_that_changed_meanwhile(server, clips):
    before, content = {path.name for path in clips.iterdir()}, sent(clips)
    made = json.loads(ask(server, "/api/save", sent(clips))[1])
    assert made["written"] == ["trials.csv", "experiment.yaml"]
    assert {path.name for path in clips.iterdir()} - before == {"trials.csv", "experiment.yaml"}
    assert made["stamp"] == json.loads(ask(server, "/api/state")[1])["stamp"]
    (clips / "experiment.yaml").write_text("chamber_l: 2\n")
    assert ask(server, "/api/save", content)[0] == 422
    assert (clips / "experiment.yaml").read_text() == "chamber_l: 2\n"


def test_other_pages_names_and_requests_without_the_secret_get_nothing(server, clips):
    for headers in ({"Host": "elsewhere.example"}, {**OURS, "Origin": "http://elsewhere.example"}):
        assert ask(server, "/api/save", sent(clips), headers)[0] == 403
    assert not (clips / "trials.csv").exists()
    assert len(server.secret) > 20
    for path in ("/", "/setup.js", "/api/state", "/api/frame?recording=a.mp4&frame=0"):
        assert ask(server, path, headers={"Host": f"evil.example:{server.port}"})[0] == 403
        assert ask(server, path, secret="")[0] == 404
