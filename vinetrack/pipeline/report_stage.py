"""The report of a results folder: one page with its tables and figures."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.tables import write_bytes, write_csv, write_json, write_text
from vinetrack.experiment.provenance import describe_run
from vinetrack.figures.registry import CAMPAIGN_FIGURES, PAPER_FIGURES, RegisteredFigure
from vinetrack.pipeline.diagnosis_stage import figure_tables, read_diagnosis_section, read_diagnosis_tables
from vinetrack.pipeline.tracks_stage import map_trials
from vinetrack.pipeline.workflow import SHARED_FILES
from vinetrack.results.folder_layout import Results, ResultsError, read_diagnosis, read_fit, read_json, read_result
from vinetrack.results.folder_layout import read_diagnosis as stored_diagnosis

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.core.records import Trial
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import FigureSettings
    from vinetrack.pipeline.diagnosis_stage import DiagnosisTables
    from vinetrack.report.build import Clip, ModelResult, ReportContent, ReportFigure, ReportSection, TrackedRecording


# ------------------------------------------------------------------------------
# Figures of a results folder: one per trial, and those of the whole experiment.

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _TrialPicture:
    """Inputs of the figure of one trial, besides its own files."""

    name: str
    title: str
    travel_ratio: float
    windows: pd.DataFrame


def draw_trials(
    experiment: Experiment,
    folder: Path,
    settings: FigureSettings,
    n_workers: int = 1,
    only: Collection[str] | None = None,
) -> int:
    """Draw `figures/trial_<trial>` for every trial that is not left out; return the number of figures."""
    results = Results(folder)
    by_trial = dict(iter(read_result(results.steady).groupby("trial", sort=False)))
    no_windows = read_result(results.steady).iloc[:0]
    trials = {trial.name: trial for trial in experiment.trials}
    pictures = [
        _TrialPicture(
            name,
            _describe_trial(trials[name]) if name in trials else name,
            trials[name].travel_ratio if name in trials else 2.0,
            by_trial.get(name, no_windows),
        )
        for name in experiment.names
        if name not in experiment.left_out and (only is None or name in only)
    ]
    work = partial(_draw_trial, results=results, settings=settings)
    return sum(1 for _ in map_trials(work, pictures, n_workers, "trial figures"))


def _draw_trial(picture: _TrialPicture, results: Results, settings: FigureSettings) -> None:
    _write(_trial_figure(picture, results), partial(results.trial_figure, picture.name), settings)


def _trial_figure(picture: _TrialPicture, results: Results) -> Figure:
    from vinetrack.figures.registry import draw

    track, kinematics = read_result(results.track(picture.name)), read_result(results.kinematics(picture.name))
    return draw("trial_motion", picture.title, track, kinematics, picture.windows, picture.travel_ratio)


def draw_trial(folder: Path, trial: Trial | None, name: str) -> Figure:
    """Draw position, speed and steady windows of one trial of a results folder."""
    results = Results(folder)
    windows = read_result(results.steady)
    title, ratio = (_describe_trial(trial), trial.travel_ratio) if trial is not None else (name, 2.0)
    return _trial_figure(_TrialPicture(name, title, ratio, windows[windows["trial"] == name]), results)


def draw_campaign(experiment: Experiment, folder: Path, settings: FigureSettings) -> list[str]:
    """Draw the figures of the whole experiment that have content; remove those of an earlier run."""
    from vinetrack.figures.registry import CAMPAIGN_FIGURES, draw

    results = Results(folder)
    for name in CAMPAIGN_FIGURES:
        for form in ("png", "svg", "pdf"):
            results.figure(name, f".{form}").unlink(missing_ok=True)
    inputs = campaign_inputs(folder, experiment.trials)
    for name, values in inputs.items():
        _write(draw(name, *values), partial(results.figure, name), settings)
        log.info("drew %s", name)
    write_json(results.figure_list, {"figures": list(inputs)})
    return list(inputs)


def campaign_inputs(folder: Path, known: tuple[Trial, ...]) -> dict[str, tuple[Any, ...]]:
    """Read the data of all figures of a whole experiment. Returns arguments of the drawing function by name of the
    figure, for figures with content.
    """
    from vinetrack.figures.overlay import MIN_EDGES, subpixel_positions
    from vinetrack.figures.registry import CAMPAIGN_FIGURES
    from vinetrack.narrative.diagnosis_text import METHOD_NAMES
    from vinetrack.pipeline.diagnosis_stage import read_diagnosis_tables

    results = Results(folder)
    damping, points, trials = read_json(results.damping), read_result(results.points), read_result(results.trials)
    described = describe_conditions(trials, known)
    names = described.loc[described["status"] != "left_out", "trial"]
    moved = {name: read_result(results.kinematics(name)) for name in names}
    places = subpixel_positions({name: read_result(results.track(name)) for name in names})
    in_fit = [vine for method in METHOD_NAMES for vine in damping[method]["vines"]]
    points = points.assign(used=points["used"] & bool(in_fit))
    compared = label_conditions(read_result(results.comparison), described)
    trajectories = {name: read_result(results.trajectories(name)) for name in compared["condition"]}
    scaling, diagnosed = read_json(results.scaling), read_diagnosis_tables(results, described)
    conditions = read_result(results.conditions)
    reached = conditions[conditions["final_lead_velocity_m_s"] > 0]
    grown = reached[["vine", "pressure_kPa", "payload_g"]].drop_duplicates()
    several_payloads = grown.duplicated(["vine", "pressure_kPa"]).any()
    diagnosis = read_diagnosis(results)
    if diagnosis is not None and diagnosis.refutes:
        compared = compared.assign(model="refuted initial model: " + compared["model"])
    inputs: dict[str, tuple[Any, ...]] = {
        "damping_law": (points, damping) if len(points) else (),
        "exponents": (damping,) if in_fit else (),
        "scaling": (scaling,) if scaling["isometric"] or scaling["thickness"] else (),
        "speed_scaling": (scaling,) if scaling["steady_speed"] else (),
        "efficiency": (scaling,) if scaling["efficiency"] else (),
        "payload_speed": (conditions, conditions.iloc[:0]) if several_payloads else (),
        "overview": (described, moved) if moved else (),
        "pixel_places": (places,) if len(places) >= MIN_EDGES else (),
        "model_comparison": (compared, with_final_model(trajectories, diagnosed)) if len(compared) else (),
        "model_residuals": (compared, trajectories) if len(compared) else (),
    }
    inputs |= {} if diagnosed is None else figure_inputs(diagnosed)
    return {name: inputs[name] for name in CAMPAIGN_FIGURES if inputs.get(name)}


def _write(figure: Figure, path: Callable[[str], Path], settings: FigureSettings) -> None:
    from vinetrack.figures.style import render

    for form, data in render(figure, settings.formats, settings.dpi).items():
        write_bytes(path(f".{form}"), data)


def _describe_trial(trial: Trial) -> str:
    """Return a title for a trial: name, vine, pressure and payload."""
    return f"{trial.name} · {' · '.join(_features(trial))}"


def _features(trial: Trial) -> list[str]:
    parts = [f"{1e3 * trial.diameter_m:g} mm"]
    if trial.thickness_m == trial.thickness_m:
        parts[0] += f" × {1e6 * trial.thickness_m:.4g} µm"
    if trial.length_m == trial.length_m:
        parts[0] += f" × {1e3 * trial.length_m:.4g} mm"
    parts.append(f"{1e-3 * trial.pressure_Pa:.3g} kPa")
    if trial.payload_kg:
        parts.append(f"{1e3 * trial.payload_kg:.3g} g")
    return parts


def describe_conditions(trials: pd.DataFrame, known: tuple[Trial, ...]) -> pd.DataFrame:
    """Add pressure and a short label of the condition to `trials.csv`, for the panels of the overview."""
    by_name: dict[str, Any] = {trial.name: trial for trial in known}
    labels, pressures = [], []
    for row in trials.itertuples():
        trial = by_name.get(str(row.trial))
        if trial is None:
            labels.append(str(row.condition) or "not readable")
            pressures.append(float("nan"))
            continue
        parts = _features(trial)
        labels.append(", ".join([f"{1e3 * trial.diameter_m:g} mm", *parts[1:]]))
        pressures.append(1e-3 * trial.pressure_Pa)
    return trials.assign(condition_label=labels, pressure_kPa=pressures)


def label_conditions(comparison: pd.DataFrame, described: pd.DataFrame) -> pd.DataFrame:
    """Add vine and label of each condition to `comparison.csv`, sorted by vine and then pressure."""
    first = described.drop_duplicates("condition").set_index("condition")
    vines = {vine: i for i, vine in enumerate(dict.fromkeys(described["vine"]))}
    labelled = comparison[comparison["condition"].isin(first.index)]
    labels = first.loc[labelled["condition"]]
    table = labelled.assign(vine=labels["vine"].to_numpy(), condition_label=labels["condition_label"].to_numpy())
    order = sorted(range(len(table)), key=lambda i: (vines[table["vine"].iloc[i]], labels["pressure_kPa"].iloc[i]))
    return table.iloc[order].reset_index(drop=True)


def figure_inputs(tables: DiagnosisTables) -> dict[str, tuple[Any, ...]]:
    """Return the data of the figures of a diagnosis that have content, by name. Returns arguments of the drawing
    function.
    """
    from vinetrack.figures.registry import DIAGNOSIS_FIGURES
    from vinetrack.pipeline.diagnosis_stage import figure_tables

    inputs: dict[str, tuple[Any, ...]] = {
        "ladder": (tables.ladder,),
        "before_after": (tables.labels.get(tables.worst, tables.worst), tables.before_after, tables.added),
        "where": (tables.where, tables.added),
        "missing_force": (tables.force,),
        "learned_force": (tables.learned,),
        "candidates": (tables.rounds,),
        "cosines": tables.cosines,
        "drift": (tables.drift, tables.added),
    }
    with_content = figure_tables(tables)
    return {name: inputs[name] for name in DIAGNOSIS_FIGURES if name in with_content}


def with_final_model(
    trajectories: Mapping[str, pd.DataFrame], diagnosed: DiagnosisTables | None
) -> dict[str, pd.DataFrame]:
    """Add the predictions of the final model to trajectories, if effects were added. Returns with a column
    `model_after_m`, m, if the table has as many rows as the prediction.
    """
    if diagnosed is None or not diagnosed.added or not len(diagnosed.trials):
        return dict(trajectories)
    final_m = {
        str(trial): part["model_after_m"].to_numpy() for trial, part in diagnosed.trials.groupby("trial", sort=False)
    }
    extended = {}
    for condition, table in trajectories.items():
        parts = [final_m.get(str(trial), np.empty(0)) for trial in dict.fromkeys(table["trial"])]
        after_m = np.concatenate(parts)
        extended[condition] = table.assign(model_after_m=after_m) if after_m.size == len(table) else table
    return extended


# ------------------------------------------------------------------------------
# Comparison of a results folder with the published numbers and figures: `paper.csv`, figures, and their tables.

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
    from vinetrack.paper.arithmetic import MARKS, MEASURED, SIMULATED, as_table, computed_rows
    from vinetrack.paper.protocol import protocol_rows
    from vinetrack.paper.result_rows import result_rows, theory_rows

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
    from vinetrack.paper import protocol as comparison
    from vinetrack.paper.arithmetic import departure_table, motion_table, pressure_table

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
    from vinetrack.paper.arithmetic import SIMULATED

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


_SHOWS_REFUTED = "It shows the initial model, which the diagnosis refutes."
_DASHED_REFUTED = "The dashed model is the initial one, which the diagnosis refutes."
# Addition to the caption of a figure that shows the initial model, if that is refuted
OF_INITIAL_MODEL = {
    **dict.fromkeys(("model_residuals", "missing_force", "learned_force"), _SHOWS_REFUTED),
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
    from vinetrack.report.build import ModelResult

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
    from vinetrack.report.build import TrackedRecording

    strip = results.strip_figure(name, ".svg")
    return TrackedRecording(
        strip=strip.read_text(encoding="utf-8") if strip.exists() else "",
        flags=read_result(results.track(name))["flag"].tolist(),
        calibration=read_json(results.analysed(name)).get("calibration"),
    )


def _trial_figures(results: Results, names: list[str]) -> dict[str, str]:
    paths = {name: results.trial_figure(name, ".svg") for name in names}
    return {name: path.read_text(encoding="utf-8") for name, path in paths.items() if path.exists()}
