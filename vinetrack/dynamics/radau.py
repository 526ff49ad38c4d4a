"""One step of Radau IIA, order 5, for the speed and position of a tail and the pressure of its chamber.

Text of a compiled kernel, set between the `rates` of one model and `vinetrack.dynamics.integrator`; why it is this
method is said there. Position follows from the speeds by the same quadrature, so that Newton's system is of the three
stage speeds alone; the chamber's pressure has one of its own.

Source: Hairer & Wanner, Solving Ordinary Differential Equations II, sections IV.5 and IV.8.
"""

from numba import njit

HAS_CHAMBER = True  #: whether an effect of the model gives the chamber an equation of its own


@njit(nogil=True)
def rates(time, x, v, chamber, on, rig, theta, trace_time, trace_pressure, bends):
    """Acceleration of the tail and rate of change of the chamber's pressure: here stand those of one model."""
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

MOST_NEWTON = 9


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
    small = 1e-2 * rtol * max(scale, abs(v))
    before = 1e300
    q1 = q2 = q3 = chamber
    jc = 0.0
    filling = False
    fresh = False
    converged = False
    for iteration in range(MOST_NEWTON):
        v1, v2, v3 = v + z1, v + z2, v + z3
        x1 = x + h * (C1 * v + A11 * z1 + A12 * z2 + A13 * z3)
        x2 = x + h * (C2 * v + A21 * z1 + A22 * z2 + A23 * z3)
        x3 = x + h * (v + A31 * z1 + A32 * z2 + A33 * z3)
        t1, t2, t3 = time + C1 * h, time + C2 * h, time + h
        f1, g1 = rates(t1, x1, v1, q1, on, rig, theta, trace_time, trace_pressure, bends)
        f2, g2 = rates(t2, x2, v2, q2, on, rig, theta, trace_time, trace_pressure, bends)
        f3, g3 = rates(t3, x3, v3, q3, on, rig, theta, trace_time, trace_pressure, bends)
        if not fresh:
            j1 = slope_in_speed(t1, x1, v1, q1, f1, scale, on, rig, theta, trace_time, trace_pressure, bends)
            j2 = slope_in_speed(t2, x2, v2, q2, f2, scale, on, rig, theta, trace_time, trace_pressure, bends)
            j3 = slope_in_speed(t3, x3, v3, q3, f3, scale, on, rig, theta, trace_time, trace_pressure, bends)
            fresh = True
            # A chamber of its own is as stiff as its supply is quick.
            filling = HAS_CHAMBER and (g1 != 0 or g2 != 0 or g3 != 0)
            if filling:
                dq = 1e-6 * (abs(q3) + 1e3)
                _f, other = rates(t3, x3, v3, q3 + dq, on, rig, theta, trace_time, trace_pressure, bends)
                jc = h * (other - g3) / dq
        change = 0.0
        if filling:
            c1, c2, c3 = solve3(
                1 - A11 * jc, -A12 * jc, -A13 * jc,
                -A21 * jc, 1 - A22 * jc, -A23 * jc,
                -A31 * jc, -A32 * jc, 1 - A33 * jc,
                h * (A11 * g1 + A12 * g2 + A13 * g3) - (q1 - chamber),
                h * (A21 * g1 + A22 * g2 + A23 * g3) - (q2 - chamber),
                h * (A31 * g1 + A32 * g2 + A33 * g3) - (q3 - chamber),
            )  # fmt: skip
            q1, q2, q3 = q1 + c1, q2 + c2, q3 + c3
            change = max(abs(c1), abs(c2), abs(c3)) / (abs(q3) + 1e3)
        d1, d2, d3 = solve3(
            1 - h * A11 * j1, -h * A12 * j2, -h * A13 * j3,
            -h * A21 * j1, 1 - h * A22 * j2, -h * A23 * j3,
            -h * A31 * j1, -h * A32 * j2, 1 - h * A33 * j3,
            h * (A11 * f1 + A12 * f2 + A13 * f3) - z1,
            h * (A21 * f1 + A22 * f2 + A23 * f3) - z2,
            h * (A31 * f1 + A32 * f2 + A33 * f3) - z3,
        )  # fmt: skip
        z1, z2, z3 = z1 + d1, z2 + d2, z3 + d3
        size = max(abs(d1), abs(d2), abs(d3), change * scale)
        if not size < 1e300:
            return False, 1e300, x, v, slope, chamber, z1, z2, z3
        ratio = size / before
        # The next iteration would change about ratio · size more.
        if size <= small or (iteration > 0 and ratio < 0.1 and ratio * size <= 0.1 * small):
            converged = True
            break
        if ratio > 0.1:
            fresh = False
        if iteration > 3 and size > before:
            break
        before = size
    if not converged:
        return False, 1e300, x, v, slope, chamber, z1, z2, z3
    # Hairer filters this with (μ/h − J)⁻¹. Not here: it hides what a long stiff step does wrong at its far end.
    raw = (h * slope + E1 * z1 + E2 * z2 + E3 * z3) / MU
    # A tenth of the final speed: what goes wrong at the start is carried through the whole growth.
    weight = rtol * max(0.1 * scale, abs(v), abs(v + z3))
    x_end = x + h * (v + A31 * z1 + A32 * z2 + A33 * z3)
    slope_end = (S1 * z1 + S2 * z2 + S3 * z3) / h
    return True, abs(raw) / weight, x_end, v + z3, slope_end, q3, z1, z2, z3


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
def carry_on(s, z1, z2, z3):
    """The cubic through (0, 0), (C1, z1), (C2, z2), (1, z3), at s."""
    l1 = s * (s - C2) * (s - 1) / (C1 * (C1 - C2) * (C1 - 1))
    l2 = s * (s - C1) * (s - 1) / (C2 * (C2 - C1) * (C2 - 1))
    l3 = s * (s - C1) * (s - C2) / ((1 - C1) * (1 - C2))
    return l1 * z1 + l2 * z2 + l3 * z3
