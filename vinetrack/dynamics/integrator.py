"""Radau IIA of order 5 for one trajectory of a vine, from rest to the end of its growth.

The equation is hard in four places. At rest the slope of v^0.37 is infinite, so any method of fixed step falls to order
1.4; near the yield pressure the speed relaxes in microseconds while growth takes minutes (a stiffness of 10⁸); towards
the end of a bare vine the mass goes to nothing; and a vine may stall, after which it stays at rest until the drive
exceeds what holds it. An implicit method that is stable at any step, with the step chosen from its own error, does
all four.

This file is the text of a compiled kernel: `vinetrack.dynamics.kernel` sets what follows the marked line behind the
`rates` of one model and `vinetrack.dynamics.radau`, so that the compiler sees all. Only numbers and arrays, nothing of
Python's.

Source of the method: Hairer & Wanner, Solving Ordinary Differential Equations II, sections IV.5 and IV.8.
"""

import numpy as np
from numba import njit

from vinetrack.dynamics.breakpoints import next_corner
from vinetrack.dynamics.radau import C1, C2, carry_on, quintic, radau_step
from vinetrack.dynamics.slack_tail import TAUT, follow_slack


@njit(nogil=True)
def rates(time, x, v, chamber, on, rig, theta, trace_time, trace_pressure, bends):
    """Acceleration of the tail and rate of change of the chamber's pressure: here stand those of one model."""
    raise NotImplementedError


@njit(nogil=True)
def rest_acceleration(time, x, chamber, on, rig, theta, trace_time, trace_pressure, bends):
    """Acceleration with which a vine at rest would set off, what holds it at rest included."""
    raise NotImplementedError


@njit(nogil=True)
def observed(time, x, v, chamber, on, rig, theta, trace_time, trace_pressure, bends):
    """Position of the leading edge that the camera reports."""
    raise NotImplementedError


@njit(nogil=True)
def first_chamber(on, rig, theta):
    """Pressure of the chamber at release."""
    raise NotImplementedError


@njit(nogil=True)
def tip_tension(time, x, v, chamber, resting, on, rig, theta, trace_time, trace_pressure, bends):
    """Tension that the tip leaves for the tail, and rate of change of the chamber's pressure."""
    raise NotImplementedError


TAIL_FREE = (
    False  #: whether `vinetrack.dynamics.slack_tail` is set behind; `rig[FREE]` and `rig[RATIO]` are then looked at
)
FREE = RATIO = 0

# ---- what follows is set behind the rates of one model ----
RUNNING, ENDED, STALLED, TOO_HARD = 0, 1, 2, 3
MOST_STEPS = 20_000
EASY = 0.1  # error, in tolerances, of a step cut short that leaves its length before the cut to be believed


@njit(nogil=True)
def typical_speed(time, x, chamber, on, rig, theta, trace_time, trace_pressure, bends, start_acceleration, room):
    """Speed that the motion will reach, within a factor of two: ballistic over `room`, or where the forces balance."""
    ballistic = (2 * start_acceleration * room) ** 0.5
    speed = ballistic
    for _ in range(60):
        acceleration, _rate = rates(time, x, speed, chamber, on, rig, theta, trace_time, trace_pressure, bends)
        if acceleration > 0:
            return min(2 * speed, ballistic)
        speed *= 0.5
    return speed


@njit(nogil=True)
def time_of_end(stop, h, x0, v0, a0, x1, v1, a1):
    """Fraction of a step at which x reaches `stop`, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        x, _v, _a = quintic(middle, h, x0, v0, a0, x1, v1, a1)
        if x < stop:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@njit(nogil=True)
def time_of_slack(
    time, h, x0, v0, a0, x1, v1, a1, chamber, chamber_end, on, rig, theta, trace_time, trace_pressure, bends
):
    """Fraction of a step at which the tail's tension comes to nothing, by bisection; 2 where it is taut at the end."""
    tension, _rate = tip_tension(
        time + h, x1, v1, chamber_end, False, on, rig, theta, trace_time, trace_pressure, bends
    )
    if tension >= 0:
        return 2.0
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        x, v, _a = quintic(middle, h, x0, v0, a0, x1, v1, a1)
        pressure = chamber + middle * (chamber_end - chamber)
        tension, _rate = tip_tension(
            time + middle * h, x, v, pressure, False, on, rig, theta, trace_time, trace_pressure, bends
        )
        if tension < 0:
            high = middle
        else:
            low = middle
    return high


