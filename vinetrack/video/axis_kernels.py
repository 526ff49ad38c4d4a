"""Compiled loops of the search for the growth axis."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def fan(
    along: np.ndarray, across: np.ndarray, time: np.ndarray, weight: np.ndarray, bins: int, length: int, n_times: int
) -> np.ndarray:
    """What monotone paths collect in each band of two bins across, shape (bins − 1,)."""
    table = np.zeros((bins, n_times, length // 4 + 1), np.float32)
    for i in range(len(along)):
        b = min(max(int(across[i]), 0), bins - 1)
        table[b, int(time[i]), min(max(int(along[i] / 4), 0), length // 4)] += weight[i]
    out = np.zeros(bins - 1)
    best = np.zeros(length // 4 + 2)
    for b in range(bins - 1):
        best[:] = 0.0
        for t in range(n_times):
            for s in range(1, len(best)):
                best[s] = max(best[s], best[s - 1] + table[b, t, s - 1] + table[b + 1, t, s - 1])
        out[b] = best[-1]
    return out


@njit(cache=True)
def ordered_path(table: np.ndarray) -> np.ndarray:
    """Time at which a monotone path passes each place, for a table (n_times, n_places); NaN beyond its ends."""
    n, places = table.shape
    best = np.zeros((n, places + 1))
    came = np.zeros((n, places + 1), np.uint8)
    for t in range(n):
        for s in range(places + 1):
            best[t, s] = best[t - 1, s] if t > 0 else 0.0
            if s > 0 and best[t, s - 1] + table[t, s - 1] > best[t, s]:
                best[t, s] = best[t, s - 1] + table[t, s - 1]
                came[t, s] = 1
    passed = np.full(places, np.nan)
    t, s = n - 1, places
    while s > 0 and t >= 0:
        if came[t, s] == 1:
            passed[s - 1] = t
            s -= 1
        elif t > 0:
            t -= 1
        else:
            break
    return passed
