"""The interface of the integrator to one model and one trial: compiled functions and the arrays that they use.

`vinetrack.dynamics.kernel` writes the functions of one model and collects them in an `Equations`; the integrator
(`radau`, `slack_tail`, `integrator`) takes it as first argument. For numba the `Equations` of every model are a type of
their own (`EquationsType`), so that the integrator is compiled for each model and the calls can be inlined.

The integrator is ordinary Python too: with NUMBA_DISABLE_JIT=1 a debugger or a coverage tool follows every line.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit, types
from numba.core.imputils import lower_constant, lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, models, register_model, typeof_impl

from vinetrack.core.records import Floats

_UNWRAPPED: dict[str, Any] = {"no_cfunc_wrapper": True, "no_cpython_wrapper": True}
_FLAGS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False, **_UNWRAPPED}

compiled: Any = njit(**_FLAGS, forceinline=False)
inlined: Any = njit(**_FLAGS, forceinline=True)
# Options with which every function of the integrator is compiled (measured)
merged: Any = njit(**_FLAGS, inline="always")


class TrialArrays(NamedTuple):
    """The inputs of one trial, constant during its growth."""

    on: Any  #: which effects act, shape (n_effects,)
    inputs: Floats  #: the fields of `vinetrack.effects.TrialInputs`, SI
    theta: Floats  #: parameters of all effects, in the order of the model
    trace_time: Floats  #: times of a measured pressure since release, s, shape (n_samples,); empty without one
    trace_pressure: Floats  #: gauge pressure there, Pa
    bends: Floats  #: rows of start, arc and radius, m, shape (n_bends, 3)


@dataclass(frozen=True, eq=False)
class Equations:
    """The compiled functions of one model, called with `(time, x, v, chamber, trial)` unless stated. x, v are position
    and speed of the tail, m and m/s; `chamber` is the gauge pressure of the chamber, Pa. The last five are for tails
    that may go slack; otherwise they are the placeholders at the end of this file.
    """

    name: str  #: of the model, unique in a process: it distinguishes numba's types
    rates: Callable  #: acceleration of the tail, m/s², and rate of change of the chamber's pressure, Pa/s
    rest_acceleration: Callable  #: of a vine at rest (no v), including the forces that hold it
    observed: Callable  #: position of the leading edge that the camera reports, m
    first_chamber: Callable  #: pressure of the chamber at release, of (trial) alone
    has_chamber: Callable  #: whether an effect gives the chamber an equation of its own, of no argument
    row_delay: Callable  #: how much later rows are read by the metre, s/m, of (trial) alone
    averaged_over: Callable  #: square of the time that positions are averaged over, s², of (trial) alone
    tip_tension: Callable  #: tension that the tip leaves for the tail, N, and rate of the chamber; one more argument
    free_fall: Callable  #: acceleration of a slack tail, m/s², at (time, y, ẏ, x, v, chamber, trial)
    slack_fraction: Callable  #: `vinetrack.dynamics.slack_tail.slack_fraction`
    slack_at_rest: Callable  #: `vinetrack.dynamics.slack_tail.slack_at_rest`
    follow_slack: Callable  #: `vinetrack.dynamics.slack_tail.follow_slack`


class EquationsType(types.Opaque):
    """Numba's type for the `Equations` of one model: no data at run time; its attributes are compiled functions. A
    tuple of functions would work too, but numba passes its functions by their memory addresses, and then cannot cache
    the compiled form for the next process.
    """

    def __init__(self, equations: Equations) -> None:
        self.equations = equations
        super().__init__(f"Equations({equations.name})")


register_model(EquationsType)(models.OpaqueModel)


@typeof_impl.register(Equations)
def _type_of_equations(value: Equations, _context: Any) -> EquationsType:
    return EquationsType(value)


@infer_getattr
class _EquationsAttributes(AttributeTemplate):
    key = EquationsType

    def generic_resolve(self, value: EquationsType, attr: str) -> Any:  # type: ignore[override]
        return types.Dispatcher(getattr(value.equations, attr))


@lower_constant(EquationsType)
def _lower_equations(context: Any, _builder: Any, _type: Any, _value: Any) -> Any:
    return context.get_dummy_value()


@lower_getattr_generic(EquationsType)
def _lower_function(context: Any, _builder: Any, _type: Any, _value: Any, _attribute: str) -> Any:
    return context.get_dummy_value()


class Point(NamedTuple):
    """State of the vine: time, s; position, speed and acceleration of the tail; pressure of the chamber, Pa."""

    time: float
    x: float
    v: float
    acceleration: float
    chamber: float


RUNNING, ENDED, STALLED, TOO_HARD, TAUT = 0, 1, 2, 3, 4  # Status of a trajectory


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


@inlined
def with_chamber():
    """Value of `has_chamber` for a model with an equation of the chamber: true, as an inlined function."""
    return True


@inlined
def without_chamber():
    """Value of `has_chamber` for a model without an equation of the chamber: false, as an inlined function."""
    return False


@inlined
def not_averaged(trial):  # noqa: ARG001
    """Placeholder for `averaged_over` if positions are not averaged in time."""
    return 0.0


@inlined
def no_row_delay(trial):  # noqa: ARG001
    """Placeholder for `row_delay` if all rows of a picture are read at once."""
    return 0.0


@inlined
def no_tip_tension(time, x, v, chamber, resting, trial):  # noqa: ARG001
    """Placeholder for `tip_tension` if no tail may go slack."""
    return 0.0, 0.0


@inlined
def no_free_fall(time, y, ydot, x, v, chamber, trial):  # noqa: ARG001
    """Placeholder for `free_fall` if no tail may go slack."""
    return 0.0


@inlined
def never_slack(equations, trial, h, start, end):  # noqa: ARG001
    """Placeholder for `slack_fraction` if no tail may go slack: beyond the end of every step."""
    return 2.0


@inlined
def not_slack_at_rest(equations, trial, time, x, chamber):  # noqa: ARG001
    """Placeholder for `slack_at_rest` if no tail may go slack."""
    return False


@inlined
def no_slack_phase(equations, trial, times, row, start, stop, rtol, out, work):  # noqa: ARG001
    """Placeholder for `follow_slack` if no tail may go slack."""
    return TAUT, row, start, 0.0
