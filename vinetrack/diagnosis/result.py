"""Results of a diagnosis, in the structure of `diagnosis.json`.

A diagnosis is a list of rounds. Each round tests a model against every candidate and reaches one of five verdicts;
while the verdict is `missing`, the effect is added and the next round tests the enlarged model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, InstanceOf, PlainSerializer

from vinetrack.core.problems import Remark, in_words
from vinetrack.core.process import Drawn, Printed
from vinetrack.core.tables import JsonRecord
from vinetrack.inference.fit_result import Fit, Number, OrNaN, or_open

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.core.records import Track, Trial
    from vinetrack.diagnosis.ladder import Failure
    from vinetrack.diagnosis.missing_force import MissingForce
    from vinetrack.inference.fit_data import Pairs

    Table = pd.DataFrame
else:
    Table = Failure = MissingForce = Any  # Records do not look into what no file holds


# ------------------------------------------------------------------------------
# Power of a campaign, as `vinetrack.diagnosis.linear_power` computes it: detectable sizes of every candidate, how often
# each is confused with others, false-alarm rates.

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
    pressure_unit: str = "kPa"

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
class PowerInput:
    """A quantity that the power was computed with, in words, and where it comes from: the fit, the user, or a prior."""

    name: str
    value: str
    origin: str


@dataclass(frozen=True)
class SimulatedRates:
    """Outcomes of complete diagnoses of simulated campaigns with one effect, none where blank. `count` of `campaigns`
    found it (where nothing is missing: anything), `promised` is its probability in theory, `named` what was named.
    """

    effect: str
    value: float
    promised: float
    count: int
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
    """Further trials that bring the power for an effect of one size to a target: `power` with them, the probability
    `before`, and that with `unlimited` replicates within the limits; `n_conditions` were considered. `trials` has for
    each to make its cells of the sheet, `vine`, `new_vine`, what is `changed` on the rig, and the `probability` then.
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
class Power(Drawn, JsonRecord):
    """Which effects the trials of a campaign can detect, at which sizes, and `numbers`, the damping law that they
    determine; any false alarm is at most as likely as `false_alarm_rate`. Printed, it is the text on the terminal.
    """

    n_trials: int = 0
    false_alarm_rate: OrNaN = math.nan
    effects: tuple[EffectPower, ...] = ()
    not_testable: Annotated[Mapping[str, StoredRemark], Field(alias="not_testable_codes")] = field(default_factory=dict)
    numbers: tuple[Number, ...] = ()
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

    def __str__(self) -> str:
        return in_words(self)


@dataclass(frozen=True)
class Confounder(JsonRecord):
    """Another effect that a fitted size, of this `parameter` and vine, may include: with any size of it that is not
    excluded, the 95 % interval is from `low_95` to `high_95`.
    """

    parameter: str
    vine: str
    effect: str
    symbol: str
    unit: str
    limit: Annotated[OrNaN, Field(alias="limit_95")]
    low_95: OrNaN
    high_95: OrNaN


VERDICTS = ("adequate", "missing", "ambiguous", "artefact", "unexplained")
ADEQUATE, MISSING, AMBIGUOUS, ARTEFACT, UNEXPLAINED = VERDICTS

REFITTED, SCREENED, NOT_TESTABLE = "refitted", "screened", "not testable here"  # Status of a candidate

DROPPED_FRAMES = "dropped_frames"  # Member of an answer set where a recording has dropped frames

TAIL_SLACK = "tail_slack"  # The rule that a tail cannot push, as a hypothesis: no effect, but a setting of the trials

EXPECTED = ["expected_m", "expected_low_m", "expected_high_m"]  # Columns of the error of an adequate model

MAX_STRETCHES = 8  # Most stretches of the growth over which a diagnosis and its figures average residuals (chosen)

BETWEEN_TRIALS = "between_trials"  # Kind of a hypothesis that trials differ


