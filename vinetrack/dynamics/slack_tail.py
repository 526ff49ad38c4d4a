"""A tail that cannot push: what happens while it is slack, for trials whose `tail_slack` is `free`.

The payload then falls free, by the forces on the tail alone; the tip, which has no mass to speak of, grows as fast as
its own forces balance, Σ tip forces = 0 at the tail speed r·ẏ of the film that passes it. The tail is taut again when
the tip has taken up its slack, x − r·y = 0. A payload that has fallen as far as the tip rests there: its push on the
tip is left out, so that growth is too slow from then on.

Like `vinetrack.dynamics.integrator` this is the text of a compiled kernel, and follows it. The method is that of
Dormand & Prince with its continuous extension: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I,
section II.6.
"""

import numpy as np
from numba import njit

RUNNING, ENDED, TOO_HARD = 0, 1, 3
MOST_STEPS = 20_000


@njit(nogil=True)
def tip_tension(time, x, v, chamber, resting, on, rig, theta, trace_time, trace_pressure, bends):
    """Tension the tip leaves for a tail passing it at v, and rate of the chamber: here stand those of one model."""
    raise NotImplementedError


@njit(nogil=True)
def free_fall(time, y, ydot, x, v, chamber, on, rig, theta, trace_time, trace_pressure, bends):
    """Acceleration of a slack tail."""
    raise NotImplementedError


@njit(nogil=True)
def observed(time, x, v, chamber, on, rig, theta, trace_time, trace_pressure, bends):
    """Position of the leading edge that the camera reports."""
    raise NotImplementedError


# ---- what follows is set behind the rates of one model ----
TAUT = 4


@njit(nogil=True)
def free_tip_speed(time, x, chamber, guess, moving, on, rig, theta, trace_time, trace_pressure, bends):
    """Tail speed of the film at a tip with nothing to pull: where its forces balance, by the Illinois rule; x = r·y."""
    f_low, _r = tip_tension(time, x, 0.0, chamber, not moving, on, rig, theta, trace_time, trace_pressure, bends)
    if f_low <= 0:
        return 0.0
    low, high = 0.0, max(guess, 1e-6)
    f_high, _r = tip_tension(time, x, high, chamber, False, on, rig, theta, trace_time, trace_pressure, bends)
    factor = 1.01
    while f_high > 0 and high < 1e6:
        low, f_low = high, f_high
        high *= factor
        factor = min(factor * factor, 10.0)
        f_high, _r = tip_tension(time, x, high, chamber, False, on, rig, theta, trace_time, trace_pressure, bends)
    if low == 0.0 and guess > 0:
        near = 0.99 * guess
        f_near, _r = tip_tension(time, x, near, chamber, False, on, rig, theta, trace_time, trace_pressure, bends)
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
        f, _r = tip_tension(time, x, middle, chamber, False, on, rig, theta, trace_time, trace_pressure, bends)
        if f * f_high < 0:
            low, f_low = high, f_high
        else:
            f_low *= 0.5
        high, f_high = middle, f
        if low > high:
            low, high, f_low, f_high = high, low, f_high, f_low
    return high


@njit(nogil=True)
def slack_rates(time, s, tip_speed, moving, r, out, on, rig, theta, trace_time, trace_pressure, bends):
    """Rates of (x, v, y, chamber) while the tail is slack, into `out`; returns the tail speed of film at the tip."""
    u = free_tip_speed(time, r * s[2], s[3], tip_speed, moving, on, rig, theta, trace_time, trace_pressure, bends)
    _t, rate = tip_tension(time, r * s[2], u, s[3], False, on, rig, theta, trace_time, trace_pressure, bends)
    fall = free_fall(time, s[2], u / r, s[0], s[1], s[3], on, rig, theta, trace_time, trace_pressure, bends)
    out[0] = s[1]
    out[1] = 0.0 if s[1] <= 0 and fall < 0 else fall
    out[2] = u / r
    out[3] = rate
    return u


