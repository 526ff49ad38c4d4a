"""The interface of the integrator to one model and one trial: compiled functions and the arrays that they use.

`vinetrack.dynamics.simulate` writes the functions of one model as a module, the first argument `equations` of the
integrator. Numba has a type for each module, so that the integrator is compiled for each model and the calls can be
inlined. Unless stated they take `(time, x, v, chamber, trial)`: x, v are position and speed of the tail, m and m/s,
`chamber` is the gauge pressure of the chamber, Pa.

rates               acceleration of the tail, m/s², and rate of change of the chamber's pressure, Pa/s
observed            position of the leading edge that the camera reports, m
first_chamber       pressure of the chamber at release, of (trial) alone
has_chamber         whether an effect gives the chamber an equation of its own, of no argument
row_delay           how much later rows are read by the metre, s/m, of (trial) alone
averaged_over       square of the time that positions are averaged over, s², of (trial) alone
ask                 what `Asked` lists, and the rate of the chamber, of (what, time, y, ẏ, x, v, chamber, trial)

A model takes long to compile, so that it stands in the compiled code twice: in the steps, where a call would cost half
as much again, and in `ask`.

The integrator is ordinary Python too: with NUMBA_DISABLE_JIT=1 a debugger or a coverage tool follows every line.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats

# Options with which every function of the integrator is compiled (measured)
_FLAGS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
_FLAGS |= {"no_cfunc_wrapper": True, "no_cpython_wrapper": True}

compiled: Any = njit(**_FLAGS, forceinline=False)
inlined: Any = njit(**_FLAGS, forceinline=True)
merged: Any = njit(**_FLAGS, inline="always")


class TrialArrays(NamedTuple):
    """The inputs of one trial, constant during its growth."""

    on: Any  #: which effects act, shape (n_effects,)
    inputs: Floats  #: the fields of `vinetrack.effects.TrialInputs`, SI
    theta: Floats  #: parameters of all effects, in the order of the model
    trace_time: Floats  #: times of a measured pressure since release, s, shape (n_samples,); empty without one
    trace_pressure: Floats  #: gauge pressure there, Pa
    bends: Floats  #: rows of start, arc and radius, m, shape (n_bends, 3)


class BatchArrays(NamedTuple):
    """Many trials one behind the other: what `TrialArrays` holds of each, and what its integration needs besides."""

    starts: NDArray[np.int64]  #: trial i has the rows `starts[i]:starts[i + 1]` of times and results
    times: Floats  #: true times since release, s, shape (n_times,)
    on: NDArray[np.bool_]  #: shape (n_trials, n_effects)
    inputs: Floats
    thetas: Floats
    trace_starts: NDArray[np.int64]
    trace_time: Floats
    trace_pressure: Floats
    bend_starts: NDArray[np.int64]
    bends: Floats
    breakpoints: Floats  #: tail travel at which a force breaks, increasing, m, shape (n_trials, n_breakpoints)
    stops: Floats  #: tail travel at the end of growth, m, shape (n_trials,); infinite if there is none


class Status(IntEnum):
    """How a trajectory, or a part of it with a slack tail, ends."""

    RUNNING = 0
    ENDED = 1
    STALLED = 2
    TOO_HARD = 3
    TAUT = 4


class Asked(IntEnum):
    """What `ask` is asked. An enumeration is compiled once; for integers, numba would compile `ask` for each."""

    ACCELERATION = 0  #: of the tail, m/s²
    REST_ACCELERATION = 1  #: of the tail of a vine at rest, including the forces that hold it, m/s²
    TENSION = 2  #: that the tip leaves for the tail, N
    REST_TENSION = 3  #: the same of a vine at rest
    FREE_FALL = 4  #: acceleration of a slack tail, m/s²
    SEEN = 5  #: position that the camera reports, m


class Point(NamedTuple):
    """State of the vine: time, s; position, speed and acceleration of the tail; pressure of the chamber, Pa."""

    time: float
    x: float
    v: float
    acceleration: float
    chamber: float


@inlined
def trace_at(time, trial):
    """The measured pressure: linear between its samples, constant before the first and after the last."""
    last = trial.trace_time.size - 1
    if time <= trial.trace_time[0]:
        return trial.trace_pressure[0]
    if time >= trial.trace_time[last]:
        return trial.trace_pressure[last]
    k = np.searchsorted(trial.trace_time, time)
    fraction = (time - trial.trace_time[k - 1]) / (trial.trace_time[k] - trial.trace_time[k - 1])
    return trial.trace_pressure[k - 1] + fraction * (trial.trace_pressure[k] - trial.trace_pressure[k - 1])


@inlined
def next_slope_change(k, time, trial):
    """Index of the first sample of the measured pressure after `time`, from index k on, at which its slope changes. No
    step of the integrator is accurate across such a sample.
    """
    trace_time, trace_pressure = trial.trace_time, trial.trace_pressure
    last = trace_time.size - 1
    while k <= last:
        if trace_time[k] > time + 1e-12 * (1.0 + abs(time)):
            before = after = 0.0
            if k > 0:
                before = (trace_pressure[k] - trace_pressure[k - 1]) / (trace_time[k] - trace_time[k - 1])
            if k < last:
                after = (trace_pressure[k + 1] - trace_pressure[k]) / (trace_time[k + 1] - trace_time[k])
            if before != after:
                break
        k += 1
    return k


@inlined
def angle_passed(y, trial):
    """Total angle of the bends that the tip has passed."""
    angle = 0.0
    for k in range(trial.bends.shape[0]):
        angle += min(max(y - trial.bends[k, 0], 0.0), trial.bends[k, 1]) / trial.bends[k, 2]
    return angle


# ------------------------------------------------------------------------------
# One step of Radau IIA, order 5, for the speed and position of a tail and the pressure of its chamber.
#
# Position follows from the speeds by the same quadrature, so that the Newton system is that of the three stage speeds
# alone; the chamber pressure has a Newton system of its own. `vinetrack.dynamics.integrator` states why this method
# is used.
#
# Source: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (Springer, 1996), sections IV.5 (the
# method, table 5.6) and IV.8 (its implementation in RADAU5: simplified Newton iterations, starting values, error
# estimate).

# Nodes c (the third is 1) and matrix A of the method
_ROOT = 6.0**0.5
C = ((4 - _ROOT) / 10, (4 + _ROOT) / 10)
A = (
    ((88 - 7 * _ROOT) / 360, (296 - 169 * _ROOT) / 1800, (-2 + 3 * _ROOT) / 225),
    ((296 + 169 * _ROOT) / 1800, (88 + 7 * _ROOT) / 360, (-2 - 3 * _ROOT) / 225),
    ((16 - _ROOT) / 36, (16 + _ROOT) / 36, 1 / 9),
)
# Slope at the end of a step of the cubic through (0, 0), (c1, z1), (c2, z2), (1, z3)
S = (
    (1 - C[1]) / (C[0] * (C[0] - C[1]) * (C[0] - 1)),
    (1 - C[0]) / (C[1] * (C[1] - C[0]) * (C[1] - 1)),
    1 + 1 / (1 - C[0]) + 1 / (1 - C[1]),
)
# Weights of the estimate of the local error, and the real eigenvalue of A⁻¹
E = ((-13 - 7 * _ROOT) / 3, (-13 + 7 * _ROOT) / 3, -1 / 3)


class Stages(NamedTuple):
    """Increments of speed at the three stages of a step of size h, m/s and s; h is 0 if there is no previous step."""

    h: float
    z1: float
    z2: float
    z3: float


NO_STAGES = Stages(0.0, 0.0, 0.0, 0.0)  # For a step without a previous one: after a start and after a rejected step


@inlined
def starting_values(point, h, previous):
    """Starting values of the Newton iterations: the last step's collocation polynomial, extrapolated, else those of the
    acceleration at the start. No stage speed is set below a tenth of the speed at the start.
    """
    lowest = -0.9 * point.v
    if previous.h > 0:
        r = h / previous.h
        p1, p2, p3 = (
            _collocation_polynomial(1 + C[0] * r, previous),
            _collocation_polynomial(1 + C[1] * r, previous),
            _collocation_polynomial(1 + r, previous),
        )
        w1, w2, w3 = p1 - previous.z3, p2 - previous.z3, p3 - previous.z3
    else:
        w1, w2, w3 = C[0] * h * point.acceleration, C[1] * h * point.acceleration, h * point.acceleration
    return Stages(h, max(w1, lowest), max(w2, lowest), max(w3, lowest))


@inlined
def _collocation_polynomial(s, stages):
    """The cubic through (0, 0), (C[0], z1), (C[1], z2), (1, z3), at s."""
    l1 = s * (s - C[1]) * (s - 1) / (C[0] * (C[0] - C[1]) * (C[0] - 1))
    l2 = s * (s - C[0]) * (s - 1) / (C[1] * (C[1] - C[0]) * (C[1] - 1))
    l3 = s * (s - C[0]) * (s - C[1]) / ((1 - C[0]) * (1 - C[1]))
    return l1 * stages.z1 + l2 * stages.z2 + l3 * stages.z3


@inlined
def _newton_step(h, j1, j2, j3, f1, f2, f3, z1, z2, z3):
    """Newton step of the increments z, by Cramer's rule: (I − hAJ) d = hAf − z, J the derivatives of the rates f."""
    m11, m12, m13 = 1 - h * A[0][0] * j1, -h * A[0][1] * j2, -h * A[0][2] * j3
    m21, m22, m23 = -h * A[1][0] * j1, 1 - h * A[1][1] * j2, -h * A[1][2] * j3
    m31, m32, m33 = -h * A[2][0] * j1, -h * A[2][1] * j2, 1 - h * A[2][2] * j3
    b1 = h * (A[0][0] * f1 + A[0][1] * f2 + A[0][2] * f3) - z1
    b2 = h * (A[1][0] * f1 + A[1][1] * f2 + A[1][2] * f3) - z2
    b3 = h * (A[2][0] * f1 + A[2][1] * f2 + A[2][2] * f3) - z3
    k1 = m22 * m33 - m23 * m32
    k2 = m23 * m31 - m21 * m33
    k3 = m21 * m32 - m22 * m31
    scale = 1 / (m11 * k1 + m12 * k2 + m13 * k3)
    d1 = (b1 * k1 + m12 * (m23 * b3 - b2 * m33) + m13 * (b2 * m32 - m22 * b3)) * scale
    d2 = (m11 * (b2 * m33 - m23 * b3) + b1 * k2 + m13 * (m21 * b3 - b2 * m31)) * scale
    d3 = (m11 * (m22 * b3 - b2 * m32) + m12 * (b2 * m31 - m21 * b3) + b1 * k3) * scale
    return d1, d2, d3