@dataclass(frozen=True)
class Candidate(JsonRecord):
    """One candidate effect: a row of the ranking. `delta_chi2` is the fall of −2 ln L with it (the squared score where
    only `screened`), `sigma` its significance as a normal deviate, with a degree of freedom for each size.
    """

    effect: str
    kind: str = ""
    status: str = ""
    delta_chi2: OrNaN = math.nan
    sigma: OrNaN = math.nan
    numbers: tuple[Number, ...] = ()
    plausible: bool = True
    in_answer_set: bool = False
    reason: Annotated[StoredRemark, Field(alias="reason_code")] = field(default_factory=Remark)
    largest: Mapping[str, OrNaN] = field(default_factory=dict)
    along: tuple[Number, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As an entry of `ranking`."""
        return {**super().to_json(), "reason": str(self.reason)}


StoredCandidate = Annotated[Candidate, PlainSerializer(Candidate.to_json)]


@dataclass(frozen=True)
class Cosines(JsonRecord):
    """Correlations of the candidates' scores, with the fitted parameters projected off: a matrix in this order."""

    effects: tuple[str, ...] = ()
    matrix: Sequence[Sequence[OrNaN]] = ()


@dataclass(frozen=True, kw_only=True)
class Round(JsonRecord):
    """One model and its tests against all candidates. `ranking` has the best first, those not testable last;
    `confounded` is what n and sizes of a model that is adequate may include.
    """

    model: tuple[str, ...] = ()
    verdict: str
    answer_set: tuple[str, ...] = ()
    sets: tuple[tuple[str, ...], ...] = ()
    partial: tuple[StoredCandidate, ...] = ()
    explanation: str = ""
    slips: Mapping[str, str] = field(default_factory=dict)
    ranking: tuple[StoredCandidate, ...] = ()
    cosines: Cosines = Cosines()
    confounded: tuple[Confounder, ...] = ()
    fit: Annotated[InstanceOf[Fit] | None, Field(exclude=True)] = None
    fits: Annotated[tuple[InstanceOf[Fit], ...], Field(exclude=True)] = ()
    partial_fits: Annotated[tuple[InstanceOf[Fit], ...], Field(exclude=True)] = ()


StoredPower = Annotated[Power, BeforeValidator(Power.from_json), PlainSerializer(Power.to_json)]

# A file holds the sentences of remarks
Sentences = Annotated[Sequence[Any], PlainSerializer(lambda lines: [str(line) for line in lines])]


def _told(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{key: str(value) if isinstance(value, Remark) else value for key, value in row.items()} for row in rows]


@dataclass(frozen=True, repr=False)
class Diagnosis(Printed, Drawn, JsonRecord):
    """The result of a diagnosis. Printed, it is the text on the terminal. `effects` are those added, in order; `fits`
    the initial model and every enlarged one; `not_tried` lack what the sheet leaves blank, where nothing explains it.
    """

    rounds: tuple[Round, ...] = ()
    effects: tuple[str, ...] = ()
    explanation: str = ""
    fits: Annotated[tuple[InstanceOf[Fit], ...], Field(exclude=True)] = ()
    ladder: Annotated[Table | None, Field(exclude=True)] = None
    drift: Annotated[Sequence[Mapping[str, Any]], PlainSerializer(_told)] = ()
    where: Sentences = ()
    next_experiment: Mapping[str, Any] | None = None
    missing_force: Mapping[str, Any] | None = None
    notes: Sentences = ()
    failure: Annotated[Failure | None, Field(exclude=True)] = None
    force: Annotated[MissingForce | None, Field(exclude=True)] = None
    stored_parameters: Annotated[tuple[Number, ...], Field(alias="parameters")] = ()
    contradicted_columns: tuple[str, ...] = ()
    not_tried: tuple[str, ...] = ()
    refused: str = ""
    power: StoredPower | None = None
    odd_trials: tuple[str, ...] = ()
    results: Annotated[str, Field(exclude=True)] = "RESULTS"  # its folder, as a command takes it

    @property
    def verdict(self) -> str:
        """Verdict on the initial model; blank where no diagnosis was possible."""
        return self.rounds[0].verdict if self.rounds else ""

    @property
    def final_verdict(self) -> str:
        """Verdict on the final model; blank where no diagnosis was possible."""
        return self.rounds[-1].verdict if self.rounds else ""

    @property
    def answer_set(self) -> tuple[str, ...]:
        """Every hypothesis for the first missing effect that the data cannot exclude."""
        return self.rounds[0].answer_set if self.rounds else ()

    @property
    def ranking(self) -> tuple[Candidate, ...]:
        """The candidates of the first round, best first."""
        return self.rounds[0].ranking if self.rounds else ()

    def refutes(self, model: Sequence[str] = ()) -> bool:
        """Whether a model that was tested, or else the initial one, lacks physics: what shows it must say so."""
        verdicts = {frozenset(step.model): step.verdict for step in reversed(self.rounds)}
        return verdicts.get(frozenset(model or self.initial_model)) in (MISSING, AMBIGUOUS, UNEXPLAINED)

    @property
    def pressure_unit(self) -> str:
        """The unit of pressures in the sheet."""
        return next((one.pressure_unit for one in self.parameters), "kPa")

    @property
    def initial_model(self) -> tuple[str, ...]:
        """Names of the effects of the initial model."""
        return self.rounds[0].model if self.rounds else ()

    @property
    def final_model(self) -> tuple[str, ...]:
        """Names of the effects of the final model."""
        return (*self.initial_model, *(name for name in self.added if name not in self.initial_model))

    @property
    def added(self) -> tuple[str, ...]:
        """The effects added, as a model takes them."""
        return tuple(name for name in self.effects if name != TAIL_SLACK)

    def settled(self, pairs: Pairs) -> list[tuple[Trial, Track]]:
        """Trials as the final model has them: their tails may go slack where that was found."""
        is_free = TAIL_SLACK in self.effects
        return [(replace(trial, tail_slack="free") if is_free else trial, track) for trial, track in pairs]

    @property
    def parameters(self) -> tuple[Number, ...]:
        """Parameters of the final model, SI."""
        return self.fits[-1].numbers if self.fits else self.stored_parameters

    @property
    def fit(self) -> Fit:
        """The last model fitted."""
        return self.fits[-1]

    def candidates(self) -> pd.DataFrame:
        """The candidates of all rounds, one row each."""
        import pandas as pd

        columns = ["round", "effect", "kind", "status", "delta_chi2", "sigma", "size", "in_answer_set", "plausible"]
        rows = [
            {**vars(row), "round": i, "size": in_words(row), "reason": str(row.reason)}
            for i, step in enumerate(self.rounds, 1)
            for row in step.ranking
        ]
        return pd.DataFrame(rows, columns=[*columns, "reason"])

    def to_json(self) -> dict[str, Any]:
        """Content of `diagnosis.json`; numbers in SI units."""
        content = super().to_json()
        return {
            **content,
            "verdict": self.verdict or None,
            "final_verdict": self.final_verdict or None,
            "answer_set": list(self.answer_set),
            "cosines": content["rounds"][0]["cosines"] if self.rounds else {},
            "parameters": [number.to_json() for number in self.parameters],
            "refused": self.refused or None,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any], ladder: pd.DataFrame | None = None) -> Diagnosis:
        """Read what `to_json` wrote."""
        stored = {key: value for key, value in content.items() if value is not None}
        if "verdict" in stored and not stored.get("rounds"):
            stored["rounds"] = [{"verdict": stored["verdict"]}]
        return replace(super().from_json(stored), ladder=ladder)

    def __repr__(self) -> str:
        named = ", ".join(self.effects or self.answer_set)
        return f"Diagnosis({self.verdict or 'refused'}{f': {named}' if named else ''})"

    def __str__(self) -> str:
        return in_words(self)
