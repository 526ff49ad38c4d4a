"""Which variables a learned force may depend on, where trials do not tell them apart, and the words for it.

Where speeds are steady, growth, speed and time are hardly three variables: a surface over two of them is a surface over
another two. Posterior weights then compare how smooth the surfaces are, which is an opinion. A choice of variables is
therefore set aside by what it leaves of the tracks, not by its weight alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_sensitivities import FittedMotion
from vinetrack.diagnosis.force_surface import ANY, CONSTANT, Domain
from vinetrack.narrative.verdict_summary import joined

TIED = 0.05
"""Weight from which a choice of variables is named beside the best. Chosen: the usual twentieth."""

SURE = 0.95
"""Weight from which a choice is sure. Chosen: the usual."""

FOLLOWS = 0.1
"""Part of a variable's variance that is left beside smooth functions of others, from which down it follows from them.
Measured on tuning seeds 20500 and 20520 to 20522: of growth, speed and time any two leave at most 8 % of the third, one
leaves 25 % and more of another. At half of it the speed is not named where it leaves 8 %, at twice most pairs are."""

SAMPLED = 40
"""Points of a motion by which it is asked whether a variable follows from others. Chosen: more than splines."""

_WORDS = {
    "growth": "the growth",
    "speed": "the speed of the tail",
    "time": "the time since release",
    "pressure": "the pressure",
}


def named(name: str) -> str:
    """A choice of variables in words.

    Parameters
    ----------
    name : str
        As `growth+speed`.

    Returns
    -------
    str
    """
    return " and ".join(_WORDS[variable] for variable in name.split("+"))


def following(domain: Domain, singles: Sequence[Domain], motions: Sequence[FittedMotion]) -> list[str]:
    """Variables that are smooth functions of those of a domain wherever trials have been.

    Parameters
    ----------
    domain : the variables from which others may follow.
    singles : sequence of Domain
        Every variable alone.
    motions : sequence of FittedMotion

    Returns
    -------
    list of str
        Without those of the domain itself.
    """
    counts = [np.count_nonzero(motion.time_s <= motion.counts_until_s) for motion in motions]
    places = [np.linspace(0, count - 1, SAMPLED).astype(int) for count in counts]

    def visited(over: Domain) -> list[Floats]:
        courses = [np.array(over.of_motion(motion))[:, at] for motion, at in zip(motions, places, strict=True)]
        return list(np.hstack(courses))

    basis = domain.basis(visited(domain))
    names = []
    for single in singles:
        if single.variables[0] in domain.variables:
            continue
        (value,) = single.parts(visited(single))
        left = value - basis @ np.linalg.lstsq(basis, value, rcond=1e-8)[0]
        if float(np.var(left)) < FOLLOWS * float(np.var(value)):
            names.append(single.variables[0])
    return names


def not_excluded(
    best: Domain,
    weights: Mapping[str, float],
    losses: Mapping[str, float],
    worth: float,
    others: Sequence[Domain],
    motions: Sequence[FittedMotion],
) -> list[str]:
    """Choices of variables beside the best that the trials do not exclude, best first.

    Of those that were followed, the ones with a weight, and those of no more variables that leave hardly more of the
    tracks. Of the others, those of as many variables from which the variables of the best follow: any force over the
    best is a force over them.

    Parameters
    ----------
    best : the most likely choice.
    weights : mapping
        Posterior weights of the choices that were followed, by name.
    losses : mapping
        By how much more χ² they leave than the best, in units of the noise.
    worth : float
        What a loss must exceed to exclude a choice.
    others : sequence of Domain
        All choices.
    motions : sequence of FittedMotion

    Returns
    -------
    list of str
    """
    singles = [domain for domain in others if len(domain.variables) == 1]
    names = []
    for domain in others:
        if domain.name == best.name:
            continue
        simple = len(domain.variables) <= len(best.variables)
        if domain.name in weights:
            kept = weights[domain.name] >= TIED or (simple and losses[domain.name] < worth)
        else:
            reached = {*domain.variables, *following(domain, singles, motions)} if simple else set()
            kept = len(domain.variables) == len(best.variables) > 1 and reached >= set(best.variables)
        if kept:
            names.append(domain.name)
    return sorted(names, key=lambda name: -weights.get(name, 0.0))


def dependence(name: str, weights: Mapping[str, float], beside: Sequence[str]) -> str:
    """What describes a force, and how sure that is: a sentence without its full stop.

    Parameters
    ----------
    name : str
        The most likely choice, as `growth+speed`.
    weights : mapping
        Posterior weights by choice.
    beside : sequence of str
        Further choices that are not excluded.

    Returns
    -------
    str
    """
    begin = "Learned as a smooth function inside the fit, the missing force"
    if not beside:
        likely = "is described" if weights[name] >= SURE else "is most likely described"
        return f"{begin} {likely} by {named(name)} (posterior weight {weights[name]:.0%})"
    choices = [tuple(choice.split("+")) for choice in (name, *beside)]
    common = [variable for variable in choices[0] if all(variable in choice for choice in choices)]
    shares = [f" ({weights[choice]:.0%})" if choice in weights else "" for choice in (name, *beside)]
    remaining = ["+".join(variable for variable in choice if variable not in common) for choice in choices]
    if common and all(remaining):
        listed = joined([f"{named(left)}{share}" for left, share in zip(remaining, shares, strict=True)], "or")
        return f"{begin} is described by {named('+'.join(common))}, and by {listed}: these trials do not tell which"
    listed = joined([f"{named(choice)}{share}" for choice, share in zip((name, *beside), shares, strict=True)], "or by")
    return f"{begin} is described by {listed}: these trials do not tell which"


def reference(domain: Domain, begins: str, undecided_N: float) -> str:
    """From what a force is counted, and what of it the trials do not decide: whole sentences.

    Parameters
    ----------
    domain : its variables.
    begins : str
        What it is where growth begins, as `force_surface` has it.
    undecided_N : float
        Standard error of a part that is the same all along the growth, N.

    Returns
    -------
    str
    """
    if domain.course < 0:
        return "How much of it is B, n and P_y these trials do not decide: it is drawn as small as it may be."
    if begins == ANY:
        return (
            "It is not nothing where growth begins, for B, n and P_y cannot hold all that acts there; they may hold a"
            f" part of it that is the same all along the growth, ±{undecided_N:.2f} N."
        )
    counted = " but for a constant, which P_y does not hold within its error" if begins == CONSTANT else ""
    return (
        f"It is counted from where growth begins{counted}: B, n and P_y are those of the vine there. How it changes"
        " from there on the trials decide, not a part that is the same all along the growth"
        + (f" (±{undecided_N:.2f} N), which B, n and P_y may hold as well." if undecided_N else ", which P_y may hold.")
    )
