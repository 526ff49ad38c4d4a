"""Interpolation of the motion between the requested times.

It is the Hermite polynomial of degree 5 through position, speed and acceleration on either side; next to the end of
growth, where the acceleration jumps, that of degree 4 without the acceleration at the jump. The jump at the start of
motion is not treated separately: over a frame that is an error of micrometres.
"""

from vinetrack.dynamics.equations import Point, compiled, inlined
from vinetrack.dynamics.radau import quintic


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
