"""A results folder: what each file in it is called, which columns it has, and reading it back.

Names of trials are text whatever they look like: `007` stays `007`, and a trial may be called `NaN`.
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
    """A results folder that is not one, or lacks what a stage needs: one sentence with a remedy."""


@dataclass(frozen=True)
class Results:
    """Paths of a results folder."""

    folder: Path

    @property
    def trials(self) -> Path:
        """One row a trial of the sheet."""
        return self.folder / "trials.csv"

    @property
    def steady(self) -> Path:
        """One row a trial and rule."""
        return self.folder / "steady.csv"

    @property
    def points(self) -> Path:
        """The points of the damping fit, one row a trial, and why one was not used."""
        return self.folder / "damping_points.csv"

    @property
    def conditions(self) -> Path:
        """What each condition gave, its replicates put together."""
        return self.folder / "conditions.csv"

    @property
    def damping(self) -> Path:
        """The damping law by both methods."""
        return self.folder / "damping.json"

    @property
    def scaling(self) -> Path:
        """How B grows with the size of the vine."""
        return self.folder / "scaling.json"

    @property
    def comparison(self) -> Path:
        """Model against measurement, one row a condition."""
        return self.folder / "comparison.csv"

    @property
    def model_check(self) -> Path:
        """B and n of steady windows beside those of whole trajectories."""
        return self.folder / "model_check.csv"

    @property
    def audit(self) -> Path:
        """What the model leaves out, weighed along the motion of each trial."""
        return self.folder / "audit.csv"

    @property
    def payload_model(self) -> Path:
        """Final speed against payload as the model in use has it."""
        return self.folder / "payload_model.csv"

    @property
    def fit(self) -> Path:
        """The model in use, fitted to the trajectories."""
        return self.folder / "fit.json"

    def trajectories(self, condition: str) -> Path:
        """Return the file of the trials of one condition and what the model gives for them.

        Parameters
        ----------
        condition : its name.

        Returns
        -------
        path, CSV.
        """
        return result_file(self.folder / "comparison", condition, ".csv")

    @property
    def diagnosis(self) -> Path:
        """What the model in use lacks."""
        return self.folder / "diagnosis.json"

    @property
    def ladder(self) -> Path:
        """The errors of the model that the user came with and of every one after it."""
        return self.folder / "ladder.csv"

    def diagnosed(self, name: str) -> Path:
        """Return a table that the diagnosis wrote.

        Parameters
        ----------
        name : of the file, with suffix.

        Returns
        -------
        path.
        """
        return self.folder / "diagnosis" / name

    @property
    def final_fit(self) -> Path:
        """The fit of the model with every effect that the diagnosis added; only where it added any."""
        return self.folder / "diagnosis" / "final_fit.json"

    def predictions(self, trial: str) -> Path:
        """Return the file of one trial and what the models before and after give for it.

        Parameters
        ----------
        trial : its name.

        Returns
        -------
        path, CSV.
        """
        return result_file(self.folder / "diagnosis" / "predictions", trial, ".csv")

    @property
    def overlays(self) -> Path:
        """Folder of the clips."""
        return self.folder / "overlays"

    def overlay(self, trial: str) -> Path:
        """Return the recording of one trial with the edges drawn.

        Parameters
        ----------
        trial : its name.

        Returns
        -------
        path, MP4.
        """
        return result_file(self.overlays, trial, ".mp4")

    @property
    def provenance(self) -> Path:
        """What all this was made with."""
        return self.folder / "provenance.json"

    @property
    def report(self) -> Path:
        """The page for people."""
        return self.folder / "report.html"

    def track(self, trial: str) -> Path:
        """Return the file of the positions of one leading edge.

        Parameters
        ----------
        trial : its name.

        Returns
        -------
        path, CSV.
        """
        return result_file(self.folder / "tracks", trial, ".csv")

    def kinematics(self, trial: str) -> Path:
        """Return the file of the motion of one leading edge.

        Parameters
        ----------
        trial : its name.

        Returns
        -------
        path, CSV.
        """
        return result_file(self.folder / "kinematics", trial, ".csv")

    def analysed(self, trial: str) -> Path:
        """Return what one trial adds to the tables of the experiment.

        Parameters
        ----------
        trial : its name.

        Returns
        -------
        path, JSON.
        """
        return result_file(self.folder / "analysed", trial, ".json")

    def strip_figure(self, trial: str, suffix: str) -> Path:
        """Return the strip of one recording with its tracked edge.

        Parameters
        ----------
        trial : its name.
        suffix : with its dot.

        Returns
        -------
        path.
        """
        return result_file(self.folder / "figures", f"strip_{trial}", suffix)

    def figure(self, name: str, suffix: str) -> Path:
        """Return a figure of the whole experiment.

        Parameters
        ----------
        name : of the figure.
        suffix : with its dot.

        Returns
        -------
        path.
        """
        return result_file(self.folder / "figures", name, suffix)

    @property
    def figure_list(self) -> Path:
        """Which figures of the whole experiment had content and were drawn."""
        return self.folder / "figures" / "campaign.json"

    def trial_figure(self, trial: str, suffix: str) -> Path:
        """Return the figure of one trial.

        Parameters
        ----------
        trial : its name.
        suffix : with its dot.

        Returns
        -------
        path.
        """
        return result_file(self.folder / "figures", f"trial_{trial}", suffix)


def read_result(path: Path) -> pd.DataFrame:
    """Read a table that a stage wrote: text stays text, numbers are floats, truth values are bool.

    Parameters
    ----------
    path : a CSV of a results folder.

    Returns
    -------
    table : in the units of its columns.

    Raises
    ------
    ResultsError
        If there is no such file or it is no table of ours.
    """
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
    """Read a JSON file that a stage wrote; see `read_result`.

    Parameters
    ----------
    path : a JSON file of a results folder.

    Returns
    -------
    content : SI units; None where a number is not known.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ResultsError(f"{path} does not exist: run the stage that writes it, or all with snakemake") from None
    except (OSError, ValueError) as error:
        raise ResultsError(f"{path} cannot be read ({error}): delete it and run snakemake again") from None
    return content


def empty_table(columns: tuple[str, ...]) -> pd.DataFrame:
    """A table with its header alone.

    Parameters
    ----------
    columns : names, in order.

    Returns
    -------
    table : without rows, text and numbers typed as `read_result` has them.
    """
    import pandas as pd

    return pd.DataFrame({column: pd.Series(dtype=object if column in TEXT_COLUMNS else float) for column in columns})
