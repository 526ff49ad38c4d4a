"""Figures of models: errors before and after an effect is added, the misfit and the missing force, candidates; and of
motions that are only simulated: predictions for vines not yet built, designs, one effect, and the power to detect it.

The model before the added effects is vermillion and dashed, the model after blue and full, here and in the clips.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.units import display_unit, number
from vinetrack.diagnosis.result import EXPECTED
from vinetrack.figures import style as st
from vinetrack.figures.registry import figure, rms_m
from vinetrack.narrative.diagnosis_text import drift_condition, size_text
from vinetrack.narrative.verdict_text import expected_text, spaced_name

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vinetrack.core.records import Floats
    from vinetrack.diagnosis.result import Power
    from vinetrack.planning.prediction import Choice, VinePrediction


# ------------------------------------------------------------------------------
# Errors of the models of the ladder, and the condition with the largest error of the initial model, before and after.


@figure("ladder", "verdict", "The ladder of errors", data="ladder")
def draw_ladder(ladder: pd.DataFrame, refuted: bool = False) -> Figure | None:
    """Root mean square error of position of the initial model and with every effect that was added, on a
    logarithmic axis: in sample; on conditions left out of the fit in turn; and on the left-out highest pressure of
    each vine. The band holds the error on conditions left out that an adequate model would show in 95 % of such
    campaigns, in trials whose pressure and B scatter as replicates do: a model within it can be refuted by the shape
    of its motions.
    """
    if not len(ladder):
        return None
    fig, ax = st.one_panel(max(5.2, 2.4 + 1.55 * len(ladder)), 3.9)  # names of effects are wrapped at 18 letters
    ax.set(yscale="log", ylabel="error of position, rms (mm)", xlim=(-0.5, len(ladder) - 0.5))
    for key, name, colour, marker, line in (
        ("rms_in_sample_m", "in sample", st.BLUE, "o", "-"),
        ("rms_left_out_m", "on left-out conditions", st.VERMILLION, "s", "-"),
        ("rms_highest_pressure_m", "on the left-out highest pressure", st.GREEN, "^", st.DASHED),
    ):
        errors_mm = st.column(ladder, key, 1e3)
        if np.isfinite(errors_mm).any():
            label = f"{name}: {' → '.join(map(number, errors_mm))} mm"
            ax.plot(errors_mm, marker=marker, color=colour, ls=line, ms=7, zorder=3, label=label)
    if expected := expected_text(*ladder[EXPECTED].iloc[-1]):
        middle, low, high = 1e3 * ladder[EXPECTED].iloc[-1]
        ax.axhspan(low, high, color=st.MUTED, alpha=0.16, lw=0, zorder=0, label=f"an adequate model: {expected}")
        ax.axhline(middle, color=st.MUTED, lw=1.3, ls=(0, (1.5, 1.5)), zorder=1)
    ax.margins(y=0.15)
    st.plain_log_ticks(ax, "y")
    labels = ["refuted\ninitial model" if refuted or len(ladder) > 1 else "model\nin use"]
    for added, part in list(zip(ladder["added"], ladder["partial"], strict=True))[1:]:
        words = str(added).replace("+", " + ").replace("_", " ") + (" (partial)" if part else "")
        labels.append("+ " + "\n".join(textwrap.wrap(words, 18, break_long_words=False)))
    ax.set_xticks(range(len(ladder)), labels)
    ax.grid(axis="x", visible=False)
    st.legend_above(ax, fontsize=9, labelspacing=0.25)
    return fig


@figure("before_after", "verdict", "The worst condition", data="before_after")
def draw_before_after(worst: str, before_after: pd.DataFrame, added: str) -> Figure | None:
    """The condition that the model in use predicts worst. Above, growth of the leading edge since release: every
    replicate (dots), that model (dashed) and, where the diagnosis added an effect, the model with it (full). Below,
    the misfit, measured minus model. Release and origin are fitted for each trial.
    """
    if before_after.empty:
        return None
    models: dict[str, tuple[str, Any, str]] = {"model_before_m": (st.VERMILLION, (0, (5, 2)), "model in use")}
    if np.isfinite(before_after["model_after_m"]).any():
        models["model_after_m"] = (st.BLUE, "-", f"with {added}" if added else "after")
    fig = st.new_figure(5.2, 4.3)  # two such figures fit side by side on a page of 11 in
    growth, misfit = fig.subplots(2, 1, sharex=True, height_ratios=(2.1, 1))
    trials = before_after.groupby("trial", sort=False)
    for _, part in trials:
        shown = st.thinned(part[part["time_s"] >= -0.06 * part["time_s"].iloc[-1]], 60)
        time_ms, measured_mm = st.column(shown, "time_s", 1e3), st.column(shown, "lead_position_m", 1e3)
        growth.plot(time_ms, measured_mm, ".", color=st.MUTED, ms=4.5, mew=0)
        for model, (colour, line, _) in models.items():
            predicted_mm = st.column(shown, model, 1e3)
            growth.plot(time_ms, predicted_mm, color=colour, lw=1.6, ls=line, zorder=2.1)  # over the dots of all trials
            misfit.plot(time_ms, measured_mm - predicted_mm, color=colour, lw=1.3, ls=line)
    misfit.axhline(0, color=st.INK, lw=0.8)
    growth.set(ylabel="growth (mm)")
    growth.set_title(worst, fontsize=10)
    misfit.set(xlabel="time since release (ms)", ylabel="misfit (mm)")
    handles = [st.line_key(f"measured, N = {len(trials)}", color=st.MUTED, marker=".", ls="none", ms=8)]
    for model, (colour, line, words) in models.items():
        error_mm = number(1e3 * rms_m(before_after, model), 2)
        handles.append(st.line_key(f"{words}: {error_mm} mm rms", color=colour, ls=line))
    growth.legend(handles=handles, loc="lower right", fontsize=9, borderaxespad=0.2, labelspacing=0.3)
    return fig


# ------------------------------------------------------------------------------
# Candidates of the diagnosis and their gains, and parameters that drift with a condition.


@figure("candidates", "candidates", "Candidates", data="ranking")
def draw_candidates(rounds: Sequence[tuple[str, pd.DataFrame]]) -> Figure | None:
    """Improvement of the fit with each candidate, as √Δχ², with its fitted size and standard error. In colour:
    hypotheses in the answer set, which the data cannot exclude. Hollow: predicted from the sensitivities, not
    fitted. One panel per round; the next round tests the model with all effects added so far.
    """
    drawn = [(title, table) for title, ranked in rounds if len(table := _drawable(ranked))]
    if not drawn:
        return None
    roles = {
        "answer": ("in the answer set", st.BLUE, 1.0),
        "physical": ("explains less", st.MUTED, 0.75),
        "measurement": ("fault of the measurement", st.ORANGE, 0.75),
    }
    heights_in = [0.33 * len(table) + 0.95 for _, table in drawn]
    fig = st.new_figure(8.6, sum(heights_in) + 0.35)
    axes = fig.subplots(len(drawn), 1, squeeze=False, height_ratios=heights_in)[:, 0]
    for ax, (title, table) in zip(axes, drawn, strict=True):
        longest = max(float(table["height"].max()), 1.0)
        for i, row in enumerate(st.rows(table)):
            colour, alpha = roles[row.role][1], None if row.in_answer_set else 0.75
            fill = colour if row.status == "refitted" else "none"
            ax.barh(i, row.height, height=0.62, color=fill, edgecolor=colour, lw=1.2, alpha=alpha)
            if words := f"{row.size}{'' if row.plausible else ' (not plausible)'}".strip():
                style = {"va": "center", "fontsize": 9, "color": st.INK if row.in_answer_set else st.MUTED}
                words = textwrap.shorten(words, 62, placeholder="…")
                ax.annotate(words, (row.height, i), (5, 0), textcoords="offset points", **style)
        st.names_beside(ax, [str(name).replace("_", " ") for name in table["effect"]])
        for label, chosen in zip(ax.get_yticklabels(), table["in_answer_set"], strict=True):
            label.set_fontweight("bold" if chosen else "normal")
        ax.set(ylim=(len(table) - 0.4, -0.6), xlim=(0, 2.2 * longest))
        ax.set_title(title, fontsize=10)
        ax.set_xticks([tick for tick in ax.get_xticks() if tick <= 1.08 * longest])
    axes[-1].set_xlabel("√Δχ²: how much better the trajectories are explained")
    present = {role for _, table in drawn for role in table["role"]}
    handles = [st.patch_key(words, colour, alpha) for role, (words, colour, alpha) in roles.items() if role in present]
    if any((table["status"] == "screened").any() for _, table in drawn):
        handles.append(st.patch_key("predicted, not fitted", "none", edgecolor=st.MUTED))
    st.page_legend(fig, handles, len(handles), handlelength=1.3)
    return fig


def _drawable(table: pd.DataFrame) -> pd.DataFrame:
    """Rows with a finite gain or score and their roles: the answer set first, then by bar length; eight at most."""
    height = np.sqrt(np.maximum(st.column(table, "delta_chi2"), 0.0))
    answer = table["in_answer_set"].astype(bool)
    role = np.where(answer, "answer", np.where(table["kind"] == "measurement", "measurement", "physical"))
    known = table.assign(height=height, in_answer_set=answer, role=role)[np.isfinite(height)]
    return known.sort_values(["in_answer_set", "height"], ascending=False, kind="stable").head(8)


@figure("drift", "drift", "Parameters that change with a condition", data="drift")
def draw_drift(drift: pd.DataFrame, added: str, pressure_unit: str = "kPa") -> Figure | None:
    """The best B in groups of trials, relative to the common law, against a condition on which it should not depend;
    bars are one standard error from the scatter of replicates. With a complete model all are 1.
    """
    models = {"before": (st.VERMILLION, st.DASHED), "after": (st.BLUE, "-")}
    known = drift[np.isfinite(drift["ratio"].astype(float))] if len(drift) else drift
    if not len(known):
        return None
    # A parameter that only the larger model has cannot show what adding the effect changed.
    shown = known[known["model"] == "before"] if (known["model"] == "before").any() else known
    panels = list(dict.fromkeys(zip(shown["parameter"], shown["against"], strict=True)))[:6]
    vines = [vine for vine in dict.fromkeys(known["vine"]) if vine]
    markers = {vine: st.VINE_MARKERS[i % len(st.VINE_MARKERS)] for i, vine in enumerate(vines)} | {"": "o"}
    n_columns = min(len(panels), 3)
    fig = st.new_figure(1.0 + 3.2 * n_columns, 0.9 + 2.6 * math.ceil(len(panels) / n_columns))
    for ax, (parameter, against) in zip(st.panel_grid(fig, len(panels), n_columns), panels, strict=True):
        groups = known[(known["parameter"] == parameter) & (known["against"] == against)]
        name, unit, factor = drift_condition(str(against), pressure_unit)
        for model, (colour, line) in models.items():
            of_model = groups[groups["model"] == model]
            for vine, of_vine in of_model.groupby("vine", sort=False):
                ordered = of_vine.sort_values("level")
                style: dict[str, Any] = {"color": colour, "marker": markers[str(vine)], "ms": 5, "elinewidth": 1.0}
                style |= {"lw": 1.1, "ls": line}
                ax.errorbar(st.column(ordered, "level", factor), ordered["ratio"], ordered["ratio_sigma"], **style)
        ax.axhline(1, color=st.INK, lw=0.8)
        count = int(groups.loc[groups["model"] == groups["model"].iloc[0], "n_trials"].sum())
        st.small_title(ax, f"{groups['symbol'].iloc[0]} against {name}, N = {count}", fontsize=9.5)
        ax.set_xlabel(f"{name} ({unit})" if unit else name, fontsize=10)
        ax.locator_params(axis="y", nbins=5)
    fig.supylabel("value / common law", fontsize=11)
    handles = [
        st.line_key(f"{model}: with {added}" if model == "after" and added else model, color=colour, marker="o", ms=5)
        for model, (colour, _) in models.items()
        if (known["model"] == model).any()
    ]
    handles += [st.line_key(vine, color=st.MUTED, marker=markers[vine], ls="none") for vine in vines]
    st.page_legend(fig, handles[:10], min(len(handles), 4))
    return fig


# ------------------------------------------------------------------------------
# Where the model fails: the misfit of every condition along its growth, and the missing force learned inside the fit.


@figure("where", "where", "Misfit by condition and position", data="where")
def draw_where(where: pd.DataFrame) -> Figure | None:
    """Misfit of the initial model (measured minus model, mean over replicates) of every condition along its growth.
    Blue: the vine is ahead of the model; vermillion: behind. Numbers, in millimetres, are written where the misfit
    exceeds twice its standard error from replicate scatter. A pattern common to all conditions, or growing towards one
    pressure, is systematic; isolated patches are chance.
    """
    from matplotlib.patches import Rectangle

    if where.empty:
        return None
    full_mm = max(1e3 * float(np.nanpercentile(where["misfit_m"].abs(), 97)), 1e-6)
    counts = where.drop_duplicates("condition_label").set_index("condition_label")["n_trials"]
    # Conditions with the largest misfit: 48 of 0.3 in each are 16 in together; a page shows no more at once.
    square = (where.set_index("condition_label")["misfit_m"] ** 2).groupby(level=0).mean()
    largest = set(square.sort_values(ascending=False, kind="stable").index[:48])
    labels = [str(label) for label in counts.index if label in largest]
    numbered = len(labels) <= 26  # with more, the figure is scaled down until numbers of 7.5 pt cannot be read
    fig, ax = st.one_panel(6.9, 0.3 * len(labels) + 1.75, xlabel="along the growth (%)")
    for row in st.rows(where[where["condition_label"].isin(labels) & np.isfinite(where["misfit_m"])]):
        y, misfit_mm = labels.index(row.condition_label), 1e3 * row.misfit_m
        left, width = 100 * row.growth_from, 100 * (row.growth_to - row.growth_from)
        # Cells become transparent with decreasing misfit, so that the page shows through.
        depth, colour = min(abs(misfit_mm) / full_mm, 1.0), st.BLUE if misfit_mm > 0 else st.VERMILLION
        ax.add_patch(Rectangle((left, y - 0.46), width, 0.92, facecolor=colour, alpha=0.85 * depth, lw=0))
        beyond = not abs(row.misfit_m) <= 2 * row.scatter_m  # an unknown scatter (NaN) explains no misfit
        if numbered and beyond and depth > 0.06:
            words = st.with_minus(misfit_mm, "+.0f" if abs(misfit_mm) >= 9.95 else "+.1f")
            ax.text(left + width / 2, y, words, ha="center", va="center", fontsize=7.5, color=st.INK)
    ax.set(xlim=(0, 100), ylim=(len(labels) - 0.45, -0.55))
    ax.grid(visible=False)
    ax.tick_params(axis="y", length=0)
    ax.set_yticks(range(len(labels)), [f"{label}, N = {int(counts[label])}" for label in labels], fontsize=9)
    words = f"full colour: {full_mm:.2g} mm{'; numbers in mm, where beyond scatter' if numbered else ''}"
    handles = [
        st.patch_key("measured is ahead of the model", st.BLUE, 0.85),
        st.patch_key("measured is behind", st.VERMILLION, 0.85),
        st.patch_key(words, st.MUTED, 0.2),
    ]
    if len(counts) > len(labels):
        words = f"the {len(labels)} of {len(counts)} conditions with the largest misfit"
        handles.append(st.patch_key(words, "none"))
    st.page_legend(fig, handles, 2, handlelength=1.3)
    return fig


@figure("learned_force", "where", "Missing force, learned in the fit", data="learned_force")
def draw_learned_force(learned_force: pd.DataFrame, pressure_unit: str = "kPa") -> Figure | None:
    """The missing force, learned within the fit as a smooth function of the variables on which it most likely
    depends: for one variable a curve with its 95 % band, for two a map next to its standard error, both only in the
    range of the trials. The part that B, n and the yield pressure could absorb is undetermined, and included in the
    band.
    """
    if not len(learned_force):
        return None
    on_grid = learned_force["condition"].fillna("") == ""
    grid, along = learned_force[on_grid], learned_force[~on_grid]
    unit, factor = display_unit("Pa", pressure_unit)
    # Quantities that the force may depend on: label, and factor from SI
    known = {
        "lead_position_m": ("growth y (mm)", 1e3),
        "tail_velocity_m_s": ("tail speed ẋ (m/s)", 1.0),
        "time_s": ("time since release (ms)", 1e3),
        "pressure_Pa": (f"pressure ({unit})", factor),
    }
    axes = {name: axis for name, axis in known.items() if name in grid and grid[name].notna().any()}
    conditions = f"N = {along['condition'].nunique()} conditions"
    if len(axes) == 2:
        fig = st.new_figure(9.6, 4.4)
        left, right = fig.subplots(1, 2, sharex=True, sharey=True)
        _draw_map(left, grid, along, axes, "force_N", "missing force (N)")
        _draw_map(right, grid, along, axes, "sigma_N", "its standard error (N)")
        st.small_title(left, f"grey: trials, {conditions}", color=st.MUTED)
        right.set_ylabel("")
        return fig
    ((variable, (words, factor)),) = axes.items()
    fig, ax = st.one_panel(6.4, 3.6, xlabel=words, ylabel="missing force (N)")
    seen = grid[grid["trials"] > 0].sort_values(variable)
    at, force, half = st.column(seen, variable, factor), st.column(seen, "force_N"), st.column(seen, "sigma_N", 1.96)
    st.band(ax, at, force - half, force + half, st.BLUE, label="95 % band")
    ax.plot(at, force, color=st.BLUE, lw=1.8, label="learned force")
    ax.axhline(0, color=st.INK, lw=0.8)
    places, across = st.column(along, variable, factor), ax.get_xaxis_transform()
    label = f"range of the trials, {conditions}"
    ax.plot(places, np.full(places.size, 0.02), "|", color=st.MUTED, ms=6, transform=across, label=label)
    ax.margins(x=0.01)
    st.page_legend(fig, None, 3)
    return fig


def _draw_map(
    ax: Axes, grid: pd.DataFrame, along: pd.DataFrame, axes: dict[str, tuple[str, float]], name: str, label: str
) -> None:
    """A map of the force, which has a sign, or of its error; blank without trials, where the force is the prior's."""
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.ticker import MaxNLocator

    variables, ((x_words, x_factor), (y_words, y_factor)) = list(axes), axes.values()
    wide = grid.pivot_table(index=variables[1], columns=variables[0], values=[name, "trials"])
    values: Floats = np.where(wide["trials"].to_numpy(float) > 0, wide[name].to_numpy(float), np.nan)
    x, y = x_factor * wide[name].columns.to_numpy(float), y_factor * wide[name].index.to_numpy(float)
    signed = name == "force_N"
    most = max(float(np.nanmax(np.abs(values))), 1e-12)
    colours = (st.VERMILLION, "#ffffff", st.BLUE) if signed else ("#ffffff", st.MUTED)
    levels = MaxNLocator(22 if signed else 11).tick_values(-most if signed else 0.0, most)
    colour_map = LinearSegmentedColormap.from_list("force", colours)
    filled = ax.contourf(x, y, values, levels=levels, cmap=colour_map, alpha=0.85)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if high > low:
        lines = ax.contour(x, y, values, levels=np.linspace(low, high, 7)[1:-1], colors=st.INK, linewidths=0.7)
        ax.clabel(lines, fmt=lambda force: st.with_minus(force, ".2g"), fontsize=8)
    for _, course in along.groupby("condition", sort=False):
        at = x_factor * course[variables[0]], y_factor * course[variables[1]]
        ax.plot(*at, color=st.MUTED, lw=0.5, alpha=0.7)
    ax.figure.colorbar(filled, ax=ax).set_label(label)
    ax.set(xlabel=x_words, ylabel=y_words, xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    ax.grid(visible=False)


# ------------------------------------------------------------------------------
# Figures of designs: the fastest vine, and the pressure loss of a chamber.


@st.look()
def draw_choice(choices: Sequence[Choice]) -> Figure:
    """Draw the films side by side: speed against diameter, and the certainty of the choice."""
    fig = st.new_figure(9.6, 4.4, layout=None)
    curves, bars = fig.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    films = [f"{1e6 * choice.prediction.inputs.trial.thickness_m:g}" for choice in choices]
    for k, (choice, film) in enumerate(zip(choices, films, strict=True)):
        colour, marker = st.VINE_COLOURS[k % len(st.VINE_COLOURS)], st.VINE_MARKERS[k % len(st.VINE_MARKERS)]
        final, diameter_mm = choice.prediction.final, 1e3 * choice.prediction.inputs.trial.diameter_m
        curves.plot(1e3 * choice.others[:, 0], choice.others[:, 1], color=colour, label=f"{film} µm")
        curves.plot(diameter_mm, final.median, marker, color=colour, ms=8, clip_on=False)
        bars.plot([k, k], [final.low, final.high], color=colour, lw=9, alpha=0.35, solid_capstyle="butt")
        bars.plot(k, final.median, marker, color=colour, ms=8)
        at = (k, final.high), (0, 5)
        bars.annotate(f"{choice.odds:.0%}", *at, textcoords="offset points", ha="center", fontsize=10)
    final = choices[0].prediction.final
    label = f"{final.name} (m/s)" if final.y_over_L == 1 else f"{final.name}\nat y/L = {final.y_over_L:g} (m/s)"
    fastest = max(choice.prediction.final.high for choice in choices)
    curves.set(xlabel="diameter (mm)", ylabel=label, ylim=(0.0, 1.12 * fastest))
    st.small_title(curves, "best length and pressure at each diameter", fontsize=10)
    curves.legend(title="film", fontsize=9.5)
    bars.set(xlabel="film (µm)", xlim=(-0.6, len(films) - 0.4))
    bars.set_xticks(range(len(films)), films)
    st.small_title(bars, "90 % band; percentage of draws in which it is the fastest", fontsize=10)
    fig.subplots_adjust(left=0.1, right=0.985, top=0.9, bottom=0.2, wspace=0.08)
    fig.text(0.1, 0.02, "line, marker: median of the prediction; bar: 90 % interval", color=st.MUTED, fontsize=8.8)
    return fig


@st.look()
def draw_reservoir(
    volumes_m3: np.ndarray, losses: Mapping[str, np.ndarray], loss: float, swept_m3: float, chosen_m3: float
) -> Figure:
    """Draw the part of its gauge pressure that a closed chamber loses to a vine. Shapes (n_volumes,)."""
    # Below 10 mL the axis is in millilitres, so that its ticks need no exponent.
    factor, unit = (1e3, "L") if volumes_m3[0] >= 1e-5 else (1e6, "mL")
    fig, ax = st.one_panel(7.2, 4.4, xscale="log", ylabel="gauge pressure lost (%)")
    ax.set_xlabel(f"volume of the chamber ({unit}); of the grown vine {factor * swept_m3:.3g} {unit}")
    for (law, lost), colour, style in zip(losses.items(), (st.BLUE, st.VERMILLION), ("-", st.DASHED), strict=True):
        ax.plot(factor * volumes_m3, 100 * lost, color=colour, ls=style, label=law)
    slow, fast = losses.values()
    st.band(ax, factor * volumes_m3, 100 * slow, 100 * fast, st.MUTED, 0.12)
    words: dict[str, Any] = {"textcoords": "offset points", "fontsize": 9.5}
    ax.axhline(100 * loss, color=st.INK, lw=1.0)
    at = (0.99, 100 * loss), (0, 3), ("axes fraction", "data")
    ax.annotate(f"allowed: {100 * loss:g} %", *at, ha="right", **words)
    if volumes_m3[0] < chosen_m3 < volumes_m3[-1]:
        ax.axvline(factor * chosen_m3, color=st.MUTED, lw=1.2)
        at = (factor * chosen_m3, 0.97), (5, 0), ("data", "axes fraction")
        ax.annotate(f"chosen: {factor * chosen_m3:.3g} {unit}", *at, va="top", **words)
    ax.set(xlim=(factor * volumes_m3[0], factor * volumes_m3[-1]), ylim=(0.0, min(800 * loss, 100.0)))
    st.plain_log_ticks(ax, "x")
    ax.legend(loc="upper right", bbox_to_anchor=(1.0, 0.9))
    return fig


# ------------------------------------------------------------------------------
# Predictions, and the motion with and without one effect.

_LOG_RATIO = 6.0  # Chosen: at a larger ratio of slowest to fastest the latter takes less than a sixth of a linear axis


@st.look()
def draw_predictions(predictions: Sequence[VinePrediction], titles: Sequence[str], at_fraction: float) -> Figure:
    """Draw one condition with the uncertainty budget of its final speed, or several conditions superposed."""
    drawn = predictions[: len(st.VINE_COLOURS)]
    width_in = 9.6
    fig = st.new_figure(width_in, 7.2, layout=None)
    axes = fig.subplots(2, 2)
    for colour, prediction in zip(st.VINE_COLOURS, drawn, strict=False):
        _draw_curves(axes, prediction.curve, colour)
    _label_prediction(axes, drawn, at_fraction)
    if len(drawn) == 1:
        _draw_shares(axes[1, 1], drawn[0])
    else:
        named = zip(st.VINE_COLOURS, titles, strict=False)  # the condition of each colour, instead of the bars
        keys = [st.line_key(textwrap.fill(title, 50), color=colour, lw=3) for colour, title in named]
        if (n_more := len(titles) - len(st.VINE_COLOURS)) > 0:
            keys.append(st.line_key(f"and {n_more} more, not drawn", ls="none"))
        axes[1, 1].set_axis_off()
        axes[1, 1].legend(handles=keys, loc="upper left", fontsize=9.2, labelspacing=1.0, borderaxespad=0.0)
    title = titles[0] if len(drawn) == 1 else f"{len(titles)} conditions"
    fig.text(0.075, 0.955, title, fontweight="bold", fontsize=st.fitting_size(title, 0.9 * 72 * width_in, 12))
    words = "line: median; band: 90 % interval; simulated from the distributions of the inputs"
    fig.text(0.075, 0.012, words, color=st.MUTED, fontsize=8.8)
    fig.align_ylabels(axes[:, 0])
    fig.subplots_adjust(left=0.075, right=0.985, top=0.91, bottom=0.105, hspace=0.3, wspace=0.27)
    return fig


def _draw_curves(axes: np.ndarray, table: pd.DataFrame, colour: str) -> None:
    """Position against time; speed and tension against growth."""
    position, speed, tension = axes.flat[:3]
    y_mm, along = st.column(table, "lead_position_m", 1e3), st.column(table, "y_over_L")
    low_ms, median_ms, high_ms = (st.column(table, name, 1e3) for name in ("time_low_90_s", "time_s", "time_high_90_s"))
    # The axis ends with the slow limit, but at most at four times the end of the median.
    early, middle, late = (float(np.max(t[np.isfinite(t)], initial=0.0)) for t in (low_ms, median_ms, high_ms))
    last = min(late, 4 * middle) if middle > 0 else early or 1.0
    ends = (np.where(np.isfinite(t), t, last) for t in (low_ms, high_ms))
    position.fill_betweenx(y_mm, *ends, color=colour, alpha=0.18, lw=0)
    come = np.isfinite(median_ms)
    position.plot(median_ms[come], y_mm[come], color=colour)
    position.set_xlim(0.0, max(last, position.get_xlim()[1] if position.lines[1:] else 0.0))
    for ax, name, unit in ((speed, "lead_velocity", "m_s"), (tension, "tension", "N")):
        low, high = (st.column(table, f"{name}_{side}_90_{unit}") for side in ("low", "high"))
        st.band(ax, along, low, high, colour, 0.18)
        ax.plot(along, table[f"{name}_{unit}"], color=colour)


def _label_prediction(axes: np.ndarray, drawn: Sequence[VinePrediction], at_fraction: float) -> None:
    position, speed, tension = axes.flat[:3]
    position.set(xlabel="time since release (ms)", ylabel="leading edge y (mm)", ylim=(0.0, None))
    for ax, label in ((speed, "speed of the leading edge ẏ (m/s)"), (tension, "tension of the tail (N)")):
        ax.set(xlabel="growth y/L", ylabel=label, xlim=(0.0, 1.0))
        ax.axvline(at_fraction, color=st.MUTED, lw=0.9, ls=st.DASHED)
    speed.set_ylim(max(speed.get_ylim()[0], 0.0))
    at: dict[str, Any] = {"transform": speed.get_xaxis_transform(), "ha": "right", "fontsize": 9, "color": st.MUTED}
    speed.text(at_fraction - 0.015, 0.03, f"y/L = {at_fraction:g}", **at)
    lowest = min(prediction.curve["tension_low_90_N"].min() for prediction in drawn)
    # Compression below 1 % of the largest tension is rounding of the simulation.
    if lowest < -0.01 * max(prediction.curve["tension_high_90_N"].max() for prediction in drawn):
        tension.axhline(0.0, color=st.INK, lw=0.8)
        st.small_title(tension, "below 0 the model predicts compression in the tail", fontsize=9.5, color=st.MUTED)
    ends = [float(prediction.curve["time_s"].replace(np.inf, np.nan).max()) for prediction in drawn]
    if max(ends) > _LOG_RATIO * min(ends):
        position.set_xscale("log")
        position.set_xlim(left=10.0 * min(ends))
        st.plain_log_ticks(position, "x")


def _draw_shares(ax: Axes, prediction: VinePrediction) -> None:
    """Bars of the final speed: with all uncertainties, then with each alone."""
    low, median, high = prediction.final.low, prediction.final.median, prediction.final.high
    bars = [("all inputs", low, high), *((share.name, share.low, share.high) for share in prediction.shares)]
    for k, (_, start, stop) in enumerate(bars):
        ax.barh(k, stop - start, left=start, height=0.55, color=st.BLUE, alpha=0.85 if k == 0 else 0.4, lw=0)
    ax.axvline(median, color=st.INK, lw=1.0)
    names = [textwrap.fill(name if len(name) <= 15 else name.replace("_", " "), 15) for name, _, _ in bars]
    ax.set_yticks(range(len(bars)), names, fontsize=8.8)
    ax.invert_yaxis()
    ax.margins(x=0.06)
    ax.use_sticky_edges = False
    if low > 0 and high > _LOG_RATIO * low:
        ax.set_xscale("log")
        st.plain_log_ticks(ax, "x")
    ax.grid(visible=False, axis="y")
    ax.set_xlabel(f"{prediction.final.name} (m/s)")
    ax.set_title("Uncertainty budget", fontsize=10.5)


# ------------------------------------------------------------------------------
# Detection power of a campaign: the probability of detecting each effect against its size, as a map.
#
# One row per effect; columns are sizes relative to the largest plausible one. The sizes of 50 and 90 % power are listed
# at the end of each row in the unit of the effect.


@st.look()
def draw_power(power: Power) -> Figure | None:
    """Draw the power to detect each effect against its size, in the order of what is detected first."""
    from matplotlib.colors import LinearSegmentedColormap

    entries = sorted(power.effects, key=lambda one: abs((one.size_at(0.9) - one.zero) / (one.largest - one.zero)))
    if not entries or power.wary:
        return None
    n = len(entries)
    least, most, n_columns = 1e-4, 3.0, 108  # sizes relative to the largest plausible one, 24 to a decade (chosen)
    parts = np.geomspace(least, most, n_columns)
    probabilities = np.array([
        [one.probability_at(one.zero + part * (one.largest - one.zero)) for part in parts] for one in entries
    ])  # fmt: skip
    fig = st.new_figure(9.6, 0.31 * n + 1.75)  # in: a line of letters for each row, and title, scale and legend
    ax, sizes = fig.subplots(1, 2, width_ratios=(1.45, 1.0))
    shades = LinearSegmentedColormap.from_list("power", ["#ffffff", "#d7e6f2", "#7fb2d8", st.BLUE, "#003f66"])
    mesh = ax.pcolormesh(parts, np.arange(n), probabilities, cmap=shades, vmin=0, vmax=1, rasterized=True)
    ax.set(xscale="log", xlim=(least, most), ylim=(n - 0.5, -0.5), xlabel="size relative to the largest plausible")
    ax.grid(visible=False)
    ax.set_xticks([0.0001, 0.001, 0.01, 0.1, 1.0], labels=["0.0001", "0.001", "0.01", "0.1", "1"])
    # A white line below the dots keeps them visible on the dark part of the map.
    ax.axvline(1.0, color="white", linewidth=2.2)
    ax.axvline(1.0, color=st.INK, linewidth=1.2, linestyle=":")
    st.names_beside(ax, [f"{spaced_name(entry.effect)}, {entry.symbol}" for entry in entries])
    for row in range(1, n):
        ax.axhline(row - 0.5, color=st.GRID, linewidth=0.7)
    # Sizes in the unit of each effect; grey beyond the plausible range
    sizes.set_axis_off()
    sizes.set(xlim=(0, 1), ylim=(n - 0.5, -0.5))
    for x, words in ((0.0, "50 %\npower"), (0.35, "90 %\npower"), (0.7, "largest\nplausible")):
        sizes.text(x, -0.65, words, va="bottom", fontsize=9, color=st.INK)
    for row, one in enumerate(entries):
        for x, value in ((0.0, one.size_at(0.5)), (0.35, one.size_at(0.9)), (0.7, one.largest)):
            beyond = x == 0.7 or abs(value - one.zero) > abs(one.largest - one.zero)
            sizes.text(x, row, size_text(one, value), va="center", fontsize=9, color=st.MUTED if beyond else st.INK)
    bar = fig.colorbar(mesh, ax=ax, location="bottom", fraction=0.06, pad=0.02, aspect=50)
    bar.set_label("power: probability of detection (%)")
    bar.set_ticks([0, 0.5, 0.9, 1], labels=["0", "50", "90", "100"])
    bar.outline.set_visible(False)
    trials = f"{power.n_trials} trial{'s' if power.n_trials != 1 else ''}"
    ax.set_title(f"What {trials} can detect", loc="left", pad=26)
    return fig
