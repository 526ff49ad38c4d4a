"""The section on the paper's numbers: both tables, every row, and the explanation of the marks."""

from __future__ import annotations

import math

import pandas as pd

from vinetrack.paper.arithmetic import (
    COMPUTED,
    DEPARTURE_COLUMNS,
    DEPARTURES,
    NOT_CHECKABLE,
    SIMULATED,
    PaperRow,
    as_table,
)
from vinetrack.report.paper_section import paper_section, tally

nan = math.nan


def rows() -> pd.DataFrame:
    common = {"where": "somewhere", "how": "somehow"}
    return as_table(
        [
            PaperRow(row="thickness_R1", quantity="wall", mark=SIMULATED, published=50.0, ours=50.0, **common),
            PaperRow(row="press_R1", quantity="press", mark=NOT_CHECKABLE, published=110.0, **common),
            PaperRow(
                row="B_R1", quantity="B", mark=SIMULATED, published=0.57, ours=0.575, low=0.56, high=0.59, **common
            ),
            PaperRow(
                row="position_rms_7kPa",
                where="Fig. 4, Table II",
                how="somehow",
                quantity="rms",
                mark=SIMULATED,
                published=1.9,
                ours=0.32,
                unit="cm",
            ),
            PaperRow(
                row="p",
                quantity="p-value",
                setting="of a fit",
                mark=COMPUTED,
                published=0.32,
                ours=0.033,
                beside="a note",
                **common,
            ),
        ]
    )


def departures() -> pd.DataFrame:
    sizes = (0.057, 0.069, 0.095, 0.110, 0.114)
    named = zip(DEPARTURES, sizes, strict=True)
    return pd.DataFrame(
        [("Fig. 4", 7.0, one.name, size, nan, nan) for one, size in named], columns=list(DEPARTURE_COLUMNS)
    )


def test_kinds_are_counted_and_explained() -> None:
    assert tally(rows()) == "5 rows: 1 computed, 3 simulated from printed parameters, 1 not checkable."
    section = paper_section(rows(), departures(), [])
    text = " ".join(section.paragraphs)
    assert "agreement checks the analysis, not the paper" in text
    assert "found in trials that were filmed" not in text
    assert "Neither is claimed to be the reason" in text


def test_table_one_has_what_is_printed_and_ours() -> None:
    one = paper_section(rows(), departures(), []).tables[0]
    assert len(one.rows) == 4
    assert one.rows[0] == ("1", "50", "–", "110", "–", "0.57", "0.575 (0.560 to 0.590)", "0.964", "–")
    assert len(one.head) == len(one.rows[0])


def test_table_two_sets_departures_beside_the_errors() -> None:
    positions, speeds = paper_section(rows(), departures(), []).tables[1:3]
    assert positions.rows[0] == ("7", "1.9", "0.320", "5.70 to 6.90", "9.50", "11.0 to 11.4")
    assert positions.rows[1] == ("14", "0.29", "–", "–", "–", "–")
    assert [row[:2] for row in speeds.rows] == [("14", "0.27"), ("28", "0.56"), ("41", "1.35")]
    assert all(len(row) == len(table.head) for table in (positions, speeds) for row in table.rows)


def test_every_row_is_there_with_its_mark() -> None:
    tables = paper_section(rows(), departures(), []).tables[3:]
    assert sum(len(table.rows) for table in tables) == 5
    (elsewhere,) = (table for table in tables if "pressures" in table.title)
    assert elsewhere.rows[-1] == ("p-value, of a fit", "0.32", "0.0330", COMPUTED, "somehow; a note")
    (fourth,) = (table for table in tables if table.title.startswith("Figs. 4 and 5"))
    assert fourth.rows[0][:4] == ("rms (cm)", "1.9", "0.320", SIMULATED)
