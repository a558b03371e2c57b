"""Learnt corrections of the INS over the outages of Xu et al. 2012 (sections 3.2 and 4).

As published the input is position and velocity as the INS shows them, (3.10), the output what the H-infinity
filter took out of them, (3.11): in an outage the navigator has no other input. As mended the input is the
INS's velocity and the output the rate at which its velocity error grows; their sum goes on from what the
filter knew last, and the machine stays inside what it was trained on.
"""

from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from ...align.bridging import lssvm
from ...align.bridging.regression import Bridging, fit
from ..parallel import in_order
from .results import Array, Progress
from .xu2012_world import SEEN, World, ins_output


class Learnt(NamedTuple):
    """Errors (k, n, 4) of the corrected INS in the outages, NaN elsewhere, and what LS-SVMs chose."""

    errors: dict[str, Array]
    chosen: Array
    """(k, 2, 3): gamma, width and verification RMS of the LS-SVM as published, for each outage."""


def learnt(
    world: World, free: Array, corrected: Array, mended: tuple[Array, Array], progress: Progress | None
) -> Learnt:
    """Bridge all outages of all draws.

    ``free`` (k, n, 6): errors of the INS left alone; ``corrected``: of the INS with the filter as published,
    which it is set to at the start of each training area; ``mended``: both with the filter as mended.
    """
    shown, shown_mended = ins_output(world, free), ins_output(world, mended[0])
    taken_out = (free - corrected)[..., SEEN]
    taken_out_mended = (mended[0] - mended[1])[..., SEEN]
    names = ("lssvm", "mlp", "rates")
    errors = {name: np.full(taken_out.shape, np.nan) for name in names}
    chosen = np.empty((len(free), 2, 3))
    stretches = world.settings.stretches
    pairs = list(zip(stretches[::2], stretches[1::2], strict=True))

    def bridge(task: tuple[int, int]) -> tuple[Array, dict[str, Array]]:
        draw, number = task
        area, outage = pairs[number]
        found: dict[str, Array] = {}
        parameters = np.empty(3)
        models: tuple[Bridging, ...] = ("lssvm", "mlp")
        for name in models:
            model = fit(name, shown[draw, area], taken_out[draw, area], seed=draw)
            found[name] = model.predict(shown[draw, outage])
            if isinstance(model.model, lssvm.LsSvm):
                machine = model.model
                parameters = np.array([machine.gamma, machine.width, machine.verification_rms])
        found["rates"] = by_rates(
            shown_mended[draw], taken_out_mended[draw], area, outage, world.settings.period_s
        )
        return parameters, found

    tasks = [(draw, number) for draw in range(len(free)) for number in range(len(pairs))]
    # The matrices are small: each thread of ours does its own, and none of BLAS's.
    with threadpool_limits(1):
        for done, ((draw, number), (parameters, found)) in enumerate(
            zip(tasks, in_order(bridge, tasks), strict=True), 1
        ):
            outage = pairs[number][1]
            chosen[draw, number] = parameters
            for name, correction in found.items():
                whole = mended[0] if name == "rates" else free
                errors[name][draw, outage] = whole[draw, outage, SEEN] - correction
            if progress:
                progress(done, len(tasks))
    return Learnt(errors, chosen)


def by_rates(shown: Array, taken_out: Array, area: slice, outage: slice, period_s: float) -> Array:
    """Correction (j, 4) over an outage from rates of the velocity error that an LS-SVM learnt.

    ``shown``, ``taken_out`` (n, 4): what the INS shows, and what the filter took out of it.
    """
    rates = np.diff(taken_out[area, 2:], axis=0) / period_s
    model = fit("lssvm", shown[area, 2:][:-1], rates)
    last = area.stop - 1
    ahead = model.predict(shown[last : outage.stop - 1, 2:])
    velocity = taken_out[last, 2:] + period_s * np.cumsum(ahead, axis=0)
    before = np.concatenate([taken_out[last : last + 1, 2:], velocity[:-1]])
    position = taken_out[last, :2] + period_s * np.cumsum(before, axis=0)
    return np.concatenate([position, velocity], axis=1)
