"""Rolling shutter: the rows of a picture are read one after the other, and show the edge at different times.

A frame stamped t shows the edge at t + s·y, with y its position at that time and s the delay per metre. At the start of
growth s·y is negligible, and rows are read at their stamps.
"""

from vinetrack.dynamics.between_frames import motion_at
from vinetrack.dynamics.equations import compiled

STEEPEST = 0.1  # Least 1 − s·ẏ by which Newton's method divides (chosen)

TURNS = 8  # Maximum number of Newton iterations (derived)

SETTLED_S = 1e-10  # Step that ends the iterations, s (derived)


@compiled
def read_by_rows(times, out, ratio, end, delay):
    """Replace the positions recorded by an instantaneous shutter by those recorded row by row."""
    # Positions that are still needed must not be replaced yet: later ones at a positive delay, else earlier ones.
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