@inlined
def radau_step(equations, trial, point, stages, scale, rtol):
    """One step from `point`, with the size and the starting values in `stages`."""
    time, x, v, _acceleration, chamber = point
    h, z1, z2, z3 = stages
    j1 = j2 = j3 = f1 = f2 = f3 = g1 = g2 = g3 = 0.0
    tolerance = 1e-2 * rtol * max(scale, abs(v))
    fast = 0.1  # contraction of the changes below which the Jacobian is kept
    previous_size = 1e300
    q1 = q2 = q3 = chamber
    jc = 0.0
    chamber_active = False
    jacobian_current = False
    converged = False
    for iteration in range(9):
        v1, v2, v3 = v + z1, v + z2, v + z3
        x1 = x + h * (C[0] * v + A[0][0] * z1 + A[0][1] * z2 + A[0][2] * z3)
        x2 = x + h * (C[1] * v + A[1][0] * z1 + A[1][1] * z2 + A[1][2] * z3)
        x3 = x + h * (v + A[2][0] * z1 + A[2][1] * z2 + A[2][2] * z3)
        t1, t2, t3 = time + C[0] * h, time + C[1] * h, time + h
        # One loop with one call, for the model to be compiled into it once: the rates at the three stages and, for a
        # new Jacobian, at a slightly higher speed each and at a slightly higher pressure of the chamber.
        for k in range(3 if jacobian_current else 7):
            t, x_stage, v_stage, q = t3, x3, v3, q3
            if k in (0, 3):
                t, x_stage, v_stage, q = t1, x1, v1, q1
            elif k in (1, 4):
                t, x_stage, v_stage, q = t2, x2, v2, q2
            delta = 0.0
            if k == 6:
                # The equation of a chamber is stiff if its supply is fast.
                chamber_active = equations.has_chamber() and (g1 != 0 or g2 != 0 or g3 != 0)
                if not chamber_active:
                    break
                delta = 1e-6 * (abs(q3) + 1e3)
                q += delta
            elif k >= 3:
                # One-sided, towards higher speed, since a different law holds at rest
                delta = 1e-6 * max(abs(v_stage), 1e-4 * scale)
                v_stage += delta
            f, g = equations.rates(t, x_stage, v_stage, q, trial)
            if k == 0:
                f1, g1 = f, g
            elif k == 1:
                f2, g2 = f, g
            elif k == 2:
                f3, g3 = f, g
            elif k == 3:
                j1 = (f - f1) / delta
            elif k == 4:
                j2 = (f - f2) / delta
            elif k == 5:
                j3 = (f - f3) / delta
            else:
                jc = (g - g3) / delta
        jacobian_current = True
        change = 0.0
        if chamber_active:
            c1, c2, c3 = _newton_step(h, jc, jc, jc, g1, g2, g3, q1 - chamber, q2 - chamber, q3 - chamber)
            q1, q2, q3 = q1 + c1, q2 + c2, q3 + c3
            change = max(abs(c1), abs(c2), abs(c3)) / (abs(q3) + 1e3)
        d1, d2, d3 = _newton_step(h, j1, j2, j3, f1, f2, f3, z1, z2, z3)
        z1, z2, z3 = z1 + d1, z2 + d2, z3 + d3
        size = max(abs(d1), abs(d2), abs(d3), change * scale)
        if not size < 1e300:
            break
        ratio = size / previous_size
        # The next iteration would change the speeds by about ratio · size.
        if size <= tolerance or (iteration > 0 and ratio < fast and ratio * size <= 0.1 * tolerance):
            converged = True
            break
        if ratio > fast:
            jacobian_current = False
        if iteration > 3 and size > previous_size:
            break
        previous_size = size
    new_stages = Stages(h, z1, z2, z3)
    if not converged:
        return False, 1e300, point, new_stages
    return True, _local_error(point, new_stages, scale, rtol), _end_of_step(point, new_stages, q3), new_stages


