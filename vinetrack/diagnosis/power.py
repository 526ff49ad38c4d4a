"""Power of a campaign: detectable sizes of every candidate, how often each is confused with others,
false-alarm rates.

Computed by `vinetrack.diagnosis.linear_power`; read by the terminal, the report and `diagnosis.json`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer

from vinetrack.core.problems import Remark, in_words
from vinetrack.core.tables import JsonRecord
from vinetrack.core.terminal import plot
from vinetrack.inference.fit_result import OrNaN, or_open

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Probabilities at which detectable sizes are tabulated (chosen)
PROBABILITIES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98)


@dataclass(frozen=True)
class EffectPower(JsonRecord):
    """Detectable sizes of one effect. `sizes` are values of the parameter, SI, at which the effect is detected with
    `PROBABILITIES`; infinite where no size is detectable.
    """

    effect: str
    kind: str
    parameter: str
    symbol: str
    unit: str
    zero: OrNaN
    least: Annotated[OrNaN, Field(alias="least_plausible")]
    largest: Annotated[OrNaN, Field(alias="largest_plausible")]
    sizes: tuple[Annotated[float, or_open(math.inf)], ...]
    taken_for: Mapping[str, OrNaN] = field(default_factory=dict)
    other_values: tuple[float, ...] = ()

    def size_at(self, probability: float) -> float:
        """The value of the parameter at which the effect is detected with this probability. Returns SI; infinite where
        no size is detectable.
        """
        if not np.isfinite(self.sizes).all():
            return math.inf
        return float(np.interp(probability, PROBABILITIES, self.sizes))

    def probability_at(self, value: float) -> float:
        """The probability with which the effect is detected at a value of its parameter. Returns 0 below and 1 above
        the tabulated sizes.
        """
        if not np.isfinite(self.sizes).all():
            return 0.0
        away = np.abs(np.array(self.sizes) - self.zero)
        return float(np.interp(abs(value - self.zero), away, PROBABILITIES, left=0.0, right=1.0))

    @property
    def is_visible(self) -> bool:
        """Whether its largest plausible size is detected at least half of the time."""
        return self.probability_at(self.largest) >= 0.5

    def to_json(self) -> dict[str, Any]:
        """As an entry of `power.effects`."""
        return super().to_json() | {
            "size_50": self.size_at(0.5),
            "size_90": self.size_at(0.9),
            "found_at_largest_plausible": self.probability_at(self.largest),
            "probabilities": PROBABILITIES,
        }


@dataclass(frozen=True)
class NumberWidth(JsonRecord):
    """Half width of the 95 % interval of a fitted parameter: relative for B, absolute for n."""

    name: str
    vine: str
    value: OrNaN
    half_width: OrNaN


@dataclass(frozen=True)
class PowerInput:
    """A quantity that the power was computed with, in words, and where it comes from: the fit, the user, or a prior."""

    name: str
    value: str
    origin: str


@dataclass(frozen=True)
class SimulatedRates:
    """Outcomes of complete diagnoses of simulated campaigns with one effect; with none where `effect` is blank. `count`
    of `campaigns` are those in which the effect was found (where nothing is missing: anything); `promised` is its
    probability by linear theory (that of a false alarm); `named` counts what was named, most frequent first.
    """

    effect: str
    value: float
    promised: float
    count: int
    alarms: int
    campaigns: int
    named: tuple[tuple[str, int], ...]
    failed: int

    @property
    def interval(self) -> tuple[float, float]:
        """Exact binomial 95 % interval of the rate; 0 and 1 where there is no campaign. Clopper & Pearson, Biometrika
        26, 404 (1934).
        """
        from scipy.stats import binomtest

        if not self.campaigns:
            return 0.0, 1.0
        # 0.95: confidence of the intervals of rates; a convention
        exact = binomtest(self.count, self.campaigns).proportion_ci(0.95, method="exact")
        return float(exact.low), float(exact.high)

    def to_json(self) -> dict[str, object]:
        """As an entry of `simulated`."""
        return {
            **{name: value for name, value in vars(self).items() if name != "count"},
            "value": None if math.isnan(self.value) else self.value,
            "rate": self.count / self.campaigns if self.campaigns else math.nan,
            "interval_95": list(self.interval),
            "named": dict(self.named),
        }


@dataclass(frozen=True)
class FurtherTrials(JsonRecord):
    """Further trials that bring the power for an effect of one size to a target. `power` is that with these trials,
    `before` the probability with the trials so far, `unlimited` that with unlimited replicates of all trials within the
    limits; `n_conditions` counts the conditions considered. `trials` has an entry for each trial to make: its cells of
    the sheet without blank ones, `vine`, `new_vine`, what is `changed` on the rig, and the `probability` once it is
    made as well.
    """

    power: Annotated[EffectPower, Field(exclude=True)]
    value: float
    target: Annotated[float, Field(alias="wanted")]
    before: Annotated[float, Field(alias="probability_before")]
    unlimited: Annotated[float, Field(alias="probability_endless")] = math.nan
    n_conditions: Annotated[int, Field(alias="conditions_looked_at")] = 0
    trials: tuple[Mapping[str, Any], ...] = ()

    @property
    def after(self) -> float:
        """Power once all trials are made."""
        return float(self.trials[-1]["probability"]) if self.trials else self.before

    @property
    def is_reached(self) -> bool:
        """Whether the target is reached."""
        return self.after >= self.target

    def to_json(self) -> dict[str, Any]:
        """As the key `further_trials` of what `vinetrack power --json` writes."""
        told = {name: getattr(self.power, name) for name in ("effect", "parameter", "unit", "taken_for")}
        return {**told, **super().to_json(), "probability_after": self.after}


StoredRemark = Annotated[Remark, BeforeValidator(Remark.from_json), PlainSerializer(Remark.to_json)]


@dataclass(frozen=True)
class Power(JsonRecord):
    """Which effects the trials of a campaign can detect, and at which sizes. Printed, it is the text on the terminal.
    The probability of any false alarm is at most `false_alarm_rate`.
    """

    n_trials: int = 0
    false_alarm_rate: OrNaN = math.nan
    effects: tuple[EffectPower, ...] = ()
    not_testable: Annotated[Mapping[str, StoredRemark], Field(alias="not_testable_codes")] = field(default_factory=dict)
    numbers: tuple[NumberWidth, ...] = ()
    inputs: tuple[PowerInput, ...] = ()
    model: tuple[str, ...] = ()
    wary: Annotated[StoredRemark, Field(alias="wary_code")] = field(default_factory=Remark)
    # Written below, and not read again
    simulated: Annotated[tuple[SimulatedRates, ...], Field(exclude=True, alias="unread_simulated")] = ()
    further: Annotated[tuple[FurtherTrials, ...], Field(exclude=True)] = ()

    def __getitem__(self, name: str) -> EffectPower:
        """The power for an effect, by its name."""
        return {entry.effect: entry for entry in self.effects}[name]

    def of_effects(self, names: Sequence[str]) -> Power:
        """The same for a selection of effects."""
        if not names:
            return self
        return replace(
            self,
            effects=tuple(entry for entry in self.effects if entry.effect in names),
            not_testable={name: why for name, why in self.not_testable.items() if name in names},
        )

    def to_json(self) -> dict[str, Any]:
        """As `power` of `diagnosis.json`; sizes in SI units."""
        return {
            **super().to_json(),
            "effects": [entry.to_json() for entry in self.effects],
            "not_testable": {name: str(why) for name, why in self.not_testable.items()},
            "wary": str(self.wary),
            "simulated": [rates.to_json() for rates in self.simulated],
            **({"further_trials": [plan.to_json() for plan in self.further]} if self.further else {}),
        }

    def plot(self, name: str = "power", **options: Any) -> Figure:
        """Draw the map of effects against size."""
        return plot(self, name, **options)

    def __str__(self) -> str:
        return in_words(self)