@njit(nogil=True)
def filled(time, x, chamber, step, on, rig, theta, trace_time, trace_pressure, bends):
    """Pressure of the chamber of a vine at rest after `step`; exact for a supply in proportion to what is lacking."""
    _a, rate = rates(time, x, 0.0, chamber, on, rig, theta, trace_time, trace_pressure, bends)
    if rate == 0:
        return chamber
    delta = 1e-6 * (abs(chamber) + 1e3)
    _a, other = rates(time, x, 0.0, chamber + delta, on, rig, theta, trace_time, trace_pressure, bends)
    decay = step * (other - rate) / delta
    return chamber + step * rate * (np.expm1(decay) / decay if abs(decay) > 1e-12 else 1.0)


@njit(nogil=True)
def once_it_shows(time, until, x, chamber, delay, on, rig, theta, trace_time, trace_pressure, bends):
    """When a drive that rises from nothing at `time` has moved a vine by 10⁻⁹ of its way, and the chamber's pressure.

    Before, the drive is a small difference of large forces, no more than rounding, and the vine as good as at rest.
    """
    start, pressure = time, chamber
    while time + delay < until:
        after = filled(time, x, chamber, delay, on, rig, theta, trace_time, trace_pressure, bends)
        if rest_acceleration(time + delay, x, after, on, rig, theta, trace_time, trace_pressure, bends) <= 0:
            break
        slope, _rate = rates(time + delay, x, 0.0, after, on, rig, theta, trace_time, trace_pressure, bends)
        room = 0.5 * slope * delay**2
        speed = typical_speed(time + delay, x, after, on, rig, theta, trace_time, trace_pressure, bends, slope, room)
        if delay * speed > 1e-9 * (x + 1e-3):
            break
        start, pressure = time + delay, after
        delay *= 2
    return start, pressure


@njit(nogil=True)
def wait_for_drive(time, until, x, chamber, on, rig, theta, trace_time, trace_pressure, bends):
    """First instant after `time` at which the drive moves a vine at rest, and the chamber's pressure then.

    The instant is past `until` where none does. The chamber goes on filling meanwhile.
    """
    steps = max(256, 2 * trace_time.size)
    step = (until - time) / steps
    for _step in range(steps):
        after = filled(time, x, chamber, step, on, rig, theta, trace_time, trace_pressure, bends)
        if rest_acceleration(time + step, x, after, on, rig, theta, trace_time, trace_pressure, bends) > 0:
            low, high = 0.0, step
            for _ in range(24):
                middle = 0.5 * (low + high)
                pressure = filled(time, x, chamber, middle, on, rig, theta, trace_time, trace_pressure, bends)
                if rest_acceleration(time + middle, x, pressure, on, rig, theta, trace_time, trace_pressure, bends) > 0:
                    high = middle
                else:
                    low = middle
            pressure = filled(time, x, chamber, high, on, rig, theta, trace_time, trace_pressure, bends)
            return once_it_shows(
                time + high, until, x, pressure, 1e-7 * step, on, rig, theta, trace_time, trace_pressure, bends
            )
        time += step
        chamber = after
    return until + 1.0, chamber


@njit(nogil=True)
def rest_from(times, k, x, chamber, on, rig, theta, trace_time, trace_pressure, bends, out):
    """Fill the rows of `out` from k with a vine at rest at x."""
    for i in range(k, times.size):
        out[i, 3] = observed(times[i], x, 0.0, chamber, on, rig, theta, trace_time, trace_pressure, bends)
        out[i, 0] = x
        out[i, 1] = 0.0
        out[i, 2] = 0.0


