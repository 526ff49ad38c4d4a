"""What is on the page as files: the curves as CSV, the figure as SVG or PNG, the choice as a command."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.effects import BASE_EFFECTS
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.choice import ChoiceError, ModelChoice, changed, sizes_of
from vinetrack.explorer.curves import Curves, errors_m

if TYPE_CHECKING:
    import pandas as pd

PICTURES = ("svg", "png", "pdf")
FORMATS = ("csv", *PICTURES)
CURVE_COLUMNS = (
    "model",
    "condition",
    "trial",
    "time_s",
    "lead_position_m",
    "model_position_m",
    "residual_m",
    "replicates_mean_m",
    "replicates_sigma_m",
)


def curve_table(campaign: Campaign, choice: ModelChoice, curves: Curves, shown: Sequence[int]) -> pd.DataFrame:
    """Measurement and model at every frame used, since release and from the origin; columns `CURVE_COLUMNS`.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    choice : effects and sizes.
    curves : of that model.
    shown : places of the trials to write.

    Returns
    -------
    table with the columns `CURVE_COLUMNS`
    """
    import pandas as pd

    parts = []
    for i in shown:
        seen, motion = campaign.trials[i], curves[i]
        band = campaign.bands.get(seen.condition)
        nothing = np.full(seen.time_s.size, math.nan)
        mean_m = nothing if band is None else np.interp(seen.time_s, band.time_s, band.mean_m)
        sigma_m = nothing if band is None else np.interp(seen.time_s, band.time_s, band.sigma_m)
        columns = ("+".join(choice.effects), seen.condition, seen.name, seen.time_s, seen.growth_m)
        model_columns = (motion.growth_m, motion.residual_m, mean_m, sigma_m)
        parts.append(pd.DataFrame(dict(zip(CURVE_COLUMNS, (*columns, *model_columns), strict=True))))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(CURVE_COLUMNS))


def exported(campaign: Campaign, choice: ModelChoice, curves: Curves, shown: Sequence[int], form: str) -> bytes:
    """The curves as `csv`, or the figure of the report as `svg`, `png` or `pdf`.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    choice : effects and sizes.
    curves : of that model.
    shown : places of the trials to draw.
    form : one of `FORMATS`.

    Returns
    -------
    bytes of the file

    Raises
    ------
    ChoiceError
        If it is none of these.
    """
    if form not in FORMATS:
        raise ChoiceError(f"{form!r} is no form of export: say one of {', '.join(FORMATS)}.")
    table = curve_table(campaign, choice, curves, shown)
    if form == "csv":
        return table.to_csv(index=False, lineterminator="\n").encode("utf-8")
    from vinetrack.figures.model_comparison import draw_model_comparison
    from vinetrack.figures.style import render

    conditions = [name for name in campaign.conditions if name in set(table["condition"])]
    compared = _compared(campaign, choice, errors_m(campaign, curves), conditions)
    trajectories = {str(name): part.reset_index(drop=True) for name, part in table.groupby("condition", sort=False)}
    return render(draw_model_comparison(compared, trajectories), [form])[form]


def _compared(
    campaign: Campaign, choice: ModelChoice, errors: Mapping[str, float], conditions: Sequence[str]
) -> pd.DataFrame:
    import pandas as pd

    floors = [campaign.floors_m.get(name, math.nan) for name in conditions]
    rms = [errors[name] for name in conditions]
    return pd.DataFrame(
        {
            "model": "+".join(choice.effects),
            "condition": conditions,
            "condition_label": [campaign.labels[name] for name in conditions],
            "vine": [campaign.trials[campaign.of_condition(name)[0]].data.trial.vine for name in conditions],
            "rms_position_m": rms,
            "ratio": [r / f if f > 0 else math.nan for r, f in zip(rms, floors, strict=True)],
        }
    )


def write_export(campaign: Campaign, choice: ModelChoice, curves: Curves, path: Path) -> None:
    """Everything in one file whose ending says in which form, whole or not at all.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    choice : effects and sizes.
    curves : of that model.
    path : of the file; its ending gives the format.

    Raises
    ------
    ChoiceError
        If the ending is none of `FORMATS`.
    """
    from vinetrack.core.tables import write_bytes

    form = path.suffix.lower().removeprefix(".")
    write_bytes(path, exported(campaign, choice, curves, range(len(campaign.trials)), form))


def commands(
    campaign: Campaign, start: ModelChoice, choice: ModelChoice, *, fitted: bool, save: bool = False
) -> list[str]:
    """What to type for the same without the page, a line a command.

    Parameters
    ----------
    start : the choice the page opened with.
    fitted : whether the sizes are those of a fit: else they are said one by one.
    campaign : as `read_campaign` returns it.
    choice : effects and sizes.
    save : whether the model is to be saved.

    Returns
    -------
    list of str
    """
    folder = shlex.quote(campaign.folder.as_posix())
    added, dropped = changed(campaign, choice)
    if not added and not dropped and (fitted or not _moved(campaign, start, choice)):
        return [f"vinetrack compare {folder}"]
    if fitted and not dropped:
        end = " --save" if save else ""
        return [f"vinetrack add {_typed(campaign, name)} {folder}{end}" for name in added]
    words = [f"--add {name}" for name in added] + [f"--drop {name}" for name in dropped]
    if fitted or save:
        words += ["--refit"] if fitted else []
        return [" ".join(["vinetrack explore", folder, *words, *(["--save"] if save else [])])]
    words += [f"--set {shlex.quote(f'{name}={value:.6g}')}" for name, value in _moved(campaign, start, choice).items()]
    return [" ".join(["vinetrack explore", folder, *words])]


def _typed(campaign: Campaign, effect: str) -> str:
    """An effect as it is named on the command line: by its file where the settings do not name that yet."""
    path = campaign.effects[effect].path
    unnamed = campaign.own_files([effect]) and path.name not in campaign.experiment.settings.effects
    return shlex.quote(path.as_posix()) if unnamed else effect


def _moved(campaign: Campaign, start: ModelChoice, choice: ModelChoice) -> dict[str, float]:
    """Sizes of effects in the model that are not those the page opened with, by name."""
    names = [
        size.name for effect in choice.effects for size in sizes_of(campaign, campaign.effects[effect], choice.numbers)
    ]
    return {name: choice.numbers[name] for name in names if choice.numbers[name] != start.numbers.get(name)}


def model_words(names: Sequence[str]) -> str:
    """A model in words: the base effects by one name, the others by theirs.

    Parameters
    ----------
    names : of the effects.

    Returns
    -------
    str
    """
    others = [name.replace("_", " ") for name in names if name not in BASE_EFFECTS]
    lacking = [name for name in BASE_EFFECTS if name not in names]
    base = "base model" if not lacking else " + ".join(name for name in names if name in BASE_EFFECTS)
    return " + ".join([base, *others])
