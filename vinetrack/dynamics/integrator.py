"""Radau IIA of order 5 for one trajectory of a vine, from rest to the end of its growth.

The equation is difficult in four respects. At rest the derivative of v^0.37 is infinite, so a method of fixed step
falls to order 1.4. Near the yield pressure the speed relaxes in microseconds while growth takes minutes (a stiffness of
10⁸). Towards the end of a bare vine the mass goes to zero. And a vine may stall and stay at rest until the drive
exceeds what holds it. An implicit L-stable method with error-controlled steps copes with all four.

`_integrate` follows one trajectory as a state machine. A vine is at rest (`_wait_for_drive`, `_start_from_rest`),
moving (`_cut_at_breakpoint`, `radau_step`, `_judge_step`, `_next_step_size`) or has a slack tail. The code uses only
numbers, tuples and arrays, so that numba can compile it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vinetrack.dynamics.equations import (
    NO_STAGES,
    Asked,
    Point,
    Status,
    TrialArrays,
    average_over,
    compiled,
    inlined,
    merged,
    next_slope_change,
    quintic,
    radau_step,
    read_by_rows,
    starting_values,
)
from vinetrack.effects import TrialInputs

# Places of two quantities in a row of inputs
RATIO, FREE = TrialInputs._fields.index("travel_ratio"), TrialInputs._fields.index("tail_free")

MOST_STEPS = 20_000  # Maximum number of steps of a trajectory, chosen: trajectories of the catalogue take 20 to 600


@merged
def _integrate(equations, trial, times, breakpoints, stop, rtol, out, work):
    """Follow one trajectory from rest at time 0."""
    moving, at_rest, slack = 0, 1, 2  # Phases of a trajectory; a convention of this file
    count = times.size
    point = Point(0.0, 0.0, 0.0, 0.0, equations.first_chamber(trial))
    row = _write_at_rest(equations, trial, times, 0, 0.0, point, out)
    end_time = slack_time = np.nan
    if row == count:
        return Status.RUNNING, end_time, 0.0, 0, slack_time
    last_time = times[count - 1]
    phase, slack_located = at_rest, False
    previous_stages, h, speed_scale = NO_STAGES, 0.0, 0.0
    next_breakpoint = sample = n_steps = 0
    while True:
        if phase == slack:
            slack_time = point.time if np.isnan(slack_time) else slack_time
            status, row, point, end_speed = _follow_slack(equations, trial, times, row, point, stop, rtol, out, work)
            if status == Status.ENDED:
                _write_at_rest(equations, trial, times, row, np.inf, _at_position(point, stop), out)
            if status != Status.TAUT:
                end_time = end_time if status == Status.RUNNING else point.time
                return status, end_time, end_speed, n_steps, slack_time
            phase = at_rest if point.v <= 0 else moving
            time, x, v, _acceleration, chamber = point
            acceleration, _rate = _ask(equations, Asked.ACCELERATION, time, x, v, chamber, trial)
            point, previous_stages = Point(time, x, v, acceleration, chamber), NO_STAGES
            speed_scale = max(speed_scale, v)
            h = 1e-2 * max(v, 1e-3 * speed_scale) / max(abs(acceleration), 1e-9)
        if phase == at_rest:
            drive, _rate = _ask(equations, Asked.REST_ACCELERATION, point.time, point.x, 0.0, point.chamber, trial)
            if drive <= 0 or point.time > 0:  # What is left of the drive of one that has just stopped is rounding.
                start, chamber = _wait_for_drive(equations, trial, point, last_time)
                resting = Point(point.time, point.x, 0.0, 0.0, chamber)
                row = _write_at_rest(equations, trial, times, row, start, resting, out)
                if row == count:
                    return Status.STALLED, point.time, 0.0, n_steps, slack_time
                point = Point(start, point.x, 0.0, 0.0, chamber)
            if trial.inputs[FREE] > 0:
                tension, _rate = _ask(equations, Asked.REST_TENSION, point.time, point.x, 0.0, point.chamber, trial)
                if tension < 0:
                    point = Point(point.time, point.x, 0.0, 0.0, point.chamber)
                    phase = slack
                    continue
            point, speed_scale, h = _start_from_rest(equations, trial, point, last_time, stop)
            phase, previous_stages = moving, NO_STAGES
        while next_breakpoint < breakpoints.size and point.x >= breakpoints[next_breakpoint]:
            next_breakpoint += 1
        breakpoint_x = breakpoints[next_breakpoint] if next_breakpoint < breakpoints.size else stop
        full_h = h = _cut_at_breakpoint(h, point, min(breakpoint_x, stop))
        # No step across a sample of a measured pressure is accepted.
        sample = next_slope_change(sample, point.time, trial)
        if sample < trial.trace_time.size and point.time + h > trial.trace_time[sample]:
            h = trial.trace_time[sample] - point.time
        converged, error, end, stages = radau_step(
            equations, trial, point, starting_values(point, h, previous_stages), speed_scale, rtol
        )
        n_steps += 1
        if n_steps > MOST_STEPS:
            return Status.TOO_HARD, point.time, point.v, n_steps, slack_time
        factor = _judge_step(point, end, stages, converged, error, breakpoint_x, stop, speed_scale)
        if factor == 0:
            point = Point(
                point.time + h, point.x + 0.5 * h * max(point.v, 0.0), point.v, point.acceleration, end.chamber
            )
            phase, end_time = at_rest, point.time
            row = _write_at_rest(equations, trial, times, row, point.time, point, out)
            if row == count:
                return Status.STALLED, end_time, 0.0, n_steps, slack_time
            continue
        if factor < 1:
            h *= factor
            previous_stages = NO_STAGES
            continue
        ended = end.x >= stop
        fraction = _fraction_at(stop, h, point, end) if ended else 1.0
        slack_fraction = _slack_fraction(equations, trial, h, point, end) if trial.inputs[FREE] > 0 else 2.0
        if slack_fraction < 2 and (slack_fraction < fraction or not ended):
            if not slack_located:
                # The chamber pressure is less accurate within a step than at its ends, so a step is ended here.
                slack_located, previous_stages = True, NO_STAGES
                h *= slack_fraction
                continue
            ended, phase, slack_located, fraction = False, slack, False, slack_fraction
        row = _write_moving(equations, trial, times, row, fraction, h, point, end, out)
        if ended and point.time + fraction * h <= last_time:
            end_time = point.time + fraction * h
            _x, end_speed, _a = quintic(fraction, h, point, end)
            _write_at_rest(equations, trial, times, row, np.inf, _at_position(end, stop), out)
            return Status.ENDED, end_time, end_speed, n_steps, slack_time
        if row == count:
            return Status.RUNNING, end_time, end.v, n_steps, slack_time
        if phase == slack:
            x, v, a = quintic(fraction, h, point, end)
            chamber = point.chamber + fraction * (end.chamber - point.chamber)
            point = Point(point.time + fraction * h, x, v, a, chamber)
            continue
        # A drive that rises from zero may take the speed far beyond the estimate at the start.
        point, previous_stages, speed_scale = end, stages, max(speed_scale, end.v)
        h = _next_step_size(h, full_h, error)


@merged
def integrate_trials(equations, batch, first, last, rtol, out, ends, work, means):
    """Integrate the trials from `first` to `last` − 1 of a `BatchArrays`, and apply the camera's readout: `_integrate`,
    `read_by_rows`, `average_over`. Shapes: out (n_times, 4); ends (n_trials, 5).
    """
    for i in range(first, last):
        trace = slice(batch.trace_starts[i], batch.trace_starts[i + 1])
        bends = batch.bends[batch.bend_starts[i] : batch.bend_starts[i + 1]]
        trial = TrialArrays(
            batch.on[i], batch.inputs[i], batch.thetas[i], batch.trace_time[trace], batch.trace_pressure[trace], bends
        )
        rows = slice(batch.starts[i], batch.starts[i + 1])
        times = batch.times[rows]
        status, end_time, end_speed, n_steps, slack_time = _integrate(
            equations, trial, times, batch.breakpoints[i], batch.stops[i], rtol, out[rows], work
        )
        at_rest = equations.observed(0.0, 0.0, 0.0, equations.first_chamber(trial), trial)
        for row in range(batch.starts[i], batch.starts[i + 1]):
            out[row, 3] -= at_rest
        end = Point(end_time if status == Status.ENDED else np.inf, batch.stops[i], end_speed, 0.0, 0.0)
        row_delay = equations.row_delay(trial)
        if row_delay != 0:
            read_by_rows(times, out[rows], trial.inputs[RATIO], end, row_delay)
        averaging_time_squared = equations.averaged_over(trial)
        if averaging_time_squared > 0:
            average_over(times, out[rows], means, trial.inputs[RATIO], end, averaging_time_squared)
        ends[i, 0] = status.value
        ends[i, 1] = end_time
        ends[i, 2] = end_speed
        ends[i, 3] = n_steps
        ends[i, 4] = slack_time


@inlined
def _ask(equations, what, time, x, v, chamber, trial):
    """What `Asked` lists, and the rate of the chamber, where the tail is taut: x = r·y."""
    r, x, v = trial.inputs[RATIO], max(x, 0.0), max(v, 0.0)
    return equations.ask(what, time, x / r, v / r, x, v, chamber, trial)


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
def _judge_step(point, end, stages, converged, error, breakpoint_x, stop, scale):
    """Factor on the step for the next attempt: 1 where it is accepted, 0 where the vine stops at a time now known."""
    h = stages.h
    if not converged:
        return 0.25
    if end.v <= 0 or point.v + stages.z1 <= 0 or point.v + stages.z2 <= 0:
        if h * point.v <= 1e-9 * max(point.x, 1e-6) or point.v <= 1e-7 * scale:
            return 0.0
        return 0.3
    if error > 1:
        return max(0.2, 0.9 * error**-0.25)
    # Tolerance on reaching the breakpoint: relative to the whole travel, or to the breakpoint if there is no end.
    position_tolerance = 1e-7 * (stop if stop < np.inf else breakpoint_x)
    if breakpoint_x < stop and end.x > breakpoint_x + position_tolerance:
        return _fraction_at(breakpoint_x + 0.5 * position_tolerance, h, point, end)
    return 1.0


@inlined
def _next_step_size(h, full_h, error):
    """Size of the step after an accepted one, from its error (Hairer & Wanner IV.8; error estimate of order 3)."""
    new_h = h * min(6.0, 0.9 * max(error, 1e-8) ** -0.25)
    # After a step that was cut short with a small error, the size proposed before the cut is taken.
    return max(new_h, full_h) if full_h > h and error < 0.1 else new_h


@inlined
def _start_from_rest(equations, trial, point, until, stop):
    """Start of a motion: the point with its acceleration, the speed to be expected, and the first step size."""
    acceleration, _rate = _ask(equations, Asked.ACCELERATION, point.time, point.x, 0.0, point.chamber, trial)
    travel = min(stop - point.x, 0.5 * acceleration * (until - point.time) ** 2 + 1e-9)
    scale = _typical_speed(equations, trial, point.time, point.x, point.chamber, acceleration, travel)
    return Point(point.time, point.x, 0.0, acceleration, point.chamber), scale, 1e-4 * scale / acceleration


@compiled
def _typical_speed(equations, trial, time, x, chamber, start_acceleration, travel):
    """Speed of the motion, within a factor of two: ballistic over `travel`, or where the forces balance."""
    ballistic = (2 * start_acceleration * travel) ** 0.5
    speed = ballistic
    for _ in range(60):
        acceleration, _rate = _ask(equations, Asked.ACCELERATION, time, x, speed, chamber, trial)
        if acceleration > 0:
            return min(2 * speed, ballistic)
        speed *= 0.5
    return speed


@compiled
def _chamber_after(equations, trial, time, x, chamber, step):
    """Chamber pressure of a vine at rest after `step`; exact if the supply is proportional to the pressure deficit."""
    _a, rate = _ask(equations, Asked.ACCELERATION, time, x, 0.0, chamber, trial)
    if rate == 0:
        return chamber
    delta = 1e-6 * (abs(chamber) + 1e3)
    _a, higher = _ask(equations, Asked.ACCELERATION, time, x, 0.0, chamber + delta, trial)
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
        if _ask(equations, Asked.REST_ACCELERATION, time + step, x, 0.0, after, trial)[0] > 0:
            low, high = 0.0, step
            for _ in range(24):
                middle = 0.5 * (low + high)
                pressure = _chamber_after(equations, trial, time, x, chamber, middle)
                if _ask(equations, Asked.REST_ACCELERATION, time + middle, x, 0.0, pressure, trial)[0] > 0:
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
    """Time at which a drive that rises from zero at `time` has moved the vine by 10⁻⁹ of the travel, and the pressure
    of the chamber then: before, the drive is a difference of large forces below their rounding error. The time is later
    than `until` if it never does.
    """
    start, pressure = time, chamber
    while time + delay < until:
        after = _chamber_after(equations, trial, time, x, chamber, delay)
        if _ask(equations, Asked.REST_ACCELERATION, time + delay, x, 0.0, after, trial)[0] <= 0:
            break
        acceleration, _rate = _ask(equations, Asked.ACCELERATION, time + delay, x, 0.0, after, trial)
        travel = 0.5 * acceleration * delay**2
        speed = _typical_speed(equations, trial, time + delay, x, after, acceleration, travel)
        if delay * speed > 1e-9 * (x + 1e-3):
            break
        start, pressure = time + delay, after
        delay *= 2
    else:
        return until + 1.0, pressure
    return start, pressure


# ------------------------------------------------------------------------------
# Motion with a slack tail, which cannot push, for trials with `tail_slack: free`.
#
# The payload then falls freely, under the forces on the tail alone; the tip, whose mass is negligible, grows at the
# speed at which its own forces balance, Σ tip forces = 0 at the tail speed r·ẏ of the film that passes it. The tail
# is taut again when the tip has taken up its slack, x − r·y = 0. A payload that has fallen as far as the tip rests
# there: its push on the tip is neglected, so that growth is too slow from then on.
#
# The method is that of Bogacki & Shampine (Appl. Math. Lett. 2, 321, 1989), of order 3 with an error of order 2; within
# a step the motion is the cubic through both ends and the rates there.


class SlackState(NamedTuple):
    """State with a slack tail: position and speed of the tail, position of the tip, chamber pressure, SI."""

    x: float
    v: float
    y: float
    chamber: float


@compiled
def _slack_fraction(equations, trial, h, start, end):
    """Fraction of a step at which the tail's tension falls to zero, by bisection."""
    tension, _rate = _ask(equations, Asked.TENSION, end.time, end.x, end.v, end.chamber, trial)
    if tension >= 0:
        return 2.0
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        x, v, _a = quintic(middle, h, start, end)
        pressure = start.chamber + middle * (end.chamber - start.chamber)
        tension, _rate = _ask(equations, Asked.TENSION, start.time + middle * h, x, v, pressure, trial)
        if tension < 0:
            high = middle
        else:
            low = middle
    return high