@njit(nogil=True)
def integrate(times, on, rig, theta, trace_time, trace_pressure, bends, kinks, stop, rtol, out):
    """Follow one trajectory from rest at time 0.

    Fills `out` (n_times, 4) with x, v, a of the tail and the position of the leading edge that the camera reports, at
    `times`; while a tail is slack, with r times those of the leading edge.

    `kinks`, rising, is where along x the forces have corners, such as where the film's mass reaches its floor: a step
    ends at each, for none is good across it. `times` must increase; before 0 the vine is at rest, after the end of
    growth (x = `stop`; infinite for a body that moves as a whole) it stays there with its last speed and acceleration
    given as 0.

    Returns
    -------
    (status, end_time, end_speed, n_steps, slack_time)
        `end_time` is that of the end of growth or of the last stall, NaN where there was neither; `slack_time` when
        the tail first went slack, NaN where it did not or may not.
    """
    count = times.size
    k = 0
    chamber = first_chamber(on, rig, theta)
    while k < count and times[k] <= 0:
        out[k, 3] = observed(0.0, 0.0, 0.0, chamber, on, rig, theta, trace_time, trace_pressure, bends)
        out[k, 0] = 0.0
        out[k, 1] = 0.0
        out[k, 2] = 0.0
        k += 1
    if k == count:
        return RUNNING, float("nan"), 0.0, 0, float("nan")
    until = times[count - 1]
    time, x, v = 0.0, 0.0, 0.0
    n_steps = 0
    end_time = float("nan")
    at_rest = True
    loose = closed_in = False
    slack_time = float("nan")
    h = 0.0
    slope = 0.0
    scale = 0.0
    z1 = z2 = z3 = 0.0
    have_guess = False
    h_before = 1.0
    passed = corner = 0
    while True:
        if TAIL_FREE and loose:
            if slack_time != slack_time:
                slack_time = time
            status, k, time, x, v, chamber, end_speed = follow_slack(
                times,
                k,
                time,
                x,
                v,
                chamber,
                on,
                rig,
                theta,
                trace_time,
                trace_pressure,
                bends,
                rig[RATIO],
                stop,
                rtol,
                out,
            )
            if status != TAUT:
                end_time = time if status == ENDED else end_time
                if status == ENDED:
                    rest_from(times, k, stop, chamber, on, rig, theta, trace_time, trace_pressure, bends, out)
                return status, end_time, end_speed, n_steps, slack_time
            loose, at_rest, have_guess = False, v <= 0, False
            slope, _rate = rates(time, x, v, chamber, on, rig, theta, trace_time, trace_pressure, bends)
            scale = max(scale, v)
            h = 1e-2 * max(v, 1e-3 * scale) / max(abs(slope), 1e-9)
        if at_rest:
            if rest_acceleration(time, x, chamber, on, rig, theta, trace_time, trace_pressure, bends) <= 0:
                start, chamber = wait_for_drive(
                    time, until, x, chamber, on, rig, theta, trace_time, trace_pressure, bends
                )
                while k < count and times[k] <= start:
                    out[k, 3] = observed(times[k], x, 0.0, chamber, on, rig, theta, trace_time, trace_pressure, bends)
                    out[k, 0] = x
                    out[k, 1] = 0.0
                    out[k, 2] = 0.0
                    k += 1
                if k == count:
                    return STALLED, time, 0.0, n_steps, slack_time
                time = start
            if TAIL_FREE and rig[FREE] > 0:
                tension, _rate = tip_tension(
                    time, x, 0.0, chamber, True, on, rig, theta, trace_time, trace_pressure, bends
                )
                if tension < 0:
                    at_rest, loose, v = False, True, 0.0
                    continue
            slope, _rate = rates(time, x, 0.0, chamber, on, rig, theta, trace_time, trace_pressure, bends)
            at_rest = False
            room = min(stop - x, 0.5 * slope * (until - time) ** 2 + 1e-9)
            scale = typical_speed(time, x, chamber, on, rig, theta, trace_time, trace_pressure, bends, slope, room)
            h = 1e-4 * scale / slope
            v = 0.0
            have_guess = False
        while passed < kinks.size and x >= kinks[passed]:
            passed += 1
        kink = kinks[passed] if passed < kinks.size else stop
        ahead = min(kink, stop) - x
        if v > 0 and h * v > 1.05 * ahead:
            h = 1.02 * ahead / v
        wished = h
        if trace_time.size > 0:
            # Between its samples a trace is straight; a step across a corner of it would be refused again and again.
            corner = next_corner(corner, time, trace_time, trace_pressure)
            if corner < trace_time.size and time + h > trace_time[corner]:
                h = trace_time[corner] - time
        if have_guess:
            # The last step's polynomial, carried on into this one, relative to where this one starts.
            r = h / h_before
            p1, p2, p3 = carry_on(1 + C1 * r, z1, z2, z3), carry_on(1 + C2 * r, z1, z2, z3), carry_on(1 + r, z1, z2, z3)
            w1, w2, w3 = p1 - z3, p2 - z3, p3 - z3
            w1, w2, w3 = max(w1, -0.9 * v), max(w2, -0.9 * v), max(w3, -0.9 * v)
        else:
            w1, w2, w3 = C1 * h * slope, C2 * h * slope, h * slope
            w1, w2, w3 = max(w1, -0.9 * v), max(w2, -0.9 * v), max(w3, -0.9 * v)
        ok, error, x_end, v_end, slope_end, chamber_end, w1, w2, w3 = radau_step(
            time, x, v, chamber, slope, h, w1, w2, w3, scale, rtol, on, rig, theta, trace_time, trace_pressure, bends
        )
        n_steps += 1
        if n_steps > MOST_STEPS:
            return TOO_HARD, time, v, n_steps, slack_time
        if not ok:
            h *= 0.25
            have_guess = False
            continue
        if v_end <= 0 or v + w1 <= 0 or v + w2 <= 0:
            # It stops within this step. Close in on the moment, then let it rest.
            if h * v <= 1e-9 * max(x, 1e-6) or v <= 1e-7 * scale:
                at_rest = True
                x += 0.5 * h * max(v, 0.0)
                time += h
                chamber = chamber_end
                end_time = time
                while k < count and times[k] <= time:
                    out[k, 3] = observed(times[k], x, 0.0, chamber, on, rig, theta, trace_time, trace_pressure, bends)
                    out[k, 0] = x
                    out[k, 1] = 0.0
                    out[k, 2] = 0.0
                    k += 1
                if k == count:
                    return STALLED, end_time, 0.0, n_steps, slack_time
                continue
            h *= 0.3
            have_guess = False
            continue
        if error > 1:
            h *= max(0.2, 0.9 * error**-0.25)
            have_guess = False
            continue
        if kink < stop and x_end > kink + 1e-7 * stop:
            h *= time_of_end(kink + 5e-8 * stop, h, x, v, slope, x_end, v_end, slope_end)
            have_guess = False
            continue
        last = time + h
        ended = x_end >= stop
        fraction = time_of_end(stop, h, x, v, slope, x_end, v_end, slope_end) if ended else 1.0
        if TAIL_FREE and rig[FREE] > 0:
            slack = time_of_slack(
                time, h, x, v, slope, x_end, v_end, slope_end, chamber, chamber_end,
                on, rig, theta, trace_time, trace_pressure, bends,
            )  # fmt: skip
            if slack < 2 and (slack < fraction or not ended):
                if not closed_in:
                    # Within a step the chamber's pressure is known less well than at its ends: end one here.
                    closed_in, have_guess = True, False
                    h *= slack
                    continue
                ended, loose, closed_in, fraction = False, True, False, slack
        while k < count and times[k] <= time + fraction * h:
            part = (times[k] - time) / h
            now_x, now_v, now_a = quintic(part, h, x, v, slope, x_end, v_end, slope_end)
            now_chamber = chamber + part * (chamber_end - chamber)
            out[k, 0] = now_x
            out[k, 1] = now_v
            out[k, 2] = now_a
            out[k, 3] = observed(times[k], now_x, now_v, now_chamber, on, rig, theta, trace_time, trace_pressure, bends)
            k += 1
        if ended and time + fraction * h <= until:
            end_time = time + fraction * h
            _x, end_speed, _a = quintic(fraction, h, x, v, slope, x_end, v_end, slope_end)
            rest_from(times, k, stop, chamber_end, on, rig, theta, trace_time, trace_pressure, bends, out)
            return ENDED, end_time, end_speed, n_steps, slack_time
        if k == count:
            return RUNNING, end_time, v_end, n_steps, slack_time
        if loose:
            chamber += fraction * (chamber_end - chamber)
            x, v, _a = quintic(fraction, h, x, v, slope, x_end, v_end, slope_end)
            time += fraction * h
            continue
        time, x, v, slope, chamber = last, x_end, v_end, slope_end, chamber_end
        # A drive that rises from nothing takes the speed far beyond what the start let expect.
        scale = max(scale, v)
        z1, z2, z3 = w1, w2, w3
        have_guess = True
        h_before = h
        further = h * min(6.0, 0.9 * max(error, 1e-8) ** -0.25)
        h = max(further, wished) if wished > h and error < EASY else further


