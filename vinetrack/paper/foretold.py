"""Lines of the table that Eq. (2) gives with the paper's own numbers, by simulation and without any experiment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pandas as pd

from vinetrack.core import published
from vinetrack.core.records import Trial
from vinetrack.paper.departures import DEPARTURES
from vinetrack.paper.expected import drag_shares, fast_vine_speeds, rule_on_noise_free
from vinetrack.paper.rows import COMPUTED, NOT_CHECKABLE, PaperRow
from vinetrack.planning.scaling_priors import damping_prior

FAST_AT = (0.90, 0.95, 0.98, 0.99)
DRAG_AT = (0.50, 0.95, 0.99)


def foretold_rows(trials: Sequence[Trial]) -> Iterator[PaperRow]:
    """The fast vine, air drag, and the published rule on noise-free motions.

    Parameters
    ----------
    trials
        Of the experiment; their pressures and lengths, at the printed scales and without payload, are those at which
        the rule is tried.
    """
    yield from _fast_rows()
    yield from _drag_rows()
    yield from _rule_rows(trials)


def _fast_rows() -> Iterator[PaperRow]:
    fast = published.FAST_VINE
    B = damping_prior(fast["diameter_mm"] / 1e3, fast["thickness_um"] / 1e6)
    size = f"{fast['diameter_mm']:g} mm × {fast['thickness_um']:g} µm × {fast['length_mm']:g} mm"
    for fraction, speed in zip(FAST_AT, fast_vine_speeds(FAST_AT), strict=True):
        yield PaperRow(
            row=f"fast_vine_predicted_{100 * fraction:.0f}",
            where="Section IV-E",
            quantity="speed of the leading edge by Eq. (2)",
            setting=f"{size}, {fast['pressure_kPa']:g} kPa, at {100 * fraction:.0f} % of the length",
            unit="m/s",
            published=published.FAST_VINE_PREDICTED_M_S,
            ours=speed,
            mark=NOT_CHECKABLE,
            how=f"its B is not printed; with a guess, B = {B:.2f}; fold and gas are the least that moves",
            beside="in Eq. (2) the speed of a bare vine has no limit at its end: the place where it is taken decides",
        )


def _drag_rows() -> Iterator[PaperRow]:
    case = published.DRAG_EXAMPLE
    size = f"{case['diameter_mm']:g} mm × {case['thickness_um']:g} µm × {case['length_mm']:g} mm"
    for fraction, share, printed in drag_shares(DRAG_AT):
        yield PaperRow(
            row=f"drag_share_{100 * fraction:.0f}",
            where="Section II",
            quantity="air drag over drive, C_D = 0.82",
            setting=f"{size}, {case['pressure_kPa']:g} kPa, at {100 * fraction:.0f} % of the length",
            unit="%",
            published=100 * published.DRAG_SHARE,
            as_printed=f"{100 * published.DRAG_SHARE:g}, not before {case['pressure_kPa']:g} kPa",
            ours=100 * share,
            mark=NOT_CHECKABLE,
            how="¼ρ A C_D ẏ² over ½PA: the air meets the head at ẏ, and the pulley halves it; its B is a guess",
            beside=f"{100 * printed:.0f} % by the printed ½ρ A C_D ẋ²: the place along the growth decides",
        )


def _rule_rows(trials: Sequence[Trial]) -> Iterator[PaperRow]:
    """What the published rule makes of motions without noise: its own bias, and that of a chamber that sags."""
    chosen: dict[str, Trial] = {}
    for trial in trials:
        scale = published.scale_of(1e3 * trial.diameter_m, 1e6 * trial.thickness_m)
        if scale is not None and trial.payload_kg == 0 and trial.travel_ratio == 2:
            chosen.setdefault(trial.condition, trial)
    if len(chosen) < len(published.DAMPING_B):
        return
    cases = (
        ("rule_bias_n", None, "chamber kept full", "the weight of the film, which Eq. (3) leaves out, lifts n"),
        ("rule_n_depletion_slow", 1.0, "chamber not refilled, isothermal", "set pressure in place of what is left"),
        ("rule_n_depletion_fast", 1.4, "chamber not refilled, adiabatic", "set pressure in place of what is left"),
    )
    for row, gamma, setting, how in cases:
        n, B = rule_on_noise_free(gamma, list(chosen.values()))
        of_scales = ", ".join(f"{B[scale]:.2f}" for scale in sorted(B))
        yield PaperRow(
            row=row,
            where="Fig. 6",
            quantity="n that the published rule finds in noise-free motions with the printed n",
            setting=setting,
            published=published.EXPONENT,
            ours=n,
            mark=COMPUTED,
            how=f"{len(chosen)} pressures and vines, Eq. (2) with the printed B, no noise or scatter; {how}",
            beside=f"and B = {of_scales} for R = {', '.join(str(scale) for scale in sorted(B))}",
        )


def departures_in_words(table: pd.DataFrame, figure: str, pressure_kPa: float) -> str:
    """What departures from Eq. (2) would cause, in a sentence: positions in cm, speeds in m/s."""
    own = table[(table["figure"] == figure) & (abs(table["pressure_kPa"] - pressure_kPa) < 1e-6)]
    column, factor, unit = (
        ("rms_position_m", 100.0, "cm") if figure == "Fig. 4" else ("rms_final_lead_velocity_m_s", 1.0, "m/s")
    )
    size = {row.departure: factor * float(getattr(row, column)) for row in own.itertuples()}
    if not size:
        return ""
    slow, fast, slack, both_slow, both_fast = (size[departure.name] for departure in DEPARTURES)
    return (
        f"not in it: a chamber that nothing refills would cause {slow:.2f} to {fast:.2f} {unit}, a tail that "
        f"cannot push {slack:.2f}, both {both_slow:.2f} to {both_fast:.2f}"
    )
