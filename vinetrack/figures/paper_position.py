"""The paper's Fig. 4 in our drawing: the leading edge at three pressures, and what is left out of Eq. (2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.style import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, blank, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BANDS = (
    ("depletion_slow", "depletion_fast", ORANGE, "chamber not refilled,\nisothermal to adiabatic"),
    ("depletion_slow_slack", "depletion_fast_slack", PURPLE, "both"),
)
_POINTS = 40
_SHOWN = 1.9
"""How many times longer than Eq. (2) takes a panel reaches: slower motions are cut off."""


def draw_paper_position(
    motions: pd.DataFrame, means: pd.DataFrame, errors: pd.DataFrame, printed_cm: Mapping[int, float]
) -> Figure:
    """Draw a panel a pressure.

    Parameters
    ----------
    motions : `pressure_kPa, departure, time_s, lead_position_m`; `departure` is `eq2` or what is added to it.
    means : `pressure_kPa, time_s, lead_position_m, lead_position_sigma_m, n_trials`, since release; may be empty.
    errors : `pressure_kPa, rms_mean_m`; may be empty.
    printed_cm : published root mean square by pressure in kPa.
    """
    from matplotlib.figure import Figure

    pressures = sorted(motions["pressure_kPa"].unique())
    if not pressures:
        return blank("There are no motions to draw.")
    with look():
        fig = Figure(figsize=(12.0, 5.2), layout="constrained")
        axes = fig.subplots(1, len(pressures), squeeze=False, sharey=True)[0]
        for ax, pressure_kPa in zip(axes, pressures, strict=True):
            own = motions[motions["pressure_kPa"] == pressure_kPa]
            curves = {str(name): part for name, part in own.groupby("departure", sort=False)}
            _draw_curves(ax, curves)
            _draw_mean(ax, means[means["pressure_kPa"] == pressure_kPa])
            ax.set(xlabel="time since release (s)", xlim=(0, _SHOWN * float(curves["eq2"]["time_s"].iloc[-1])))
            said = errors.loc[errors["pressure_kPa"] == pressure_kPa, "rms_mean_m"]
            ours = f"ours {100 * float(said.iloc[0]):.2f} cm" if len(said) else "not among the trials"
            ax.set_title(
                f"{pressure_kPa:g} kPa\nrms: printed {printed_cm[round(pressure_kPa)]:.2f} cm, {ours}", fontsize=10.5
            )
        axes[0].set_ylabel("growth of the leading edge (cm)")
        handles, labels = axes[-1].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9.5)
    return fig


def _draw_curves(ax: Axes, curves: Mapping[str, pd.DataFrame]) -> None:
    """Eq. (2), and the bands and the line of what departs from it; bands are filled between equal positions."""
    for slow, fast, colour, label in _BANDS:
        position_cm = np.linspace(0, 28, 200)
        first, last = (_time_at(curves[name], position_cm) for name in (slow, fast))
        ax.fill_betweenx(position_cm, first, last, color=colour, alpha=0.3, lw=0, label=label)
    slack = curves["slack"]
    ax.plot(
        slack["time_s"],
        100 * slack["lead_position_m"],
        color=GREEN,
        lw=1.6,
        ls=(0, (4, 2)),
        label="tail that\ncannot push",
    )
    plain = curves["eq2"]
    ax.plot(
        plain["time_s"], 100 * plain["lead_position_m"], color=INK, lw=1.8, label="Eq. (2) with the\nprinted numbers"
    )


def _time_at(curve: pd.DataFrame, position_cm: np.ndarray) -> np.ndarray:
    """When a motion passes each place; where it never gets, the place is put at the end of time."""
    time_s, grown_cm = curve["time_s"].to_numpy(float), 100 * curve["lead_position_m"].to_numpy(float)
    when = np.interp(position_cm, grown_cm, time_s)
    return np.where(position_cm <= grown_cm.max() + 1e-9, when, 1e3)


def _draw_mean(ax: Axes, mean: pd.DataFrame) -> None:
    if not len(mean):
        return
    part = mean.iloc[:: max(len(mean) // _POINTS, 1)]
    time_s, position_cm, sigma_cm = (
        part["time_s"].to_numpy(float),
        100 * part["lead_position_m"].to_numpy(float),
        100 * np.nan_to_num(part["lead_position_sigma_m"].to_numpy(float)),
    )
    n_trials = int(mean["n_trials"].iloc[0])
    ax.fill_between(time_s, position_cm - sigma_cm, position_cm + sigma_cm, color=BLUE, alpha=0.2, lw=0)
    ax.plot(
        time_s,
        position_cm,
        "o",
        color=BLUE,
        ms=3.2,
        mec=MUTED,
        mew=0.3,
        label=f"mean of {n_trials} trials,\n± one trial's scatter",
    )
