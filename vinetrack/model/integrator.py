"""Radau IIA of order 5 for one trajectory of a vine, from rest to the end of its growth.

The equation is hard in four places. At rest the slope of v^0.37 is infinite, so any method of fixed step falls to order
1.4; near the yield pressure the speed relaxes in microseconds while growth takes minutes (a stiffness of 10⁸); towards
the end of a bare vine the mass goes to nothing; and a vine may stall, after which it stays at rest until the drive
exceeds what holds it. An implicit method that is stable at any step, with the step chosen from its own error, does
all four.

This file is the text of a compiled kernel: `vinetrack.model.kernel` sets what follows the marked line behind the
`rates` of one model, so that the compiler sees both. Only numbers and arrays, nothing of Python's.

Source of the method: Hairer & Wanner, Solving Ordinary Differential Equations II, sections IV.5 and IV.8.
"""

from numba import njit


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


# ---- what follows is set behind the rates of one model ----
SQRT6 = 6.0**0.5
C1, C2 = (4 - SQRT6) / 10, (4 + SQRT6) / 10
A11, A12, A13 = (88 - 7 * SQRT6) / 360, (296 - 169 * SQRT6) / 1800, (-2 + 3 * SQRT6) / 225
A21, A22, A23 = (296 + 169 * SQRT6) / 1800, (88 + 7 * SQRT6) / 360, (-2 - 3 * SQRT6) / 225
A31, A32, A33 = (16 - SQRT6) / 36, (16 + SQRT6) / 36, 1 / 9
# Slope of the collocation polynomial at the end of a step: free of the cancellation that f(v) suffers when stiff.
S1 = (1 - C2) / (C1 * (C1 - C2) * (C1 - 1))
S2 = (1 - C1) / (C2 * (C2 - C1) * (C2 - 1))
S3 = 1 + 1 / (1 - C1) + 1 / (1 - C2)
# The real eigenvalue of A⁻¹ and the weights of Hairer's estimate of the local error.
MU = 3 + 3 ** (2 / 3) - 3 ** (1 / 3)
E1, E2, E3 = (-13 - 7 * SQRT6) / 3, (-13 + 7 * SQRT6) / 3, -1 / 3

RUNNING, ENDED, STALLED, TOO_HARD = 0, 1, 2, 3
MOST_STEPS = 20_000
MOST_NEWTON = 9


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
def solve3(m11, m12, m13, m21, m22, m23, m31, m32, m33, b1, b2, b3):
    """Cramer's rule for the Newton step of the three stages."""
    k1 = m22 * m33 - m23 * m32
    k2 = m23 * m31 - m21 * m33
    k3 = m21 * m32 - m22 * m31
    scale = 1 / (m11 * k1 + m12 * k2 + m13 * k3)
    z1 = (b1 * k1 + m12 * (m23 * b3 - b2 * m33) + m13 * (b2 * m32 - m22 * b3)) * scale
    z2 = (m11 * (b2 * m33 - m23 * b3) + b1 * k2 + m13 * (m21 * b3 - b2 * m31)) * scale
    z3 = (m11 * (m22 * b3 - b2 * m32) + m12 * (b2 * m31 - m21 * b3) + b1 * k3) * scale
    return z1, z2, z3


@njit(nogil=True)
def slope_in_speed(time, x, v, chamber, acceleration, scale, on, rig, theta, trace_time, trace_pressure, bends):
    """∂a/∂v by a one-sided difference, upwards: below rest the law is another."""
    delta = 1e-6 * max(abs(v), 1e-4 * scale)
    other, _rate = rates(time, x, v + delta, chamber, on, rig, theta, trace_time, trace_pressure, bends)
    return (other - acceleration) / delta


