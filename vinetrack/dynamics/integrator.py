"""Radau IIA of order 5 for one trajectory of a vine, from rest to the end of its growth.

The equation is difficult in four respects. At rest the derivative of v^0.37 is infinite, so a method of fixed step
falls to order 1.4. Near the yield pressure the speed relaxes in microseconds while growth takes minutes (a stiffness of
10⁸). Towards the end of a bare vine the mass goes to zero. And a vine may stall and stay at rest until the drive
exceeds what holds it. An implicit L-stable method with error-controlled steps copes with all four.

`_integrate` follows one trajectory as a state machine. A vine is at rest (`_wait_for_drive`, `_start_from_rest`),
moving (`_cut_at_breakpoint`, `radau_step`, `_judge_step`, `_next_step_size`) or has a slack tail
(`vinetrack.dynamics.slack_tail`). The code uses only numbers, tuples and arrays, so that numba can compile it.

Source of the method: E.
"""

import numpy as np

from vinetrack.dynamics.equations import (
    ENDED,
    RUNNING,
    STALLED,
    TAUT,
    TOO_HARD,
    Point,
    TrialArrays,
    compiled,
    inlined,
    merged,
    next_slope_change,
)
from vinetrack.dynamics.radau import NO_STAGES, quintic, radau_step, starting_values
from vinetrack.dynamics.row_readout import read_by_rows
from vinetrack.dynamics.time_average import average_over
from vinetrack.effects import TrialInputs

TRAVEL_RATIO = TrialInputs._fields.index("travel_ratio")  # Convention: index of the travel ratio in a row of inputs

MOST_STEPS = 20_000  # Maximum number of steps of a trajectory, chosen: trajectories of the catalogue take 20 to 600

# Error of a step that was cut short, in tolerances, below which the next step takes the size proposed before the cut
SMALL_ERROR = 0.1

# Arguments of `integrate_trials` after the equations, in order
BATCH = (
    "starts", "times", "on", "inputs", "thetas", "trace_starts", "trace_time", "trace_pressure", "bend_starts", "bends",
    "breakpoints", "stops", "rtol", "out", "ends", "work",
    "means",
)  # fmt: skip

MOVING, AT_REST, SLACK = 0, 1, 2  # Phases of a trajectory; a convention of this file

ACCEPTED, REFUSED, STOPPED = 0, 1, 2  # Outcomes of a step (`_judge_step`); a convention of this file


