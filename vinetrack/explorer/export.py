"""Exports of the page: the curves as CSV, the figure as SVG or PNG, the choice as a command."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.effects import BASE_EFFECTS
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.choice import ChoiceError, ModelChoice, added_and_dropped, sizes_of
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
    """Return measurement and model at every frame used, since release and from the origin."""
    import pandas as pd

    parts = []
    for i in shown:
        aligned, motion = campaign.trials[i], curves[i]
        band = campaign.bands.get(aligned.condition)
        unknown = np.full(aligned.time_s.size, math.nan)
        mean_m = unknown if band is None else np.interp(aligned.time_s, band.time_s, band.mean_m)
        sigma_m = unknown if band is None else np.interp(aligned.time_s, band.time_s, band.sigma_m)
        columns = ("+".join(choice.effects), aligned.condition, aligned.name, aligned.time_s, aligned.growth_m)
        model_columns = (motion.growth_m, motion.residual_m, mean_m, sigma_m)
        parts.append(pd.DataFrame(dict(zip(CURVE_COLUMNS, (*columns, *model_columns), strict=True))))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(CURVE_COLUMNS))


def export_bytes(campaign: Campaign, choice: ModelChoice, curves: Curves, shown: Sequence[int], form: str) -> bytes:
    """Return the curves as `csv`, or the figure of the report as `svg`, `png` or `pdf`."""
    if form not in FORMATS:
        raise ChoiceError(f"{form!r} is no export format: use one of {', '.join(FORMATS)}.")
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
            "vine": [campaign.trials[campaign.indices_of_condition(name)[0]].data.trial.vine for name in conditions],
            "rms_position_m": rms,
            "ratio": [r / f if f > 0 else math.nan for r, f in zip(rms, floors, strict=True)],
        }
    )


def write_export(campaign: Campaign, choice: ModelChoice, curves: Curves, path: Path) -> None:
    """Write all trials to a file, atomically; its suffix gives the format."""
    from vinetrack.core.tables import write_bytes

    form = path.suffix.lower().removeprefix(".")
    write_bytes(path, export_bytes(campaign, choice, curves, range(len(campaign.trials)), form))


def commands(
    campaign: Campaign, start: ModelChoice, choice: ModelChoice, *, fitted: bool, save: bool = False
) -> list[str]:
    """Return the commands that reproduce the choice without the page."""
    folder = shlex.quote(campaign.folder.as_posix())
    added, dropped = added_and_dropped(campaign, choice)
    if not added and not dropped and (fitted or not _changed_sizes(campaign, start, choice)):
        return [f"vinetrack compare {folder}"]
    if fitted and not dropped:
        end = " --save" if save else ""
        return [f"vinetrack add {_command_line_name(campaign, name)} {folder}{end}" for name in added]
    options = [f"--add {name}" for name in added] + [f"--drop {name}" for name in dropped]
    if fitted or save:
        options += ["--refit"] if fitted else []
        return [" ".join(["vinetrack explore", folder, *options, *(["--save"] if save else [])])]
    options += [
        f"--set {shlex.quote(f'{name}={value:.6g}')}" for name, value in _changed_sizes(campaign, start, choice).items()
    ]
    return [" ".join(["vinetrack explore", folder, *options])]


def _command_line_name(campaign: Campaign, effect: str) -> str:
    """Name of an effect on the command line: its file, if the settings do not list that yet."""
    path = campaign.effects[effect].path
    is_unlisted = campaign.own_files([effect]) and path.name not in campaign.experiment.settings.effects
    return shlex.quote(path.as_posix()) if is_unlisted else effect


def _changed_sizes(campaign: Campaign, start: ModelChoice, choice: ModelChoice) -> dict[str, float]:
    """Sizes of effects in the model that differ from those with which the page opened, by name."""
    names = [
        size.name for effect in choice.effects for size in sizes_of(campaign, campaign.effects[effect], choice.numbers)
    ]
    return {name: choice.numbers[name] for name in names if choice.numbers[name] != start.numbers.get(name)}


def model_text(names: Sequence[str]) -> str:
    """Return a model as text, with one name for the base effects together."""
    others = [name.replace("_", " ") for name in names if name not in BASE_EFFECTS]
    missing_base = [name for name in BASE_EFFECTS if name not in names]
    base = "base model" if not missing_base else " + ".join(name for name in names if name in BASE_EFFECTS)
    return " + ".join([base, *others])