@njit(nogil=True)
def dormand_prince(time, s, h, tip_speed, moving, r, k, on, rig, theta, trace_time, trace_pressure, bends):
    """One step: k (7, 4), its first row given, gets the others. Returns the end, its error and the tip's speed."""
    a = (
        (1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0),
        (3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0),
        (44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0),
        (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    )
    c = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
    e = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
    end = s.copy()
    u = tip_speed
    for i in range(6):
        for m in range(4):
            end[m] = s[m]
            for j in range(i + 1):
                end[m] += h * a[i][j] * k[j, m]
        u = slack_rates(time + c[i] * h, end, u, moving, r, k[i + 1], on, rig, theta, trace_time, trace_pressure, bends)
    error_x, error_y = 0.0, 0.0
    for i in range(7):
        error_x += h * e[i] * k[i, 0]
        error_y += h * e[i] * k[i, 2]
    return end, max(abs(error_x), r * abs(error_y)), u


@njit(nogil=True)
def slack_at(part, h, s, end, k):
    """State (x, v, y, chamber) at the fraction `part` of a step."""
    d = (-12715105075 / 11282082432, 0.0, 87487479700 / 32700410799, -10690763975 / 1880347072,
         701980252875 / 199316789632, -1453857185 / 822651844, 69997945 / 29380423)  # fmt: skip
    found = np.empty(4)
    for m in range(4):
        change = end[m] - s[m]
        bend = h * k[0, m] - change
        last = 0.0
        for i in range(7):
            last += h * d[i] * k[i, m]
        rest = change - h * k[6, m] - bend
        found[m] = s[m] + part * (change + (1 - part) * (bend + part * (rest + (1 - part) * last)))
    return found


@njit(nogil=True)
def slack_event(kind, stop, r, h, s, end, k):
    """Fraction of a step at which growth ends (`kind` 0) or the tail is taut again (1), by bisection."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        state = slack_at(middle, h, s, end, k)
        before = r * state[2] < stop if kind == 0 else state[0] > r * state[2]
        if before:
            low = middle
        else:
            high = middle
    return high


@njit(nogil=True)
def follow_slack(times, n, time, x, v, chamber, on, rig, theta, trace_time, trace_pressure, bends, r, stop, rtol, out):
    """From the moment the tail goes slack until it is taut again, growth ends or the last time is filled in.

    Fills rows n… of `out` as `integrate` does, with r·y, r·ẏ and r·ÿ of the tip. `r` is the travel ratio, `stop` r·L.

    Returns
    -------
    (status, n, time, x, v, chamber, tip_speed)
        `status` TAUT, RUNNING (all filled in), ENDED or TOO_HARD; `tip_speed` is r·ẏ there.
    """
    until = times[times.size - 1]
    s = np.array([x, v, x / r, chamber])
    k = np.zeros((7, 4))
    u = slack_rates(time, s, v, v > 0, r, k[0], on, rig, theta, trace_time, trace_pressure, bends)
    h = 1e-3 * (until - time)
    allowed = 1e-3 * rtol * stop
    for _ in range(MOST_STEPS):
        end, error, u_end = dormand_prince(
            time, s, h, u, u > 0, r, k, on, rig, theta, trace_time, trace_pressure, bends
        )
        if not error <= allowed:
            h *= max(0.2, 0.9 * (allowed / error) ** 0.2) if error < 1e300 else 0.1
            continue
        status, part = RUNNING, 1.0
        if r * end[2] >= stop:
            status, part = ENDED, slack_event(0, stop, r, h, s, end, k)
        elif end[0] <= r * end[2] and end[1] < u_end:
            status, part = TAUT, slack_event(1, stop, r, h, s, end, k)
        while n < times.size and times[n] <= time + part * h:
            fraction = (times[n] - time) / h
            now = slack_at(fraction, h, s, end, k)
            speed = free_tip_speed(
                times[n], r * now[2], now[3], u, u > 0, on, rig, theta, trace_time, trace_pressure, bends
            )
            out[n, 0] = r * now[2]
            out[n, 1] = speed
            out[n, 2] = (u_end - u) / h
            out[n, 3] = observed(times[n], r * now[2], speed, now[3], on, rig, theta, trace_time, trace_pressure, bends)
            n += 1
        if n == times.size and time + part * h > until:
            return RUNNING, n, until, end[0], end[1], end[3], u_end
        if status != RUNNING:
            now = slack_at(part, h, s, end, k)
            return status, n, time + part * h, r * now[2], max(now[1], 0.0), now[3], u_end
        time += h
        s[:] = end
        # Where the payload has come to the tip it rests there.
        tip = stop / r + s[2]
        if s[0] > tip:
            s[0] = tip
            s[1] = min(s[1], u_end / r)
        u = slack_rates(time, s, u_end, u_end > 0, r, k[0], on, rig, theta, trace_time, trace_pressure, bends)
        h *= min(5.0, 0.9 * (allowed / max(error, 1e-6 * allowed)) ** 0.2)
    return TOO_HARD, n, time, s[0], s[1], s[3], u
