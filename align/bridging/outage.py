"""Over an outage of the fixes: position and velocity of a free-running INS, corrected by what was learnt.

An INS is started from the filter's state in the middle of the record so far, and nothing corrects it. Up to
the outage the filter tells what error it has; the rate at which its velocity error grows is learnt as a
function of specific force and velocity, both in n. Over the outage the INS goes on, and its error is what the
filter knew of it last, and the sum of learnt rates. (Xu et al. 2012 learn the errors themselves, and from
position: outside of what was learnt from, that goes astray; `cosim.papers.xu2012_bridges` has both.)

What is learnt is judged before it is used: a model of the first half of the training forecasts the second,
and what it misses there is an error of the rate s, RMS over three axes. After a time t in the outage the
variance of velocity is that of the filter at its begin and ``(s t)^2``, that of position has the filter's,
``t^2`` times that of velocity, and ``(s t^2 / 2)^2``.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ...sins import attitude, earth
from ...sins.earth import GravityModel
from ...sins.error_model import POSITION, VELOCITY
from ...sins.mechanization import NavigationState, mechanize
from ..estimate import Array, Estimate
from ..increments import Record
from ..reception import Integers
from .regression import LEAST_ROWS, Bridging, fit

MOST_POINTS = 101
"""Of a training: 100 rates."""
LEAST_OUTPUTS = 4 * LEAST_ROWS
"""Of the filter before an outage: half of them are trained on, half of these verify."""


def bridged(
    found: Estimate,
    record: Record,
    gravity: GravityModel,
    outages: Sequence[tuple[float, float]],
    bridging: Bridging,
) -> Estimate:
    """The estimate of a filter with position, velocity and their deviations of the bridge in outages.

    ``record`` : what the filter was given. ``outages`` : begin and end, s, of times without valid fixes, in
    order. Attitude and all else stay the filter's; so does everything where ``bridging`` is ``coast``, or
    where the filter has put out fewer than `LEAST_OUTPUTS` before.
    """
    if bridging == "coast" or not outages:
        return found
    time, increments = record.time, record.increments
    lla, v_n, sd, jump = found.lla.copy(), found.v_n.copy(), found.sd.copy(), found.jump.copy()
    since = -np.inf
    for begin, end in outages:
        known = np.isfinite(found.lla).all(axis=1) & (found.time > since) & (found.time <= begin)
        before = np.flatnonzero(known)
        inside = np.flatnonzero((found.time > begin) & (found.time < end) & np.isfinite(found.lla[:, 0]))
        since = end
        if len(inside) == 0 or len(before) < LEAST_OUTPUTS:
            continue
        trained = before[len(before) // 2 :]
        rows = np.concatenate([trained, inside])
        ins, force_n = _free_running(found, time, increments, gravity, rows)
        over = slice(len(trained) - 1, None)  # from the last epoch before the outage on
        position, velocity, slack = _forecast(found, ins, force_n, rows, len(trained), bridging)
        lla[inside] = earth.displaced(ins.lla[over][1:], -position[1:])
        v_n[inside] = ins.v_n[over][1:] - velocity[1:]
        ahead = (found.time[rows[over]] - found.time[rows[over]][0])[1:, None]
        last = found.sd[trained[-1]]
        variance = last[VELOCITY] ** 2 + (slack * ahead) ** 2
        sd[np.ix_(inside, _columns(VELOCITY))] = np.sqrt(variance)
        carried = last[POSITION] ** 2 + (ahead * last[VELOCITY]) ** 2
        sd[np.ix_(inside, _columns(POSITION))] = np.sqrt(carried + (slack * ahead**2 / 2) ** 2)
        # Back from the bridge to the filter.
        last, after = inside[-1], inside[-1] + 1
        if after < len(jump):
            moved = np.append(earth.displacement_n(found.lla[last], lla[last]), found.v_n[last] - v_n[last])
            jump[after] = max(jump[after], np.max(np.abs(moved) / sd[last, :6]))
    return replace(found, lla=lla, v_n=v_n, sd=sd, jump=jump)


def _columns(part: slice) -> Integers:
    return np.arange(part.start, part.stop)


def _free_running(
    found: Estimate, time: Array, increments: Array, gravity: GravityModel, rows: Integers
) -> tuple[NavigationState, Array]:
    """The INS at some rows of the estimate, from the filter's state at the first; and the specific force,
    (j, 3), in n, mean over the time since the row before."""
    epochs = np.searchsorted(time, found.time[rows] - 1e-9)
    part = slice(epochs[0], epochs[-1] + 1)
    first = NavigationState(*(getattr(found, name)[rows[0]] for name in ("lla", "v_n", "q_nb")))
    ran = mechanize(time[part], increments[part, :3], increments[part, 3:], first, gravity)
    at = epochs - epochs[0]
    dv_n = attitude.rotate(ran.q_nb, increments[part, 3:])
    sums = np.cumsum(dv_n, axis=0)[at]
    elapsed = np.diff(found.time[rows], prepend=found.time[rows[0]])[:, None]
    force = np.diff(sums, axis=0, prepend=sums[:1]) / np.where(elapsed > 0, elapsed, 1.0)
    return NavigationState(ran.lla[at], ran.v_n[at], ran.q_nb[at]), force


def _forecast(
    found: Estimate, ins: NavigationState, force_n: Array, rows: Integers, trained: int, bridging: Bridging
) -> tuple[Array, Array, float]:
    """Error of the INS in position, m NED, and velocity, (j, 3) each, from the last trained row on; and the
    error of its rate, m/s^2, that the verification found."""
    t = found.time[rows]
    position = earth.displacement_n(ins.lla[:trained], found.lla[rows[:trained]])
    velocity = ins.v_n[:trained] - found.v_n[rows[:trained]]
    chosen = np.unique(np.linspace(0, trained - 1, min(MOST_POINTS, trained)).astype(int))
    half = len(chosen) // 2
    slack = _verified(t, position, velocity, ins, force_n, chosen, half, bridging)
    inputs, rates = _pairs(t, velocity, ins, force_n, chosen)
    model = fit(bridging, inputs, rates)
    after = np.arange(trained - 1, len(rows))
    return *_integrated(model.predict, t, ins, force_n, after, position[-1], velocity[-1]), slack


def _verified(
    t: Array,
    position: Array,
    velocity: Array,
    ins: NavigationState,
    force_n: Array,
    chosen: Integers,
    half: int,
    bridging: Bridging,
) -> float:
    """RMS error of the rate of velocity, m/s^2, of a model of the first half over the second."""
    model = fit(bridging, *_pairs(t, velocity, ins, force_n, chosen[: half + 1]))
    begin, end = chosen[half], chosen[-1]
    rows = np.arange(begin, end + 1)
    p, v = _integrated(model.predict, t, ins, force_n, rows, position[begin], velocity[begin])
    lead = float(t[end] - t[begin])
    missed = np.stack([(v[-1] - velocity[end]) / lead, 2 * (p[-1] - position[end]) / lead**2])
    return float(np.sqrt(np.mean(missed**2)))


def _pairs(
    t: Array, velocity: Array, ins: NavigationState, force_n: Array, chosen: Integers
) -> tuple[Array, Array]:
    """Inputs and rates of velocity error, (j, 6) and (j, 3), between chosen rows."""
    rates = np.diff(velocity[chosen], axis=0) / np.diff(t[chosen])[:, None]
    weights = np.diff(t, prepend=t[0])[:, None]
    sums = np.cumsum(force_n * weights, axis=0)[chosen]
    force = np.diff(sums, axis=0) / np.diff(t[chosen])[:, None]
    speed = 0.5 * (ins.v_n[chosen[1:]] + ins.v_n[chosen[:-1]])
    return np.hstack([force, speed]), rates


def _integrated(
    predict: Callable[[Array], Array],
    t: Array,
    ins: NavigationState,
    force_n: Array,
    rows: Integers,
    position: Array,
    velocity: Array,
) -> tuple[Array, Array]:
    """Errors in position and velocity at ``rows``, from those at the first of them."""
    inputs = np.hstack([force_n[rows[1:]], 0.5 * (ins.v_n[rows[1:]] + ins.v_n[rows[:-1]])])
    dt = np.diff(t[rows])[:, None]
    v = np.concatenate([velocity[None], velocity + np.cumsum(predict(inputs) * dt, axis=0)])
    p = position + np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (v[1:] + v[:-1]) * dt, axis=0)])
    return p, v