@compiled
def _free_tip_speed(equations, trial, time, x, chamber, guess, moving):
    """Tail speed r·ẏ at a tip without tension, at which its forces balance, by the Illinois method; x = r·y."""
    f_low, _r = _ask(equations, Asked.TENSION if moving else Asked.REST_TENSION, time, x, 0.0, chamber, trial)
    if f_low <= 0:
        return 0.0
    low, high = 0.0, max(guess, 1e-6)
    f_high, _r = _ask(equations, Asked.TENSION, time, x, high, chamber, trial)
    factor = 1.01
    while f_high > 0 and high < 1e6:
        low, f_low = high, f_high
        high *= factor
        factor = min(factor * factor, 10.0)
        f_high, _r = _ask(equations, Asked.TENSION, time, x, high, chamber, trial)
    if low == 0.0 and guess > 0:
        near = 0.99 * guess
        f_near, _r = _ask(equations, Asked.TENSION, time, x, near, chamber, trial)
        if f_near > 0:
            low, f_low = near, f_near
        else:
            high, f_high = near, f_near
    for _ in range(100):
        if high - low <= 1e-13 * high or f_high == 0:
            break
        middle = high - f_high * (high - low) / (f_high - f_low)
        if not low < middle < high:
            middle = 0.5 * (low + high)
        f, _r = _ask(equations, Asked.TENSION, time, x, middle, chamber, trial)
        if f * f_high < 0:
            low, f_low = high, f_high
        else:
            f_low *= 0.5
        high, f_high = middle, f
        if low > high:
            low, high, f_low, f_high = high, low, f_high, f_low
    return high


