"""Background fits: the missing effect is found, progress reported, a fit cancelled, errors given in a sentence."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import replace

import pytest

from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.optimiser import Step, Watch
from vinetrack.pages.campaign import (
    FAULT,
    BackgroundFit,
    Campaign,
    FitJob,
    FitProgress,
    Fitted,
    choice_in_use,
    correlated_pairs_text,
    first_fit,
    fit_choice,
    likelihood_change_text,
    overall_m,
)

GAMMA = "reservoir_depletion.gamma"


@pytest.fixture(scope="module")
def first(campaign: Campaign) -> Fitted:
    return first_fit(campaign, choice_in_use(campaign))


def test_the_first_fit_is_that_of_the_workflow(campaign: Campaign, first: Fitted) -> None:
    for name, value in campaign.numbers.items():
        assert first.choice.numbers[name] == pytest.approx(value, rel=0.02)


@pytest.mark.parametrize(("known", "asked"), [(-1e9, [False]), (1e9, [False, True]), (math.nan, [False, True])])
def test_other_starts_are_tried_if_the_first_does_not_reach_the_known_fit(
    campaign: Campaign, first: Fitted, monkeypatch: pytest.MonkeyPatch, known: float, asked: list[bool]
) -> None:
    seen: list[bool] = []

    def fitted(*_: object, thorough: bool = True, **__: object) -> Fit:
        seen.append(thorough)
        return first.fit

    monkeypatch.setattr("vinetrack.pages.campaign.fit", fitted)
    first_fit(replace(campaign, log_likelihood=known), choice_in_use(campaign))
    assert seen == asked


def test_the_missing_effect_is_found_and_the_error_falls_to_the_replicates(campaign: Campaign, first: Fitted) -> None:
    steps: list[Step] = []
    choice = first.choice.with_effect("reservoir_depletion")
    found = fit_choice(campaign, first.fit, choice, steps.append)
    assert steps
    assert found.choice.numbers[GAMMA] == pytest.approx(1.4, abs=0.05)
    number = found.number(GAMMA)
    assert number is not None
    assert number.low <= 1.4
    after, before = (overall_m(one.prediction.errors_m, campaign.conditions) for one in (found, first))
    floor = overall_m(campaign.floors_m, campaign.conditions)
    assert after < 0.5 * before
    assert after < 1.3 * floor
    assert likelihood_change_text(first.fit, found.fit).endswith("for 1 parameter more.")
    assert "fell" in likelihood_change_text(first.fit, found.fit)
    back = fit_choice(campaign, found.fit, found.choice.with_effect("reservoir_depletion", False))
    assert "rose" in likelihood_change_text(found.fit, back.fit)
    assert overall_m(back.prediction.errors_m, campaign.conditions) == pytest.approx(before, rel=0.05)


def test_a_bad_start_is_replaced_by_the_default(campaign: Campaign, first: Fitted) -> None:
    """A time constant dragged to zero is refitted from its default."""
    choice = first.choice.with_effect("supply_refill").with_size("supply_refill.tau", 1e-6)
    found = fit_choice(campaign, first.fit, choice)
    assert found.fit.log_likelihood >= first.fit.log_likelihood - 0.5


def test_correlated_parameters_are_named(first: Fitted) -> None:
    lines = correlated_pairs_text(first.fit)
    assert all("correlation" in line for line in lines)
    tied = replace(first.fit, covariance=first.fit.covariance * 0 + 1.0)
    assert len(correlated_pairs_text(tied)) == len(tied.numbers) * (len(tied.numbers) - 1) // 2
    assert correlated_pairs_text(tied)[0].endswith("+1.00")


class RecordedCallbacks:
    """Records the callbacks of a job."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.results: list[Fitted] = []
        self.reasons: list[str] = []

    def job(self, work: object) -> FitJob:
        return FitJob(
            work, on_progress=self.steps.append, on_success=self.results.append, on_failure=self.reasons.append
        )  # type: ignore[arg-type]


def test_a_job_reports_progress_and_its_result(campaign: Campaign, first: Fitted) -> None:
    recorded = RecordedCallbacks()
    job = recorded.job(lambda watch: fit_choice(campaign, first.fit, first.choice, watch))
    job.wait(60)
    assert not job.running
    assert recorded.steps
    assert recorded.results[0].fit.model.names == first.fit.model.names


def test_a_cancelled_job_calls_no_callback() -> None:
    recorded, started = RecordedCallbacks(), threading.Event()

    def endless(watch: Watch) -> Fitted:
        started.set()
        while True:
            watch(Step(1, {}, 1.0))
            time.sleep(0.01)

    job = recorded.job(endless)
    started.wait(10)
    job.cancel()
    assert not job.running
    job.wait(10)
    count = len(recorded.steps)
    time.sleep(0.05)
    assert len(recorded.steps) == count
    assert not recorded.results
    assert not recorded.reasons


@pytest.mark.parametrize(("error", "said"), [(FitError("no start"), "no start"), (ZeroDivisionError(), FAULT)])
def test_a_failed_job_gives_the_reason_in_a_sentence(error: Exception, said: str) -> None:
    recorded = RecordedCallbacks()

    def fail(_: Watch) -> Fitted:
        raise error

    recorded.job(fail).wait(10)
    assert recorded.reasons == [said]


def test_the_background_fit_runs_once_for_all_pages(campaign: Campaign) -> None:
    background = BackgroundFit(campaign)
    news: list[bool] = []

    def hear() -> None:
        news.append(background.fitted is not None)

    background.add_listener(hear)
    background.begin().wait(120)
    assert background.failure == ""
    assert not background.running
    assert background.prediction is not None
    assert background.fitted is not None
    assert background.step is not None
    assert len(news) > 2
    assert news[-1]
    background.remove_listener(hear)
    background.remove_listener(hear)


def test_progress_never_decreases() -> None:
    waiting = FitProgress()
    waiting.begin(100.0)
    assert waiting.state(100.5, "refitting")[1] == "refitting · 0.5 s"
    shares = []
    for k, promised in enumerate((5e4, 300.0, 800.0, 2.0, 1e-3)):
        waiting.update(Step(k + 1, {}, promised))
        shares.append(waiting.state(101.0, "refitting")[0])
    assert shares == sorted(shares)
    assert 0 < shares[0] < 0.1
    assert shares[-1] == 0.97
    waiting.update(Step(9, {}, 123.0))
    text = waiting.state(101.0, "refitting")[1]
    assert text == "refitting · step 9 · the next step lowers −2 ln L by 1.2e+02 · 1.0 s"
    waiting.end("The fit was stopped.")
    assert waiting.message == "The fit was stopped."
