"""The rows of `hidden.laboratory_rows`: for each kind of laboratory its faults, and what is right to say of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from hidden import laboratories as faults
from hidden import over_time, weights
from hidden.designs import Setting, Wants
from hidden.kinds import EFFECTS
from hidden.shots import Fault
from hidden.verdicts import DAY, N_BY_VINE, ORDER, SPECIMEN, Should

TRIALS = (24, 48)
CLEAR = 12.0
"""Standard deviations at which there is no excuse for not seeing a fault; the bar asks for what lies above 8."""

BARE = Wants(payload=False)
FAST = Wants(payload=False, fast=True)
WHO, WHEN = ("specimen", "order"), ("specimen", "day", "order")

Accept = Callable[[list[Setting]], bool]


@dataclass(frozen=True)
class Row:
    """One kind of laboratory.

    `family` seeds the numbers: rows of one family are the same data. `faults` come one after the other; `quiet` is a
    factor on the noise and scatter of a careful laboratory; `columns` are those of the sheet that say who and when.
    With `least_sigma` it is measured how visible the fault is, and campaigns where it is less so are drawn again.
    """

    name: str
    family: str
    should: Should
    faults: tuple[Fault, ...] = ()
    wants: Wants = BARE
    accept: Accept = lambda settings: True  # noqa: ARG005
    quiet: float = 1.0
    columns: tuple[str, ...] = ()
    least_sigma: float | None = None
    model: tuple[str, ...] = ()


def _vines(settings: list[Setting]) -> int:
    return len({one.vine for one in settings})


def _levels(settings: list[Setting]) -> int:
    return len({one.pressure_kPa for one in settings}) // _vines(settings)


def _one_or_two(settings: list[Setting]) -> bool:
    return _vines(settings) <= 2 and _levels(settings) >= 4


def _two(settings: list[Setting]) -> bool:
    return _vines(settings) == 2


def _one(settings: list[Setting]) -> bool:
    return _vines(settings) == 1


def _down(settings: list[Setting]) -> bool:
    return settings[0].angle_deg == 0


def _very_fast(settings: list[Setting]) -> bool:
    """One vine, thin enough to reach tens of metres a second."""
    return _one(settings) and settings[0].vine.thickness_um <= 100 and max(one.pressure_kPa for one in settings) > 45


def _from_12_kPa(settings: list[Setting]) -> bool:
    return min(one.pressure_kPa for one in settings) >= 12


ADEQUATE = Should(("adequate",))
NAMED = ("artefact", "ambiguous", "missing")


def _names(*names: str, adequate: bool = False, verdicts: tuple[str, ...] = NAMED) -> Should:
    """One of these names, which are all true, alone or with others."""
    return Should((*verdicts, *(("adequate",) if adequate else ())), any_of=names, true=names)


def _twice(row: Row, unknown: Should | None = None, columns: tuple[str, ...] = WHO) -> tuple[Row, Row]:
    """A row whose sheet says who, when and in which order, and one whose sheet does not."""
    silent = replace(row, name=f"{row.name}_unknown", should=unknown or row.should)
    return replace(row, columns=columns), silent


def _order_rows() -> list[Row]:
    between = ("artefact", "ambiguous")
    tied = _names(*ORDER, verdicts=between)
    tubes = _names(*SPECIMEN, verdicts=between)
    # Without the columns a step from tube to tube may pass for a drift, or stay in the scatter.
    unlike = (*ORDER, *SPECIMEN, *DAY)
    guessed = _names(*unlike, verdicts=between, adequate=True)
    quietly = replace(_names(*unlike, verdicts=("artefact",), adequate=True), only=unlike)
    rising, any_order = faults.in_rising_order, faults.by_vine
    set_anew, set_daily = over_time.regulator_reset(0.04), over_time.gain_by_day(0.03)
    some = {"wants": BARE, "accept": _one_or_two}
    several = (faults.new_tubes(7, 0.03), faults.worn(0.005, 0.005), over_time.zero_by_day(0.2))
    rows = [
        *_twice(
            Row("wear_ordered", "wear_ordered", tied, (rising, faults.worn(0.01, 0.03)), **some), columns=("order",)
        ),
        *_twice(
            Row("wear_random", "wear_random", quietly, (any_order, faults.worn(0.01, 0.03)), **some), columns=("order",)
        ),
        *_twice(
            Row("supply_falls", "supply_falls", guessed, (rising, over_time.supply_falls(0.05)), BARE, quiet=0.5),
            columns=("order",),
        ),
        *_twice(
            Row("regulator_reset", "regulator_reset", guessed, (rising, set_anew), BARE, quiet=0.5), columns=("order",)
        ),
        *_twice(
            Row("day_gains_rising", "day_gains_rising", guessed, (rising, set_daily), BARE, quiet=0.5), columns=WHEN
        ),
        *_twice(Row("day_zeros_rising", "day_zeros_rising", guessed, (rising, *several), **some), columns=WHEN),
        *_twice(Row("day_zeros_random", "day_zeros_random", guessed, (any_order, *several), **some), columns=WHEN),
        *_twice(
            Row("specimen_high", "specimen_high", tubes, (rising, faults.another_for_high_pressures), **some), guessed
        ),
        *_twice(Row("specimen_each", "specimen_each", tubes, (rising, faults.tube_each_condition), **some), guessed),
        *_twice(
            Row("specimen_mixed", "specimen_mixed", quietly, (any_order, faults.two_tubes_mixed), **some), ADEQUATE
        ),
        *_twice(
            Row("specimen_replicate", "specimen_replicate", quietly, (any_order, faults.tube_each_replicate), **some),
            ADEQUATE,
        ),
    ]
    return rows


def _camera_rows() -> list[Row]:
    two = {"wants": Wants(payload=False, vines=2), "accept": _two}
    by_vine, moved = faults.by_vine, over_time.camera_of_a_day
    on_two_days = {"columns": WHEN, "quiet": 0.5}
    return [
        Row("rate_day", "rate_day", _names("time_base"), (by_vine, moved(0.04, 0.08, clock=True)), **on_two_days),
        Row(
            "scale_day",
            "scale_day",
            _names("length_scale", adequate=True),
            (by_vine, moved(0.02, 0.05, clock=False)),
            **on_two_days,
        ),
        Row("wild_1pct", "wild_1pct", ADEQUATE, (faults.wild_points(0.01, 1, 10),)),
        Row("wild_2pct_3mm", "wild_2pct_3mm", ADEQUATE, (faults.wild_points(0.02, 3, 3),)),
        Row(
            "n_by_vine_03",
            "n_by_vine_03",
            _names(*N_BY_VINE),
            (faults.exponents_apart(0.03),),
            quiet=0.6,
            least_sigma=0.0,
            **two,
        ),
        Row(
            "n_by_vine_06",
            "n_by_vine_06",
            _names(*N_BY_VINE),
            (faults.exponents_apart(0.06),),
            quiet=0.6,
            least_sigma=CLEAR,
            **two,
        ),
        Row(
            "lens_small",
            "lens_small",
            _names("lens", adequate=True),
            (faults.lens(0.08, 0.13),),
            quiet=0.5,
            least_sigma=0.0,
        ),
        Row(
            "lens_strong",
            "lens_strong",
            _names("lens"),
            (faults.lens(2, 6, quintic=True),),
            quiet=0.7,
            least_sigma=CLEAR,
        ),
        Row(
            "rolling_shutter",
            "rolling_shutter",
            _names("rolling_shutter"),
            (faults.rolling,),
            FAST,
            quiet=0.7,
            least_sigma=CLEAR,
        ),
        Row("smoothed", "smoothed", _names("moving_average", adequate=True), (faults.smoothed((5, 7, 9)),)),
        Row(
            "smoothed_polynomial",
            "smoothed_polynomial",
            _names("moving_average", adequate=True),
            (faults.smoothed((9, 11), 2),),
        ),
        Row(
            "smoothed_depletion",
            "smoothed_depletion",
            _names("reservoir_depletion"),
            (faults.physics(gamma=1.3), faults.smoothed((5, 7))),
            Wants(payload=False, chamber=True),
            least_sigma=CLEAR,
        ),
        Row(
            "smoothed_valve",
            "smoothed_valve",
            _names("supply_rise"),
            (faults.valve("exponential", 5, 7), faults.smoothed((5, 7))),
            quiet=0.7,
            least_sigma=CLEAR,
        ),
        Row("clicked", "clicked", ADEQUATE, (faults.clicked(1e-3, 4),)),
        Row("clicked_every", "clicked_every", ADEQUATE, (faults.clicked(1e-3, 1),), quiet=0.5),
        Row("speed_noise", "speed_noise", ADEQUATE, (faults.blur(60e-6),), FAST, _very_fast, quiet=0.5),
        Row(
            "trace_clock",
            "trace_clock",
            _names("*clock*", "*trace*"),
            (faults.physics(gamma=1.3), faults.trace_off(5, 15)),
            Wants(payload=False, chamber=True),
            least_sigma=CLEAR,
        ),
        Row(
            "gauge_lag",
            "gauge_lag",
            _names("*lag*"),
            (faults.physics(gamma=1.3), faults.lagging_gauge(3, 20)),
            Wants(payload=False, chamber=True),
            least_sigma=CLEAR,
        ),
        Row("gauge_slow", "gauge_slow", ADEQUATE, (faults.slow_gauge(40, 150, 100.0),)),
        Row(
            "gauge_slow_depletion",
            "gauge_slow_depletion",
            ADEQUATE,
            (faults.physics(gamma=1.3), faults.slow_gauge(100, 200, 50.0)),
            Wants(payload=False, chamber=True),
        ),
        Row("gauge_rounded", "gauge_rounded", ADEQUATE, (faults.slow_gauge(40, 150, 100.0, trace_digit_Pa=10.0),)),
        Row(
            "gauge_held",
            "gauge_held",
            ADEQUATE,
            (faults.slow_gauge(40, 150, 60.0, gauge_digit_Pa=100.0, gauge_holds=True),),
        ),
        Row("gauge_steps", "gauge_steps", ADEQUATE, (faults.slow_gauge(40, 150, 60.0, gauge_digit_Pa=100.0),)),
        Row("gauge_coarse", "gauge_coarse", ADEQUATE, (faults.coarse_gauge(100.0, 0.4, 1.0),)),
        Row("gauge_coarse_quiet", "gauge_coarse_quiet", ADEQUATE, (faults.coarse_gauge(100.0, 0.05, 0.3),)),
        Row(
            "gauge_coarse_depletion",
            "gauge_coarse_depletion",
            ADEQUATE,
            (faults.physics(gamma=1.3), faults.coarse_gauge(50.0, 0.05, 0.5)),
            Wants(payload=False, chamber=True),
        ),
        Row("gauge_filtered", "gauge_filtered", ADEQUATE, (faults.filtered_gauge(30, 100, 100.0),)),
    ]


def _rig_rows() -> list[Row]:
    losses = ("air_drag", "inlet_loss")
    sizes = ("inlet_loss.K", "air_drag.C_D")
    both = Should(("missing", "ambiguous"), any_of=losses, all_of=losses, true=losses, holds=sizes)
    supply = _names("supply_rise")
    opening, smooth = faults.valve("exponential", 5, 7), faults.valve("smooth", 5, 8)
    no_gauge = Should(("missing", "ambiguous"), none_of=("pressure_gauge",))
    return [
        Row("valve_6ms", "valve_6ms", supply, (opening,), quiet=0.7, least_sigma=CLEAR),
        Row("valve_smooth", "valve_smooth", supply, (smooth,), FAST, quiet=0.5, least_sigma=CLEAR),
        Row(
            "slack_tail",
            "slack_tail",
            _names("*slack*"),
            (faults.slack_tail,),
            Wants(payload=True),
            _down,
            least_sigma=CLEAR,
        ),
        Row(
            "drag_and_inlet",
            "drag_and_inlet",
            both,
            (faults.inlet_half, faults.drag_beside_inlet),
            Wants(payload=False, fast=True, inlet=True),
            _one,
            quiet=0.5,
        ),
        Row("gauge_off_by_nothing", "gauge_off_by_nothing", ADEQUATE, (), BARE, _from_12_kPa),
        *(
            Row(
                f"gauge_beside_{name}",
                f"gauge_beside_{name}",
                replace(no_gauge, any_of=(name,), true=(name,)),
                (faults.effect(name),),
                replace(EFFECTS[name][1], wide_chamber=False),
                _from_12_kPa,
                quiet=0.5,
                least_sigma=CLEAR,
            )
            for name in ("linear_damping", "inlet_loss", "tail_friction")
        ),
    ]


CLEAN_EFFECTS = (
    "reservoir_depletion",
    "tail_friction",
    "air_drag",
    "inlet_loss",
    "fold_inertia",
    "linear_damping",
    "payload_friction",
    "latch_release",
    "pressure_damping",
    "wall_stretch",
    "length_scale",
)


def _clean_rows() -> list[Row]:
    drag = Should(("missing",), any_of=("air_drag",), only=("air_drag",), true=("air_drag",), holds=("air_drag.C_D",))
    rows = [
        Row("clean", "clean", ADEQUATE, (), Wants()),
        Row("few_trials", "few_trials", ADEQUATE, (faults.few(2, 7),), BARE),
        Row("falling_ball", "falling_ball", drag, model=("gravity",)),
        Row("falling_ball_payload_friction", "falling_ball", drag, model=("gravity", "payload_friction")),
    ]
    for name in CLEAN_EFFECTS:
        should = Should(("artefact", "ambiguous") if name == "length_scale" else ("missing", "ambiguous"))
        should = replace(should, any_of=(name,), true=(name,))
        wants = replace(EFFECTS[name][1], wide_chamber=False)
        rows.append(
            Row(
                f"clean_{name}",
                f"clean_{name}",
                should,
                (faults.effect(name),),
                wants,
                quiet=0.2 if wants.quiet else 0.5,
                least_sigma=CLEAR,
            )
        )
    return rows


FILM_EFFECTS = (
    "reservoir_depletion",
    "tail_friction",
    "air_drag",
    "linear_damping",
    "payload_friction",
    "wall_stretch",
)


def _film_rows() -> list[Row]:
    """Film that weighs other than the sheet says, alone and beside an effect."""
    film = ("film_mass",)
    between = ("artefact", "ambiguous")
    uneven = weights.film_off(0.05)
    two = {"wants": Wants(payload=False, vines=2), "accept": _two}
    rows = [
        Row("film_uneven", "film_uneven", _names(*film, verdicts=between, adequate=True), (uneven,), quiet=0.5, **two),
        Row("film_density", "film_density", _names(*film, verdicts=between), (weights.film_of(920.0),), quiet=0.5),
    ]
    for name in FILM_EFFECTS:
        should = Should(NAMED, any_of=(name, *film), true=(name, *film))
        wants = replace(EFFECTS[name][1], wide_chamber=False)
        label = f"film_{name}"
        rows.append(Row(label, label, should, (uneven, faults.effect(name)), wants, quiet=0.5, least_sigma=CLEAR))
    return rows


def _stated_rows() -> list[Row]:
    """Payloads and chambers that are other than the sheet says."""
    verdicts, loaded = ("artefact", "ambiguous"), Wants(payload=True, vines=2)
    always, mostly = (_names("payload_mass", verdicts=verdicts, adequate=adequate) for adequate in (False, True))
    mount = weights.mount_forgotten(3, 10)
    depletion, closed = _names("reservoir_depletion"), Wants(payload=False, chamber=True)
    return [
        Row("mount_forgotten", "mount_forgotten", always, (mount,), loaded, quiet=0.5),
        Row("payload_mistyped", "payload_mistyped", mostly, (weights.payload_mistyped,), loaded, quiet=0.5),
        Row("chamber_larger", "chamber_larger", depletion, (faults.chamber_misread(1.1, 1.4),), closed, quiet=0.5),
        Row("chamber_smaller", "chamber_smaller", depletion, (faults.chamber_misread(0.7, 0.9),), closed, quiet=0.5),
    ]


def _everyday_rows() -> list[Row]:
    """Everything at once, each a little: tubes that differ and wear, points half a percent of which are wild."""
    usual = (faults.by_vine, faults.tubes_alike(0.04), faults.worn(0.001, 0.003), faults.wild_points(0.005, 1, 10))
    unlike = (*ORDER, *SPECIMEN, *DAY)
    nothing = replace(_names(*unlike, verdicts=("artefact", "ambiguous"), adequate=True), only=unlike)
    rows = [Row("everyday", "everyday", nothing, usual, quiet=0.5, columns=WHO)]
    for name in CLEAN_EFFECTS:
        should = Should(("artefact", "ambiguous", "missing"), any_of=(name,), true=(name, *unlike))
        wants = replace(EFFECTS[name][1], wide_chamber=False)
        faulty = (*usual, faults.effect(name))
        label = f"everyday_{name}"
        rows.append(Row(label, label, should, faulty, wants, quiet=0.5, columns=WHO, least_sigma=CLEAR))
    # The trials say of themselves that they do not go with the others; what they are is not for the verdict to say.
    slip = Should(("adequate", "unexplained"))
    return [*rows, Row("exchanged_rows", "exchanged_rows", slip, (faults.two_rows_exchanged,), quiet=0.5)]


def every_row() -> Iterator[Row]:
    """All rows, those of careful laboratories first."""
    for rows in (_clean_rows, _camera_rows, _rig_rows, _order_rows, _film_rows, _stated_rows, _everyday_rows):
        yield from rows()