@merged
def _integrate(equations, trial, times, breakpoints, stop, rtol, out, work):
    """Follow one trajectory from rest at time 0."""
    count = times.size
    point = Point(0.0, 0.0, 0.0, 0.0, equations.first_chamber(trial))
    row = _write_at_rest(equations, trial, times, 0, 0.0, point, out)
    end_time = slack_time = np.nan
    if row == count:
        return RUNNING, end_time, 0.0, 0, slack_time
    last_time = times[count - 1]
    phase, slack_located = AT_REST, False
    previous_stages, h, speed_scale = NO_STAGES, 0.0, 0.0
    next_breakpoint = sample = n_steps = 0
    while True:
        if phase == SLACK:
            slack_time = point.time if np.isnan(slack_time) else slack_time
            status, row, point, end_speed = equations.follow_slack(
                equations, trial, times, row, point, stop, rtol, out, work
            )
            if status == ENDED:
                _write_at_rest(equations, trial, times, row, np.inf, _at_position(point, stop), out)
            if status != TAUT:
                end_time = end_time if status == RUNNING else point.time
                return status, end_time, end_speed, n_steps, slack_time
            phase = AT_REST if point.v <= 0 else MOVING
            point, speed_scale, h = _resume_taut(equations, trial, point, speed_scale)
            previous_stages = NO_STAGES
        if phase == AT_REST:
            if _rest_acceleration(equations, point.time, point.x, point.chamber, trial) <= 0:
                start, chamber = _wait_for_drive(equations, trial, point, last_time)
                resting = Point(point.time, point.x, 0.0, 0.0, chamber)
                row = _write_at_rest(equations, trial, times, row, start, resting, out)
                if row == count:
                    return STALLED, point.time, 0.0, n_steps, slack_time
                point = Point(start, point.x, 0.0, 0.0, chamber)
            if equations.slack_at_rest(equations, trial, point.time, point.x, point.chamber):
                point = Point(point.time, point.x, 0.0, 0.0, point.chamber)
                phase = SLACK
                continue
            point, speed_scale, h = _start_from_rest(equations, trial, point, last_time, stop)
            phase, previous_stages = MOVING, NO_STAGES
        while next_breakpoint < breakpoints.size and point.x >= breakpoints[next_breakpoint]:
            next_breakpoint += 1
        breakpoint_x = breakpoints[next_breakpoint] if next_breakpoint < breakpoints.size else stop
        full_h = _cut_at_breakpoint(h, point, min(breakpoint_x, stop))
        sample = next_slope_change(sample, point.time, trial)
        h = _cut_at_sample(full_h, point.time, sample, trial)
        converged, error, end, stages = radau_step(
            equations, trial, point, starting_values(point, h, previous_stages), speed_scale, rtol
        )
        n_steps += 1
        if n_steps > MOST_STEPS:
            return TOO_HARD, point.time, point.v, n_steps, slack_time
        outcome, factor = _judge_step(point, end, stages, converged, error, breakpoint_x, stop, speed_scale)
        if outcome == STOPPED:
            point = Point(
                point.time + h, point.x + 0.5 * h * max(point.v, 0.0), point.v, point.acceleration, end.chamber
            )
            phase, end_time = AT_REST, point.time
            row = _write_at_rest(equations, trial, times, row, point.time, point, out)
            if row == count:
                return STALLED, end_time, 0.0, n_steps, slack_time
            continue
        if outcome == REFUSED:
            h *= factor
            previous_stages = NO_STAGES
            continue
        ended = end.x >= stop
        fraction = _fraction_at(stop, h, point, end) if ended else 1.0
        slack_fraction = equations.slack_fraction(equations, trial, h, point, end)
        if slack_fraction < 2 and (slack_fraction < fraction or not ended):
            if not slack_located:
                # The chamber pressure is less accurate within a step than at its ends, so a step is ended here.
                slack_located, previous_stages = True, NO_STAGES
                h *= slack_fraction
                continue
            ended, phase, slack_located, fraction = False, SLACK, False, slack_fraction
        row = _write_moving(equations, trial, times, row, fraction, h, point, end, out)
        if ended and point.time + fraction * h <= last_time:
            end_time = point.time + fraction * h
            _x, end_speed, _a = quintic(fraction, h, point, end)
            _write_at_rest(equations, trial, times, row, np.inf, _at_position(end, stop), out)
            return ENDED, end_time, end_speed, n_steps, slack_time
        if row == count:
            return RUNNING, end_time, end.v, n_steps, slack_time
        if phase == SLACK:
            point = _point_within_step(fraction, h, point, end)
            continue
        # A drive that rises from zero may take the speed far beyond the estimate at the start.
        point, previous_stages, speed_scale = end, stages, max(speed_scale, end.v)
        h = _next_step_size(h, full_h, error)


@merged
def integrate_trials(
    equations,
    starts,
    times,
    on,
    inputs,
    thetas,
    trace_starts,
    trace_time,
    trace_pressure,
    bend_starts,
    bends,
    breakpoints,
    stops,
    rtol,
    out,
    ends,
    work,
    means,
):
    """Integrate many trials, and apply the readout of the camera: `_integrate`, `read_by_rows`, `average_over`."""
    for i in range(starts.size - 1):
        trace = slice(trace_starts[i], trace_starts[i + 1])
        trial = TrialArrays(
            on[i],
            inputs[i],
            thetas[i],
            trace_time[trace],
            trace_pressure[trace],
            bends[bend_starts[i] : bend_starts[i + 1]],
        )
        rows = slice(starts[i], starts[i + 1])
        status, end_time, end_speed, n_steps, slack_time = _integrate(
            equations, trial, times[rows], breakpoints[i], stops[i], rtol, out[rows], work
        )
        end = Point(end_time if status == ENDED else np.inf, stops[i], end_speed, 0.0, 0.0)
        row_delay = equations.row_delay(trial)
        if row_delay != 0:
            read_by_rows(times[rows], out[rows], inputs[i, TRAVEL_RATIO], end, row_delay)
        averaging_time_squared = equations.averaged_over(trial)
        if averaging_time_squared > 0:
            average_over(times[rows], out[rows], means, inputs[i, TRAVEL_RATIO], end, averaging_time_squared)
        ends[i, 0] = status
        ends[i, 1] = end_time
        ends[i, 2] = end_speed
        ends[i, 3] = n_steps
        ends[i, 4] = slack_time


