"""One step of Radau IIA, order 5, for the speed and position of a tail and the pressure of its chamber.

Position follows from the speeds by the same quadrature, so that the Newton system is that of the three stage speeds
alone; the chamber pressure has a Newton system of its own. `vinetrack.dynamics.integrator` states why this method is
used.

Source: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (Springer, 1996), sections IV.5 (the method,
table 5.6) and IV.8 (its implementation in RADAU5: simplified Newton iterations, starting values, error estimate).
"""

from typing import NamedTuple

from vinetrack.dynamics.equations import Point, inlined

SQRT6 = 6.0**0.5  # Derived: √6, which appears in the nodes

C1, C2 = (4 - SQRT6) / 10, (4 + SQRT6) / 10
A11, A12, A13 = (88 - 7 * SQRT6) / 360, (296 - 169 * SQRT6) / 1800, (-2 + 3 * SQRT6) / 225
A21, A22, A23 = (296 + 169 * SQRT6) / 1800, (88 + 7 * SQRT6) / 360, (-2 - 3 * SQRT6) / 225
A31, A32, A33 = (16 - SQRT6) / 36, (16 + SQRT6) / 36, 1 / 9  # Nodes c and matrix A of the method; the third node is 1

S1 = (1 - C2) / (C1 * (C1 - C2) * (C1 - 1))  # Derivative at the end of a step of the cubic through (0, 0), (C1, z1),
S2 = (1 - C1) / (C2 * (C2 - C1) * (C2 - 1))
S3 = 1 + 1 / (1 - C1) + 1 / (1 - C2)  # Slope at the end of a step of the cubic through (0, 0), (C1, z1), (C2, z2),

MU = 3 + 3 ** (2 / 3) - 3 ** (1 / 3)  # source: below
# The real eigenvalue of A⁻¹ and the weights of the estimate of the local error
E1, E2, E3 = (-13 - 7 * SQRT6) / 3, (-13 + 7 * SQRT6) / 3, -1 / 3

MOST_NEWTON_ITERATIONS = 9  # Newton iterations before a step is given up; chosen near the 7 of RADAU5

NEWTON_TOLERANCE = 1e-2  # Change of the speeds at which the iterations stop, relative to the tolerance of a step

# Ratio of two successive changes below which the Jacobian is kept for the next iteration, chosen
FAST_CONTRACTION = 0.1


class Stages(NamedTuple):
    """Increments of speed at the three stages of a step of size h, m/s and s; h is 0 if there is no previous step."""

    h: float
    z1: float
    z2: float
    z3: float


NO_STAGES = Stages(0.0, 0.0, 0.0, 0.0)  # For a step without a previous one: after a start and after a rejected step


@inlined
def _solve3(m11, m12, m13, m21, m22, m23, m31, m32, m33, b1, b2, b3):
    """Solve three linear equations by Cramer's rule: the Newton step of the three stages."""
    k1 = m22 * m33 - m23 * m32
    k2 = m23 * m31 - m21 * m33
    k3 = m21 * m32 - m22 * m31
    scale = 1 / (m11 * k1 + m12 * k2 + m13 * k3)
    z1 = (b1 * k1 + m12 * (m23 * b3 - b2 * m33) + m13 * (b2 * m32 - m22 * b3)) * scale
    z2 = (m11 * (b2 * m33 - m23 * b3) + b1 * k2 + m13 * (m21 * b3 - b2 * m31)) * scale
    z3 = (m11 * (m22 * b3 - b2 * m32) + m12 * (b2 * m31 - m21 * b3) + b1 * k3) * scale
    return z1, z2, z3


@inlined
def _speed_derivative(equations, trial, time, x, v, chamber, acceleration, scale):
    """∂a/∂v, 1/s, by a one-sided difference towards higher speed, since a different law holds at rest."""
    delta = 1e-6 * max(abs(v), 1e-4 * scale)
    higher, _rate = equations.rates(time, x, v + delta, chamber, trial)
    return (higher - acceleration) / delta


@inlined
def starting_values(point, h, previous):
    """Starting values of the Newton iterations: the collocation polynomial of the last step, extrapolated. Without a
    previous step they follow from the acceleration at the start. No stage speed is set below a tenth of the speed at
    the start.
    """
    lowest = -0.9 * point.v
    if previous.h > 0:
        r = h / previous.h
        p1, p2, p3 = (
            _collocation_polynomial(1 + C1 * r, previous),
            _collocation_polynomial(1 + C2 * r, previous),
            _collocation_polynomial(1 + r, previous),
        )
        w1, w2, w3 = p1 - previous.z3, p2 - previous.z3, p3 - previous.z3
    else:
        w1, w2, w3 = C1 * h * point.acceleration, C2 * h * point.acceleration, h * point.acceleration
    return Stages(h, max(w1, lowest), max(w2, lowest), max(w3, lowest))


@inlined
def _collocation_polynomial(s, stages):
    """The cubic through (0, 0), (C1, z1), (C2, z2), (1, z3), at s."""
    l1 = s * (s - C2) * (s - 1) / (C1 * (C1 - C2) * (C1 - 1))
    l2 = s * (s - C1) * (s - 1) / (C2 * (C2 - C1) * (C2 - 1))
    l3 = s * (s - C1) * (s - C2) / ((1 - C1) * (1 - C2))
    return l1 * stages.z1 + l2 * stages.z2 + l3 * stages.z3


