"""Replicates laid over each other, the model against the measurement, and rows that belong to other recordings."""

from dataclasses import replace

import numpy as np
import pytest
from lsoda_vine import B_TRUE, as_track, filmed, grown_position, vine_trial

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.diagnosis import diagnose as diagnosing
from vinetrack.diagnosis.diagnose import diagnose, implied_pressure_Pa, odd_trials
from vinetrack.diagnosis.ladder import compare, position_errors, replicates_of
from vinetrack.diagnosis.result import Candidate, Diagnosis, Round
from vinetrack.inference.fit_result import TrialFit

STEP_S = 1e-3
SPEED_M_S = 2.0


def by_hand(name: str, misfit_m: np.ndarray | float, rest: int = 20, end_s: float = 0.1) -> TrialFit:
    """A trial that rests and then runs at 2 m/s in the model; its measurement is off by `misfit_m` once it moves."""
    time_s = STEP_S * np.arange(-rest, round(end_s / STEP_S) + 1)
    model_m, off_m = 0.3 + SPEED_M_S * np.maximum(time_s, 0.0), np.zeros(time_s.size)
    off_m[rest + 1 :] = misfit_m
    nothing = ("release_s", "release_sigma_s", "origin_sigma_m", "pressure_deviation", "pressure_deviation_sigma",
               "damping_deviation", "damping_deviation_sigma")  # fmt: skip
    return TrialFit(
        trial=Trial(name=name, vine="v", condition="c"), time_s=time_s, lead_position_m=model_m + off_m,
        predicted_position_m=model_m, predicted_velocity_m_s=SPEED_M_S * (time_s > 1e-9), residual_m=off_m,
        whitened=off_m, origin_m=0.3, noise_m=1e-5, **dict.fromkeys(nothing, 0.0),
    )  # fmt: skip


def errors_of(*trials: TrialFit) -> dict[str, float]:
    return position_errors(replicates_of(trials))


def test_the_error_of_position_is_that_of_the_growth_trials_count_alike_and_one_alone_has_no_floor():
    # 100 moving frames off by 3 mm, and the frame of the release itself: √(100/101) · 3 mm.
    for rest in (10, 500):
        assert errors_of(by_hand("a", 3e-3, rest=rest))["rms_position_m"] == pytest.approx(3e-3 * np.sqrt(100 / 101))
    error = errors_of(by_hand("a", 1e-3, end_s=0.4), by_hand("b", 3e-3, end_s=0.04))["rms_position_m"]
    assert error == pytest.approx(np.sqrt((1e-6 * 400 / 401 + 9e-6 * 40 / 41) / 2))
    assert np.isnan([errors_of(by_hand("a", 1e-3))[name] for name in ("replicate_floor_m", "ratio")]).all()


@pytest.mark.parametrize("n_trials", [2, 3, 5])
def test_the_floor_is_the_scatter_of_single_trials_for_any_number_of_them(n_trials):
    squares, draw = [], np.random.default_rng(11)
    for _ in range(20):
        # What the model is off by in all of them is no scatter.
        trials = [by_hand(f"t{i}", 5e-3 + 1e-3 * draw.standard_normal(400), end_s=0.4) for i in range(n_trials)]
        squares.append(errors_of(*trials)["replicate_floor_m"] ** 2)
    # One of 400 degrees of freedom goes into each trial's release; 20 × 400 × (N − 1) draws leave 0.8 % or less.
    assert np.sqrt(np.mean(squares)) == pytest.approx(1e-3, rel=0.025)


def test_the_band_is_that_of_the_replicates():
    trials = [by_hand("a", np.full(100, 1e-3)), by_hand("b", np.full(100, -1e-3))]
    table = replicates_of(trials).frames
    last = table[table["trial"] == "a"].iloc[-1]
    columns = ["model_position_m", "replicates_mean_m", "lead_position_m"]
    assert last[columns].tolist() == pytest.approx([SPEED_M_S * 0.1, SPEED_M_S * 0.1, SPEED_M_S * 0.1 + 1e-3])


def test_a_final_speed_is_compared_at_one_place_and_knows_a_slower_model():
    trial = vine_trial("a", 28.0, payload_kg=0.0356, vine="v", condition="c")
    track, *_ = filmed(trial, np.random.default_rng(12))
    found = vt.fit(vt.base_model().with_values({"eversion_damping.n": 0.4}), [(trial, track)], fixed=["n"])
    slow = replace(found, model=found.model.with_values({"eversion_damping.B": 12.0}))

    def final_m_s(B: float) -> float:
        time_s = np.linspace(0, 2, 200_001)
        y, reached_m = grown_position(trial, time_s, B), track.lead_position_m.max() - track.lead_position_m[0]
        place = int(np.argmax(y >= 0.95 * min(trial.length_m, reached_m)))
        return float((y[place] - y[place - 1]) / (time_s[1] - time_s[0]))

    error = compare(slow, [(trial, track)]).table["rms_final_velocity_m_s"].iloc[0]
    assert error == pytest.approx(final_m_s(B_TRUE[24.0]) - final_m_s(12.0), rel=0.1)


@pytest.fixture(scope="module")
def campaign():
    pairs, time = [], np.arange(0, 0.3, 0.001)
    for k, kPa in enumerate((18, 18, 21, 21, 25, 25, 29, 29, 34, 34, 40, 40)):
        more = {"vine": "12mm", "condition": f"12mm_{kPa}", "length_m": 0.3, "growth_angle_rad": np.pi / 2}
        trial, draw = vine_trial(f"t{k}", kPa, 12.0, **more), np.random.default_rng(20000 + k)
        position = grown_position(trial, time - 0.02, 1.83 * np.exp(0.02 * draw.normal()), 0.37)
        seen = np.isfinite(position)
        pairs.append((trial, as_track(time[seen], position[seen] + draw.normal(0, 1e-4, np.count_nonzero(seen)))))
    return pairs