@inlined
def _local_error(point, stages, scale, rtol):
    """Hairer's estimate of the local error of the speed, in units of the tolerance. Hairer filters it with (μ/h − J)⁻¹.
    This is omitted: the filter hides the error of a long stiff step at its far end.
    """
    mu = 3 + 3 ** (2 / 3) - 3 ** (1 / 3)
    h, z1, z2, z3 = stages
    raw = (h * point.acceleration + E[0] * z1 + E[1] * z2 + E[2] * z3) / mu
    # At least a tenth of the final speed: an error at the start affects the whole growth.
    weight = rtol * max(0.1 * scale, abs(point.v), abs(point.v + z3))
    return abs(raw) / weight


@inlined
def _end_of_step(point, stages, chamber):
    """The vine at the end of a step; `chamber` is the pressure at its last stage."""
    h, z1, z2, z3 = stages
    x_end = point.x + h * (point.v + A[2][0] * z1 + A[2][1] * z2 + A[2][2] * z3)
    acceleration_end = (S[0] * z1 + S[1] * z2 + S[2] * z3) / h
    return Point(point.time + h, x_end, point.v + z3, acceleration_end, chamber)


@inlined
def quintic(s, h, start, end):
    """Motion within a step: the Hermite polynomial of degree 5 through position, speed and acceleration."""
    d = end.x - start.x - h * start.v - 0.5 * h * h * start.acceleration
    e = h * (end.v - start.v - h * start.acceleration)
    f = h * h * (end.acceleration - start.acceleration)
    c3 = 10 * d - 4 * e + 0.5 * f
    c4 = -15 * d + 7 * e - f
    c5 = 6 * d - 3 * e + 0.5 * f
    s2 = s * s
    x = start.x + h * s * start.v + 0.5 * h * h * s2 * start.acceleration + s2 * s * (c3 + s * (c4 + s * c5))
    v = start.v + h * s * start.acceleration + s2 * (3 * c3 + s * (4 * c4 + s * 5 * c5)) / h
    a = start.acceleration + s * (6 * c3 + s * (12 * c4 + s * 20 * c5)) / (h * h)
    return x, v, a


