"""Where a measured pressure changes its slope: no step of the integrator is good across such a corner.

This file is part of the text of a compiled kernel, see `vinetrack.dynamics.integrator`.
"""

from numba import njit


# ---- what follows is set behind the rates of one model ----
@njit(nogil=True)
def next_corner(k, time, trace_time, trace_pressure):
    """Place of the first sample of a trace after `time`, from place k on, at which it changes its slope."""
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
