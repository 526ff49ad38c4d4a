"""The report of a results folder: one page with its tables and figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.tables import write_json, write_text
from vinetrack.experiment.provenance import describe_run
from vinetrack.figures.registry import CAMPAIGN_FIGURES, PAPER_FIGURES, RegisteredFigure
from vinetrack.pipeline.diagnosis_tables import figure_tables, read_diagnosis_section, read_diagnosis_tables
from vinetrack.pipeline.figures_stage import describe_conditions
from vinetrack.pipeline.workflow import SHARED_FILES
from vinetrack.results.folder_layout import Results, read_json, read_result
from vinetrack.results.stored_diagnosis import read_diagnosis as stored_diagnosis
from vinetrack.results.stored_fit import read_fit

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.experiment.folder import Experiment
    from vinetrack.pipeline.diagnosis_tables import DiagnosisTables
    from vinetrack.report.build import Clip, ReportContent, ReportFigure, ReportSection
    from vinetrack.report.model_section import ModelResult
    from vinetrack.report.trials_section import TrackedRecording

_SHOWS_REFUTED = "It shows the initial model, which the diagnosis refutes."
_DASHED_REFUTED = "The dashed model is the initial one, which the diagnosis refutes."
# Addition to the caption of a figure that shows the initial model, if that is refuted
OF_INITIAL_MODEL = {
    **dict.fromkeys(("model_residuals", "payload_speed", "missing_force", "learned_force"), _SHOWS_REFUTED),
    **dict.fromkeys(("model_comparison", "before_after"), _DASHED_REFUTED),
}

MAX_CURVE_ROWS = 6000  # Largest number of rows of the downloadable curves (chosen)


def write_report(experiment: Experiment, folder: Path, settings: Mapping[str, Any]) -> Path:
    """Write `provenance.json` and `report.html`; return the path of the report."""
    from vinetrack.report.build import build_report

    results = Results(folder)
    content = report_content(experiment, folder, settings)
    page = build_report(content)
    write_json(results.provenance, dict(content.provenance))
    write_text(results.report, page)
    return results.report


def report_content(experiment: Experiment, folder: Path, settings: Mapping[str, Any]) -> ReportContent:
    """Collect the content of the report from a results folder."""
    from vinetrack.report.build import ReportContent

    results = Results(folder)
    trials = read_result(results.trials)
    drawn = [name for name in trials["trial"] if results.kinematics(name).exists()]
    filmed = [trial.name for trial in experiment.trials if trial.video is not None and trial.name in drawn]
    diagnosed = read_diagnosis_tables(results, describe_conditions(trials, experiment.trials))
    own_data = {name: _as_csv(table) for name, table in figure_tables(diagnosed).items()}
    own_data["model_comparison"] = _as_csv(_curves(results))
    return ReportContent(
        name=experiment.name,
        trials=trials,
        windows=read_result(results.steady),
        damping=read_json(results.damping),
        provenance=_provenance(experiment, settings),
        kinematics={name: read_result(results.kinematics(name)) for name in drawn},
        figures=[_figure(results, figure, own_data.get(figure.name, "")) for figure in _drawn(results)],
        trial_figures=_trial_figures(results, drawn),
        recordings={name: _recording(results, name) for name in filmed},
        clips={name: f"overlays/{name}.mp4" for name in filmed if results.overlay(name).exists()},
        clip=_clip(results, diagnosed, trials),
        model=_model_result(results),
        diagnosis=read_diagnosis_section(results, experiment),
        sections=[_paper_section(results)] if experiment.settings.published else [],
        notes=experiment.blank_notes,
    )


def _provenance(experiment: Experiment, settings: Mapping[str, Any]) -> dict[str, Any]:
    inputs = [path for trial in experiment.trials for path in (trial.track, trial.video, trial.pressure_trace) if path]
    target = getattr(experiment.settings.calibration, "image", None)
    inputs += [experiment.folder / target] if target is not None else []
    inputs += [experiment.folder / path for path in experiment.settings.effects]
    shared = [path for name in SHARED_FILES if (path := experiment.folder / name).exists()]
    return describe_run(experiment.folder, dict.fromkeys([*shared, *inputs]), dict(settings), experiment.settings.model)


def _model_result(results: Results) -> ModelResult:
    from vinetrack.report.model_section import ModelResult

    compared, checked = read_result(results.comparison), read_result(results.model_check)
    return ModelResult(read_fit(results), compared, checked, stored_diagnosis(results))


def _paper_section(results: Results) -> ReportSection:
    from vinetrack.report.paper_section import paper_section

    figures = [_figure(results, figure) for figure in PAPER_FIGURES.values() if _svg(results, figure).exists()]
    table, departures = (read_result(results.folder / f"{name}.csv") for name in ("paper", "paper_departures"))
    return paper_section(table, departures, figures)


def _drawn(results: Results) -> list[RegisteredFigure]:
    """Return the figures of the whole experiment that were drawn."""
    names = set(read_json(results.figure_list)["figures"])
    return [figure for name, figure in CAMPAIGN_FIGURES.items() if name in names and _svg(results, figure).exists()]


def _svg(results: Results, figure: RegisteredFigure) -> Path:
    return results.figure(figure.name, ".svg")


def _figure(results: Results, figure: RegisteredFigure, own_data: str = "") -> ReportFigure:
    """Return a figure for the page, with the file of its data, or with `own_data`."""
    from vinetrack.report.build import ReportFigure, figure_caption

    data = (results.folder / figure.data).read_text(encoding="utf-8") if figure.data else own_data
    svg = _svg(results, figure).read_text(encoding="utf-8")
    caption, data_name = figure_caption(figure.name), figure.data or f"{figure.name}.csv"
    diagnosis = stored_diagnosis(results)
    if diagnosis is not None and diagnosis.refutes and figure.name in OF_INITIAL_MODEL:
        caption = f"{caption} {OF_INITIAL_MODEL[figure.name]}"
    return ReportFigure(figure.name, figure.title, caption, svg, data_name, data)


def _as_csv(table: pd.DataFrame) -> str:
    """Return a table to download as CSV with five digits, more than a figure can show."""
    return str(table.to_csv(index=False, float_format="%.5g", lineterminator="\n"))


def _curves(results: Results) -> pd.DataFrame:
    """Return measured and modelled growth of all trials, at most `MAX_CURVE_ROWS` rows at an even stride."""
    import pandas as pd

    conditions = read_result(results.comparison)["condition"]
    parts = [read_result(results.trajectories(name)).assign(condition=name) for name in conditions]
    if not parts:
        return pd.DataFrame()
    whole = pd.concat(parts, ignore_index=True)
    return whole.iloc[:: -(-len(whole) // MAX_CURVE_ROWS)]


def _clip(results: Results, diagnosed: DiagnosisTables | None, trials: pd.DataFrame) -> Clip | None:
    """Return the clip for the page: of the condition that the model predicts worst if it has one, else the first."""
    from vinetrack.report.build import Clip

    with_clip = trials[[results.overlay(name).exists() for name in trials["trial"]]]
    if not len(with_clip):
        return None
    worst = diagnosed.worst if diagnosed is not None else ""
    chosen = with_clip[with_clip["condition"] == worst] if (with_clip["condition"] == worst).any() else with_clip
    name = str(chosen["trial"].iloc[0])
    note = " The condition is the one that the model predicts worst." if len(chosen) < len(with_clip) else ""
    edges = "the tracked edge (yellow)"
    if diagnosed is not None:
        edges += ", that of the initial model (vermillion)"
        edges += f", and that with {diagnosed.added} (blue)" if diagnosed.added else ""
    caption = f"The recording, slowed down, with {edges}.{note}"
    path = results.overlay(name)
    return Clip(name, path.read_bytes(), caption, _poster(path))


def _poster(path: Path) -> bytes:
    """Return a frame two thirds into a clip, where models differ visibly, as WebP; empty if it cannot be read."""
    import io

    import av

    try:
        with av.open(str(path)) as container:
            frames = list(container.decode(video=0))
            picture = frames[2 * len(frames) // 3].to_image()
    except av.error.FFmpegError:
        return b""
    file = io.BytesIO()
    picture.save(file, "WEBP", quality=60)
    return file.getvalue()


def _recording(results: Results, name: str) -> TrackedRecording:
    from vinetrack.report.trials_section import TrackedRecording

    strip = results.strip_figure(name, ".svg")
    return TrackedRecording(
        strip=strip.read_text(encoding="utf-8") if strip.exists() else "",
        flags=read_result(results.track(name))["flag"].tolist(),
        calibration=read_json(results.analysed(name)).get("calibration"),
    )


def _trial_figures(results: Results, names: list[str]) -> dict[str, str]:
    paths = {name: results.trial_figure(name, ".svg") for name in names}
    return {name: path.read_text(encoding="utf-8") for name, path in paths.items() if path.exists()}
