"""Listing of recordings, and columns from their names."""

from __future__ import annotations

from pathlib import Path

import pytest

from vinetrack.core.tables import list_recordings
from vinetrack.pages.clip_names import (
    columns_from_names,
    list_pictures,
    list_tables,
    trial_names,
    units_of,
)


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")


def test_recordings_are_films_and_folders_of_pictures_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    touch(tmp_path, "run 10.mp4", "run 2.MOV", "notes.txt", ".hidden.mp4", "board.png", "calibration/board.mp4")
    touch(tmp_path, *(f"burst/{i:03d}.png" for i in range(5)), "two/1.png", "two/2.png", "monday/a.avi")
    touch(tmp_path, "results/provenance.json", "results/overlay.mp4")
    assert list_recordings(tmp_path) == ["burst", "monday/a.avi", "run 2.MOV", "run 10.mp4"]
    assert list_pictures(tmp_path) == ["board.png", "calibration/board.mp4"]


@pytest.mark.parametrize(
    ("name", "cells"),
    [
        ("d12_24kPa_1.mp4", {"diameter_mm": "12", "pressure_kPa": "24"}),
        ("D12 24KPA run 3.mov", {"diameter_mm": "12", "pressure_kPa": "24"}),
        ("24mm-200um-280mm_30.5kPa_20g.mp4", {
            "diameter_mm": "24", "thickness_um": "200", "length_mm": "280", "pressure_kPa": "30.5", "payload_g": "20",
        }),
        ("d0p5in_4psi.mp4", {"diameter_in": "0.5", "pressure_psi": "4"}),
        ("p36_m20_l280_t100_2.avi", {
            "pressure_kPa": "36", "payload_g": "20", "length_mm": "280", "thickness_um": "100",
        }),
        ("l28cm 1000fps.mp4", {"length_cm": "28", "capture_fps": "1000"}),
        ("d12/24kPa/1.mp4", {"diameter_mm": "12", "pressure_kPa": "24"}),
        ("d12/d24_1.mp4", {"diameter_mm": "24"}),
        ("GX010042.mp4", {}),
        ("2024-05-01 17.22.mp4", {}),
        ("day3_tube2.mp4", {"day": "3", "specimen": "2"}),
    ],
)  # fmt: skip
def test_a_name_says(name: str, cells: dict[str, str]) -> None:
    assert columns_from_names([name]) == [cells]


def test_a_unit_that_all_names_share_is_kept_and_mixed_ones_are_converted() -> None:
    assert columns_from_names(["4psi.mp4", "5psi.mp4"]) == [{"pressure_psi": "4"}, {"pressure_psi": "5"}]
    assert columns_from_names(["4psi.mp4", "30kPa.mp4"]) == [{"pressure_kPa": "27.579"}, {"pressure_kPa": "30"}]


def test_names_of_trials_are_unique_also_where_case_alone_differs() -> None:
    assert trial_names(["a/1.mp4", "b/1.mp4", "X.mp4", "ä ö.mp4"], ["x"]) == ["a_1", "b_1", "X_2", "trial"]


def test_units_to_choose_measure_the_same_quantity() -> None:
    assert units_of("pressure_kPa")[0] == "kPa"
    assert {"psi", "bar"} <= set(units_of("pressure_kPa"))
    assert "mm" not in units_of("pressure_kPa")
    assert units_of("trial") == []


def test_tables_are_offered_as_pressure_traces(tmp_path: Path) -> None:
    touch(tmp_path, "trials.csv", "corrections.csv", "p 10.csv", "p 2.csv", "traces/a.csv", "results/provenance.json")
    touch(tmp_path, "results/trials.csv")
    assert list_tables(tmp_path) == ["p 2.csv", "p 10.csv", "traces/a.csv"]
