"""Results of a diagnosis, in the structure of `diagnosis.json`.

A diagnosis is a list of rounds. Each round tests a model against every candidate and reaches one of five verdicts;
while the verdict is `missing`, the effect is added and the next round tests the enlarged model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Field, InstanceOf, PlainSerializer

from vinetrack.core.problems import Remark, in_words
from vinetrack.core.tables import JsonRecord
from vinetrack.core.terminal import Printed, plot
from vinetrack.diagnosis.power import Power, StoredRemark
from vinetrack.inference.fit_result import Fit, Number, OrNaN

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.diagnosis.locate import Failure

    Table = pd.DataFrame
else:
    Table = Failure = Any  # Records do not look into what no file holds


# ------------------------------------------------------------------------------
# Record of an undetected effect that a fitted size may include, as stored in a diagnosis and its file.


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
    value: Annotated[OrNaN, Field(alias="value_at_limit")]
    low_95: OrNaN
    high_95: OrNaN


ADEQUATE, MISSING, AMBIGUOUS, ARTEFACT, UNEXPLAINED = VERDICTS = (
    "adequate",
    "missing",
    "ambiguous",
    "artefact",
    "unexplained",
)

REFITTED, SCREENED, NOT_TESTABLE = "refitted", "screened", "not testable here"  # Status of a candidate

DROPPED_FRAMES = "dropped_frames"  # Member of an answer set where a recording has dropped frames

EXPECTED = ["expected_m", "expected_low_m", "expected_high_m"]  # Columns of the error of an adequate model

MAX_STRETCHES = 8  # Most stretches of the growth over which a diagnosis and its figures average residuals (chosen)

BETWEEN_TRIALS = "between_trials"  # Kind of a hypothesis that trials differ

# Codes of reasons of a richer form: a candidate that equals another in a limit, named `name`
CONTAINS, CONTAINS_AND_FITS_NO_BETTER = "contains", "contains_and_fits_no_better"


@dataclass(frozen=True)
class Candidate(JsonRecord):
    """One candidate effect: a row of the ranking. `delta_chi2` is the fall of −2 ln L when it is added (the
    squared score where only `screened`), and `sigma` its significance as a normal deviate, with one degree of
    freedom for each size.
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
    confounded_by: tuple[Confounder, ...] = ()

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
    """One model and its tests against all candidates. `ranking` has the best first, those not testable last."""

    model: tuple[str, ...] = ()
    verdict: str
    answer_set: tuple[str, ...] = ()
    sets: tuple[tuple[str, ...], ...] = ()
    partial: tuple[StoredCandidate, ...] = ()
    explanation: str = ""
    ranking: tuple[StoredCandidate, ...] = ()
    cosines: Cosines = Cosines()
    fit: Annotated[InstanceOf[Fit] | None, Field(exclude=True)] = None
    fits: Annotated[Mapping[str, InstanceOf[Fit]], Field(exclude=True)] = field(default_factory=dict)
    partial_fits: Annotated[tuple[InstanceOf[Fit], ...], Field(exclude=True)] = ()


StoredPower = Annotated[Power, BeforeValidator(Power.from_json), PlainSerializer(Power.to_json)]

# A file holds the sentences of remarks
Sentences = Annotated[Sequence[Any], PlainSerializer(lambda lines: [str(line) for line in lines])]


def _told(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{key: str(value) if isinstance(value, Remark) else value for key, value in row.items()} for row in rows]


@dataclass(frozen=True, repr=False)
class Diagnosis(Printed, JsonRecord):
    """The result of a diagnosis. Printed, it is the text on the terminal. `effects` are those added, in order; `fits`
    the initial model and every enlarged one.
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
    force_table: Annotated[Table | None, Field(exclude=True)] = None
    learned_table: Annotated[Table | None, Field(exclude=True)] = None
    stored_parameters: Annotated[tuple[Number, ...], Field(alias="parameters")] = ()
    contradicted_columns: tuple[str, ...] = ()
    refused: str = ""
    power: StoredPower | None = None
    odd_trials: tuple[str, ...] = ()

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

    @property
    def refutes(self) -> bool:
        """Whether the initial model lacks physics, so that figures drawn with it must state that."""
        return self.verdict in (MISSING, AMBIGUOUS, UNEXPLAINED)

    @property
    def initial_model(self) -> tuple[str, ...]:
        """Names of the effects of the initial model."""
        return self.rounds[0].model if self.rounds else ()

    @property
    def final_model(self) -> tuple[str, ...]:
        """Names of the effects of the final model."""
        return (*self.initial_model, *(name for name in self.effects if name not in self.initial_model))

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

    def plot(self, name: str = "", **options: Any) -> Figure:
        """Return a figure of the report: `ladder` (the default), `before_after`, `where`, `candidates`, …, by name."""
        return plot(self, name, **options)

    def __repr__(self) -> str:
        named = ", ".join(self.effects or self.answer_set)
        return f"Diagnosis({self.verdict or 'refused'}{f': {named}' if named else ''})"

    def __str__(self) -> str:
        return in_words(self)
