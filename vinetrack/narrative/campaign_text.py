"""A designed campaign as text: its conditions, its expected standard errors, and those of simulated campaigns."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vinetrack.planning.campaign_design import Plan, Planned
    from vinetrack.planning.campaign_information import FilmingPlan
    from vinetrack.planning.predictive_inputs import PredictiveInputs
    from vinetrack.planning.simulated_campaigns import SimulatedCampaigns

_SHOWN_OTHERS = 4  # Other campaigns shown that also meet the limits (chosen)


def campaign_lines(
    planned: Planned,
    inputs: Sequence[PredictiveInputs],
    camera: FilmingPlan,
    n_error: float,
    B_error: float,
    most_trials: int,
) -> Iterator[str]:
    """Yield the campaign, its expected standard errors, and those of other campaigns."""
    spread_P, spread_B = inputs[0].spreads
    yield (
        f"standard errors wanted: n {n_error:g}, B {100 * B_error:g} %; filmed at {camera.capture_fps:g} "
        f"frames per second, noise {1e3 * camera.noise_m:g} mm; between-trial standard deviations: P "
        f"{100 * spread_P:.2g} %, B {100 * spread_B:.2g} %"
    )
    yield f"assumed: {'; '.join(dict.fromkeys(_assumed(vine) for vine in inputs))}"
    yield ""
    if planned.best is None:
        yield from _out_of_reach(planned, most_trials)
        return
    yield from _conditions(planned, planned.best)
    yield ""
    yield from _compared(planned, inputs, camera)
    if planned.candidates.rejected:
        yield f"conditions left out because they are too slow or too fast to film: {planned.candidates.rejected}"


def _assumed(inputs: PredictiveInputs) -> str:
    from vinetrack.planning.campaign_design import MEASURED_YIELD_SIGMA_PA

    values = inputs.medians
    trial = inputs.trial
    stated_Pa = trial.yield_pressure_sigma_Pa
    yield_sigma_Pa = stated_Pa if stated_Pa > 0 else MEASURED_YIELD_SIGMA_PA
    P_y = f"P_y {trial.yield_pressure_Pa / 1e3:.3g} ± {yield_sigma_Pa / 1e3:.2g} kPa"
    return f"{trial.vine} B {values['eversion_damping.B']:.3g}, n {values['eversion_damping.n']:.3g}, {P_y}"


def _conditions(planned: Planned, best: Plan) -> Iterator[str]:
    """The campaign, a row for each vine and payload."""
    from vinetrack.core.terminal import table

    shown = planned.candidates
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


def _compared(planned: Planned, inputs: Sequence[PredictiveInputs], camera: FilmingPlan) -> Iterator[str]:
    """The campaign, others that meet the limits, and the cheapest, each with its expected standard errors."""
    from vinetrack.core.terminal import table
    from vinetrack.planning.campaign_information import reaches_steady, steady_error

    shown = planned.candidates
    steady = reaches_steady(shown.model, shown.trials, camera.longest_s)

    def row(name: str, plan: Plan) -> tuple[str, ...]:
        by_speeds = steady_error(shown.model, shown.trials, plan.counts, inputs[0].spreads, steady)
        n_by_speeds = "–" if math.isinf(by_speeds) else f"{by_speeds:.4f}"
        errors = f"{plan.n_error:.4f}", f"{100 * plan.B_error:.2f}", n_by_speeds
        loads = " and ".join(f"{1e3 * load:g} g" for load in plan.payloads_kg)
        shape = (
            f"{plan.pressures} pressures × {plan.replicates}, {loads}"
            if plan.pressures
            else "at the most informative conditions"
        )
        return name, str(plan.n_trials), shape, *errors

    assert planned.best is not None
    rows = [row("this campaign", planned.best)]
    rows += [row("another", plan) for plan in planned.others[:_SHOWN_OTHERS]]
    if planned.cheapest is not None:
        rows.append(row("cheapest", planned.cheapest))
    head = ("", "trials", "", "error of n", "worst B", "n, steady speeds")
    yield from table(rows, head, ("", "", "", "", "%", "alone"), align="<><>>>")
    yield "errors: of a fit to whole trajectories with the true model; the cheapest design cannot reveal a wrong model"


def _out_of_reach(planned: Planned, most_trials: int) -> Iterator[str]:
    nearest, limit = planned.nearest, planned.endless
    yield f"! no campaign of {most_trials} trials or fewer with the allowed pressures and replicates reaches that"
    yield (
        f"the nearest, {nearest.n_trials} trials at {nearest.pressures} pressures, has n {nearest.n_error:.4f} and B "
        f"{100 * nearest.B_error:.2f} %; unlimited replicates would have n {limit.n_error:.4f} and B "
        f"{100 * limit.B_error:.2f} %"
    )
    yield (
        "widen the pressures, allow more trials (--most-trials, --replicates, --pressures), add vines, or accept "
        "larger errors"
    )


def simulation_lines(planned: Planned, simulated: SimulatedCampaigns) -> list[str]:
    """Return the standard errors of simulated campaigns beside the expected ones, as lines of text."""
    from vinetrack.core.terminal import table

    assert planned.best is not None
    if simulated.campaigns == 0:
        return ["", "! none of the simulated campaigns could be fitted"]
    relative_sigma = simulated.uncertainty
    rows = [
        (
            "n",
            f"{planned.best.n_error:.4f}",
            f"{simulated.n_stated:.4f}",
            _rms_with_error(simulated.n_rms, relative_sigma, 4),
            "",
        )
    ]
    for vine, expected in planned.best.B_errors.items():
        stated, rms = (100 * errors.get(vine, math.nan) for errors in (simulated.B_stated, simulated.B_rms))
        rows.append(
            (f"B ({vine})", f"{100 * expected:.2f}", f"{stated:.2f}", _rms_with_error(rms, relative_sigma, 2), "%")
        )
    lines = [
        "",
        f"{simulated.campaigns} campaigns simulated with scatter and noise, fitted, and compared with the true values:",
    ]
    lines += table(rows, ("error of", "expected", "stated by fits", "simulated", "unit"), align="<>>><")
    lines.append(f"95 % intervals contained the true value in {simulated.covered:.0%} of cases")
    if simulated.failed:
        lines.append(f"! {simulated.failed} simulated campaigns could not be fitted")
    return lines


def _rms_with_error(rms: float, relative_sigma: float, digits: int) -> str:
    return f"{rms:.{digits}f} ± {rms * relative_sigma:.{digits}f}"
