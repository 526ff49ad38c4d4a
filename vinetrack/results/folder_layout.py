"""Layout of a results folder: paths of its files, columns of its tables, and reading them.

Names of trials are always text: `007` stays `007`, and a trial may be called `NaN`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import UserError
from vinetrack.core.tables import result_file

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.result import Diagnosis
    from vinetrack.inference.fit_summary import FitSummary


TRACK_COLUMNS = (
    "frame",
    "time_s",
    "edge_px",
    "lead_position_m",
    "lead_position_sigma_m",
    "flag",
    "tracked_edge_px",
    "lead_position_systematic_m",
)
KINEMATICS_COLUMNS = (
    "time_s",
    "lead_position_m",
    "lead_velocity_m_s",
    "lead_velocity_sigma_m_s",
    "tail_velocity_m_s",
    "lead_acceleration_m_s2",
)
TRIALS_COLUMNS = (
    "trial",
    "vine",
    "condition",
    "status",
    "reason",
    "n_frames",
    "mm_per_px",
    "scale_rel_sigma",
    "noise_m",
    "steady_from_s",
    "steady_to_s",
    "steady_rule",
    "x_ss_m_s",
    "x_ss_sigma_m_s",
    "x_ss_paper_m_s",
    "cv",
    "force_N",
    "final_lead_velocity_m_s",
    "efficiency",
    "tube_width_mm",
    "growth_mm",
)
STEADY_COLUMNS = (
    "trial",
    "rule",
    "accepted",
    "from_s",
    "to_s",
    "points",
    "x_ss_m_s",
    "x_ss_sigma_m_s",
    "drift",
    "drift_95_low",
    "drift_95_high",
    "cv",
    "reason",
)
POINT_COLUMNS = (
    "trial",
    "vine",
    "condition",
    "diameter_mm",
    "thickness_um",
    "pressure_kPa",
    "window_pressure_kPa",
    "pressure_source",
    "x_ss_m_s",
    "x_ss_sigma_m_s",
    "force_N",
    "force_sigma_N",
    "yield_force_sigma_N",
    "scale_rel_sigma",
    "x_ss_paper_m_s",
    "force_paper_N",
    "eligible",
    "used",
    "reason",
)
TEXT_COLUMNS = frozenset(
    {
        "trial",
        "vine",
        "condition",
        "status",
        "reason",
        "steady_rule",
        "rule",
        "flag",
        "pressure_source",
        "model",
        "term",
        "size",
        "note",
        "added",
        "parameter",
        "symbol",
        "unit",
        "against",
        "sentence",
        "row",
        "where",
        "quantity",
        "setting",
        "as_printed",
        "mark",
        "how",
        "beside",
        "figure",
        "departure",
        "method",
    }
)
COUNT_COLUMNS = frozenset({"n_frames", "points"})
TRUTH_COLUMNS = frozenset({"accepted", "eligible", "used", "significant", "relative"})


class ResultsError(UserError):
    """A folder that is not a results folder, or lacks a file that is needed; one sentence with a remedy."""


@dataclass(frozen=True)
class Results:
    """Paths of a results folder."""

    folder: Path

    @property
    def trials(self) -> Path:
        """One row per trial of the sheet."""
        return self.folder / "trials.csv"

    @property
    def steady(self) -> Path:
        """Steady windows, one row per trial and rule."""
        return self.folder / "steady.csv"

    @property
    def points(self) -> Path:
        """Points of the damping fit, one row per trial, with the reason if a point is not used."""
        return self.folder / "damping_points.csv"

    @property
    def conditions(self) -> Path:
        """Results of each condition, its replicates combined."""
        return self.folder / "conditions.csv"

    @property
    def damping(self) -> Path:
        """The damping law by both methods."""
        return self.folder / "damping.json"

    @property
    def scaling(self) -> Path:
        """Scaling of B with the size of the vine."""
        return self.folder / "scaling.json"

    @property
    def comparison(self) -> Path:
        """Comparison of model and measurement, one row per condition."""
        return self.folder / "comparison.csv"

    @property
    def model_check(self) -> Path:
        """B and n from steady windows, compared with those from whole trajectories."""
        return self.folder / "model_check.csv"

    @property
    def audit(self) -> Path:
        """Size of neglected effects along the motion of each trial."""
        return self.folder / "audit.csv"

    @property
    def fit(self) -> Path:
        """The model in use, fitted to the trajectories."""
        return self.folder / "fit.json"

    def trajectories(self, condition: str) -> Path:
        """Return the file of measured and modelled trajectories of one condition."""
        return result_file(self.folder / "comparison", condition, ".csv")

    @property
    def diagnosis(self) -> Path:
        """The diagnosis of the model in use."""
        return self.folder / "diagnosis.json"

    @property
    def ladder(self) -> Path:
        """Errors of the initial model and of each later model."""
        return self.folder / "ladder.csv"

    def diagnosed(self, name: str) -> Path:
        """Return a file of the folder `diagnosis`."""
        return self.folder / "diagnosis" / name

    @property
    def final_fit(self) -> Path:
        """The fit of the model with all effects that the diagnosis added; exists only if it added any."""
        return self.folder / "diagnosis" / "final_fit.json"

    def predictions(self, trial: str) -> Path:
        """Return the file of one trial with the predictions of the initial and the final model."""
        return result_file(self.folder / "diagnosis" / "predictions", trial, ".csv")

    @property
    def overlays(self) -> Path:
        """Folder of the clips."""
        return self.folder / "overlays"

    def overlay(self, trial: str) -> Path:
        """Return the clip of one trial with the edges drawn."""
        return result_file(self.overlays, trial, ".mp4")

    @property
    def provenance(self) -> Path:
        """Versions, settings and hashes of all inputs."""
        return self.folder / "provenance.json"

    @property
    def report(self) -> Path:
        """The report."""
        return self.folder / "report.html"

    def track(self, trial: str) -> Path:
        """Return the file of the positions of one leading edge."""
        return result_file(self.folder / "tracks", trial, ".csv")

    def kinematics(self, trial: str) -> Path:
        """Return the file of the motion of one leading edge."""
        return result_file(self.folder / "kinematics", trial, ".csv")

    def analysed(self, trial: str) -> Path:
        """Return the file with a trial's contribution to the tables of the experiment."""
        return result_file(self.folder / "analysed", trial, ".json")

    def strip_figure(self, trial: str, suffix: str) -> Path:
        """Return the strip figure of one recording with its tracked edge."""
        return result_file(self.folder / "figures", f"strip_{trial}", suffix)

    def figure(self, name: str, suffix: str) -> Path:
        """Return a figure of the whole experiment."""
        return result_file(self.folder / "figures", name, suffix)

    @property
    def figure_list(self) -> Path:
        """List of the figures of the whole experiment that were drawn."""
        return self.folder / "figures" / "campaign.json"

    def trial_figure(self, trial: str, suffix: str) -> Path:
        """Return the figure of one trial."""
        return result_file(self.folder / "figures", f"trial_{trial}", suffix)


