"""The missing force learned within the fit: a curve with its band, or a map with the paths of the trials.

Regions without trials are left blank: there the force is that of the prior.
"""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.units import number
from vinetrack.figures.registry import DASHED_REFUTED, SHOWS_REFUTED, figure
from vinetrack.figures.style import (
    BLUE,
    DASHED,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    VERMILLION,
    VINE_MARKERS,
    fitting_size,
    line_key,
    new_figure,
    panel_grid,
    plain_log_ticks,
    rows,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vinetrack.core.records import Floats


# ------------------------------------------------------------------------------
# Errors of the models of the ladder, and the condition with the largest error of the initial model, before
# and after.
#
# Errors change by factors, so their axis is logarithmic. The range below replicate scatter is shaded: an error there
# says
# nothing about the model.

# Columns of `ladder.csv`, with label, colour, marker and line style
_ERRORS = {
    "rms_in_sample_m": ("in sample", BLUE, "o", "-"),
    "rms_left_out_m": ("on left-out conditions", VERMILLION, "s", "-"),
    "rms_highest_pressure_m": ("on the left-out highest pressure", GREEN, "^", DASHED),
}

_WIDTH_IN = 5.2  # Chosen: both figures fit side by side on a page of 11 in

_STEP_IN = 1.55  # Width per model of the ladder; chosen: the longest name of an effect, wrapped at 18 letters of 10 pt


@figure("ladder", "verdict", "The ladder of errors", data="ladder")
def draw_ladder(ladder: pd.DataFrame) -> Figure | None:
    """Root mean square error of position of the initial model and with every effect that was added, on a
    logarithmic axis: in sample; on conditions left out of the fit in turn; and on the left-out highest pressure of
    each vine. The dotted line is the replicate scatter over all conditions: when the error has fallen to it,
    nothing is left to explain. With few replicates it is uncertain, so an error may end below it; at the highest
    pressures replicates often scatter less.
    """
    if not len(ladder):
        return None
    steps = np.arange(len(ladder))
    errors_mm = {key: 1e3 * ladder[key].to_numpy(dtype=float) for key in _ERRORS}
    floor_mm = 1e3 * ladder["floor_m"].to_numpy(dtype=float)
    fig = new_figure(max(_WIDTH_IN, 2.4 + _STEP_IN * len(ladder)), 3.9)
    ax = fig.add_subplot()
    ax.set(yscale="log", ylabel="error of position, rms (mm)", xlim=(-0.5, len(ladder) - 0.5))
    ax.set_ylim(*_error_limits([*errors_mm.values(), floor_mm]))
    _draw_floor(ax, floor_mm)
    for key, (_, colour, marker, line) in _ERRORS.items():
        ax.plot(steps, errors_mm[key], marker=marker, color=colour, ls=line, ms=7, zorder=3)
    _write_values(ax, errors_mm)
    partial = ladder["partial"] if "partial" in ladder else [False] * len(ladder)
    labels = [_step_label(*step) for step in zip(range(len(ladder)), ladder["added"], partial, strict=True)]
    ax.set_xticks(steps, labels)
    ax.grid(axis="x", visible=False)
    plain_log_ticks(ax, "y")
    _ladder_legend(ax, errors_mm)
    return fig


def _step_label(step: int, added: Any, partial: Any) -> str:
    if step == 0:
        return "initial\nmodel"
    words = str(added).replace("+", " + ").replace("_", " ") + (" (partial)" if partial in (True, "True") else "")
    return "+ " + "\n".join(textwrap.wrap(words, 18, break_long_words=False))


def _error_limits(errors_mm: list[np.ndarray]) -> tuple[float, float]:
    """Limits around all values with a margin, spanning at least a factor of four."""
    known = np.concatenate(errors_mm)
    known = known[np.isfinite(known) & (known > 0)]
    if not known.size:
        return 0.1, 1.0
    low, high = float(known.min()), float(known.max())
    middle = math.sqrt(low * high)
    return min(0.72 * low, middle / 2), max(1.35 * high, middle * 2)


def _draw_floor(ax: Axes, floor_mm: np.ndarray) -> None:
    known = floor_mm[np.isfinite(floor_mm) & (floor_mm > 0)]
    if not known.size:
        return
    floor = float(known[-1])
    ax.axhspan(ax.get_ylim()[0], floor, color=MUTED, alpha=0.16, lw=0, zorder=0)
    ax.axhline(floor, color=MUTED, lw=1.3, ls=(0, (1.5, 1.5)), zorder=1)
    words = f"replicate scatter: {number(floor)} mm"
    ax.annotate(
        words, (0.015, floor), (0, -4), ("axes fraction", "data"), "offset points", color=MUTED, va="top", fontsize=9
    )


def _write_values(ax: Axes, errors_mm: dict[str, np.ndarray]) -> None:
    """Write the values next to the points, clear of the lines and of each other."""
    low, high = (math.log10(value) for value in ax.get_ylim())
    spacing = 0.075 * (high - low)
    n_steps = len(next(iter(errors_mm.values())))
    for step in range(n_steps):
        shown = [(float(values[step]), _ERRORS[key][1]) for key, values in errors_mm.items() if values[step] > 0]
        shown.sort()
        side, sideways = ("right", -9) if step == 0 and n_steps > 1 else ("left", 9)
        lifted = 0.6 * spacing if 0 < step < n_steps - 1 else 0.0  # lines arrive from above left and leave to the right
        levels = [math.log10(value) + lifted for value, _ in shown]
        for i in range(1, len(levels)):
            levels[i] = max(levels[i], levels[i - 1] + spacing)
        excess = max(levels[-1] - (high - spacing / 2), 0.0) if levels else 0.0
        for (value, colour), level in zip(shown, levels, strict=True):
            style: dict[str, Any] = {"color": colour, "fontsize": 9, "fontweight": "bold", "ha": side, "va": "center"}
            ax.annotate(
                number(value), (step, 10 ** (level - excess)), (sideways, 0), textcoords="offset points", **style
            )


def _ladder_legend(ax: Axes, errors_mm: dict[str, np.ndarray]) -> None:
    handles = [
        line_key(name, color=colour, marker=marker, ls=line, ms=6)
        for key, (name, colour, marker, line) in _ERRORS.items()
        if np.isfinite(errors_mm[key]).any()
    ]
    ax.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(-0.02, 1.0), fontsize=9, labelspacing=0.25, labelcolor=INK
    )


