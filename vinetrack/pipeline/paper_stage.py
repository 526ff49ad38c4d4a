"""Comparison of a results folder with the published numbers and figures: `paper.csv`, figures, and their tables."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.tables import write_bytes, write_csv
from vinetrack.results.folder_layout import Results, ResultsError, read_json, read_result
from vinetrack.results.stored_fit import read_fit

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import FigureSettings

log = logging.getLogger(__name__)

TABLES_FOR_FIGURES = ("paper", "paper_departures", "paper_motions", "paper_means", "paper_positions", "paper_pressures")
SPEED_TABLES = ("paper_speeds", "paper_speed_curves")

FIG5_NOTE = (
    "B of this vine and the payloads other than 35.6 g are not printed; the paper shows its points only in a plot"
)
FIG7_VIRTUAL = (
    "Of the 12 mm vines only that of 100 µm has a printed B. Virtual vines with other walls were simulated with B "
    "proportional to the wall: their straight line is an input"
)
FIG8_NOTE = (
    "Alvarez et al. (2025): linear, R² = 0.935, from which p = 0.033 (printed: 0.32). The B printed in Fig. 6 do not "
    "give linearly increasing speeds"
)
FIG8_VIRTUAL = ": virtual vines simulated with them cannot test one figure against the other"
FIG9_NOTE = "Alvarez et al. (2025): higher for thinner walls, no clear trend with diameter; values are only plotted"


def compare_with_paper(experiment: Experiment, folder: Path) -> pd.DataFrame:
    """Write `paper.csv` and the tables of the figures; return `paper.csv` as written."""
    from vinetrack.paper.arithmetic import computed_rows
    from vinetrack.paper.protocol import protocol_rows
    from vinetrack.paper.result_rows import result_rows
    from vinetrack.paper.rows import MARKS, MEASURED, SIMULATED, as_table
    from vinetrack.paper.theory_rows import theory_rows

    kind = experiment.settings.published
    if kind is None:
        raise ResultsError("experiment.yaml has no key `published`: set it to `simulated` or `measured`")
    results = Results(folder)
    mark = SIMULATED if kind == "simulated" else MEASURED
    tables = _tables(experiment, results)
    results_given = _experiment_results(mark, results, tables)
    rows = [
        *protocol_rows(experiment.trials, read_result(results.steady), mark),
        *result_rows(results_given),
        *computed_rows(),
        *theory_rows(experiment.trials),
    ]
    table = as_table(rows)
    for name, table_of_figure in tables.items():
        write_csv(folder / f"{name}.csv", table_of_figure)
    write_csv(folder / "paper.csv", table)
    for mark in MARKS:
        log.info("%s: %d rows", mark, int((table["mark"] == mark).sum()))
    return table


def _tables(experiment: Experiment, results: Results) -> dict[str, pd.DataFrame]:
    """Return the tables of all figures, by file name."""
    from vinetrack.paper import comparison
    from vinetrack.paper.departures import departure_table, motion_table, pressure_table

    trials = experiment.trials
    positions, speeds = comparison.position_conditions(trials), comparison.speed_conditions(trials)
    starts = {
        name: comparison.Rest(fitted_trial.release_s, fitted_trial.origin_m)
        for name, fitted_trial in read_fit(results).trials.items()
    }
    rests = {name: start for name, start in starts.items() if math.isfinite(start.release_s + start.origin_m)}
    kinematics = {
        trial.name: read_result(results.kinematics(trial.name))
        for replicates in (*positions.values(), *speeds.values())
        for trial in replicates
        if trial.name in rests
    }
    payloads_g = sorted({round(1e3 * replicates[0].payload_kg, 6) for replicates in speeds.values()})
    return {
        "paper_departures": departure_table(payloads_g),
        "paper_motions": motion_table(),
        "paper_means": comparison.mean_motions(positions, kinematics, rests),
        "paper_positions": comparison.position_errors(positions, kinematics, rests),
        "paper_pressures": pressure_table(),
        "paper_speeds": comparison.final_speeds(speeds, kinematics, rests),
        "paper_speed_curves": comparison.speed_curves(speeds),
    }


def draw_paper(folder: Path, settings: FigureSettings) -> None:
    """Draw the figures of the comparison from the tables of `compare_with_paper`."""
    from vinetrack.figures.registry import draw
    from vinetrack.figures.style import render

    for name, inputs in _figure_inputs(Results(folder)).items():
        for form, data in render(draw(name, *inputs), settings.formats, settings.dpi).items():
            write_bytes(Results(folder).figure(name, f".{form}"), data)


def _figure_inputs(results: Results) -> dict[str, tuple[Any, ...]]:
    """Return the data of each figure of the comparison, by its name in the registry."""
    from vinetrack.core import published
    from vinetrack.paper.rows import SIMULATED

    tables = {name: read_result(results.folder / f"{name}.csv") for name in (*TABLES_FOR_FIGURES, *SPEED_TABLES)}
    damping, scaling = read_json(results.damping), read_json(results.scaling)
    virtual = (tables["paper"]["mark"] == SIMULATED).any()
    fig7, fig8 = (FIG7_VIRTUAL, FIG8_NOTE + FIG8_VIRTUAL) if virtual else ("", FIG8_NOTE)
    speed = {"steady_speed": _near(scaling["steady_speed"], published.STEADY_SPEED_KPA)}
    efficiency = {"efficiency": _near(scaling["efficiency"], published.EFFICIENCY_KPA)}
    motions = (tables[f"paper_{name}"] for name in ("motions", "means", "positions"))
    printed_B = {"B": _printed_B(damping), "source": f"{published.SOURCE}, printed"}
    return {
        "paper_fig4": (*motions, published.POSITION_RMS_CM),
        "paper_fig5": (
            tables["paper_speeds"],
            tables["paper_speed_curves"],
            FIG5_NOTE,
            "Eq. (2), B proportional to the wall",
        ),
        "paper_fig6": (read_result(results.points), damping, published.DAMPING_B, published.EXPONENT),
        "paper_fig7": (scaling, printed_B, fig7),
        "paper_fig8": (speed, fig8),
        "paper_fig9": (efficiency, FIG9_NOTE),
        "paper_reservoir": (tables["paper_pressures"],),
        "paper_table2": (tables["paper"], tables["paper_departures"]),
    }


def _near(families: list[dict[str, Any]], pressure_kPa: float) -> list[dict[str, Any]]:
    return [family for family in families if abs(family["pressure_kPa"] / pressure_kPa - 1) < 0.02]


def _printed_B(damping: dict[str, Any]) -> dict[str, float]:
    """Return the printed B of those vines that are in Table I, by the name of the vine here."""
    from vinetrack.core import published

    printed = {}
    for law in damping.values():
        for name, vine in (law.get("vines") or {}).items():
            scale = published.scale_of(vine["diameter_mm"], vine["thickness_um"])
            if scale is not None:
                printed[name] = published.DAMPING_B[scale]
    return printed


def _experiment_results(mark: str, results: Results, tables: Mapping[str, pd.DataFrame]) -> Any:
    from vinetrack.paper.result_rows import ExperimentResults

    return ExperimentResults(
        mark=mark,
        damping=read_json(results.damping),
        scaling=read_json(results.scaling),
        conditions=read_result(results.conditions),
        fit=read_fit(results),
        positions=tables["paper_positions"],
        speeds=tables["paper_speeds"],
        departures=tables["paper_departures"],
    )