@compiled
def _slack_rates(equations, trial, time, s, tip_speed, moving, rates):
    """Write the rates of a `SlackState` into `rates`, shape (4,); return the tail speed of the film at the tip, m/s."""
    r = trial.inputs[RATIO]
    u = _free_tip_speed(equations, trial, time, r * s.y, s.chamber, tip_speed, moving)
    _tension, chamber_rate = _ask(equations, Asked.TENSION, time, r * s.y, u, s.chamber, trial)
    fall, _rate = equations.ask(Asked.FREE_FALL, time, s.y, u / r, s.x, s.v, s.chamber, trial)
    rates[0] = s.v
    rates[1] = 0.0 if s.v <= 0 and fall < 0 else fall
    rates[2] = u / r
    rates[3] = chamber_rate
    return u


@compiled
def _moved_on(s, h, rates):
    """The state s after h at constant rates, shape (4,)."""
    return SlackState(s.x + h * rates[0], s.v + h * rates[1], s.y + h * rates[2], s.chamber + h * rates[3])


@compiled
def _slack_step(equations, trial, time, s, h, tip_speed, k):
    """One step: k (5, 4), with the rates at its start in row 0, gets those at its end in row 3. End, error, speed."""
    moving = tip_speed > 0
    u = _slack_rates(equations, trial, time + h / 2, _moved_on(s, h / 2, k[0]), tip_speed, moving, k[1])
    u = _slack_rates(equations, trial, time + 3 / 4 * h, _moved_on(s, 3 / 4 * h, k[1]), u, moving, k[2])
    for i in range(4):
        k[4, i] = (2 * k[0, i] + 3 * k[1, i] + 4 * k[2, i]) / 9
    end = _moved_on(s, h, k[4])
    u = _slack_rates(equations, trial, time + h, end, u, moving, k[3])
    for i in range(4):
        k[4, i] = h * (k[1, i] / 12 + k[2, i] / 9 - 5 / 72 * k[0, i] - k[3, i] / 8)
    return end, max(abs(k[4, 0]), trial.inputs[RATIO] * abs(k[4, 2])), u


