"""Stopping rule for a campaign that is diagnosed repeatedly: one effect is left at a risk stated beforehand.

An experimenter who looks after every few trials and stops when the verdict suits errs more often than a single verdict
does. A likelihood ratio, however, may be monitored at any number of looks: if hypothesis T is true, the ratio of the
marginal likelihoods of any other fixed hypothesis Y and of T ever exceeds 1/α with probability at most α (Ville, Étude
critique de la notion de collectif, 1939; as e-values: Grünwald, de Heide & Koolen, J. R. Stat. Soc. B 86, 1091, 2024;
Ramdas, Grünwald, Vovk & Shafer, Statistical Science 38, 576, 2023). This holds however each trial is chosen in view of
those before. With m hypotheses, of which "nothing is missing" is one, an effect is named when its marginal likelihood
exceeds that of every other by

    Z_Y / Z_T ≥ (m − 1)/risk,
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vinetrack.core.units import or_nan
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    MISSING,
    NOT_TESTABLE,
    REFITTED,
    UNEXPLAINED,
    Candidate,
    Diagnosis,
    Round,
)

FEWEST_TRIALS = 6  # Trials before which no campaign stops (chosen)

NO_MISSING_EFFECT = "nothing missing"  # Name of the hypothesis that the model lacks no effect

STOP, GO_ON = "stop", "go on"


@dataclass(frozen=True)
class CampaignLook:
    """Result of one look at a campaign. `names` are the effects found, in order. `log_ratio` is the log of the smallest
    ratio of marginal likelihoods of one of them to a rival, and `rival` that rival; `needed` is ln((m − 1)/risk).
    """

    trials: int
    verdict: str
    names: tuple[str, ...]
    log_ratio: float
    rival: str
    needed: float
    decision: str
    why: str

    def to_json(self) -> dict[str, Any]:
        """As an entry of `looks` of the ledger."""
        return {**vars(self), "names": list(self.names)}

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> CampaignLook:
        """Read what `to_json` wrote."""
        return cls(
            trials=int(entry["trials"]),
            verdict=str(entry["verdict"]),
            names=tuple(entry.get("names") or ()),
            log_ratio=or_nan(entry.get("log_ratio")),
            rival=str(entry.get("rival") or ""),
            needed=or_nan(entry.get("needed")),
            decision=str(entry["decision"]),
            why=str(entry.get("why") or ""),
        )


def look_at(diagnosis: Diagnosis, trials: int, risk: float) -> CampaignLook:
    """Decide whether a campaign may stop."""
    testable = [candidate for candidate in diagnosis.ranking if candidate.status != NOT_TESTABLE]
    needed = math.log(max(len(testable), 1) / risk)
    verdict = diagnosis.verdict
    names = diagnosis.effects or diagnosis.answer_set
    log_ratio, rival = _least_ratio(diagnosis)
    stops = False
    if diagnosis.refused or not verdict:
        why = f"there is no verdict: {diagnosis.refused}"
    elif verdict == ADEQUATE:
        why = "nothing is found to be missing; the power of the trials states which effects could go undetected"
    elif UNEXPLAINED in (verdict, diagnosis.final_verdict):
        why = "what is missing is not among the candidates, so no effect is named"
    elif AMBIGUOUS in (verdict, diagnosis.final_verdict):
        why = "several effects are left"
    elif verdict == MISSING and diagnosis.final_verdict != ADEQUATE:
        why = "with the named effect in the model, a misfit remains"
    elif verdict == ARTEFACT and len(names) > 1:
        why = "several faults of the measurement are left"
    elif trials < FEWEST_TRIALS:
        why = f"fewer than {FEWEST_TRIALS} trials do not determine the scatter between trials"
    elif not math.isfinite(log_ratio):
        why = "the effect was added together with others, and its marginal likelihood alone is not known"
    elif log_ratio < needed:
        why = f"{rival} is not excluded at the stated risk"
    else:
        stops, why = True, f"all others of {len(testable)} candidates, and nothing missing, are excluded"
    return CampaignLook(trials, verdict, tuple(names), log_ratio, rival, needed, STOP if stops else GO_ON, why)


def trials_to_go(look: CampaignLook) -> int:
    """Number of further trials of the same kinds that are needed, if the log ratio grows in proportion to
    the trials.
    """
    if look.decision == STOP or not math.isfinite(look.log_ratio) or look.log_ratio <= 0:
        return 0
    return max(math.ceil(look.trials * (look.needed / look.log_ratio - 1)), 1)


def _least_ratio(diagnosis: Diagnosis) -> tuple[float, str]:
    """The smallest ln(Z_effect / Z_rival) over all effects named, and the rival; NaN where it is not known."""
    log_ratios: list[tuple[float, str]] = []
    named = [step for step in diagnosis.rounds if step.verdict in (MISSING, ARTEFACT) and len(step.answer_set) == 1]
    for step in named:
        name = step.answer_set[0]
        best = next((candidate for candidate in step.ranking if candidate.effect == name), None)
        if best is None or not math.isfinite(best.log_bayes):
            return math.nan, ""
        log_ratios.append((best.log_bayes, NO_MISSING_EFFECT))
        log_ratios += _rivals(step, best)
    return min(log_ratios) if log_ratios else (math.nan, "")


def _rivals(step: Round, best: Candidate) -> list[tuple[float, str]]:
    """ln(Z_best / Z_rival) for all candidates of a round. A rival that was not refitted counts with the fall of −2 ln L
    that its score test predicts, without a penalty for its parameters: the ratio is then no larger than after a refit.
    """
    ratios = []
    for rival in step.ranking:
        if rival.effect == best.effect or rival.status == NOT_TESTABLE or rival.is_richer_form_of(best.effect):
            continue
        if rival.status == REFITTED and rival.posterior_weight > 0:
            ratios.append((math.log(best.posterior_weight / rival.posterior_weight), rival.effect))
        elif math.isfinite(rival.delta_chi2) and best.delta_chi2 > 0:
            # One over the inflation; a little less where the best has several sizes, so that the ratio is no larger.
            tempering = best.sigma**2 / best.delta_chi2
            ratios.append((0.5 * tempering * (best.delta_chi2 - rival.delta_chi2), rival.effect))
    return ratios