BEFORE, AFTER = VERMILLION, BLUE  # Colours of the models before and after adding effects, here and in the clips

_BEFORE_LINE: Any = (0, (5, 2))  # Dashes of five line widths
_MAX_POINTS = 160  # Points per trial; chosen


@figure("before_after", "verdict", "The worst condition", data="before_after", if_refuted=DASHED_REFUTED)
def draw_before_after(worst: str, before_after: pd.DataFrame, added: str) -> Figure | None:
    """The condition that the initial model predicts worst. Above, growth of the leading edge since release: every
    replicate (dots), the model before (dashed) and with what was added (full). Below, the misfit, measured minus
    model. Release and origin are fitted for each trial.
    """
    if before_after.empty:
        return None
    parts = [_moving(part) for _, part in before_after.groupby("trial", sort=False)]
    has_after = bool(np.isfinite(before_after["model_after_m"]).any())
    fig = new_figure(_WIDTH_IN, 4.3)
    growth, misfit = fig.subplots(2, 1, sharex=True, height_ratios=(2.1, 1))
    for part in parts:
        time_ms, measured_mm = 1e3 * part["time_s"].to_numpy(), 1e3 * part["lead_position_m"].to_numpy()
        growth.plot(time_ms, measured_mm, ".", color=MUTED, ms=4.5, mew=0)
        misfit.plot(time_ms, measured_mm - 1e3 * part["model_before_m"], color=BEFORE, lw=1.3, ls=_BEFORE_LINE)
        if has_after:
            misfit.plot(time_ms, measured_mm - 1e3 * part["model_after_m"], color=AFTER, lw=1.3)
    for part in parts:
        growth.plot(1e3 * part["time_s"], 1e3 * part["model_before_m"], color=BEFORE, lw=1.6, ls=_BEFORE_LINE)
        if has_after:
            growth.plot(1e3 * part["time_s"], 1e3 * part["model_after_m"], color=AFTER, lw=1.6)
    misfit.axhline(0, color=INK, lw=0.8)
    growth.set_ylabel("growth (mm)")
    misfit.set(xlabel="time since release (ms)", ylabel="misfit (mm)")
    growth.set_title(worst, fontsize=10)
    _before_after_legend(growth, before_after, len(parts), has_after, added)
    return fig


