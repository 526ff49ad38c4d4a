"""Every figure of a results folder, declared once: file name, label, title, section of the report, data and drawing.

The workflow uses the file names, its report label, category and caption, the figures stage the drawing function, and
the page title, caption and data. A new figure is an entry of `_ALL`, an entry of `_drawing` and a caption `<name>.rst`
in `CAPTIONS` (files, because Snakemake's report reads captions from files). Does not import matplotlib.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CAPTIONS = Path(__file__).parents[1] / "report" / "captions"  # Folder of the captions

# Category in Snakemake's report by section of the page; all other sections belong to the diagnosis
_CATEGORIES = {
    "damping": "Experiment",
    "model": "Experiment",
    "trials": "Trials",
    "paper": "Comparison with the paper",
    "power": "Power",
}


@dataclass(frozen=True)
class RegisteredFigure:
    """One figure of a results folder."""

    name: str
    section: str
    label: str
    title: str
    data: str = ""

    @property
    def category(self) -> str:
        """The category in Snakemake's report."""
        return _CATEGORIES.get(self.section, "Diagnosis")

    @property
    def caption_file(self) -> str:
        """The file of the caption."""
        return (CAPTIONS / f"{self.name}.rst").as_posix()


_ALL = (
    RegisteredFigure(
        "damping_law", "damping", "Force and steady speed", "Steady force and steady speed", "damping_points.csv"
    ),
    RegisteredFigure(
        "exponents",
        "damping",
        "Exponent and coefficients",
        "The exponent and the coefficients, by both methods",
        "damping.json",
    ),
    RegisteredFigure("scaling", "damping", "Coefficient and size", "Damping against size", "scaling.json"),
    RegisteredFigure(
        "speed_scaling", "damping", "Steady speed and size", "Steady speed against size", "conditions.csv"
    ),
    RegisteredFigure("efficiency", "damping", "Energy efficiency", "Energy efficiency", "conditions.csv"),
    RegisteredFigure(
        "payload_speed", "damping", "Final speed and payload", "Final speed and payload", "conditions.csv"
    ),
    RegisteredFigure("overview", "damping", "All trials", "All trials at a glance", "trials.csv"),
    RegisteredFigure("pixel_places", "damping", "Positions within a pixel", "Positions of edges within a pixel"),
    RegisteredFigure("model_comparison", "model", "Model and measurement", "Model and measurement"),
    RegisteredFigure("model_residuals", "model", "Residuals of the model", "Residuals of the model", "comparison.csv"),
    RegisteredFigure("ladder", "verdict", "The ladder of errors", "The ladder of errors"),
    RegisteredFigure("before_after", "verdict", "The worst condition", "The worst condition"),
    RegisteredFigure("where", "where", "Where it fails", "Misfit by condition and position"),
    RegisteredFigure("missing_force", "where", "The missing force", "The missing force"),
    RegisteredFigure("learned_force", "where", "The learned force", "The missing force, learned inside the fit"),
    RegisteredFigure("candidates", "candidates", "Candidates", "Candidates"),
    RegisteredFigure("cosines", "tied", "Tied candidates", "Candidates that these trials cannot tell apart"),
    RegisteredFigure("power", "power", "Detectable effects", "Detectable effects"),
    RegisteredFigure("drift", "drift", "Drift of parameters", "Parameters that change with a condition"),
    RegisteredFigure(
        "paper_fig4", "paper", "Fig. 4, position", "Fig. 4: the leading edge with the payload", "paper_motions.csv"
    ),
    RegisteredFigure("paper_table2", "paper", "Table II, drawn", "Table II, drawn", "paper.csv"),
    RegisteredFigure(
        "paper_fig5", "paper", "Fig. 5, final speed", "Fig. 5: final speed and payload", "paper_speeds.csv"
    ),
    RegisteredFigure(
        "paper_fig6",
        "paper",
        "Fig. 6, force and speed",
        "Fig. 6: growth force and steady speed",
        "damping_points.csv",
    ),
    RegisteredFigure(
        "paper_fig7", "paper", "Fig. 7, damping and size", "Fig. 7: B against scale and wall", "scaling.json"
    ),
    RegisteredFigure(
        "paper_fig8", "paper", "Fig. 8, speed and size", "Fig. 8: steady speed and scale", "conditions.csv"
    ),
    RegisteredFigure("paper_fig9", "paper", "Fig. 9, efficiency", "Fig. 9: energy efficiency", "conditions.csv"),
    RegisteredFigure(
        "paper_reservoir", "paper", "Pressure lost by a chamber", "Pressure lost by a chamber", "paper_pressures.csv"
    ),
    RegisteredFigure("trial_motion", "trials", "Motion", "Motion of one trial"),
    RegisteredFigure("strip", "trials", "Strip", "Strip of one recording"),
    RegisteredFigure("overlay", "trials", "Clip", "Clip of one recording"),
)
FIGURES = {figure.name: figure for figure in _ALL}  # All figures by name, in the order of the page

