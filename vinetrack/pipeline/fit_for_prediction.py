"""Which fit of a results folder predictions are made from: never silently one whose model its diagnosis refuted.

A diagnosis that ends with `adequate` hands on the model that it ended with: the one in use, or the one with every
added effect. After any other verdict there is no model to predict from, unless the person insists.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.results.folder_layout import Results, ResultsError, read_json
from vinetrack.results.stored_diagnosis import read_diagnosis


@dataclass(frozen=True)
class ChosenFit:
    """What a fit file holds, and the lines that must stand above everything predicted from it."""

    content: Mapping[str, Any]
    heading: tuple[str, ...]


def choose_fit(folder: Path, anyway: bool = False) -> ChosenFit:
    """Choose the fit of a results folder to predict from.

    Parameters
    ----------
    folder : results folder.
    anyway : whether a refuted model will do.

    Returns
    -------
    ChosenFit
        `heading` names the verdict where it is not `adequate` on the model in use.

    Raises
    ------
    ResultsError
        If there is no fit, or its model was refuted and `anyway` is not given.
    """
    results = Results(folder)
    in_use = read_json(results.fit)
    diagnosis = read_diagnosis(results)
    if diagnosis is None or not diagnosis.verdict:
        return ChosenFit(
            in_use, (f"! {folder} has no diagnosis: whether this model describes the trials is not known",)
        )
    if diagnosis.verdict == ADEQUATE:
        return ChosenFit(in_use, ())
    final = read_json(results.final_fit) if results.final_fit.exists() else None
    added = " + ".join(diagnosis.effects)
    if diagnosis.final_verdict == ADEQUATE and final is not None:
        return ChosenFit(final, (f"by the model that the diagnosis ended with, {added} added",))
    verdict = f"{diagnosis.final_verdict or diagnosis.verdict}: {diagnosis.explanation}"
    if not anyway:
        why = (
            f"the model with {added} is not stored there: run it again"
            if diagnosis.final_verdict == ADEQUATE
            else "the diagnosis refuted the model and ended with none that describes the trials"
        )
        raise ResultsError(f"{folder}: no prediction, {why}; or predict from it with --anyway. {verdict}")
    which = f"the model with {added} added" if final is not None else "the model in use"
    return ChosenFit(final or in_use, (f"! {verdict}", f"! what follows is by {which} all the same"))