@compiled
def _slack_at(part, h, s, end, k):
    """The state at the fraction `part` of a step."""
    return SlackState(
        _cubic(part, s.x, end.x, h * k[0, 0], h * k[3, 0]),
        _cubic(part, s.v, end.v, h * k[0, 1], h * k[3, 1]),
        _cubic(part, s.y, end.y, h * k[0, 2], h * k[3, 2]),
        _cubic(part, s.chamber, end.chamber, h * k[0, 3], h * k[3, 3]),
    )


@compiled
def _cubic(part, start, end, first, last):
    """The cubic through both ends of a step, with these changes over a step at the rates there."""
    change = end - start
    bend = first - change
    return start + part * (change + (1 - part) * (bend + part * (change - last - bend)))


@compiled
def _event_fraction(kind, stop, r, h, s, end, k):
    """Fraction of a step at which growth ends (`kind` ENDED) or the tail is taut again (TAUT), by bisection."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        state = _slack_at(middle, h, s, end, k)
        before = r * state.y < stop if kind == Status.ENDED else state.x > r * state.y
        if before:
            low = middle
        else:
            high = middle
    return high


@compiled
def _write_slack(equations, trial, times, row, time, fraction, h, s, end, k, u, u_end, out):
    """Fill the rows of `out` from `row` up to a fraction of a step with r·y, r·ẏ, r·ÿ of the tip; the next row."""
    r = trial.inputs[RATIO]
    while row < times.size and times[row] <= time + fraction * h:
        state = _slack_at((times[row] - time) / h, h, s, end, k)
        speed = _free_tip_speed(equations, trial, times[row], r * state.y, state.chamber, u, u > 0)
        out[row, 0] = r * state.y
        out[row, 1] = speed
        out[row, 2] = (u_end - u) / h
        out[row, 3] = equations.observed(times[row], r * state.y, speed, state.chamber, trial)
        row += 1
    return row


@compiled
def _follow_slack(equations, trial, times, row, start, stop, rtol, out, k):
    """Integrate a slack phase until the tail is taut again, growth ends or the last time is reached."""
    time, until = start.time, times[times.size - 1]
    r = trial.inputs[RATIO]
    s = SlackState(start.x, start.v, start.x / r, start.chamber)
    u = _slack_rates(equations, trial, time, s, start.v, start.v > 0, k[0])
    h = 1e-3 * (until - time)
    allowed = 1e-3 * rtol * stop
    for _ in range(MOST_STEPS):
        end, error, u_end = _slack_step(equations, trial, time, s, h, u, k)
        if not error <= allowed:
            h *= max(0.2, 0.9 * (allowed / error) ** (1 / 3)) if error < 1e300 else 0.1
            continue
        status, fraction = Status.RUNNING, 1.0
        if r * end.y >= stop:
            status, fraction = Status.ENDED, _event_fraction(Status.ENDED, stop, r, h, s, end, k)
        elif end.x <= r * end.y and end.v < u_end:
            status, fraction = Status.TAUT, _event_fraction(Status.TAUT, stop, r, h, s, end, k)
        row = _write_slack(equations, trial, times, row, time, fraction, h, s, end, k, u, u_end, out)
        if row == times.size and time + fraction * h > until:
            return Status.RUNNING, row, Point(until, end.x, end.v, 0.0, end.chamber), u_end
        if status != Status.RUNNING:
            state = _slack_at(fraction, h, s, end, k)
            return status, row, Point(time + fraction * h, r * state.y, max(state.v, 0.0), 0.0, state.chamber), u_end
        time += h
        s, tip = end, stop / r + end.y
        if s.x > tip:  # a payload that has reached the tip rests there
            s = SlackState(tip, min(s.v, u_end / r), s.y, s.chamber)
        u = _slack_rates(equations, trial, time, s, u_end, u_end > 0, k[0])
        h *= min(5.0, 0.9 * (allowed / max(error, 1e-6 * allowed)) ** (1 / 3))
    return Status.TOO_HARD, row, Point(time, s.x, s.v, 0.0, s.chamber), u
