"""Motion with a slack tail, which cannot push, for trials with `tail_slack: free`.

The payload then falls freely, under the forces on the tail alone; the tip, whose mass is negligible, grows at the speed
at which its own forces balance, Σ tip forces = 0 at the tail speed r·ẏ of the film that passes it. The tail is taut
again when the tip has taken up its slack, x − r·y = 0. A payload that has fallen as far as the tip rests there: its
push on the tip is neglected, so that growth is too slow from then on.

The method is that of Dormand & Prince with its continuous extension: E. Hairer, S. P. Nørsett and G. Wanner, Solving
Ordinary Differential Equations I (Springer, 1993), section II.5, table 5.2, and section II.6, equation (6.12).
"""

from typing import NamedTuple

from vinetrack.dynamics.equations import ENDED, RUNNING, TAUT, TOO_HARD, Point, compiled
from vinetrack.dynamics.radau import quintic
from vinetrack.effects import TrialInputs

MOST_STEPS = 20_000  # Maximum number of steps of a slack phase, chosen as in `vinetrack.dynamics.integrator`

# Indices in the inputs of a trial: derived from the order of the fields
FREE, RATIO = TrialInputs._fields.index("tail_free"), TrialInputs._fields.index("travel_ratio")

# Source: Dormand & Prince, as below.
NODES = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
WEIGHTS = (
    (1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0),
    (3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0),
    (44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
# Source: the same.
ERROR_WEIGHTS = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
# The method of Dormand & Prince
DENSE_WEIGHTS = (
    -12715105075 / 11282082432, 0.0, 87487479700 / 32700410799, -10690763975 / 1880347072,
    701980252875 / 199316789632, -1453857185 / 822651844, 69997945 / 29380423,
)  # fmt: skip


class SlackState(NamedTuple):
    """State with a slack tail: position and speed of the tail, position of the tip, chamber pressure, SI."""

    x: float
    v: float
    y: float
    chamber: float


@compiled
def _tip_tension(equations, time, x, v, chamber, resting, trial):
    """`equations.tip_tension`, compiled once instead of into each of its nine callers."""
    return equations.tip_tension(time, x, v, chamber, resting, trial)


@compiled
def slack_at_rest(equations, trial, time, x, chamber):
    """Whether the tail of a vine at rest would be under compression."""
    if trial.inputs[FREE] <= 0:
        return False
    tension, _rate = _tip_tension(equations, time, x, 0.0, chamber, True, trial)
    return tension < 0


@compiled
def slack_fraction(equations, trial, h, start, end):
    """Fraction of a step at which the tail's tension falls to zero, by bisection."""
    if trial.inputs[FREE] <= 0:
        return 2.0
    tension, _rate = _tip_tension(equations, end.time, end.x, end.v, end.chamber, False, trial)
    if tension >= 0:
        return 2.0
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        x, v, _a = quintic(middle, h, start, end)
        pressure = start.chamber + middle * (end.chamber - start.chamber)
        tension, _rate = _tip_tension(equations, start.time + middle * h, x, v, pressure, False, trial)
        if tension < 0:
            high = middle
        else:
            low = middle
    return high


@compiled
def _free_tip_speed(equations, trial, time, x, chamber, guess, moving):
    """Tail speed r·ẏ at a tip without tension, at which its forces balance, by the Illinois method; x = r·y."""
    f_low, _r = _tip_tension(equations, time, x, 0.0, chamber, not moving, trial)
    if f_low <= 0:
        return 0.0
    low, high = 0.0, max(guess, 1e-6)
    f_high, _r = _tip_tension(equations, time, x, high, chamber, False, trial)
    factor = 1.01
    while f_high > 0 and high < 1e6:
        low, f_low = high, f_high
        high *= factor
        factor = min(factor * factor, 10.0)
        f_high, _r = _tip_tension(equations, time, x, high, chamber, False, trial)
    if low == 0.0 and guess > 0:
        near = 0.99 * guess
        f_near, _r = _tip_tension(equations, time, x, near, chamber, False, trial)
        if f_near > 0:
            low, f_low = near, f_near
        else:
            high, f_high = near, f_near
    for _ in range(100):
        if high - low <= 1e-13 * high or f_high == 0:
            break
        middle = high - f_high * (high - low) / (f_high - f_low)
        if not low < middle < high:
            middle = 0.5 * (low + high)
        f, _r = _tip_tension(equations, time, x, middle, chamber, False, trial)
        if f * f_high < 0:
            low, f_low = high, f_high
        else:
            f_low *= 0.5
        high, f_high = middle, f
        if low > high:
            low, high, f_low, f_high = high, low, f_high, f_low
    return high


@compiled
def _slack_rates(equations, trial, time, s, tip_speed, moving, rates):
    """Write the rates of a `SlackState` into `rates`, shape (4,); return the tail speed of the film at the tip, m/s."""
    r = trial.inputs[RATIO]
    u = _free_tip_speed(equations, trial, time, r * s.y, s.chamber, tip_speed, moving)
    _tension, chamber_rate = _tip_tension(equations, time, r * s.y, u, s.chamber, False, trial)
    fall = equations.free_fall(time, s.y, u / r, s.x, s.v, s.chamber, trial)
    rates[0] = s.v
    rates[1] = 0.0 if s.v <= 0 and fall < 0 else fall
    rates[2] = u / r
    rates[3] = chamber_rate
    return u


@compiled
def _stage_state(s, h, weights, k, n):
    """The state s plus h times the weighted sum of the first n rows of k."""
    x, v, y, chamber = s
    for j in range(n):
        x += h * weights[j] * k[j, 0]
        v += h * weights[j] * k[j, 1]
        y += h * weights[j] * k[j, 2]
        chamber += h * weights[j] * k[j, 3]
    return SlackState(x, v, y, chamber)


@compiled
def _dormand_prince(equations, trial, time, s, h, tip_speed, k):
    """One step: k (7, 4), with its first row given, is completed. Returns the end, its error and the tip's speed."""
    moving = tip_speed > 0
    end = s
    u = tip_speed
    for i in range(6):
        end = _stage_state(s, h, WEIGHTS[i], k, i + 1)
        u = _slack_rates(equations, trial, time + NODES[i] * h, end, u, moving, k[i + 1])
    error_x, error_y = 0.0, 0.0
    for i in range(7):
        error_x += h * ERROR_WEIGHTS[i] * k[i, 0]
        error_y += h * ERROR_WEIGHTS[i] * k[i, 2]
    return end, max(abs(error_x), trial.inputs[RATIO] * abs(error_y)), u


@compiled
def _slack_at(part, h, s, end, k):
    """The state at the fraction `part` of a step."""
    return SlackState(
        _dense(part, h, s.x, end.x, k, 0),
        _dense(part, h, s.v, end.v, k, 1),
        _dense(part, h, s.y, end.y, k, 2),
        _dense(part, h, s.chamber, end.chamber, k, 3),
    )


@compiled
def _dense(part, h, start, end, k, column):
    """The continuous extension of one component, of order 4."""
    change = end - start
    bend = h * k[0, column] - change
    last = 0.0
    for i in range(7):
        last += h * DENSE_WEIGHTS[i] * k[i, column]
    remainder = change - h * k[6, column] - bend
    return start + part * (change + (1 - part) * (bend + part * (remainder + (1 - part) * last)))


@compiled
def _event_fraction(kind, stop, r, h, s, end, k):
    """Fraction of a step at which growth ends (`kind` ENDED) or the tail is taut again (TAUT), by bisection."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        state = _slack_at(middle, h, s, end, k)
        before = r * state.y < stop if kind == ENDED else state.x > r * state.y
        if before:
            low = middle
        else:
            high = middle
    return high


@compiled
def _write_slack(equations, trial, times, row, time, fraction, h, s, end, k, u, u_end, out):
    """Fill the rows of `out` from `row` up to a fraction of a step with r·y, r·ẏ, r·ÿ of the tip; the next row."""
    r = trial.inputs[RATIO]
    while row < times.size and times[row] <= time + fraction * h:
        state = _slack_at((times[row] - time) / h, h, s, end, k)
        speed = _free_tip_speed(equations, trial, times[row], r * state.y, state.chamber, u, u > 0)
        out[row, 0] = r * state.y
        out[row, 1] = speed
        out[row, 2] = (u_end - u) / h
        out[row, 3] = equations.observed(times[row], r * state.y, speed, state.chamber, trial)
        row += 1
    return row


@compiled
def follow_slack(equations, trial, times, row, start, stop, rtol, out, k):
    """Integrate a slack phase until the tail is taut again, growth ends or the last time is reached."""
    time, until = start.time, times[times.size - 1]
    r = trial.inputs[RATIO]
    s = SlackState(start.x, start.v, start.x / r, start.chamber)
    u = _slack_rates(equations, trial, time, s, start.v, start.v > 0, k[0])
    h = 1e-3 * (until - time)
    allowed = 1e-3 * rtol * stop
    for _ in range(MOST_STEPS):
        end, error, u_end = _dormand_prince(equations, trial, time, s, h, u, k)
        if not error <= allowed:
            h *= max(0.2, 0.9 * (allowed / error) ** 0.2) if error < 1e300 else 0.1
            continue
        status, fraction = RUNNING, 1.0
        if r * end.y >= stop:
            status, fraction = ENDED, _event_fraction(ENDED, stop, r, h, s, end, k)
        elif end.x <= r * end.y and end.v < u_end:
            status, fraction = TAUT, _event_fraction(TAUT, stop, r, h, s, end, k)
        row = _write_slack(equations, trial, times, row, time, fraction, h, s, end, k, u, u_end, out)
        if row == times.size and time + fraction * h > until:
            return RUNNING, row, Point(until, end.x, end.v, 0.0, end.chamber), u_end
        if status != RUNNING:
            state = _slack_at(fraction, h, s, end, k)
            return status, row, Point(time + fraction * h, r * state.y, max(state.v, 0.0), 0.0, state.chamber), u_end
        time += h
        s = _resting_on_tip(end, stop / r + end.y, u_end / r)
        u = _slack_rates(equations, trial, time, s, u_end, u_end > 0, k[0])
        h *= min(5.0, 0.9 * (allowed / max(error, 1e-6 * allowed)) ** 0.2)
    return TOO_HARD, row, Point(time, s.x, s.v, 0.0, s.chamber), u


@compiled
def _resting_on_tip(s, tip, tip_velocity):
    """The state with a payload that has reached the tip resting there."""
    if s.x > tip:
        return SlackState(tip, min(s.v, tip_velocity), s.y, s.chamber)
    return s