def rms_m(trials: pd.DataFrame, model: str) -> float:
    """Return the root mean square error of position of a model after release, m. Returns all trials have the same
    weight, as in `comparison.csv`; NaN without a prediction.
    """
    squares = [
        float(np.mean((part["lead_position_m"] - part[model]) ** 2))
        for _, part in trials[trials["time_s"] >= 0].groupby("trial", sort=False)
    ]
    return math.sqrt(float(np.mean(squares))) if squares else math.nan


def _moving(part: pd.DataFrame) -> pd.DataFrame:
    """One trial, starting before release by 6 % of its duration, thinned for a small figure."""
    end_s = float(part["time_s"].iloc[-1])
    kept = part[part["time_s"] >= -0.06 * end_s]
    return kept.iloc[:: max(len(kept) // _MAX_POINTS, 1)]


def _before_after_legend(ax: Axes, trials: pd.DataFrame, n_trials: int, has_after: bool, added: str) -> None:
    handles = [
        line_key(f"measured, N = {n_trials}", color=MUTED, marker=".", ls="none", ms=8),
        line_key(f"initial model: {_rms_text(trials, 'model_before_m')}", color=BEFORE, ls=_BEFORE_LINE),
    ]
    if has_after:
        after = f"with {added}" if added else "after"
        handles.append(line_key(f"{after}: {_rms_text(trials, 'model_after_m')}", color=AFTER))
    ax.legend(handles=handles, loc="lower right", fontsize=9, borderaxespad=0.2, labelspacing=0.3)


def _rms_text(trials: pd.DataFrame, model: str) -> str:
    return f"{number(1e3 * rms_m(trials, model), 2)} mm rms"


# ------------------------------------------------------------------------------
# Candidates of the diagnosis: their gains, the cosines between them, and parameters that drift with a condition.
#
# Candidates in the answer set are drawn in colour. A hollow bar is a candidate that was not fitted: its length is the
# score in standard deviations. A cosine of 1 means that no analysis of these trials can tell two candidates apart, −1
# that one is the other with opposite sign.

MAX_CANDIDATES = 12  # Candidates drawn per round; chosen: 0.33 in each, 4 in of figure; the table in the report has all

_ROLES = {
    "answer": ("in the answer set", BLUE),
    "physical": ("explains less", MUTED),
    "measurement": ("fault of the measurement", ORANGE),
}
_CANDIDATE_FIGURES_WIDTH_IN = 8.6  # Chosen: bars of 4 in beside names of 22 letters and sizes of 60

_ROW_IN = 0.33  # Chosen: two lines of 9 pt would fit, so rows stay apart


@figure("candidates", "candidates", "Candidates", data="ranking")
def draw_candidates(rounds: Sequence[tuple[str, pd.DataFrame]]) -> Figure | None:
    """Improvement of the fit with each candidate, as √Δχ², with its fitted size and standard error. In colour:
    hypotheses in the answer set, which the data cannot exclude. Hollow: predicted from the sensitivities, not
    fitted. One panel per round; the next round tests the model with all effects added so far.
    """
    drawn = [(title, _drawable(table)) for title, table in rounds]
    drawn = [(title, table) for title, table in drawn if len(table)]
    if not drawn:
        return None
    heights_in = [_ROW_IN * len(table) + 0.95 for _, table in drawn]
    fig = new_figure(_CANDIDATE_FIGURES_WIDTH_IN, sum(heights_in) + 0.35)
    axes = fig.subplots(len(drawn), 1, squeeze=False, height_ratios=heights_in)[:, 0]
    for ax, (title, table) in zip(axes, drawn, strict=True):
        _draw_round(ax, title, table)
    axes[-1].set_xlabel("√Δχ²: how much better the trajectories are explained (σ)")
    _candidate_legend(fig, [table for _, table in drawn])
    return fig


def _drawable(table: pd.DataFrame) -> pd.DataFrame:
    """Rows with a finite gain or score: the answer set first, then by bar length."""
    gain = np.sqrt(np.maximum(table["delta_chi2"].to_numpy(dtype=float), 0.0))
    score = np.abs(table["sigma"].to_numpy(dtype=float))
    # A predicted gain may have the wrong sign of the parameter or too small a noise; the score accounts for both.
    fitted = (table["status"] == "refitted").to_numpy() & np.isfinite(gain)
    height = np.where(fitted | ~np.isfinite(score), gain, score)
    ranked = table.assign(height=height, in_answer_set=table["in_answer_set"].astype(bool))
    known = ranked[np.isfinite(height)]
    return known.sort_values(["in_answer_set", "height"], ascending=False, kind="stable").head(MAX_CANDIDATES)


def _role(row: Any) -> str:
    """The key of a candidate in `_ROLES`."""
    if row.in_answer_set:
        return "answer"
    return "measurement" if row.kind == "measurement" else "physical"


def _draw_round(ax: Axes, title: str, table: pd.DataFrame) -> None:
    heights = table["height"].to_numpy(dtype=float)
    longest = max(float(heights.max()), 1.0)
    for i, (row, height) in enumerate(zip(rows(table), heights, strict=True)):
        colour = _ROLES[_role(row)][1]
        fill = colour if row.status == "refitted" else "none"
        ax.barh(i, height, height=0.62, color=fill, edgecolor=colour, lw=1.2, alpha=None if row.in_answer_set else 0.75)
        words = " ".join(part for part in (row.size, "" if row.plausible else "(not plausible)") if part)
        if words:
            ax.annotate(
                textwrap.shorten(words, 62, placeholder="…"),
                (height, i),
                (5, 0),
                textcoords="offset points",
                va="center",
                fontsize=9,
                color=INK if row.in_answer_set else MUTED,
            )
    ax.set_yticks(range(len(table)), [str(name).replace("_", " ") for name in table["effect"]])
    for label, chosen in zip(ax.get_yticklabels(), table["in_answer_set"], strict=True):
        label.set_fontweight("bold" if chosen else "normal")
    ax.set(ylim=(len(table) - 0.4, -0.6), xlim=(0, 1.75 * longest))
    ax.set_title(title, fontsize=10)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_xticks([tick for tick in ax.get_xticks() if tick <= 1.08 * longest])


def _candidate_legend(fig: Figure, tables: Sequence[pd.DataFrame]) -> None:
    from matplotlib.patches import Patch

    present = {_role(row) for table in tables for row in rows(table)}
    handles = [
        Patch(facecolor=colour, alpha=1.0 if name == "answer" else 0.75, label=words)
        for name, (words, colour) in _ROLES.items()
        if name in present
    ]
    if any((table["status"] == "screened").any() for table in tables):
        handles.append(Patch(facecolor="none", edgecolor=MUTED, label="predicted, not fitted"))
    fig.legend(handles=handles, loc="outside upper left", ncols=len(handles), fontsize=9, handlelength=1.3)


TIED_COSINE = 0.95  # Chosen: above it two candidates count as tied

MAX_EFFECTS = 22  # Chosen: 0.36 in each make a square of 8 in, and cells that hold two digits of 7.5 pt


@figure("cosines", "tied", "Candidates that these trials cannot tell apart", data="cosines")
def draw_cosines(cosines: pd.DataFrame) -> Figure | None:
    """Cosine between the effects of two candidates on the trajectories, after projecting out the fitted parameters:
    1 the same, −1 the same with opposite sign, 0 nothing in common. Framed: these trials cannot tell the two apart.
    """
    from matplotlib.patches import Rectangle

    if not len(cosines):
        return None
    effects = list(dict.fromkeys([*cosines["other"], *cosines["effect"]]))[:MAX_EFFECTS]
    place, n = {name: i for i, name in enumerate(effects)}, len(effects)
    names = [str(name).replace("_", " ") for name in effects]
    side_in = 0.36 * n
    fig = new_figure(side_in + 2.3, side_in + 2.0)
    ax = fig.add_subplot()
    for effect, other, value in cosines.itertuples(index=False):
        if effect not in place or other not in place or not math.isfinite(value):
            continue
        i, j = place[effect], place[other]
        colour, tied = BLUE if value > 0 else VERMILLION, abs(value) >= TIED_COSINE
        box = Rectangle((j - 0.5, i - 0.5), 1, 1, facecolor=colour, alpha=min(abs(value), 1.0) ** 2 * 0.8, lw=0)
        ax.add_patch(box)
        if tied:
            outline = Rectangle((j - 0.45, i - 0.45), 0.9, 0.9, facecolor="none", edgecolor=INK, lw=1.4)
            ax.add_patch(outline)
        words = f"{value:.2f}".replace("0.", ".", 1).replace("-", "−")
        ax.text(j, i, words, ha="center", va="center", fontsize=7.5, fontweight="bold" if tied else "normal")
    size = min(fitting_size(name, 115, 9, bold=False) for name in names)
    ax.set_xticks(range(n - 1), names[:-1], rotation=55, ha="right", rotation_mode="anchor", fontsize=size)
    ax.set_yticks(range(1, n), names[1:], fontsize=size)
    ax.set(xlim=(-0.5, n - 1.5), ylim=(n - 0.5, 0.5), aspect="equal")
    ax.tick_params(length=0)
    ax.grid(visible=False)
    ax.set_title(f"cosine; framed: tied (|cos| ≥ {TIED_COSINE:g})", fontsize=9, fontweight="normal")
    return fig


_MAX_DRIFT_PANELS = 6  # Chosen: two rows of three panels
# Conditions: label, and factor from SI
_CONDITIONS = {
    "pressure_Pa": ("pressure (kPa)", 1e-3),
    "payload_kg": ("payload (g)", 1e3),
    "growth_angle_rad": ("growth angle (°)", 180 / math.pi),
    "chamber_m3": ("chamber (l)", 1e3),
    "inlet_m": ("inlet (mm)", 1e3),
    "vine": ("vine", 1.0),
}

_MODELS = {"before": (BEFORE, "before", -0.06), "after": (AFTER, "after", 0.06)}


@figure("drift", "drift", "Parameters that change with a condition", data="drift")
def draw_drift(drift: pd.DataFrame, added: str) -> Figure | None:
    """The best value of each parameter in groups of trials, relative to the common law, against a condition on
    which it should not depend; bars are one standard error from the scatter of replicates. With a complete model
    all are 1.
    """
    known = drift[np.isfinite(drift["ratio"].astype(float))] if len(drift) else drift
    if not len(known):
        return None
    # A parameter that only the larger model has cannot show what adding the effect changed.
    shown = known[known["model"] == "before"] if (known["model"] == "before").any() else known
    panels = list(dict.fromkeys(zip(shown["parameter"], shown["against"], strict=True)))[:_MAX_DRIFT_PANELS]
    vines = [vine for vine in dict.fromkeys(known["vine"]) if vine]
    markers = {vine: VINE_MARKERS[i % len(VINE_MARKERS)] for i, vine in enumerate(vines)} | {"": "o"}
    n_columns = min(len(panels), 3)
    n_rows = math.ceil(len(panels) / n_columns)
    fig = new_figure(1.0 + 3.2 * n_columns, 0.9 + 2.6 * n_rows)
    for ax, (parameter, against) in zip(panel_grid(fig, len(panels), n_columns), panels, strict=True):
        chosen = known[(known["parameter"] == parameter) & (known["against"] == against)]
        _draw_drift_panel(ax, chosen, str(against), markers)
    fig.supylabel("value / common law", fontsize=11)
    _drift_legend(fig, known, markers, added)
    return fig


def _draw_drift_panel(ax: Axes, groups: pd.DataFrame, against: str, markers: dict[str, str]) -> None:
    words, factor = _CONDITIONS.get(against, (against.replace("_", " "), 1.0))
    names = list(dict.fromkeys(groups["vine"]))
    by_vine = against == "vine"
    for model, (colour, _, offset) in _MODELS.items():
        of_model = groups[groups["model"] == model]
        for vine, of_vine in [("", of_model)] if by_vine else of_model.groupby("vine", sort=False):
            ordered = of_vine.sort_values("level")
            x = np.array([names.index(name) for name in ordered["vine"]], dtype=float) + offset
            x = x if by_vine else factor * ordered["level"].to_numpy(dtype=float)
            style: dict[str, Any] = {"color": colour, "marker": markers.get(str(vine), "o"), "ms": 5, "elinewidth": 1.0}
            line = "none" if by_vine else "-" if model == "after" else DASHED
            ax.errorbar(x, ordered["ratio"], ordered["ratio_sigma"], lw=1.1, ls=line, **style)
    ax.axhline(1, color=INK, lw=0.8)
    symbol = str(groups["symbol"].iloc[0])
    count = int(groups.loc[groups["model"] == groups["model"].iloc[0], "n_trials"].sum())
    ax.set_title(f"{symbol} against {words.split(' (')[0]}, N = {count}", fontsize=9.5, fontweight="normal")
    ax.set_xlabel(words, fontsize=10)
    if by_vine:
        ax.set_xticks(range(len(names)), names, fontsize=8)
        ax.margins(x=0.25)
    ax.locator_params(axis="y", nbins=5)


def _drift_legend(fig: Figure, groups: pd.DataFrame, markers: dict[str, str], added: str) -> None:
    present = set(groups["model"])
    handles = [
        line_key(f"{words}: with {added}" if model == "after" and added else words, color=colour, marker="o", ms=5)
        for model, (colour, words, _) in _MODELS.items()
        if model in present
    ]
    handles += [line_key(vine, color=MUTED, marker=marker, ls="none") for vine, marker in markers.items() if vine]
    fig.legend(handles=handles[:10], loc="outside upper left", ncols=min(len(handles), 4), fontsize=9)


# ------------------------------------------------------------------------------
# Where the model fails: the misfit of every condition along its growth, and the missing force.
#
# Colour shows size and sign of the misfit; numbers, in millimetres, are written only where it exceeds replicate
# scatter.
# Cells become transparent with decreasing misfit, so that the page shows through, whatever its colour. If the force is
# a
# single curve against one quantity, it depends on that quantity.

_AHEAD_COLOUR, _BEHIND_COLOUR = BLUE, VERMILLION
_MAX_ROWS = 48  # Chosen: conditions of 0.3 in each, 16 in together; a page shows no more at once

_NUMBERED_ROWS = 26  # Chosen: with more conditions, the figure is scaled down until numbers of 7.5 pt cannot be read

_COLUMNS = {"misfit_before_m": "before", "misfit_after_m": "after"}


@figure("where", "where", "Misfit by condition and position", data="where")
def draw_where(where: pd.DataFrame, added: str) -> Figure | None:
    """Misfit (measured minus model, mean over replicates) of every condition along its growth, before and, if
    effects were added, after. Blue: the vine is ahead of the model; vermillion: behind. Numbers, in millimetres,
    are written where the misfit exceeds twice its standard error from replicate scatter. A pattern common to all
    conditions, or growing towards one pressure, is systematic; isolated patches are chance.
    """
    shown = [c for c in _COLUMNS if len(where) and np.isfinite(where[c].to_numpy(dtype=float)).any()]
    if not shown:
        return None
    labels, n_conditions = _largest_misfits(where, shown), where["condition_label"].nunique()
    known_mm = 1e3 * np.abs(where[shown].to_numpy(dtype=float))
    full_mm = max(float(np.nanpercentile(known_mm, 97)), 1e-6)
    width_in = 2.6 + 4.3 * len(shown)
    fig = new_figure(width_in, 0.3 * len(labels) + 1.75)
    axes = fig.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for ax, column in zip(axes, shown, strict=True):
        _draw_cells(ax, where, column, labels, full_mm)
        words = _COLUMNS[column] + (f": with {added}" if column == "misfit_after_m" and added else "")
        ax.set_title(words, fontsize=10)
        ax.set_xlabel("along the growth (%)")
    axes[0].set_yticks(range(len(labels)), _row_names(where, labels), fontsize=9)
    left_out = f"the {len(labels)} of {n_conditions} conditions with the largest misfit"
    numbers = "; numbers in mm, where beyond scatter" if len(labels) <= _NUMBERED_ROWS else ""
    legend = f"full colour: {full_mm:.2g} mm{numbers}", left_out if n_conditions > len(labels) else ""
    _misfit_legend(fig, legend, 3 if len(shown) > 1 else 2)
    return fig


def _largest_misfits(table: pd.DataFrame, columns: Sequence[str]) -> list[str]:
    """Labels of the conditions with the largest misfit, at most `_MAX_ROWS`, in the order of the table."""
    labels = list(dict.fromkeys(table["condition_label"]))
    if len(labels) <= _MAX_ROWS:
        return labels
    misfit_m = table.set_index("condition_label")[columns[0]].astype(float)
    square = (misfit_m**2).groupby(level=0).mean().sort_values(ascending=False, kind="stable")
    largest = set(square.index[:_MAX_ROWS])
    return [label for label in labels if label in largest]


def _row_names(table: pd.DataFrame, labels: Sequence[str]) -> list[str]:
    counts = table.drop_duplicates("condition_label").set_index("condition_label")["n_trials"]
    return [f"{label}, N = {int(counts[label])}" for label in labels]


def _draw_cells(ax: Axes, table: pd.DataFrame, column: str, labels: Sequence[str], full_mm: float) -> None:
    from matplotlib.patches import Rectangle

    place = {label: i for i, label in enumerate(labels)}
    for row in rows(table):
        misfit_m = getattr(row, column)
        if row.condition_label not in place or not np.isfinite(misfit_m):
            continue
        y, misfit_mm = place[row.condition_label], 1e3 * misfit_m
        left, width = 100 * row.growth_from, 100 * (row.growth_to - row.growth_from)
        depth = min(abs(misfit_mm) / full_mm, 1.0)
        cell: dict[str, Any] = {
            "facecolor": _AHEAD_COLOUR if misfit_mm > 0 else _BEHIND_COLOUR,
            "alpha": 0.85 * depth,
            "lw": 0,
        }
        ax.add_patch(Rectangle((left, y - 0.46), width, 0.92, **cell))
        beyond = not abs(misfit_m) <= 2 * row.scatter_m  # an unknown scatter (NaN) explains no misfit
        if beyond and len(labels) <= _NUMBERED_ROWS and depth > 0.06:
            digits = 0 if abs(misfit_mm) >= 9.95 else 1
            words = f"{misfit_mm:+.{digits}f}".replace("-", "−")
            ax.text(left + width / 2, y, words, ha="center", va="center", fontsize=7.5, color=INK)
    ax.set(xlim=(0, 100), ylim=(len(labels) - 0.45, -0.55))
    ax.grid(visible=False)
    ax.tick_params(axis="y", length=0)


def _misfit_legend(fig: Figure, words: tuple[str, str], n_columns: int) -> None:
    """The legend: both colours, the meaning of full colour, and which conditions are shown (blank if all)."""
    from matplotlib.patches import Patch

    full_colour, which = words
    handles = [
        Patch(facecolor=_AHEAD_COLOUR, alpha=0.85, label="measured is ahead of the model"),
        Patch(facecolor=_BEHIND_COLOUR, alpha=0.85, label="measured is behind"),
        Patch(facecolor=MUTED, alpha=0.2, label=full_colour),
    ]
    if which:
        handles.append(Patch(alpha=0.0, label=which))
    fig.legend(handles=handles, loc="outside upper left", ncols=n_columns, fontsize=9, handlelength=1.3)


# Quantities that the force may depend on: label, and factor from SI
FORCE_AXES = {
    "tail_position_m": ("tail position x (mm)", 1e3),
    "lead_position_m": ("growth y (mm)", 1e3),
    "tail_velocity_m_s": ("tail speed ẋ (m/s)", 1.0),
    "lead_velocity_m_s": ("leading-edge speed ẏ (m/s)", 1.0),
    "time_s": ("time since release (ms)", 1e3),
    "pressure_Pa": ("pressure (kPa)", 1e-3),
}

_MAX_FORCE_PANELS = 4  # Chosen: two rows of two panels


@figure("missing_force", "where", "The missing force", data="missing_force", if_refuted=SHOWS_REFUTED)
def draw_missing_force(missing_force: pd.DataFrame) -> Figure | None:
    """The force that would have to be added to the model to explain the misfit, against position, speed, time and
    pressure: grey for single conditions, blue for their mean with one standard error. Where all conditions fall on
    one curve, the force depends on that alone.
    """
    panels = [name for name in FORCE_AXES if len(missing_force) and (missing_force["against"] == name).any()][
        :_MAX_FORCE_PANELS
    ]
    if not panels:
        return None
    n_columns = min(len(panels), 2)
    n_rows = -(-len(panels) // n_columns)
    fig = new_figure(1.0 + 4.0 * n_columns, 0.5 + 2.7 * n_rows)
    for ax, against in zip(panel_grid(fig, len(panels), n_columns, sharey=True), panels, strict=True):
        _draw_force(ax, missing_force[missing_force["against"] == against], against)
    fig.supylabel("missing force (N)", fontsize=11)
    return fig


def _draw_force(ax: Axes, points: pd.DataFrame, against: str) -> None:
    words, factor = FORCE_AXES[against]
    single = points[points["condition"] != ""]
    for _, curve in single.groupby("condition", sort=False):
        ordered = curve.sort_values("value")
        ax.plot(factor * ordered["value"], ordered["force_N"], color=MUTED, lw=0.9, alpha=0.8)
    mean = points[points["condition"] == ""].sort_values("value")
    if len(mean):
        sigma = np.nan_to_num(mean["sigma_N"].to_numpy(dtype=float))
        ax.errorbar(factor * mean["value"], mean["force_N"], sigma, color=BLUE, marker="o", ms=4, lw=1.5, elinewidth=1)
    ax.axhline(0, color=INK, lw=0.8)
    ax.set_xlabel(words)
    count = single["condition"].nunique()
    if count:
        ax.set_title(f"N = {count} conditions", fontsize=9, fontweight="normal", color=MUTED)


_BAND = 1.96  # Half width of a 95 % band in standard errors (derived)

_LEVELS, _LABELLED = 11, 5  # Shades from zero to the largest force, and labelled contour lines (chosen)


@figure(
    "learned_force",
    "where",
    "The missing force, learned inside the fit",
    data="learned_force",
    if_refuted=SHOWS_REFUTED,
)
def draw_learned_force(learned_force: pd.DataFrame) -> Figure | None:
    """The missing force, learned within the fit as a smooth function of the variables on which it most likely
    depends: for one variable a curve with its 95 % band, for two a map next to its standard error, both only in the
    range of the trials. The part that B, n and the yield pressure could absorb is undetermined, and included in the
    band.
    """
    variables = [name for name in FORCE_AXES if name in learned_force and learned_force[name].notna().any()]
    if not len(learned_force) or not variables:
        return None
    grid, along = (
        learned_force[learned_force["condition"].fillna("") == ""],
        learned_force[learned_force["condition"].fillna("") != ""],
    )
    if len(variables) == 1:
        fig = new_figure(6.4, 3.6)
        _draw_curve(fig.subplots(), grid, along, variables[0])
        return fig
    fig = new_figure(9.6, 4.4)
    left, right = fig.subplots(1, 2, sharex=True, sharey=True)
    _draw_map(left, grid, along, variables, "force_N", "missing force (N)")
    _draw_map(right, grid, along, variables, "sigma_N", "its standard error (N)")
    right.set_ylabel("")
    return fig


def _draw_curve(ax: Axes, grid: pd.DataFrame, along: pd.DataFrame, variable: str) -> None:
    words, factor = FORCE_AXES[variable]
    seen = grid[grid["trials"] > 0].sort_values(variable)
    at, force = factor * seen[variable].to_numpy(float), seen["force_N"].to_numpy(float)
    half = _BAND * seen["sigma_N"].to_numpy(float)
    ax.fill_between(at, force - half, force + half, color=BLUE, alpha=0.22, lw=0, label="95 % band")
    ax.plot(at, force, color=BLUE, lw=1.8, label="learned force")
    ax.axhline(0, color=INK, lw=0.8)
    places = factor * along[variable].to_numpy(float)
    ax.plot(places, np.full(places.size, 0.02), "|", color=MUTED, ms=6, transform=ax.get_xaxis_transform(),
            label=f"range of the trials, N = {along['condition'].nunique()} conditions")  # fmt: skip
    ax.set(xlabel=words, ylabel="missing force (N)")
    ax.margins(x=0.01)
    ax.figure.legend(loc="outside upper left", ncols=3, fontsize=9)


def _draw_map(ax: Axes, grid: pd.DataFrame, along: pd.DataFrame, variables: list[str], column: str, label: str) -> None:
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.ticker import MaxNLocator

    (x_words, x_factor), (y_words, y_factor) = (FORCE_AXES[name] for name in variables)
    wide = grid.pivot_table(index=variables[1], columns=variables[0], values=[column, "trials"])
    values: Floats = np.where(wide["trials"].to_numpy(float) > 0, wide[column].to_numpy(float), np.nan)
    x, y = x_factor * wide[column].columns.to_numpy(float), y_factor * wide[column].index.to_numpy(float)
    signed = column == "force_N"
    most = max(float(np.nanmax(np.abs(values))), 1e-12)
    colours = (VERMILLION, "#ffffff", BLUE) if signed else ("#ffffff", MUTED)
    shown = LinearSegmentedColormap.from_list("force", colours)
    levels = MaxNLocator(2 * _LEVELS if signed else _LEVELS).tick_values(-most if signed else 0.0, most)
    filled = ax.contourf(x, y, values, levels=levels, cmap=shown, alpha=0.85)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if high > low:
        steps = np.linspace(low, high, _LABELLED + 2)[1:-1]
        lines = ax.contour(x, y, values, levels=steps, colors=INK, linewidths=0.7)
        ax.clabel(lines, fmt=lambda force: f"{force:.2g}".replace("-", "−"), fontsize=8)
    for _, course in along.groupby("condition", sort=False):
        ax.plot(x_factor * course[variables[0]], y_factor * course[variables[1]], color=MUTED, lw=0.5, alpha=0.7)
    bar = ax.figure.colorbar(filled, ax=ax)
    bar.set_label(label)
    ax.set(xlabel=x_words, ylabel=y_words, xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    ax.grid(visible=False)
    if signed:
        ax.set_title(f"grey: trials, N = {along['condition'].nunique()} conditions", fontsize=9, fontweight="normal",
                     color=MUTED)  # fmt: skip