# Figures of a whole experiment
CAMPAIGN_FIGURES = {
    name: figure for name, figure in FIGURES.items() if figure.section not in ("paper", "power", "trials")
}

# Further figures of an experiment that is compared with the published numbers
PAPER_FIGURES = {name: figure for name, figure in FIGURES.items() if figure.section == "paper"}

# Figures that show the diagnosis
DIAGNOSIS_FIGURES = {name: figure for name, figure in FIGURES.items() if figure.category == "Diagnosis"}


def draw(name: str, *inputs: Any, **options: Any) -> Figure:
    """Draw a figure by its name in `FIGURES`."""
    return _drawing(name)(*inputs, **options)


def _drawing(name: str) -> Callable[..., Figure]:
    """The drawing function of a figure; clips (`overlay`) have none, they are composed frame by frame."""
    from vinetrack.figures import (
        damping_figures,
        paper_figures,
    )
    from vinetrack.figures import (
        damping_figures as size_figures,
    )
    from vinetrack.figures import (
        diagnosis_figures as candidate_figures,
    )
    from vinetrack.figures import (
        diagnosis_figures as ladder_figures,
    )
    from vinetrack.figures import (
        diagnosis_figures as learned_force_figure,
    )
    from vinetrack.figures import (
        diagnosis_figures as misfit_figures,
    )
    from vinetrack.figures import (
        motion_figures as model_comparison,
    )
    from vinetrack.figures import (
        motion_figures as overview,
    )
    from vinetrack.figures import (
        motion_figures as trial_motion,
    )
    from vinetrack.figures import (
        overlay as pixel_places,
    )
    from vinetrack.figures import (
        overlay as strip_figure,
    )
    from vinetrack.figures import (
        prediction_figures as power_figures,
    )

    functions: dict[str, Callable[..., Figure]] = {
        "damping_law": damping_figures.draw_damping_law,
        "exponents": damping_figures.draw_exponents,
        "scaling": size_figures.draw_scaling,
        "speed_scaling": size_figures.draw_speed_scaling,
        "efficiency": size_figures.draw_efficiency,
        "payload_speed": size_figures.draw_payload_speed,
        "overview": overview.draw_overview,
        "pixel_places": pixel_places.draw_pixel_places,
        "model_comparison": model_comparison.draw_model_comparison,
        "model_residuals": model_comparison.draw_model_residuals,
        "ladder": ladder_figures.draw_ladder,
        "before_after": ladder_figures.draw_before_after,
        "where": misfit_figures.draw_where,
        "missing_force": misfit_figures.draw_missing_force,
        "learned_force": learned_force_figure.draw_learned_force,
        "candidates": candidate_figures.draw_candidates,
        "cosines": candidate_figures.draw_cosines,
        "power": power_figures.draw_power,
        "drift": candidate_figures.draw_drift,
        "paper_fig4": paper_figures.draw_paper_position,
        "paper_table2": paper_figures.draw_paper_rms,
        "paper_fig5": size_figures.draw_payload_speed,
        "paper_fig6": paper_figures.draw_paper_damping,
        "paper_fig7": size_figures.draw_scaling,
        "paper_fig8": size_figures.draw_speed_scaling,
        "paper_fig9": size_figures.draw_efficiency,
        "paper_reservoir": paper_figures.draw_paper_reservoir,
        "trial_motion": trial_motion.draw_trial_motion,
        "strip": strip_figure.draw_strip,
    }
    return functions[name]
