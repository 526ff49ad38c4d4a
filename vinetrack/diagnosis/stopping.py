"""When a campaign that is diagnosed again and again may stop: one name is left at a risk that was stated beforehand.

Who looks after every few trials and stops when the verdict suits him errs more often than each verdict does. Evidence
that may be looked at any number of times is a likelihood ratio. With a hypothesis T true, the ratio of the marginal
likelihoods of any other fixed hypothesis Y and of T never exceeds 1/α at any time but with probability α (Ville, Étude
critique de la notion de collectif, 1939; as e-values: Grünwald, de Heide & Koolen, J. R. Stat. Soc. B 86, 1091, 2024;
Ramdas, Grünwald, Vovk & Shafer, Statistical Science 38, 576, 2023). That holds whatever trials are chosen in view of
those before. With m hypotheses, of which "nothing is missing" is one, a name is left when its marginal likelihood
exceeds that of every other by

    Z_Y / Z_T ≥ (m − 1)/risk,

so that, whichever of them is true, another is named with at most that risk, by Bonferroni's inequality. Marginal
likelihoods are those of `plausibility_prior`, with plausible ranges as priors, brought down by what trials scatter more
than the noise model says. Numbers that all hypotheses share are at their best values in each, so the bound holds for
campaigns that pin them, not to the letter for the first few trials: a campaign never stops before `FEWEST_TRIALS`.

A truth that is in no list breaks the bound's premise. Of that speaks the diagnosis: a name stops a campaign only where
nothing is left beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vinetrack.core.numbers import or_nan
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

FEWEST_TRIALS = 6
"""Trials before which no campaign stops. Chosen: with fewer, scatter between trials is not estimated
(`fit_problem.estimable`), and nothing says whether trials agree."""

NOTHING = "nothing missing"
"""Name of the hypothesis that the model lacks nothing."""

STOP, GO_ON = "stop", "go on"


@dataclass(frozen=True)
class CampaignLook:
    """What one look at a campaign said.

    `names` are those found, in order; `log_ratio` the logarithm of the least ratio of the marginal likelihood of a
    name to that of a rival, of all names, and `rival` which rival that is; `needed` is ln((m − 1)/risk). `decision` is
    `stop` or `go on`, `why` a sentence.
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
        """Read what `to_json` wrote.

        Parameters
        ----------
        entry : of `looks`.

        Returns
        -------
        CampaignLook
        """
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
    """Decide whether a campaign may stop.

    Parameters
    ----------
    diagnosis : of all trials so far.
    trials : int
        How many they are.
    risk : float
        Chance, stated before the first look, that a wrong name stops the campaign.

    Returns
    -------
    CampaignLook
    """
    testable = [candidate for candidate in diagnosis.ranking if candidate.status != NOT_TESTABLE]
    needed = math.log(max(len(testable), 1) / risk)
    verdict = diagnosis.verdict
    names = diagnosis.effects or diagnosis.answer_set
    log_ratio, rival = _least_ratio(diagnosis)
    done = False
    if diagnosis.refused or not verdict:
        why = f"there is no verdict: {diagnosis.refused}"
    elif verdict == ADEQUATE:
        why = "nothing is found to be missing, and that is no name: what could still hide is in the power of the trials"
    elif UNEXPLAINED in (verdict, diagnosis.final_verdict):
        why = "what is missing is in no list: no name is given"
    elif AMBIGUOUS in (verdict, diagnosis.final_verdict):
        why = "several names are left"
    elif verdict == MISSING and diagnosis.final_verdict != ADEQUATE:
        why = "something is left beside the name"
    elif verdict == ARTEFACT and len(names) > 1:
        why = "several faults of the measurement are left"
    elif trials < FEWEST_TRIALS:
        why = f"fewer than {FEWEST_TRIALS} trials do not show how trials scatter"
    elif not math.isfinite(log_ratio):
        why = "the name came with others, and what it is worth alone is not known"
    elif log_ratio < needed:
        why = f"{rival} is not excluded at the risk that was stated"
    else:
        done, why = True, f"every other of {len(testable)} candidates, and nothing missing, are excluded"
    return CampaignLook(trials, verdict, tuple(names), log_ratio, rival, needed, STOP if done else GO_ON, why)


def trials_to_go(look: CampaignLook) -> int:
    """How many further trials of the same kinds it takes, evidence growing with the number of trials.

    Parameters
    ----------
    look : the last one.

    Returns
    -------
    int
        At least 1; 0 where that is not known.
    """
    if look.decision == STOP or not math.isfinite(look.log_ratio) or look.log_ratio <= 0:
        return 0
    return max(math.ceil(look.trials * (look.needed / look.log_ratio - 1)), 1)


def _least_ratio(diagnosis: Diagnosis) -> tuple[float, str]:
    """The least ln(Z_name / Z_rival) over all names, and the rival; NaN where a name's own worth is not known."""
    worth: list[tuple[float, str]] = []
    named = [step for step in diagnosis.rounds if step.verdict in (MISSING, ARTEFACT) and len(step.answer_set) == 1]
    for step in named:
        name = step.answer_set[0]
        best = next((candidate for candidate in step.ranking if candidate.effect == name), None)
        if best is None or not math.isfinite(best.log_bayes):
            return math.nan, ""
        worth.append((best.log_bayes, NOTHING))
        worth += _rivals(step, best)
    return min(worth) if worth else (math.nan, "")


def _rivals(step: Round, best: Candidate) -> list[tuple[float, str]]:
    """ln(Z_best / Z_rival) of all candidates of a round.

    One that was not refitted counts by the fall of −2 ln L that the sensitivities promise it, without paying for its
    numbers: its ratio is then no larger than it would be. Where they promise nothing, the search has passed it over.
    One that holds the name as a limit, and is no better, is a richer form of the same name.
    """
    ratios = []
    for rival in step.ranking:
        richer = rival.reason.startswith(f"it contains {best.effect} as a limit")
        if rival.effect == best.effect or rival.status == NOT_TESTABLE or richer:
            continue
        if rival.status == REFITTED and rival.posterior_weight > 0:
            ratios.append((math.log(best.posterior_weight / rival.posterior_weight), rival.effect))
        elif math.isfinite(rival.delta_chi2) and best.delta_chi2 > 0:
            tempered = best.sigma**2 / best.delta_chi2
            ratios.append((0.5 * tempered * (best.delta_chi2 - rival.delta_chi2), rival.effect))
    return ratios