@njit(nogil=True)
def integrate_many(
    starts,
    times,
    on,
    rigs,
    thetas,
    trace_starts,
    trace_time,
    trace_pressure,
    bend_starts,
    bends,
    kinks,
    stops,
    rtol,
    out,
    ends,
):
    """`integrate` for many trials.

    Trial i has times[starts[i]:starts[i+1]], on[i], rigs[i], thetas[i], kinks[i] (padded with infinity), and the trace
    and the bends between its own starts. Fills `out` (n_times, 4) and `ends` (n_trials, 5): status, end time, end
    speed, number of steps, time of slack.
    """
    for i in range(starts.size - 1):
        low, high = starts[i], starts[i + 1]
        trace = slice(trace_starts[i], trace_starts[i + 1])
        status, end_time, end_speed, n_steps, slack_time = integrate(
            times[low:high],
            on[i],
            rigs[i],
            thetas[i],
            trace_time[trace],
            trace_pressure[trace],
            bends[bend_starts[i] : bend_starts[i + 1]],
            kinks[i],
            stops[i],
            rtol,
            out[low:high],
        )
        ends[i, 0] = status
        ends[i, 1] = end_time
        ends[i, 2] = end_speed
        ends[i, 3] = n_steps
        ends[i, 4] = slack_time
