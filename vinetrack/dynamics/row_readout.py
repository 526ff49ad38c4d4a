"""A picture whose rows are read one after the other: the edge is seen where it is when its row is read.

What is stamped t shows the edge at t + s·y, with y the position at which it is seen then and s the delay by the metre.
Where the vine sets off rows are read at their stamps, since s·y is next to nothing.
"""

from vinetrack.dynamics.between_frames import motion_at
from vinetrack.dynamics.equations import compiled

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
            x, v, offset = motion_at(times, out, ratio, end, i, read)
            seen = x / ratio + offset
            change = (read - times[i] - delay * seen) / max(1.0 - delay * v / ratio, STEEPEST)
            read -= change
            if abs(change) < SETTLED_S:
                break
        out[i, 3] = seen
