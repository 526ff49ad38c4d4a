"""The tables and pictures of a results folder put together as one page."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.figures.style import METHOD_NAMES
from vinetrack.provenance import describe_run
from vinetrack.stages.results import Results, read_json, read_result
from vinetrack.tables import write_json, write_text

if TYPE_CHECKING:
    from vinetrack.experiment import Experiment
    from vinetrack.report.build import ReportFigure
    from vinetrack.report.recordings import Recording

FIGURES = {
    "damping_law": ("Steady force and steady speed", "damping_points.csv"),
    "exponents": ("The exponent and the coefficients, by both methods", "damping.json"),
    "scaling": ("How damping grows with size", "scaling.json"),
    "speed_scaling": ("How steady speed goes with size", "conditions.csv"),
    "efficiency": ("How much of the work becomes motion", "conditions.csv"),
    "payload_speed": ("Final speed and payload", "conditions.csv"),
    "overview": ("All trials at a glance", "trials.csv"),
    "model_comparison": ("Model and measurement", "comparison.csv"),
    "model_residuals": ("What the model leaves", "comparison.csv"),
}
MAX_TRIAL_PICTURES = 60
"""With more trials their figures stay files beside the report: at 0.1 MB each the page would not open at once."""


def write_report(experiment: Experiment, folder: Path, settings: Mapping[str, Any]) -> Path:
    """Write `provenance.json` and `report.html`; return the path of the report.

    Raises
    ------
    ResultsError
        If a stage before this one has not run.
    """
    from vinetrack.report.build import ReportContent, build_report
    from vinetrack.report.model import ModelResult

    results = Results(folder)
    inputs = [path for trial in experiment.trials for path in (trial.track, trial.video, trial.pressure_trace) if path]
    target = getattr(experiment.settings.calibration, "image", None)
    inputs += [experiment.folder / target] if target is not None else []
    inputs += [experiment.folder / path for path in experiment.settings.effects]
    shared = [path for name in ("trials.csv", "experiment.yaml") if (path := experiment.folder / name).exists()]
    provenance = describe_run(
        experiment.folder, dict.fromkeys([*shared, *inputs]), dict(settings), experiment.settings.model
    )
    trials = read_result(results.trials)
    drawn = [name for name in trials["trial"] if results.kinematics(name).exists()]
    filmed = [trial.name for trial in experiment.trials if trial.video is not None and trial.name in drawn]
    few = len(drawn) <= MAX_TRIAL_PICTURES
    content = ReportContent(
        name=experiment.name,
        trials=trials,
        windows=read_result(results.steady),
        damping=read_json(results.damping),
        provenance=provenance,
        kinematics={name: read_result(results.kinematics(name)) for name in drawn},
        figures=[figure for name in _drawn(results) if (figure := _figure(results, name))],
        trial_figures=_trial_figures(results, drawn) if few else {},
        recordings={name: _recording(results, name, few) for name in filmed},
        n_strips_left_out=0 if few else len(filmed),
        model=ModelResult(read_json(results.fit), read_result(results.comparison), read_result(results.model_check)),
    )
    page = build_report(content)
    write_json(results.provenance, provenance)
    write_text(results.report, page)
    return results.report


def _drawn(results: Results) -> list[str]:
    """Figures with something in them; the others would only repeat why there is no law."""
    damping, scaling = read_json(results.damping), read_json(results.scaling)
    empty = set() if any(damping[method]["vines"] for method in METHOD_NAMES) else {"exponents"}
    empty |= set() if scaling["isometric"] or scaling["thickness"] else {"scaling"}
    empty |= {key for key, of in (("speed_scaling", "steady_speed"), ("efficiency", "efficiency")) if not scaling[of]}
    empty |= set() if len(read_result(results.payload_model)) else {"payload_speed"}
    empty |= {"model_comparison", "model_residuals"} if read_json(results.fit)["refused"] else set()
    return [name for name in FIGURES if name not in empty]


def _figure(results: Results, name: str) -> ReportFigure | None:
    from vinetrack.report.build import ReportFigure

    path = results.figure(name, ".svg")
    if not path.exists():
        return None
    title, data_name = FIGURES[name]
    caption = (files("vinetrack.report") / "captions" / f"{name}.rst").read_text(encoding="utf-8")
    data = (results.folder / data_name).read_text(encoding="utf-8")
    return ReportFigure(name, title, " ".join(caption.split()), path.read_text(encoding="utf-8"), data_name, data)


def _recording(results: Results, name: str, with_strip: bool) -> Recording:
    from vinetrack.report.recordings import Recording

    strip = results.strip_figure(name, ".svg")
    return Recording(
        strip=strip.read_text(encoding="utf-8") if with_strip and strip.exists() else "",
        flags=read_result(results.track(name))["flag"].tolist(),
        calibration=read_json(results.analysed(name)).get("calibration"),
    )


def _trial_figures(results: Results, names: list[str]) -> dict[str, str]:
    paths = {name: results.trial_figure(name, ".svg") for name in names}
    return {name: path.read_text(encoding="utf-8") for name, path in paths.items() if path.exists()}