@compiled
def _rates(equations, time, x, v, chamber, trial):
    """`equations.rates` for callers outside the steps, compiled once instead of into each of them. With
    `_rest_acceleration` this saves a tenth of the time to compile the whole catalogue.
    """
    return equations.rates(time, x, v, chamber, trial)


@compiled
def _rest_acceleration(equations, time, x, chamber, trial):
    """`equations.rest_acceleration`, compiled once."""
    return equations.rest_acceleration(time, x, chamber, trial)


@inlined
def _at_position(point, x):
    """The same point at another position."""
    return Point(point.time, x, point.v, point.acceleration, point.chamber)


@compiled
def _write_at_rest(equations, trial, times, row, until, point, out):
    """Fill the rows of `out` from `row` up to the time `until` with a vine at rest; return the next row."""
    while row < times.size and times[row] <= until:
        # Before release the camera records the vine as it is at release.
        out[row, 3] = equations.observed(max(times[row], 0.0), point.x, 0.0, point.chamber, trial)
        out[row, 0] = point.x
        out[row, 1] = 0.0
        out[row, 2] = 0.0
        row += 1
    return row


@inlined
def _write_moving(equations, trial, times, row, fraction, h, start, end, out):
    """Fill the rows of `out` from `row` up to a fraction of a step; return the next row."""
    while row < times.size and times[row] <= start.time + fraction * h:
        step_fraction = (times[row] - start.time) / h
        x, v, a = quintic(step_fraction, h, start, end)
        chamber = start.chamber + step_fraction * (end.chamber - start.chamber)
        out[row, 0] = x
        out[row, 1] = v
        out[row, 2] = a
        out[row, 3] = equations.observed(times[row], x, v, chamber, trial)
        row += 1
    return row


@inlined
def _point_within_step(fraction, h, start, end):
    """The vine at a fraction of a step."""
    x, v, a = quintic(fraction, h, start, end)
    return Point(start.time + fraction * h, x, v, a, start.chamber + fraction * (end.chamber - start.chamber))