# ------------------------------------------------------------------------------
# Interpolation of the motion between the requested times.
#
# It is the Hermite polynomial of degree 5 through position, speed and acceleration on either side; next to the end of
# growth, where the acceleration jumps, that of degree 4 without the acceleration at the jump. The jump at the start
# of motion is not treated separately: over a frame that is an error of micrometres.


@inlined
def _point(times, out, k):
    return Point(times[k], out[k, 0], out[k, 1], out[k, 2], 0.0)


@compiled
def motion_at(times, out, ratio, end, k, read):
    """Position, m, and speed, m/s, of the tail at a time, and the camera's offset of the lead position, m."""
    last = times.size - 1
    while k < last and times[k + 1] <= read:
        k += 1
    while k > 0 and times[k] > read:
        k -= 1
    before = _point(times, out, k)
    offset = out[k, 3] - before.x / ratio
    if k < last and times[k] <= read:
        part = (read - times[k]) / (times[k + 1] - times[k])
        offset += part * (out[k + 1, 3] - out[k + 1, 0] / ratio - offset)
    if read >= end.time:
        return end.x, 0.0, offset
    if k == last or times[k] > read:
        since = read - before.time
        x = before.x + since * (before.v + 0.5 * since * before.acceleration)
        return max(x, 0.0), before.v + since * before.acceleration, offset
    after = _point(times, out, k + 1)
    if after.time >= end.time:
        x, v = _without_far_acceleration(before, end, read)
        return min(x, end.x), v, offset
    x, v, _a = quintic((read - before.time) / (after.time - before.time), after.time - before.time, before, after)
    return x, v, offset


