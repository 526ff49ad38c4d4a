"""Radau IIA of order 5 for one trajectory of a vine, from rest to the end of its growth.

The equation is hard in four places. At rest the slope of v^0.37 is infinite, so any method of fixed step falls to order
1.4; near the yield pressure the speed relaxes in microseconds while growth takes minutes (a stiffness of 10⁸); towards
the end of a bare vine the mass goes to nothing; and a vine may stall, after which it stays at rest until the drive
exceeds what holds it. An implicit method that is stable at any step, with the step chosen from its own error, does
all four.

`_integrate` follows one trajectory. A vine is at rest (`_wait_for_drive`, `_set_off`), moving (`_limited_step`,
`radau_step`, `_judge_step`, `_next_step_size`) or has a slack tail (`vinetrack.dynamics.slack_tail`). Only numbers,
tuples and arrays here, nothing that numba could not compile. The first argument of most functions, `equations`, holds
the compiled functions of one model, and `trial` the arrays of one trial: see `vinetrack.dynamics.equations`.

Source of the method: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (Springer, 1996), sections
IV.5 and IV.8.
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
    next_slope_change,
)
from vinetrack.dynamics.radau import NO_STAGES, first_stages, quintic, radau_step
from vinetrack.dynamics.row_readout import read_by_rows
from vinetrack.dynamics.time_average import average_over
from vinetrack.effects import TrialInputs

TRAVEL_RATIO = TrialInputs._fields.index("travel_ratio")
"""Convention: where the travel ratio stands in a row of inputs."""

MOST_STEPS = 20_000
"""Steps before a trajectory is given up, chosen: trajectories of the catalogue take 20 to 600. At half and at twice
nothing changes but how long a hopeless one takes, about 20 ms at 1 µs a step."""

EASY = 0.1
"""Error, in tolerances, of a shortened step below which the next takes up the length wished before; chosen: an error
grows with the fourth power of the step, so that at 0.1 a step 1.8 times as long would just do. At half it is taken up
less often, at twice more of such steps are refused."""

BATCH = (
    "starts", "times", "on", "inputs", "thetas", "trace_starts", "trace_time", "trace_pressure", "bend_starts", "bends",
    "breakpoints", "stops", "rtol", "out", "ends", "work",
    "means",
)  # fmt: skip
"""Arguments of `integrate_trials` behind the equations, in their order."""

MOVING, AT_REST, SLACK = 0, 1, 2
"""Phases of a trajectory; a convention of this file."""

ACCEPTED, REFUSED, STANDSTILL = 0, 1, 2
"""What becomes of a step (`_judge_step`); a convention of this file."""


@compiled
def _integrate(equations, trial, times, breakpoints, stop, rtol, out, work):
    """Follow one trajectory from rest at time 0.

    Parameters
    ----------
    times : array (n_times,), s since release, increasing. Before 0 the vine is at rest; after the end of growth it
        stays at `stop`, speed and acceleration 0.
    breakpoints : array, rising, padded with infinity: where along x the slope of a force changes abruptly, such as
        where the film's mass reaches its floor, m. A step ends at each, for none is accurate across it.
    stop : tail travel at the end of growth, m; infinite for a body that moves as a whole.
    rtol : local tolerance on the speed, relative.
    out : array (n_times, 4) to be filled: x, v, a of the tail and the position of the leading edge that the camera
        reports; while a tail is slack, r times those of the leading edge.
    work : array (7, 4) for `follow_slack`.

    Returns
    -------
    (status, end_time, end_speed, n_steps, slack_time)
        `end_time` is that of the end of growth, of the last stall or of where a trajectory that is TOO_HARD was given
        up, NaN where there was none of them; `slack_time` when the tail first went slack, NaN where it did not or may
        not.
    """
    count = times.size
    point = Point(0.0, 0.0, 0.0, 0.0, equations.first_chamber(trial))
    row = _write_at_rest(equations, trial, times, 0, 0.0, point, out)
    end_time = slack_time = np.nan
    if row == count:
        return RUNNING, end_time, 0.0, 0, slack_time
    until = times[count - 1]
    phase, closed_in = AT_REST, False
    before, h, scale = NO_STAGES, 0.0, 0.0
    passed = sample = n_steps = 0
    while True:
        if phase == SLACK:
            slack_time = point.time if np.isnan(slack_time) else slack_time
            status, row, point, end_speed = equations.follow_slack(
                equations, trial, times, row, point, stop, rtol, out, work
            )
            if status == ENDED:
                _write_at_rest(equations, trial, times, row, np.inf, _at(point, stop), out)
            if status != TAUT:
                end_time = end_time if status == RUNNING else point.time
                return status, end_time, end_speed, n_steps, slack_time
            phase = AT_REST if point.v <= 0 else MOVING
            point, scale, h = _pulled_taut(equations, trial, point, scale)
            before = NO_STAGES
        if phase == AT_REST:
            if equations.rest_acceleration(point.time, point.x, point.chamber, trial) <= 0:
                start, chamber = _wait_for_drive(equations, trial, point, until)
                resting = Point(point.time, point.x, 0.0, 0.0, chamber)
                row = _write_at_rest(equations, trial, times, row, start, resting, out)
                if row == count:
                    return STALLED, point.time, 0.0, n_steps, slack_time
                point = Point(start, point.x, 0.0, 0.0, chamber)
            if equations.slack_at_rest(equations, trial, point.time, point.x, point.chamber):
                point = Point(point.time, point.x, 0.0, 0.0, point.chamber)
                phase = SLACK
                continue
            point, scale, h = _set_off(equations, trial, point, until, stop)
            phase, before = MOVING, NO_STAGES
        while passed < breakpoints.size and point.x >= breakpoints[passed]:
            passed += 1
        breakpoint_x = breakpoints[passed] if passed < breakpoints.size else stop
        wished = _limited_step(h, point, min(breakpoint_x, stop))
        sample = next_slope_change(sample, point.time, trial)
        h = _up_to_sample(wished, point.time, sample, trial)
        converged, error, end, stages = radau_step(equations, trial, point, first_stages(point, h, before), scale, rtol)
        n_steps += 1
        if n_steps > MOST_STEPS:
            return TOO_HARD, point.time, point.v, n_steps, slack_time
        verdict, factor = _judge_step(point, end, stages, converged, error, breakpoint_x, stop, scale)
        if verdict == STANDSTILL:
            point = Point(
                point.time + h, point.x + 0.5 * h * max(point.v, 0.0), point.v, point.acceleration, end.chamber
            )
            phase, end_time = AT_REST, point.time
            row = _write_at_rest(equations, trial, times, row, point.time, point, out)
            if row == count:
                return STALLED, end_time, 0.0, n_steps, slack_time
            continue
        if verdict == REFUSED:
            h *= factor
            before = NO_STAGES
            continue
        ended = end.x >= stop
        fraction = _fraction_at(stop, h, point, end) if ended else 1.0
        slack = equations.slack_fraction(equations, trial, h, point, end)
        if slack < 2 and (slack < fraction or not ended):
            if not closed_in:
                # Within a step the chamber's pressure is known less well than at its ends: end one here.
                closed_in, before = True, NO_STAGES
                h *= slack
                continue
            ended, phase, closed_in, fraction = False, SLACK, False, slack
        row = _write_moving(equations, trial, times, row, fraction, h, point, end, out)
        if ended and point.time + fraction * h <= until:
            end_time = point.time + fraction * h
            _x, end_speed, _a = quintic(fraction, h, point, end)
            _write_at_rest(equations, trial, times, row, np.inf, _at(end, stop), out)
            return ENDED, end_time, end_speed, n_steps, slack_time
        if row == count:
            return RUNNING, end_time, end.v, n_steps, slack_time
        if phase == SLACK:
            point = _within_step(fraction, h, point, end)
            continue
        # A drive that rises from nothing takes the speed far beyond what the start let expect.
        point, before, scale = end, stages, max(scale, end.v)
        h = _next_step_size(h, wished, error)


@compiled
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
    """`_integrate` for many trials.

    Parameters
    ----------
    equations : the compiled functions of the model.
    starts, times : trial i has times[starts[i]:starts[i + 1]], s since release; shapes (n_trials + 1,) and (n_times,).
    on, inputs, thetas : which effects act, fields of `TrialInputs` and parameters: a row for each trial.
    trace_starts, trace_time, trace_pressure : measured pressures, s and Pa, laid end to end like the times.
    bend_starts, bends : bends laid end to end: rows of start, arc and radius, m.
    breakpoints, stops : as those of `_integrate`, m: shapes (n_trials, n_breakpoints), padded with infinity, and
        (n_trials,).
    rtol : local tolerance on the speed, relative.
    out, ends : filled, shapes (n_times, 4) and (n_trials, 5): the latter status, end time, end speed, number of steps,
        time of slack.
    work : array (7, 4), overwritten.
    means : array, overwritten, as long as the longest trial.
    """
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
        delay = equations.row_delay(trial)
        if delay != 0:
            read_by_rows(times[rows], out[rows], inputs[i, TRAVEL_RATIO], end, delay)
        square = equations.averaged_over(trial)
        if square > 0:
            average_over(times[rows], out[rows], means, inputs[i, TRAVEL_RATIO], end, square)
        ends[i, 0] = status
        ends[i, 1] = end_time
        ends[i, 2] = end_speed
        ends[i, 3] = n_steps
        ends[i, 4] = slack_time


@inlined
def _at(point, x):
    """The same point at another position."""
    return Point(point.time, x, point.v, point.acceleration, point.chamber)


@inlined
def _write_at_rest(equations, trial, times, row, until, point, out):
    """Fill the rows of `out` from `row` up to the time `until` with a vine at rest; returns the next row."""
    while row < times.size and times[row] <= until:
        # Before release the camera sees the vine as it stood at release.
        out[row, 3] = equations.observed(max(times[row], 0.0), point.x, 0.0, point.chamber, trial)
        out[row, 0] = point.x
        out[row, 1] = 0.0
        out[row, 2] = 0.0
        row += 1
    return row


@inlined
def _write_moving(equations, trial, times, row, fraction, h, start, end, out):
    """Fill the rows of `out` from `row` up to a fraction of a step; returns the next row."""
    while row < times.size and times[row] <= start.time + fraction * h:
        part = (times[row] - start.time) / h
        x, v, a = quintic(part, h, start, end)
        chamber = start.chamber + part * (end.chamber - start.chamber)
        out[row, 0] = x
        out[row, 1] = v
        out[row, 2] = a
        out[row, 3] = equations.observed(times[row], x, v, chamber, trial)
        row += 1
    return row


@inlined
def _within_step(fraction, h, start, end):
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
def _limited_step(h, point, x_limit):
    """The step size, cut so that the step ends just behind the next breakpoint or the end of growth."""
    ahead = x_limit - point.x
    if point.v > 0 and h * point.v > 1.05 * ahead:
        return 1.02 * ahead / point.v
    return h


@inlined
def _up_to_sample(h, time, sample, trial):
    """The step size, cut at the next sample of a measured pressure: a step across it would be refused repeatedly."""
    if sample < trial.trace_time.size and time + h > trial.trace_time[sample]:
        return trial.trace_time[sample] - time
    return h


@inlined
def _judge_step(point, end, stages, converged, error, breakpoint_x, stop, scale):
    """Whether a step counts, and otherwise the factor on its size for the next attempt.

    STANDSTILL: the vine stops within the step, which is by now so short that the moment is known.
    """
    h = stages.h
    if not converged:
        return REFUSED, 0.25
    if end.v <= 0 or point.v + stages.z1 <= 0 or point.v + stages.z2 <= 0:
        if h * point.v <= 1e-9 * max(point.x, 1e-6) or point.v <= 1e-7 * scale:
            return STANDSTILL, 1.0
        return REFUSED, 0.3
    if error > 1:
        return REFUSED, max(0.2, 0.9 * error**-0.25)
    # How near counts as at the breakpoint: of the whole way, or of the way so far where a body has no end.
    near = 1e-7 * (stop if stop < np.inf else breakpoint_x)
    if breakpoint_x < stop and end.x > breakpoint_x + near:
        return REFUSED, _fraction_at(breakpoint_x + 0.5 * near, h, point, end)
    return ACCEPTED, 1.0


@inlined
def _next_step_size(h, wished, error):
    """Size of the step after an accepted one, from its error: Hairer & Wanner IV.8, an estimate of order 3."""
    longer = h * min(6.0, 0.9 * max(error, 1e-8) ** -0.25)
    return max(longer, wished) if wished > h and error < EASY else longer


@inlined
def _set_off(equations, trial, point, until, stop):
    """From rest: the point with its acceleration, the speed that the motion will reach, and the first step."""
    acceleration, _rate = equations.rates(point.time, point.x, 0.0, point.chamber, trial)
    room = min(stop - point.x, 0.5 * acceleration * (until - point.time) ** 2 + 1e-9)
    scale = _typical_speed(equations, trial, point.time, point.x, point.chamber, acceleration, room)
    return Point(point.time, point.x, 0.0, acceleration, point.chamber), scale, 1e-4 * scale / acceleration


@inlined
def _pulled_taut(equations, trial, point, scale):
    """After a slack phase: the point with its acceleration, the speed to be expected, and the first step."""
    time, x, v, _acceleration, chamber = point
    acceleration, _rate = equations.rates(time, x, v, chamber, trial)
    scale = max(scale, v)
    return Point(time, x, v, acceleration, chamber), scale, 1e-2 * max(v, 1e-3 * scale) / max(abs(acceleration), 1e-9)


@compiled
def _typical_speed(equations, trial, time, x, chamber, start_acceleration, room):
    """Speed that the motion will reach, within a factor of two: ballistic over `room`, or where the forces balance."""
    ballistic = (2 * start_acceleration * room) ** 0.5
    speed = ballistic
    for _ in range(60):
        acceleration, _rate = equations.rates(time, x, speed, chamber, trial)
        if acceleration > 0:
            return min(2 * speed, ballistic)
        speed *= 0.5
    return speed


@compiled
def _filled(equations, trial, time, x, chamber, step):
    """Pressure of the chamber of a vine at rest after `step`; exact for a supply in proportion to what is lacking."""
    _a, rate = equations.rates(time, x, 0.0, chamber, trial)
    if rate == 0:
        return chamber
    delta = 1e-6 * (abs(chamber) + 1e3)
    _a, higher = equations.rates(time, x, 0.0, chamber + delta, trial)
    decay = step * (higher - rate) / delta
    return chamber + step * rate * (np.expm1(decay) / decay if abs(decay) > 1e-12 else 1.0)


@compiled
def _wait_for_drive(equations, trial, point, until):
    """First instant at which the drive moves a vine that rests at `point`, and the chamber's pressure then.

    The instant is past `until` where none does. The chamber goes on filling meanwhile.
    """
    time, x, _v, _acceleration, chamber = point
    steps = max(256, 2 * trial.trace_time.size)
    step = (until - time) / steps
    for _step in range(steps):
        after = _filled(equations, trial, time, x, chamber, step)
        if equations.rest_acceleration(time + step, x, after, trial) > 0:
            low, high = 0.0, step
            for _ in range(24):
                middle = 0.5 * (low + high)
                pressure = _filled(equations, trial, time, x, chamber, middle)
                if equations.rest_acceleration(time + middle, x, pressure, trial) > 0:
                    high = middle
                else:
                    low = middle
            pressure = _filled(equations, trial, time, x, chamber, high)
            return _visible_start(equations, trial, time + high, until, x, pressure, 1e-7 * step)
        time += step
        chamber = after
    return until + 1.0, chamber


@compiled
def _visible_start(equations, trial, time, until, x, chamber, delay):
    """When a drive that rises from nothing at `time` has moved a vine by 10⁻⁹ of its way, and the chamber's pressure.

    Before, the drive is a small difference of large forces, no more than rounding, and the vine as good as at rest.
    """
    start, pressure = time, chamber
    while time + delay < until:
        after = _filled(equations, trial, time, x, chamber, delay)
        if equations.rest_acceleration(time + delay, x, after, trial) <= 0:
            break
        acceleration, _rate = equations.rates(time + delay, x, 0.0, after, trial)
        room = 0.5 * acceleration * delay**2
        speed = _typical_speed(equations, trial, time + delay, x, after, acceleration, room)
        if delay * speed > 1e-9 * (x + 1e-3):
            break
        start, pressure = time + delay, after
        delay *= 2
    return start, pressure
