"""What is said of a campaign that is planned: its conditions, the errors it leaves, and how it went when rehearsed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vinetrack.planning.campaign_design import Plan, Planned
    from vinetrack.planning.campaign_information import FilmingPlan
    from vinetrack.planning.predictive_inputs import PredictiveInputs
    from vinetrack.planning.simulated_campaigns import SimulatedCampaigns

SHOWN_OTHERS = 4


def campaign_lines(
    found: Planned,
    beliefs: Sequence[PredictiveInputs],
    camera: FilmingPlan,
    n_error: float,
    B_error: float,
    most_trials: int,
) -> Iterator[str]:
    """What the campaign is, what it leaves, and what others would."""
    spread_P, spread_B = beliefs[0].spreads
    yield (
        f"standard errors wanted: n {n_error:g}, B {100 * B_error:g} %; filmed at {camera.capture_fps:g} "
        f"frames a second, noise {1e3 * camera.noise_m:g} mm; from trial to trial P {100 * spread_P:.2g} %, B "
        f"{100 * spread_B:.2g} %"
    )
    yield f"believed: {'; '.join(dict.fromkeys(_believed(belief) for belief in beliefs))}"
    yield ""
    if found.best is None:
        yield from _out_of_reach(found, most_trials)
        return
    yield from _conditions(found, found.best)
    yield ""
    yield from _compared(found, beliefs, camera)
    if found.candidates.rejected:
        yield f"conditions passed over as too slow or too quick to be filmed: {found.candidates.rejected}"


def _believed(belief: PredictiveInputs) -> str:
    from vinetrack.planning.campaign_design import MEASURED_YIELD_SIGMA_PA

    values = belief.medians
    trial = belief.trial
    sigma = trial.yield_pressure_sigma_Pa
    known = sigma if sigma > 0 else MEASURED_YIELD_SIGMA_PA
    yields = f"P_y {trial.yield_pressure_Pa / 1e3:.3g} kPa, measured to {known / 1e3:.2g}"
    return f"{trial.vine} B {values['eversion_damping.B']:.3g}, n {values['eversion_damping.n']:.3g}, {yields}"


def _conditions(found: Planned, best: Plan) -> Iterator[str]:
    """The campaign, a row a vine and payload."""
    from vinetrack.core.terminal import table

    shown = found.candidates
    yield f"{best.n_trials} trials: {best.replicates} at each of these pressures"
    rows = []
    for vine in dict.fromkeys(shown.vine):
        for payload in best.payloads_kg:
            pressures = [
                trial.pressure_Pa / 1e3
                for trial, count in zip(shown.trials, best.counts, strict=True)
                if trial.vine == vine and trial.payload_kg == payload and count > 0
            ]
            rows.append((vine, f"{1e3 * payload:g}", ", ".join(f"{P:.3g}" for P in pressures)))
    yield from table(rows, ("vine", "payload", "pressures"), ("", "g", "kPa"), align="<><")


def _compared(found: Planned, beliefs: Sequence[PredictiveInputs], camera: FilmingPlan) -> Iterator[str]:
    """The campaign beside others that will do, the cheapest of all, and what steady speeds alone would say."""
    from vinetrack.core.terminal import table
    from vinetrack.planning.steady_information import reaches_steady, steady_error

    shown = found.candidates
    steady = reaches_steady(shown.model, shown.trials, camera.longest_s)

    def row(name: str, one: Plan) -> tuple[str, ...]:
        alone = steady_error(shown.model, shown.trials, one.counts, beliefs[0].spreads, steady)
        errors = f"{one.n_error:.4f}", f"{100 * one.B_error:.2f}", "–" if math.isinf(alone) else f"{alone:.4f}"
        loads = " and ".join(f"{1e3 * load:g} g" for load in one.payloads_kg)
        shape = (
            f"{one.pressures} pressures × {one.replicates}, {loads}" if one.pressures else "placed where it helps most"
        )
        return name, str(one.n_trials), shape, *errors

    assert found.best is not None
    rows = [row("this campaign", found.best)]
    rows += [row("another", one) for one in found.others[:SHOWN_OTHERS]]
    if found.cheapest is not None:
        rows.append(row("cheapest", found.cheapest))
    head = ("", "trials", "", "error of n", "worst B", "n, steady speeds")
    yield from table(rows, head, ("", "", "", "", "%", "alone"), align="<><>>>")
    yield ("errors: of a fit to whole trajectories whose model lacks nothing; the cheapest would not show if it did")


def _out_of_reach(found: Planned, most_trials: int) -> Iterator[str]:
    near, end = found.nearest, found.endless
    yield f"! no campaign of {most_trials} trials or fewer, with the pressures and replicates allowed, leaves so little"
    yield (
        f"the nearest, {near.n_trials} trials at {near.pressures} pressures, leaves n {near.n_error:.4f} and B "
        f"{100 * near.B_error:.2f} %; endlessly many would leave n {end.n_error:.4f} and B {100 * end.B_error:.2f} %"
    )
    yield "widen the pressures, allow more (--most-trials, --replicates, --pressures), add vines, or want less"


def rehearsal_lines(found: Planned, rehearsal: SimulatedCampaigns) -> list[str]:
    """What the campaign left when it was rehearsed, beside what was expected."""
    from vinetrack.core.terminal import table

    assert found.best is not None
    if rehearsal.campaigns == 0:
        return ["", "! none of the rehearsed campaigns could be fitted"]
    room = rehearsal.uncertainty
    rows = [("n", f"{found.best.n_error:.4f}", f"{rehearsal.n_stated:.4f}", _found(rehearsal.n_rms, room, 4), "")]
    for vine, expected in found.best.B_errors.items():
        stated, rms = (100 * errors.get(vine, math.nan) for errors in (rehearsal.B_stated, rehearsal.B_rms))
        rows.append((f"B ({vine})", f"{100 * expected:.2f}", f"{stated:.2f}", _found(rms, room, 2), "%"))
    lines = ["", f"rehearsed {rehearsal.campaigns} times: grown with scatter and noise, fitted, held against the truth"]
    lines += table(rows, ("error of", "expected", "stated by fits", "found", "unit"), align="<>>><")
    lines.append(f"95 % intervals held the truth in {rehearsal.covered:.0%} of cases")
    if rehearsal.failed:
        lines.append(f"! {rehearsal.failed} of the campaigns could not be fitted")
    return lines


def _found(rms: float, room: float, digits: int) -> str:
    return f"{rms:.{digits}f} ± {rms * room:.{digits}f}"