@inlined
def _newton_speeds(h, j1, j2, j3, f1, f2, f3, z1, z2, z3):
    """Newton step of the stage speeds: (I − h A J) d = h A f − z, J the derivatives ∂a/∂v."""
    return _solve3(
        1 - h * A11 * j1, -h * A12 * j2, -h * A13 * j3,
        -h * A21 * j1, 1 - h * A22 * j2, -h * A23 * j3,
        -h * A31 * j1, -h * A32 * j2, 1 - h * A33 * j3,
        h * (A11 * f1 + A12 * f2 + A13 * f3) - z1,
        h * (A21 * f1 + A22 * f2 + A23 * f3) - z2,
        h * (A31 * f1 + A32 * f2 + A33 * f3) - z3,
    )  # fmt: skip


@inlined
def _newton_chamber(h, jc, g1, g2, g3, q1, q2, q3, chamber):
    """Newton step of the chamber pressures at the stages; jc is h times the derivative of the rate."""
    return _solve3(
        1 - A11 * jc, -A12 * jc, -A13 * jc,
        -A21 * jc, 1 - A22 * jc, -A23 * jc,
        -A31 * jc, -A32 * jc, 1 - A33 * jc,
        h * (A11 * g1 + A12 * g2 + A13 * g3) - (q1 - chamber),
        h * (A21 * g1 + A22 * g2 + A23 * g3) - (q2 - chamber),
        h * (A31 * g1 + A32 * g2 + A33 * g3) - (q3 - chamber),
    )  # fmt: skip


@inlined
def radau_step(equations, trial, point, stages, scale, rtol):
    """One step from `point`, with the size and the starting values in `stages`."""
    time, x, v, _acceleration, chamber = point
    h, z1, z2, z3 = stages
    j1 = j2 = j3 = 0.0
    g1 = g2 = g3 = 0.0
    tolerance = NEWTON_TOLERANCE * rtol * max(scale, abs(v))
    previous_size = 1e300
    q1 = q2 = q3 = chamber
    jc = 0.0
    chamber_active = False
    jacobian_current = False
    converged = False
    for iteration in range(MOST_NEWTON_ITERATIONS):
        v1, v2, v3 = v + z1, v + z2, v + z3
        x1 = x + h * (C1 * v + A11 * z1 + A12 * z2 + A13 * z3)
        x2 = x + h * (C2 * v + A21 * z1 + A22 * z2 + A23 * z3)
        x3 = x + h * (v + A31 * z1 + A32 * z2 + A33 * z3)
        t1, t2, t3 = time + C1 * h, time + C2 * h, time + h
        f1, g1 = equations.rates(t1, x1, v1, q1, trial)
        f2, g2 = equations.rates(t2, x2, v2, q2, trial)
        f3, g3 = equations.rates(t3, x3, v3, q3, trial)
        if not jacobian_current:
            j1 = _speed_derivative(equations, trial, t1, x1, v1, q1, f1, scale)
            j2 = _speed_derivative(equations, trial, t2, x2, v2, q2, f2, scale)
            j3 = _speed_derivative(equations, trial, t3, x3, v3, q3, f3, scale)
            jacobian_current = True
            # The equation of a chamber is stiff if its supply is fast.
            chamber_active = equations.has_chamber() and (g1 != 0 or g2 != 0 or g3 != 0)
            if chamber_active:
                dq = 1e-6 * (abs(q3) + 1e3)
                _f, higher = equations.rates(t3, x3, v3, q3 + dq, trial)
                jc = h * (higher - g3) / dq
        change = 0.0
        if chamber_active:
            c1, c2, c3 = _newton_chamber(h, jc, g1, g2, g3, q1, q2, q3, chamber)
            q1, q2, q3 = q1 + c1, q2 + c2, q3 + c3
            change = max(abs(c1), abs(c2), abs(c3)) / (abs(q3) + 1e3)
        d1, d2, d3 = _newton_speeds(h, j1, j2, j3, f1, f2, f3, z1, z2, z3)
        z1, z2, z3 = z1 + d1, z2 + d2, z3 + d3
        size = max(abs(d1), abs(d2), abs(d3), change * scale)
        if not size < 1e300:
            break
        ratio = size / previous_size
        # The next iteration would change the speeds by about ratio · size.
        if size <= tolerance or (iteration > 0 and ratio < FAST_CONTRACTION and ratio * size <= 0.1 * tolerance):
            converged = True
            break
        if ratio > FAST_CONTRACTION:
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
    h, z1, z2, z3 = stages
    raw = (h * point.acceleration + E1 * z1 + E2 * z2 + E3 * z3) / MU
    # At least a tenth of the final speed: an error at the start affects the whole growth.
    weight = rtol * max(0.1 * scale, abs(point.v), abs(point.v + z3))
    return abs(raw) / weight


@inlined
def _end_of_step(point, stages, chamber):
    """The vine at the end of a step; `chamber` is the pressure at its last stage."""
    h, z1, z2, z3 = stages
    x_end = point.x + h * (point.v + A31 * z1 + A32 * z2 + A33 * z3)
    acceleration_end = (S1 * z1 + S2 * z2 + S3 * z3) / h
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
