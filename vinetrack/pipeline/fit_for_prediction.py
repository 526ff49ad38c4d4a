"""Choice of the fit from which predictions are made; a model that the diagnosis refuted is not used silently.

If the diagnosis ended with `adequate`, its final model is used: the one in use, or the one with all added effects.
After any other verdict there is no prediction, unless the user insists with `--anyway`.
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
    """Content of a fit file, and the heading for everything predicted from it."""

    content: Mapping[str, Any]
    heading: tuple[str, ...]


def choose_fit(folder: Path, anyway: bool = False) -> ChosenFit:
    """Choose the fit of a results folder to predict from."""
    results = Results(folder)
    in_use = read_json(results.fit)
    diagnosis = read_diagnosis(results)
    if diagnosis is None or not diagnosis.verdict:
        return ChosenFit(
            in_use, (f"! {folder} has no diagnosis: it is unknown whether this model describes the trials",)
        )
    if diagnosis.verdict == ADEQUATE:
        return ChosenFit(in_use, ())
    final = read_json(results.final_fit) if results.final_fit.exists() else None
    added = " + ".join(diagnosis.effects)
    if diagnosis.final_verdict == ADEQUATE and final is not None:
        return ChosenFit(final, (f"predicted from the final model of the diagnosis, with {added} added",))
    verdict = f"{diagnosis.final_verdict or diagnosis.verdict}: {diagnosis.explanation}"
    if not anyway:
        reason = (
            f"because the fit with {added} is not stored there: run the diagnosis again"
            if diagnosis.final_verdict == ADEQUATE
            else "because the diagnosis refuted the model and found none that describes the trials"
        )
        raise ResultsError(f"{folder}: no prediction, {reason}; or predict from it with --anyway. {verdict}")
    model = f"the model with {added} added" if final is not None else "the model in use"
    return ChosenFit(final or in_use, (f"! {verdict}", f"! the following is nevertheless predicted from {model}"))