def stated(pairs: list[tuple[Trial, Track]], **kPa: float) -> list[tuple[Trial, Track]]:
    told = {name: {"pressure_Pa": 1e3 * value, "condition": f"12mm_{value}"} for name, value in kPa.items()}
    return [(replace(trial, **told.get(trial.name, {})), track) for trial, track in pairs]


def odd(pairs: list[tuple[Trial, Track]]) -> dict[str, float]:
    """The odd trials of a fit, with the pressures that a fit of the others implies."""
    fit = vt.fit(vt.base_model(), pairs)
    names = odd_trials(fit)
    others = vt.fit(vt.base_model(), [pair for pair in pairs if pair[0].name not in names])
    return {one.trial.name: implied_pressure_Pa(others, one) for one in fit.predictor.data if one.trial.name in names}


@pytest.mark.parametrize(
    ("trials", "told_kPa", "true_kPa"),
    [
        (12, {}, {}),
        (12, {"t2": 12}, {"t2": 21}),
        (12, {"t0": 40, "t11": 18}, {"t0": 18, "t11": 40}),
        (12, {"t5": 2}, {"t5": 25}),
        (12, {"t2": 12, "t3": 12}, {}),
        (12, {"t2": 22.5}, {}),
        (7, {"t2": 12}, {}),
    ],
    ids=["all agree", "swapped digits", "exchanged rows", "could not move", "all replicates", "a tenth", "few"],
)
def test_rows_of_other_recordings_are_named_with_the_pressure_that_was(campaign, trials, told_kPa, true_kPa):
    """What all replicates share is no slip, a tenth is what trials differ by, few trials say nothing."""
    expected = {name: pytest.approx(1e3 * value, rel=0.03) for name, value in true_kPa.items()}
    assert odd(stated(campaign[:trials], **told_kPa)) == expected


def test_a_slip_in_a_pressure_without_replicates_is_named_among_few_trials(campaign):
    """Eight trials at four pressures, one of them typed as a pressure of its own."""
    of_four = [pair for pair in campaign if pair[0].pressure_Pa in (18e3, 21e3, 29e3, 40e3)]
    assert list(odd(stated(of_four, t2=42))) == ["t2"]


@pytest.mark.slow
def test_a_row_that_contradicts_the_others_is_named_and_left_out(campaign):
    result = diagnose(stated(campaign, t2=12), candidates=["tail_friction"], ladder=False, advice=False)
    assert result.verdict == "adequate"
    assert [trial.name for trial in result.fit.trials] == [trial.name for trial, _ in campaign if trial.name != "t2"]
    (note,) = (note for note in result.notes if note.code == "odd_trials")
    assert (note.facts["odd"][0][0], note.facts["others"]) == ("t2", 11)
    assert Diagnosis.from_json(result.to_json()).odd_trials == result.odd_trials == ("t2",)


def test_where_the_gauge_was_recorded_it_is_the_gauge_that_states_the_pressure(campaign):
    there = vt.fit(vt.base_model(), stated(campaign, t2=12))
    there.predictor.data = [
        replace(one, trial=trial, trace=(one.time_s, np.full(one.time_s.size, one.trial.pressure_Pa)))
        for one, (trial, _) in zip(there.predictor.data, campaign, strict=True)
    ]
    assert odd_trials(there) == ("t2",)
    (one,) = (one for one in there.predictor.data if one.trial.name == "t2")
    assert implied_pressure_Pa(vt.fit(vt.base_model(), campaign), one) == pytest.approx(21e3, rel=0.03)


def test_usual_trials_are_rarely_odd_nor_are_many(monkeypatch):
    monkeypatch.setattr("vinetrack.diagnosis.diagnose.CHANCE", 1e-2)  # ten times the level
    draw = np.random.default_rng(20050)
    assert sum(bool(diagnosing._farthest(0.05 * draw.standard_normal(24))) for _ in range(600)) <= 12
    assert diagnosing._farthest(np.append(0.02 * draw.standard_normal(11), 0.2)) == [11]
    assert diagnosing._farthest(np.append(0.02 * draw.standard_normal(13), [0.5, 5.0, 50.0])) == []


FAULT, DIFFER = ((Candidate("a", kind, in_answer_set=True),) for kind in ("measurement", "between_trials"))


@pytest.mark.parametrize(
    ("first", "others", "odd"),
    [((), "unexplained", ()), ((), "adequate", ("t2",)), (FAULT, "adequate", ()), (DIFFER, "adequate", ("t2",))],
)
def test_a_trial_is_odd_only_where_the_others_leave_nothing_unexplained(campaign, monkeypatch, first, others, odd):
    """Also where trials were found to differ, but beside no other fault of the measurement."""
    verdict = "artefact" if first else "unexplained"
    rounds = iter([(Round(verdict=verdict, ranking=first),), (Round(verdict=others),)])
    monkeypatch.setattr(diagnosing, "odd_trials", lambda _: ("t2",))
    monkeypatch.setattr(diagnosing, "_diagnosis_of", lambda fit, *_: Diagnosis(rounds=next(rounds), fits=(fit,)))
    assert diagnose(campaign, candidates=["tail_friction"], ladder=False, advice=False).odd_trials == odd
