"""Which variables a learned force may depend on when the trials cannot tell, and the sentences about it.

Where speeds are steady, growth, speed and time are hardly three separate variables: a surface over two of them can be
written over another two. Posterior weights then compare only how smooth the surfaces are, which depends on the prior. A
choice of variables is therefore excluded by the misfit that it leaves, not by its weight alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_evidence import ForcePosterior
from vinetrack.diagnosis.force_sensitivities import FittedMotion
from vinetrack.diagnosis.force_surface import CONSTANT_AT_START, FREE_AT_START, Domain
from vinetrack.narrative.verdict_summary import joined

if TYPE_CHECKING:
    import pandas as pd

LEAST_WEIGHT_NAMED = 0.05  # Weight from which a choice of variables is reported with the best (chosen)

CERTAIN_WEIGHT = 0.95  # Weight from which a choice counts as certain (chosen)

# Part of a variable's variance left by smooth functions of others, up to which it counts as a function of them
# (measured)
LARGEST_FREE_VARIANCE = 0.1

POINTS_PER_MOTION = 40  # Points of a motion at which one variable is regressed on others (chosen)

_WORDS = {
    "growth": "the growth",
    "speed": "the speed of the tail",
    "time": "the time since release",
    "pressure": "the pressure",
}


def variables_in_words(name: str) -> str:
    """A choice of variables in words."""
    return " and ".join(_WORDS[variable] for variable in name.split("+"))


def dependent_variables(domain: Domain, singles: Sequence[Domain], motions: Sequence[FittedMotion]) -> list[str]:
    """Variables that are smooth functions of those of a domain, along all trials."""
    counts = [np.count_nonzero(motion.time_s <= motion.counts_until_s) for motion in motions]
    points = [np.linspace(0, count - 1, POINTS_PER_MOTION).astype(int) for count in counts]

    def visited(of: Domain) -> list[Floats]:
        by_motion = [np.array(of.values_along(motion))[:, at] for motion, at in zip(motions, points, strict=True)]
        return list(np.hstack(by_motion))

    basis = domain.basis(visited(domain))
    names = []
    for single in singles:
        if single.variables[0] in domain.variables:
            continue
        (value,) = single.normalised(visited(single))
        residual = value - basis @ np.linalg.lstsq(basis, value, rcond=1e-8)[0]
        if float(np.var(residual)) < LARGEST_FREE_VARIANCE * float(np.var(value)):
            names.append(single.variables[0])
    return names


def not_excluded(
    best: Domain,
    weights: Mapping[str, float],
    losses: Mapping[str, float],
    threshold: float,
    others: Sequence[Domain],
    motions: Sequence[FittedMotion],
) -> list[str]:
    """Choices of variables, besides the best, that the trials do not exclude; highest weight first. Among the refined
    choices: those with enough weight, and those of no more variables than the best whose χ² is hardly larger.
    """
    singles = [domain for domain in others if len(domain.variables) == 1]
    names = []
    for domain in others:
        if domain.name == best.name:
            continue
        no_larger = len(domain.variables) <= len(best.variables)
        if domain.name in weights:
            possible = weights[domain.name] >= LEAST_WEIGHT_NAMED or (no_larger and losses[domain.name] < threshold)
        else:
            implied = {*domain.variables, *dependent_variables(domain, singles, motions)} if no_larger else set()
            possible = len(domain.variables) == len(best.variables) > 1 and implied >= set(best.variables)
        if possible:
            names.append(domain.name)
    return sorted(names, key=lambda name: -weights.get(name, 0.0))


def dependence(name: str, weights: Mapping[str, float], alternatives: Sequence[str]) -> str:
    """What the force depends on and how certain that is: a sentence without its full stop."""
    subject = "Learned as a smooth function inside the fit, the missing force"
    if not alternatives:
        likely = "is described" if weights[name] >= CERTAIN_WEIGHT else "is most likely described"
        return f"{subject} {likely} by {variables_in_words(name)} (posterior weight {weights[name]:.0%})"
    choices = [tuple(choice.split("+")) for choice in (name, *alternatives)]
    common = [variable for variable in choices[0] if all(variable in choice for choice in choices)]
    shares = [f" ({weights[choice]:.0%})" if choice in weights else "" for choice in (name, *alternatives)]
    remaining = ["+".join(variable for variable in choice if variable not in common) for choice in choices]
    if common and all(remaining):
        listed = joined(
            [f"{variables_in_words(variables)}{share}" for variables, share in zip(remaining, shares, strict=True)],
            "or",
        )
        shared = variables_in_words("+".join(common))
        return f"{subject} is described by {shared}, and by {listed}: these trials do not tell which"
    listed = joined(
        [f"{variables_in_words(choice)}{share}" for choice, share in zip((name, *alternatives), shares, strict=True)],
        "or by",
    )
    return f"{subject} is described by {listed}: these trials do not tell which"


def reference(domain: Domain, at_start: str, undecided_N: float) -> str:
    """From where the force is measured, and which part of it the trials do not determine: whole sentences."""
    if domain.start_axis < 0:
        return "These trials do not decide how much of it belongs to B, n and P_y; it is drawn as small as they allow."
    if at_start == FREE_AT_START:
        return (
            "It is not zero where growth begins, because B, n and P_y cannot account for all that acts there; they"
            f" could account for a part of it that is the same all along the growth, ±{undecided_N:.2f} N."
        )
    constant = (
        ", except for a constant, which P_y cannot account for within its error"
        if at_start == CONSTANT_AT_START
        else ""
    )
    competitors = f" (±{undecided_N:.2f} N), which B, n and P_y" if undecided_N else ", which P_y"
    return (
        f"It is measured from where growth begins{constant}: B, n and P_y are those of the vine there. The trials"
        " determine how it changes from there on, but not a part that is the same all along the"
        f" growth{competitors} could account for as well."
    )


def force_sentence(
    best: ForcePosterior,
    weights: Mapping[str, float],
    alternatives: Sequence[str],
    explained: float,
    table: pd.DataFrame,
    undecided_N: float,
) -> str:
    """The variables of the force and how sure they are, its range and error, and from where it is measured."""
    visited = table[(table["condition"] == "") & (table["trials"] > 0)]
    low, high, sigma = (
        float(value) for value in (visited["force_N"].min(), visited["force_N"].max(), visited["sigma_N"].median())
    )
    name = best.domain.name
    subject = f" As a function of {variables_in_words(name)} it" if alternatives else " It"
    return (
        f"{dependence(name, weights, alternatives)}.{subject} ranges from {low:.2f} to {high:.2f} N where there are"
        f" trials, with a standard error of {sigma:.2f} N, and takes away {explained:.0%} of the misfit."
        f" {reference(best.domain, best.at_start, undecided_N)} A law over other variables may fit the tracks as well."
    ).replace("-", "−")


def remarks(replicates: int, domains: Sequence[Domain], alternatives: Sequence[str]) -> list[str]:
    """What limits the result, and which trials would help."""
    sentences = []
    if not replicates:
        sentences.append("No condition was repeated: how sure this is rests on the scatter that the fit assumes.")
    if not any("pressure" in domain.variables for domain in domains):
        sentences.append("All trials had one pressure, so they do not show whether the force depends on it.")
    if alternatives:
        sentences.append(
            "Trials that reach the same growth at another speed or time, by another pressure or payload, would tell"
            " them apart."
        )
    return sentences
