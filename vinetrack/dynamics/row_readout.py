"""A picture whose rows are read one after the other: the edge is seen where it is when its row is read.

What is stamped t shows the edge at t + s·y, with y the position at which it is seen then and s the delay by the metre.
Between the times asked for the motion is the Hermite polynomial of degree 5 through position, speed and acceleration at
either side; up to the end of growth, where the acceleration jumps, that of degree 4 without the one at the jump. Where
the vine sets off it jumps as well, but there rows are read at their stamps, since s·y is next to nothing.
"""

from vinetrack.dynamics.equations import Point, compiled, inlined
from vinetrack.dynamics.radau import quintic

STEEPEST = 0.1
"""Least 1 − s·ẏ that Newton's method divides by. Chosen: an edge that keeps up with the readout within 10 % is seen
smeared over the picture, and no track comes of that; between 0.05 and 0.2 only the number of turns changes."""

TURNS = 8
"""Steps of Newton's method. Derived: the error is squared at each; from 10 % four come to rounding, and a first guess
on the far side of the release costs two or three more."""

SETTLED_S = 1e-10
"""A step that ends the search, s. Derived: at 100 m/s it is 10 nm."""


@compiled
def read_by_rows(times, out, ratio, end, delay):
    """Replace what a camera would see at once by what it sees row by row.

    Parameters
    ----------
    times : array (n_times,), s since release, increasing.
    out : array (n_times, 4): x, v, a of the tail and the reported position of the leading edge, m, which is replaced.
    ratio : travel ratio r, x = r·y.
    end : the `Point` at which growth ends; its time is infinite where it does not.
    delay : s, s/m, not 0.
    """
    # What is still to be asked for must be as it was: later rows where the delay is positive, else earlier ones.
    count = times.size
    for step in range(count):
        i = step if delay > 0 else count - 1 - step
        read = times[i] + delay * out[i, 3]
        seen = out[i, 3]
        for _turn in range(TURNS):
            x, v, offset = _motion_at(times, out, ratio, end, i, read)
            seen = x / ratio + offset
            change = (read - times[i] - delay * seen) / max(1.0 - delay * v / ratio, STEEPEST)
            read -= change
            if abs(change) < SETTLED_S:
                break
        out[i, 3] = seen


@inlined
def _point(times, out, k):
    return Point(times[k], out[k, 0], out[k, 1], out[k, 2], 0.0)


@compiled
def _motion_at(times, out, ratio, end, i, read):
    """Position, m, and speed, m/s, of the tail when a row is read, and what the camera adds to the lead position, m."""
    k, last = i, times.size - 1
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
    """Position, m, and speed, m/s, of the tail between an instant and another, later or earlier, at which it jerks."""
    h = far.time - near.time
    part = (read - near.time) / h
    d = far.x - near.x - h * near.v - 0.5 * h * h * near.acceleration
    e = h * (far.v - near.v - h * near.acceleration)
    c3, c4 = 4 * d - e, e - 3 * d
    moved = h * near.v + part * (h * h * near.acceleration + part * (3 * c3 + part * 4 * c4))
    x = near.x + part * h * (near.v + 0.5 * part * h * near.acceleration) + part**3 * (c3 + part * c4)
    return x, moved / h