@inlined
def _without_far_acceleration(near, far, read):
    """Position, m, and speed, m/s, of the tail between a time and another at which the acceleration jumps."""
    h = far.time - near.time
    part = (read - near.time) / h
    d = far.x - near.x - h * near.v - 0.5 * h * h * near.acceleration
    e = h * (far.v - near.v - h * near.acceleration)
    c3, c4 = 4 * d - e, e - 3 * d
    moved = h * near.v + part * (h * h * near.acceleration + part * (3 * c3 + part * 4 * c4))
    x = near.x + part * h * (near.v + 0.5 * part * h * near.acceleration) + part**3 * (c3 + part * c4)
    return x, moved / h


# ------------------------------------------------------------------------------
# Rolling shutter: the rows of a picture are read one after the other, and show the edge at different times.
#
# A frame stamped t shows the edge at t + s·y, with y its position at that time and s the delay per metre. At the
# start of growth s·y is negligible, and rows are read at their stamps.


@compiled
def read_by_rows(times, out, ratio, end, delay):
    """Replace the positions recorded by an instantaneous shutter by those recorded row by row."""
    # Positions that are still needed must not be replaced yet: later ones at a positive delay, else earlier ones.
    count = times.size
    # An edge that outruns the rows is never read: then the iteration would leave the motion.
    latest = 2.0 * abs(delay * out[count - 1, 3])
    for step in range(count):
        i = step if delay > 0 else count - 1 - step
        read = times[i] + delay * out[i, 3]
        seen = out[i, 3]
        for _turn in range(8):
            x, v, offset = motion_at(times, out, ratio, end, i, read)
            seen = x / ratio + offset
            change = (read - times[i] - delay * seen) / max(1.0 - delay * v / ratio, 0.1)
            read = min(max(read - change, times[i] - latest), times[i] + latest)
            if abs(change) < 1e-10:
                break
        out[i, 3] = seen


# ------------------------------------------------------------------------------
# Positions averaged over time: the position reported at t is the mean from t − T/2 to t + T/2.


@compiled
def average_over(times, out, work, ratio, end, square):
    """Replace instantaneous positions by their means over the time around each. Shape: work (2, n_times or more)."""
    half, since_first, means = 0.5 * math.sqrt(square), work[0], work[1]
    since_first[0] = 0.0
    for k in range(times.size - 1):
        since_first[k + 1] = since_first[k] + _integral_from(times, out, ratio, end, k, times[k + 1])
    for i in range(times.size):
        means[i] = 0.0
        for side in (-1, 1):
            at = times[i] + side * half
            k = max(np.searchsorted(times, at, side="right") - 1, 0)
            means[i] += side * (since_first[k] + _integral_from(times, out, ratio, end, k, at)) / (2 * half)
    for i in range(times.size):
        out[i, 3] = means[i]


@compiled
def _integral_from(times, out, ratio, end, k, until):
    """Integral of the reported position, m s, from time k until another before the next, past the end of growth."""
    if times[k] < end.time < until:
        before = _integral(times, out, ratio, end, k, times[k], end.time)
        return before + _integral(times, out, ratio, end, k, end.time, until)
    return _integral(times, out, ratio, end, k, times[k], until)


@compiled
def _integral(times, out, ratio, end, k, low, high):
    """Integral of the reported position, m s, where the motion is one polynomial: Gauss–Legendre with three nodes."""
    middle, reach = 0.5 * (low + high), 0.5 * math.sqrt(0.6) * (high - low)
    total = 0.0
    for place in range(3):
        x, _v, offset = motion_at(times, out, ratio, end, k, middle + (place - 1) * reach)
        total += (4 / 9 if place == 1 else 5 / 18) * (x / ratio + offset)
    return total * (high - low)
