"""Blocks pasted from notes or a spreadsheet: each number stands beside its own film, or nowhere."""

from __future__ import annotations

import pytest

from vinetrack.pages.draft_files import SHARED_ROW, place_block, read_block

COLUMNS = ["capture_fps", "diameter_mm", "pressure_kPa", "payload_g"]
ROWS = [
    {"trial": "d15_24kPa_1", "video": "d15 24kPa 1.mp4"},
    {"trial": "d15_30kPa_1", "video": "d15 30kPa 1.mp4"},
    {"trial": "late", "video": "monday/d15 36kPa 1.mov"},
]
EXPECTED = {(0, "pressure_kPa"): "24.1317", (0, "payload_g"): "0", (1, "pressure_kPa"): "31.0264",
            (1, "payload_g"): "20", (2, "pressure_kPa"): "36.5422", (2, "payload_g"): "5"}  # fmt: skip


def changed(text: str, at_row: int | str = 0, at_column: str = "trial", decimal: str = ".") -> dict[tuple, str]:
    placed = place_block(text, COLUMNS, ROWS, at_row, at_column, decimal)
    assert len({cell[:2] for cell in placed.cells}) == len(placed.cells)
    return {(row, column): text for row, column, text in placed.cells}


def notes(text: str, at_row: int | str = 0, at_column: str = "trial") -> int:
    return len(place_block(text, COLUMNS, ROWS, at_row, at_column).notes)


@pytest.mark.parametrize("mark", ["\t", ";", ",", "  "])
@pytest.mark.parametrize("header", ["clip{0}pressure (psi){0}payload_g", "Trial{0}Pressure [psi]{0}Payload"])
@pytest.mark.parametrize("at_column", ["trial", "capture_fps", "payload_g"])
def test_a_header_names_columns_and_units_and_rows_are_matched_by_their_clips(
    mark: str, header: str, at_column: str
) -> None:
    lines = [header.format(mark), "monday/d15 36kPa 1.mov|5.3|5", "d15 24kPa 1.mp4|3.5|0", "d15_30kPa_1|4.5|20"]
    text = "\r\n".join(lines).replace("|", mark) + "\r\n"
    assert changed(text, 1, at_column) == EXPECTED
    assert notes(text, 1, at_column) == 0


def test_blanks_separate_cells_without_blanks() -> None:
    assert changed("name pressure_psi payload_g\nlate 5.3 5\nd15_24kPa_1 3.5 0\nd15_30kPa_1 4.5 20") == EXPECTED


def test_without_a_header_columns_follow_the_one_pasted_into_and_rows_their_names() -> None:
    text = "late\t36\t5\nd15_24kPa_1\t24\t0\n"
    expected = {(2, "pressure_kPa"): "36", (2, "payload_g"): "5", (0, "pressure_kPa"): "24", (0, "payload_g"): "0"}
    assert changed(text, 0, "pressure_kPa") == expected


def test_a_block_of_numbers_alone_goes_where_it_is_pasted() -> None:
    assert changed("24\t0\n30\t20", 1, "pressure_kPa") == {
        (1, "pressure_kPa"): "24", (1, "payload_g"): "0", (2, "pressure_kPa"): "30", (2, "payload_g"): "20",
    }  # fmt: skip
    assert changed("1000\n24\n", SHARED_ROW, "pressure_kPa") == {
        (SHARED_ROW, "pressure_kPa"): "1000", (0, "pressure_kPa"): "24",
    }  # fmt: skip
    assert changed("pressure\n24", 1, "diameter_mm") == {(1, "pressure_kPa"): "24"}


def test_what_matches_nothing_is_named_and_changes_nothing() -> None:
    text = "clip\tpressure_kPa\tcolour\nd15_24kPa_1\t24\tred\nd99_1\t99\tblue"
    assert changed(text) == {(0, "pressure_kPa"): "24"}
    assert notes(text) == 2
    assert changed("24\n30\n36\n42", 1, "pressure_kPa") == {(1, "pressure_kPa"): "24", (2, "pressure_kPa"): "30"}
    assert notes("24\n30\n36\n42", 1, "pressure_kPa") == 2
    assert changed("1\t2\n3\t4", 0, "trial") == {}
    assert notes("1\t2\n3\t4", 0, "trial") == 1
    assert notes("24\t0\t5", 0, "pressure_kPa") == 1


def test_a_name_of_two_recordings_is_of_neither() -> None:
    rows = [{"trial": "a", "video": "x/1.mp4"}, {"trial": "b", "video": "y/1.mp4"}]
    assert place_block("1.mp4\t24\nx/1.mp4\t30", COLUMNS, rows, 0, "pressure_kPa").cells == [(0, "pressure_kPa", "30")]


def test_decimal_commas_are_read_and_written_as_the_sheet_has_them() -> None:
    assert read_block("24,5\n30,5") == [["24,5"], ["30,5"]]
    assert changed("24,5\n30,5", 0, "pressure_kPa") == {(0, "pressure_kPa"): "24.5", (1, "pressure_kPa"): "30.5"}
    assert changed("late;36,5", 0, "pressure_kPa", ",") == {(2, "pressure_kPa"): "36,5"}
    assert read_block("late,36") == [["late", "36"]]
