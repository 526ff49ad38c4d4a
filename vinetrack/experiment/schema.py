"""Declarations of all columns of the trial sheet: name, unit, bounds, meaning, and field of `Trial`.

These declarations define the reading of `trials.csv` (`vinetrack.experiment.sheet`), the settings of the same name in
`experiment.yaml` and its `limits` (`settings`), the options of `vinetrack predict` and `design`
(`vinetrack.cli.design_options`), the inputs that an effect may require (`vinetrack.dynamics.trial_inputs`), and the
output of `vinetrack settings`. `vinetrack.experiment.cells` reads values.

Imports stay light: the command line loads this module at every start.
"""

from __future__ import annotations

import math

from vinetrack.core.units import UNITS, split_unit
from vinetrack.experiment.column import Column

_BAR = "looks like bar: 1 bar is 100 kPa"

# Every column of `trials.csv`, in the order of the documentation
COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            name="trial",
            field="name",
            kind="text",
            shared=False,
            meaning="Name of the trial, unique in the sheet; it names files.",
            default="required",
        ),
        Column(
            name="video",
            field="video",
            kind="path",
            shared=False,
            meaning="The recording: mp4, mov, avi, mkv, Phantom cine, Photron mraw, or a folder or stack of pictures.",
        ),
        Column(
            name="track",
            field="track",
            kind="path",
            shared=False,
            meaning="Positions measured elsewhere: a CSV with time_s, position_m, or a file of Physics Tracker.",
        ),
        Column(
            name="pressure_trace",
            field="pressure_trace",
            kind="path",
            meaning="The gauge pressure measured during the trial: a CSV with time_s, pressure_kPa, or a TDMS file.",
            measured="A gauge at the chamber, logged on the clock of the recording.",
        ),
        Column(
            name="capture_fps",
            field="capture_fps",
            low=0,
            above_low=True,
            high=1e7,
            usual=(60, math.inf),
            unusual_hint="write the capture rate, not the playback rate",
            meaning="Capture rate, frames per second; never the rate at which the file plays.",
            measured="The camera's setting; the rate stored in the file is that of playback.",
            default="required with a video that does not state it (DNG, cine, mraw do)",
        ),
        Column(
            name="capture_fps_is_playback",
            field="capture_fps_is_playback",
            kind="yes_no",
            meaning="yes: the film plays as fast as it was captured, so that capture_fps may equal its playback rate.",
            measured="yes for an ordinary film of a phone, no for a high-speed camera.",
            default="no: a capture_fps equal to the playback rate is refused",
        ),
        Column(
            name="exposure_us",
            field="exposure_s",
            low=0,
            above_low=True,
            high=1e6,
            slips=("ns",),
            usual=(1, math.inf),
            unusual_hint="looks like milliseconds: 1 ms is 1000 µs",
            meaning="Exposure of one frame.",
            measured="The camera's setting.",
        ),
        Column(
            name="diameter_mm",
            field="diameter_m",
            low=0.5,
            high=300,
            slips=("m", "um"),
            limit="choice",
            meaning="Diameter of the inflated vine.",
            measured="Calliper on the inflated tube, or lay-flat width times 2/π.",
            default="required",
        ),
        Column(
            name="thickness_um",
            field="thickness_m",
            low=0,
            above_low=True,
            high=75_000,
            slips=("nm",),
            usual=(2, math.inf),
            unusual_hint="looks like millimetres: 1 mm is 1000 µm",
            limit="choice",
            meaning="Thickness of the wall.",
            measured="Micrometer over ten layers, divided by ten.",
            default="required",
        ),
        Column(
            name="length_mm",
            field="length_m",
            low=0,
            above_low=True,
            high=100_000,
            slips=("um",),
            usual=(5, math.inf),
            unusual_hint="looks like metres: 0.28 m is 280 mm",
            limit="choice",
            meaning="Length of the grown vine.",
            measured="Ruler along the everted tube.",
            default="required",
        ),
        Column(
            name="pressure_kPa",
            field="pressure_Pa",
            low=0,
            high=1000,
            slips=("Pa", "mbar"),
            usual=(1, math.inf),
            unusual_hint=_BAR,
            limit="range",
            meaning="Gauge pressure.",
            measured="Gauge at the chamber, before the release.",
            default="required without a trace",
        ),
        Column(
            name="pressure_sigma_kPa",
            field="pressure_sigma_Pa",
            low=0,
            high=1000,
            slips=("Pa", "mbar"),
            meaning="Scatter of the gauge pressure from trial to trial.",
            measured="Standard deviation of the gauge reading over repeated fillings.",
            default="1 % of the pressure",
        ),
        Column(
            name="yield_pressure_kPa",
            field="yield_pressure_Pa",
            low=0,
            high=1000,
            slips=("Pa", "mbar"),
            meaning="Yield pressure: the lowest gauge pressure at which the vine grows.",
            measured="Raise the pressure slowly from zero until the tip starts to move; mean reading of five starts.",
            default="required",
        ),
        Column(
            name="yield_pressure_sigma_kPa",
            field="yield_pressure_sigma_Pa",
            low=0,
            high=1000,
            slips=("Pa", "mbar"),
            meaning="Standard error of the yield pressure.",
            measured="Standard deviation over those starts, divided by the square root of their number.",
            default="0.2 kPa",
        ),
        Column(
            name="payload_g",
            field="payload_kg",
            low=0,
            high=100_000,
            slips=("mg",),
            usual=(0.1, math.inf),
            unusual_hint="looks like kilograms: 0.0356 kg is 35.6 g",
            limit="range",
            meaning="Mass that rides on the tail.",
            measured="Balance.",
            default="0",
        ),
        Column(
            name="growth_angle_deg",
            field="growth_angle_rad",
            low=-180,
            high=180,
            limit="choice",
            condition_part="{}deg",
            meaning="Direction of growth: 0 straight down, 90 level, 180 straight up.",
            measured="Protractor, or a plumb line in the picture.",
            default="0: straight down",
        ),
        Column(
            name="chamber_l",
            field="chamber_m3",
            low=0,
            above_low=True,
            high=10_000,
            slips=("cm3",),
            limit="choice",
            condition_part="chamber{}l",
            meaning="Volume of the pressure chamber.",
            measured="Mass of the water that fills it.",
            default="unknown",
        ),
        Column(
            name="inlet_mm",
            field="inlet_m",
            low=0,
            above_low=True,
            high=300,
            slips=("um",),
            limit="choice",
            condition_part="inlet{}mm",
            meaning="Diameter of the inlet between chamber and vine.",
            measured="Drawing of the connector, or calliper.",
            default="unknown",
        ),
        Column(
            name="bends",
            field="bends",
            kind="bends",
            condition_part="bends{}",
            meaning="Bends of the path: start_mm:arc_mm:radius_mm, several joined by ;.",
            measured="Drawing of the guide, or a string laid along it.",
            default="none",
        ),
        Column(
            name="film_density_kg_m3",
            field="film_density_kg_m3",
            low=100,
            high=25_000,
            slips=("g_cm3",),
            condition_part="film{}",
            meaning="Density of the film.",
            measured="Data sheet, or the mass of a piece over its volume.",
            default="1200 kg/m³",
        ),
        Column(
            name="mm_per_px",
            field="m_per_px",
            low=0,
            above_low=True,
            high=1000,
            unit_key="mm",
            meaning="Scale of the picture; overrides the calibration.",
            measured="Length of a ruler in the plane of growth over its pixels.",
        ),
        Column(
            name="compare_sizes",
            field="compare_sizes",
            kind="yes_no",
            meaning="no: width and growth of the tube in the picture are not compared with diameter_mm and length_mm.",
            measured="no if only part of the tube's width is visible.",
            default="yes",
        ),
        Column(
            name="travel_ratio",
            field="travel_ratio",
            kind="choice",
            low=1,
            high=2,
            condition_part="ratio{}",
            meaning="Travel of the tail over that of the lead: 2 for eversion, 1 for a body that moves as a whole.",
            default="2",
        ),
        Column(
            name="steady",
            field="steady_window_s",
            kind="window",
            meaning="A steady window chosen by hand: from_s:to_s.",
            default="found by rules",
        ),
        Column(
            name="use",
            field="use",
            kind="yes_no",
            meaning="no: the trial stays in the sheet and is left out of the analysis.",
            default="yes",
        ),
        Column(
            name="specimen",
            field="specimen",
            kind="text",
            meaning="Which physical tube of that vine was used.",
            measured="Label every tube.",
            default="unknown",
        ),
        Column(
            name="day",
            field="day",
            kind="text",
            meaning="Day or batch in which the trial was run.",
            default="unknown",
        ),
        Column(
            name="order",
            field="order",
            low=1,
            high=1_000_000,
            shared=False,
            meaning="Position of the trial in the order in which trials were run: 1, 2, …",
            measured="Count trials as they are run.",
            default="the order of the rows",
        ),
        Column(
            name="axis",
            field="axis",
            kind="axis",
            shared=False,
            meaning="Growth axis in the picture for this trial only: x,y:x,y[:width_mm], px; more points for a bend.",
            default="the axis of all trials, or found from the motion",
        ),
        Column(
            name="frames_used",
            field="frames_used",
            kind="frames",
            shared=False,
            meaning="First and last frame of this trial to use: from:to, counted from 0 (rows of a track file).",
            default="all",
        ),
        Column(
            name="point_mass",
            field="point_mass",
            kind="text",
            shared=False,
            meaning="Name of the point mass in a Physics Tracker file that is this trial.",
            default="the one with the most points",
        ),
    )
}

# Columns that `experiment.yaml` may set for all trials
SHARED = tuple(name for name, column in COLUMNS.items() if column.shared)

# Columns that `limits` of `experiment.yaml` may constrain for further trials, by the form of the constraint
LIMITED = {kind: tuple(name for name in COLUMNS if COLUMNS[name].limit == kind) for kind in ("range", "choice")}


def column_in_other_unit(name: str) -> tuple[Column, str] | None:
    """Return the column of the same quantity as a name in another unit, and that unit; None if there is none. Returns
    column, unit, >>> column, unit = column_in_other_unit("pressure_psi"), >>> column.name, unit, ('pressure_kPa',
    'psi').
    """
    quantity, unit = split_unit(name)
    for column in COLUMNS.values():
        same = split_unit(column.name)[0] == quantity and column.scale is not None and unit in UNITS
        if same and column.name != name and column.scale is not None and UNITS[unit].si == column.scale.si:
            return column, unit
    return None


def option(column: str) -> str:
    """Return the command-line option for a column of the sheet."""
    return "--" + column.replace("_", "-")