@njit(nogil=True)
def radau_step(
    time, x, v, chamber, slope, h, z1, z2, z3, scale, rtol, on, rig, theta, trace_time, trace_pressure, bends
):
    """One step of size h from (x, v, chamber); z1…z3 are first guesses of the speeds gained at the stages.

    Returns
    -------
    (converged, error, x, v, slope, chamber, z1, z2, z3)
        The error is in units of the tolerance; `slope` the acceleration at the end.
    """
    j1 = j2 = j3 = 0.0
    g1 = g2 = g3 = 0.0
    small = 1e-2 * rtol * scale
    before = 1e300
    fresh = False
    converged = False
    for iteration in range(MOST_NEWTON):
        v1, v2, v3 = v + z1, v + z2, v + z3
        x1 = x + h * (C1 * v + A11 * z1 + A12 * z2 + A13 * z3)
        x2 = x + h * (C2 * v + A21 * z1 + A22 * z2 + A23 * z3)
        x3 = x + h * (v + A31 * z1 + A32 * z2 + A33 * z3)
        q1 = chamber + h * (A11 * g1 + A12 * g2 + A13 * g3)
        q2 = chamber + h * (A21 * g1 + A22 * g2 + A23 * g3)
        q3 = chamber + h * (A31 * g1 + A32 * g2 + A33 * g3)
        t1, t2, t3 = time + C1 * h, time + C2 * h, time + h
        f1, g1 = rates(t1, x1, v1, q1, on, rig, theta, trace_time, trace_pressure, bends)
        f2, g2 = rates(t2, x2, v2, q2, on, rig, theta, trace_time, trace_pressure, bends)
        f3, g3 = rates(t3, x3, v3, q3, on, rig, theta, trace_time, trace_pressure, bends)
        if not fresh:
            j1 = slope_in_speed(t1, x1, v1, q1, f1, scale, on, rig, theta, trace_time, trace_pressure, bends)
            j2 = slope_in_speed(t2, x2, v2, q2, f2, scale, on, rig, theta, trace_time, trace_pressure, bends)
            j3 = slope_in_speed(t3, x3, v3, q3, f3, scale, on, rig, theta, trace_time, trace_pressure, bends)
            fresh = True
        d1, d2, d3 = solve3(
            1 - h * A11 * j1, -h * A12 * j2, -h * A13 * j3,
            -h * A21 * j1, 1 - h * A22 * j2, -h * A23 * j3,
            -h * A31 * j1, -h * A32 * j2, 1 - h * A33 * j3,
            h * (A11 * f1 + A12 * f2 + A13 * f3) - z1,
            h * (A21 * f1 + A22 * f2 + A23 * f3) - z2,
            h * (A31 * f1 + A32 * f2 + A33 * f3) - z3,
        )  # fmt: skip
        z1, z2, z3 = z1 + d1, z2 + d2, z3 + d3
        size = max(abs(d1), abs(d2), abs(d3))
        if not size < 1e300:
            return False, 1e300, x, v, slope, chamber, z1, z2, z3
        if size <= small:
            converged = True
            break
        if size > 0.1 * before:
            fresh = False
        if iteration > 3 and size > before:
            break
        before = size
    if not converged:
        return False, 1e300, x, v, slope, chamber, z1, z2, z3
    # Hairer filters this with (μ/h − J)⁻¹. Not here: it hides what a long stiff step does wrong at its far end.
    raw = (h * slope + E1 * z1 + E2 * z2 + E3 * z3) / MU
    weight = rtol * max(scale, abs(v), abs(v + z3))
    x_end = x + h * (v + A31 * z1 + A32 * z2 + A33 * z3)
    chamber_end = chamber + h * (A31 * g1 + A32 * g2 + A33 * g3)
    slope_end = (S1 * z1 + S2 * z2 + S3 * z3) / h
    return True, abs(raw) / weight, x_end, v + z3, slope_end, chamber_end, z1, z2, z3


@njit(nogil=True)
def quintic(s, h, x0, v0, a0, x1, v1, a1):
    """Position, speed and acceleration at the fraction s of a step, from those at its ends (Hermite, order 6)."""
    d = x1 - x0 - h * v0 - 0.5 * h * h * a0
    e = h * (v1 - v0 - h * a0)
    f = h * h * (a1 - a0)
    c3 = 10 * d - 4 * e + 0.5 * f
    c4 = -15 * d + 7 * e - f
    c5 = 6 * d - 3 * e + 0.5 * f
    s2 = s * s
    x = x0 + h * s * v0 + 0.5 * h * h * s2 * a0 + s2 * s * (c3 + s * (c4 + s * c5))
    v = v0 + h * s * a0 + s2 * (3 * c3 + s * (4 * c4 + s * 5 * c5)) / h
    a = a0 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5)) / (h * h)
    return x, v, a


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
def wait_for_drive(time, until, x, chamber, on, rig, theta, trace_time, trace_pressure, bends):
    """First instant after `time` at which the drive moves a vine at rest, and the chamber's pressure then.

    The instant is past `until` where none does. The chamber goes on filling meanwhile.
    """
    steps = max(256, 2 * trace_time.size)
    step = (until - time) / steps
    for k in range(1, steps + 1):
        _a, rate = rates(time, x, 0.0, chamber, on, rig, theta, trace_time, trace_pressure, bends)
        _a, rate = rates(time, x, 0.0, chamber + 0.5 * step * rate, on, rig, theta, trace_time, trace_pressure, bends)
        if (
            rest_acceleration(time + step, x, chamber + step * rate, on, rig, theta, trace_time, trace_pressure, bends)
            > 0
        ):
            low, high = 0.0, step
            for _ in range(40):
                middle = 0.5 * (low + high)
                pressure = chamber + middle * rate
                if rest_acceleration(time + middle, x, pressure, on, rig, theta, trace_time, trace_pressure, bends) > 0:
                    high = middle
                else:
                    low = middle
            return time + high, chamber + high * rate
        time += step
        chamber += step * rate
    return until + 1.0, chamber