def read_result(path: Path) -> pd.DataFrame:
    """Read a table that a stage wrote: text stays text, numbers are floats, truth values are bool."""
    import pandas as pd

    try:
        with path.open(encoding="utf-8") as file:
            columns = file.readline().strip().split(",")
        numbers = [column for column in columns if column not in TEXT_COLUMNS | TRUTH_COLUMNS]
        table = pd.read_csv(
            path,
            dtype={column: float if column in numbers else str for column in columns},
            keep_default_na=False,
            na_values={column: ["", "NaN"] for column in numbers},
        )
    except FileNotFoundError:
        raise ResultsError(f"{path} does not exist: run the stage that writes it, or all with snakemake") from None
    except (OSError, ValueError) as error:
        raise ResultsError(f"{path} cannot be read ({error}): delete it and run snakemake again") from None
    for column in TRUTH_COLUMNS.intersection(columns):
        table[column] = (table[column] == "True").astype(bool)
    return table


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that a stage wrote; see `read_result`. Returns content : SI units; None for an
    unknown number.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ResultsError(f"{path} does not exist: run the stage that writes it, or all with snakemake") from None
    except (OSError, ValueError) as error:
        raise ResultsError(f"{path} cannot be read ({error}): delete it and run snakemake again") from None
    return content


def empty_table(columns: tuple[str, ...]) -> pd.DataFrame:
    """Return a table without rows."""
    import pandas as pd

    return pd.DataFrame({column: pd.Series(dtype=object if column in TEXT_COLUMNS else float) for column in columns})


# ------------------------------------------------------------------------------
# Reading the fit of a results folder as a typed object; the only reader of `fit.json`.


def read_fit(results: Results) -> FitSummary:
    """Read `fit.json`."""
    from vinetrack.inference.fit_summary import FitSummary

    content = read_json(results.fit)
    try:
        return FitSummary.from_json(content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise unreadable_file_error(results.fit, error) from None


def unreadable_file_error(path: Path, error: Exception) -> ResultsError:
    """Return the error for a file of the results with unexpected content."""
    return ResultsError(f"{path} cannot be read ({error!r}): delete it and run snakemake again")


# ------------------------------------------------------------------------------
# Reading the diagnosis of a results folder as a typed object; the only reader of `diagnosis.json`.


def read_diagnosis(results: Results) -> Diagnosis | None:
    """Read `diagnosis.json` and `ladder.csv`."""
    from vinetrack.diagnosis.result import Diagnosis

    if not results.diagnosis.exists():
        return None
    content = read_json(results.diagnosis)
    ladder = read_result(results.ladder) if results.ladder.exists() else None
    try:
        return Diagnosis.from_json(content, ladder if ladder is not None and len(ladder) else None)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise unreadable_file_error(results.diagnosis, error) from None