@inlined
def _fraction_at(x_wanted, h, start, end):
    """Fraction of a step at which x reaches a position, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        x, _v, _a = quintic(middle, h, start, end)
        if x < x_wanted:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@inlined
def _cut_at_breakpoint(h, point, x_limit):
    """The step size, reduced so that the step ends just after the next breakpoint or the end of growth."""
    distance = x_limit - point.x
    if point.v > 0 and h * point.v > 1.05 * distance:
        return 1.02 * distance / point.v
    return h


@inlined
def _cut_at_sample(h, time, sample, trial):
    """The step size, reduced to end at the next sample of a measured pressure, as no step across it is accepted."""
    if sample < trial.trace_time.size and time + h > trial.trace_time[sample]:
        return trial.trace_time[sample] - time
    return h


@inlined
def _judge_step(point, end, stages, converged, error, breakpoint_x, stop, scale):
    """Accept or reject a step, with the factor on its size for the next attempt. STOPPED: the vine stops within the
    step, which by now is so short that the time is known.
    """
    h = stages.h
    if not converged:
        return REFUSED, 0.25
    if end.v <= 0 or point.v + stages.z1 <= 0 or point.v + stages.z2 <= 0:
        if h * point.v <= 1e-9 * max(point.x, 1e-6) or point.v <= 1e-7 * scale:
            return STOPPED, 1.0
        return REFUSED, 0.3
    if error > 1:
        return REFUSED, max(0.2, 0.9 * error**-0.25)
    # Tolerance on reaching the breakpoint: relative to the whole travel, or to the breakpoint if there is no end.
    position_tolerance = 1e-7 * (stop if stop < np.inf else breakpoint_x)
    if breakpoint_x < stop and end.x > breakpoint_x + position_tolerance:
        return REFUSED, _fraction_at(breakpoint_x + 0.5 * position_tolerance, h, point, end)
    return ACCEPTED, 1.0


@inlined
def _next_step_size(h, full_h, error):
    """Size of the step after an accepted one, from its error (Hairer & Wanner IV.8; error estimate of order 3)."""
    new_h = h * min(6.0, 0.9 * max(error, 1e-8) ** -0.25)
    return max(new_h, full_h) if full_h > h and error < SMALL_ERROR else new_h


@inlined
def _start_from_rest(equations, trial, point, until, stop):
    """Start of a motion: the point with its acceleration, the speed to be expected, and the first step size."""
    acceleration, _rate = _rates(equations, point.time, point.x, 0.0, point.chamber, trial)
    travel = min(stop - point.x, 0.5 * acceleration * (until - point.time) ** 2 + 1e-9)
    scale = _typical_speed(equations, trial, point.time, point.x, point.chamber, acceleration, travel)
    return Point(point.time, point.x, 0.0, acceleration, point.chamber), scale, 1e-4 * scale / acceleration


@inlined
def _resume_taut(equations, trial, point, scale):
    """After a slack phase: the point with its acceleration, the speed to be expected, and the first step size."""
    time, x, v, _acceleration, chamber = point
    acceleration, _rate = _rates(equations, time, x, v, chamber, trial)
    scale = max(scale, v)
    return Point(time, x, v, acceleration, chamber), scale, 1e-2 * max(v, 1e-3 * scale) / max(abs(acceleration), 1e-9)


@compiled
def _typical_speed(equations, trial, time, x, chamber, start_acceleration, travel):
    """Speed of the motion, within a factor of two: ballistic over `travel`, or where the forces balance."""
    ballistic = (2 * start_acceleration * travel) ** 0.5
    speed = ballistic
    for _ in range(60):
        acceleration, _rate = _rates(equations, time, x, speed, chamber, trial)
        if acceleration > 0:
            return min(2 * speed, ballistic)
        speed *= 0.5
    return speed


@compiled
def _chamber_after(equations, trial, time, x, chamber, step):
    """Chamber pressure of a vine at rest after `step`; exact if the supply is proportional to the pressure deficit."""
    _a, rate = _rates(equations, time, x, 0.0, chamber, trial)
    if rate == 0:
        return chamber
    delta = 1e-6 * (abs(chamber) + 1e3)
    _a, higher = _rates(equations, time, x, 0.0, chamber + delta, trial)
    decay = step * (higher - rate) / delta
    return chamber + step * rate * (np.expm1(decay) / decay if abs(decay) > 1e-12 else 1.0)


@compiled
def _wait_for_drive(equations, trial, point, until):
    """First time at which the drive moves a vine that rests at `point`, and the chamber pressure at that time. The time
    is later than `until` if there is none. The chamber continues to fill meanwhile.
    """
    time, x, _v, _acceleration, chamber = point
    steps = max(256, 2 * trial.trace_time.size)
    step = (until - time) / steps
    for _step in range(steps):
        after = _chamber_after(equations, trial, time, x, chamber, step)
        if _rest_acceleration(equations, time + step, x, after, trial) > 0:
            low, high = 0.0, step
            for _ in range(24):
                middle = 0.5 * (low + high)
                pressure = _chamber_after(equations, trial, time, x, chamber, middle)
                if _rest_acceleration(equations, time + middle, x, pressure, trial) > 0:
                    high = middle
                else:
                    low = middle
            pressure = _chamber_after(equations, trial, time, x, chamber, high)
            return _resolvable_start(equations, trial, time + high, until, x, pressure, 1e-7 * step)
        time += step
        chamber = after
    return until + 1.0, chamber


@compiled
def _resolvable_start(equations, trial, time, until, x, chamber, delay):
    """Time at which a drive that rises from zero at `time` starts a resolvable motion, and the chamber pressure then.
    That is a displacement by 10⁻⁹ of the travel. Before, the drive is a difference of large forces below their rounding
    error, and the vine is practically at rest.
    """
    start, pressure = time, chamber
    while time + delay < until:
        after = _chamber_after(equations, trial, time, x, chamber, delay)
        if _rest_acceleration(equations, time + delay, x, after, trial) <= 0:
            break
        acceleration, _rate = _rates(equations, time + delay, x, 0.0, after, trial)
        travel = 0.5 * acceleration * delay**2
        speed = _typical_speed(equations, trial, time + delay, x, after, acceleration, travel)
        if delay * speed > 1e-9 * (x + 1e-3):
            break
        start, pressure = time + delay, after
        delay *= 2
    return start, pressure