@njit(nogil=True)
def integrate(times, on, rig, theta, trace_time, trace_pressure, bends, kink, stop, rtol, out):
    """Follow one trajectory from rest at time 0; fill `out` (n_times, 4) with x, v, a of the tail and the
    position of the leading edge that the camera reports, at `times`.

    `kink` is where along x the film's mass reaches its floor: a step ends there, for none is good across it. `times`
    must increase; before 0 the vine is at rest, after the end of growth (x = `stop`; infinite for a body that moves
    as a whole) it stays there with its last speed and acceleration given as 0.

    Returns
    -------
    (status, end_time, end_speed, n_steps)
        `end_time` is that of the end of growth or of the last stall, NaN where there was neither.
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
        return RUNNING, float("nan"), 0.0, 0
    until = times[count - 1]
    time, x, v = 0.0, 0.0, 0.0
    n_steps = 0
    end_time = float("nan")
    at_rest = True
    h = 0.0
    slope = 0.0
    scale = 0.0
    z1 = z2 = z3 = 0.0
    have_guess = False
    h_before = 1.0
    while True:
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
                    return STALLED, time, 0.0, n_steps
                time = start
            slope, _rate = rates(time, x, 0.0, chamber, on, rig, theta, trace_time, trace_pressure, bends)
            at_rest = False
            room = min(stop - x, 0.5 * slope * (until - time) ** 2 + 1e-9)
            scale = typical_speed(time, x, chamber, on, rig, theta, trace_time, trace_pressure, bends, slope, room)
            h = 1e-3 * scale / slope
            v = 0.0
            have_guess = False
        ahead = (kink if x < kink else stop) - x
        if v > 0 and h * v > 1.05 * ahead:
            h = 1.02 * ahead / v
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
            return TOO_HARD, time, v, n_steps
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
                end_time = time
                continue
            h *= 0.3
            have_guess = False
            continue
        if error > 1:
            h *= max(0.2, 0.9 * error**-0.25)
            have_guess = False
            continue
        if x < kink and x_end > kink + 1e-7 * stop:
            h *= time_of_end(kink + 5e-8 * stop, h, x, v, slope, x_end, v_end, slope_end)
            have_guess = False
            continue
        last = time + h
        ended = x_end >= stop
        fraction = time_of_end(stop, h, x, v, slope, x_end, v_end, slope_end) if ended else 1.0
        while k < count and times[k] <= time + fraction * h:
            part = (times[k] - time) / h
            now_x, now_v, now_a = quintic(part, h, x, v, slope, x_end, v_end, slope_end)
            now_chamber = chamber + part * (chamber_end - chamber)
            out[k, 0] = now_x
            out[k, 1] = now_v
            out[k, 2] = now_a
            out[k, 3] = observed(times[k], now_x, now_v, now_chamber, on, rig, theta, trace_time, trace_pressure, bends)
            k += 1
        if ended:
            end_time = time + fraction * h
            _x, end_speed, _a = quintic(fraction, h, x, v, slope, x_end, v_end, slope_end)
            while k < count:
                out[k, 3] = observed(
                    times[k], stop, 0.0, chamber_end, on, rig, theta, trace_time, trace_pressure, bends
                )
                out[k, 0] = stop
                out[k, 1] = 0.0
                out[k, 2] = 0.0
                k += 1
            return ENDED, end_time, end_speed, n_steps
        if k == count:
            return RUNNING, end_time, v_end, n_steps
        time, x, v, slope, chamber = last, x_end, v_end, slope_end, chamber_end
        z1, z2, z3 = w1, w2, w3
        have_guess = True
        h_before = h
        h *= min(6.0, 0.9 * max(error, 1e-8) ** -0.25)


@njit(nogil=True)
def carry_on(s, z1, z2, z3):
    """The cubic through (0, 0), (C1, z1), (C2, z2), (1, z3), at s."""
    l1 = s * (s - C2) * (s - 1) / (C1 * (C1 - C2) * (C1 - 1))
    l2 = s * (s - C1) * (s - 1) / (C2 * (C2 - C1) * (C2 - 1))
    l3 = s * (s - C1) * (s - C2) / ((1 - C1) * (1 - C2))
    return l1 * z1 + l2 * z2 + l3 * z3


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

    Trial i has times[starts[i]:starts[i+1]], rigs[i], thetas[i], the trace and the bends between its own starts. Fills
    `out` (n_times, 4) and `ends` (n_trials, 4): status, end time, end speed, number of steps.
    """
    for i in range(starts.size - 1):
        low, high = starts[i], starts[i + 1]
        trace = slice(trace_starts[i], trace_starts[i + 1])
        status, end_time, end_speed, n_steps = integrate(
            times[low:high],
            on,
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
