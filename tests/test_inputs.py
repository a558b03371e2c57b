"""What filters are given is made once and shared: the same bits as made for each, and nobody writes to it."""

import numpy as np
import pytest
from fleetalign.align._increments_kernel import count_repeats
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.methods import estimate
from fleetalign.cosim.run import simulate
from fleetalign.cosim.scenario import replaced

METHODS = ("ekf", "ekf_stamped", "l2linf", "smoother", "ekf_ten")
BROKEN = {
    "faults.imu": [{"kind": "nan", "start_s": 12.0}],
    "faults.packets": {"outlier_share": 0.1, "detour_share": 0.2, "copies": 2},
}


def arrays_of(value, found=None):
    """All arrays of a tree of tuples and data classes."""
    found = [] if found is None else found
    if isinstance(value, np.ndarray):
        found.append(value)
    elif isinstance(value, tuple):
        for part in value:
            arrays_of(part, found)
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            arrays_of(getattr(value, name), found)
    return found


@pytest.mark.parametrize("coarse_stage", ["none", "in_motion"])
def test_filters_share_what_they_are_given_and_leave_it_as_it_was(stated, flight, window, coarse_stage):
    scenario = replaced(stated, {"alignment.filters": ["ekf"], **BROKEN})
    run = simulate(scenario, flight, 0, seed=7)
    settings = scenario.alignment.settings.model_copy(update={"coarse_stage": coarse_stage})
    measured = run.imu.time, run.imu.dtheta_b, run.imu.dv_b, run.q_nb_coarse, run.fixes

    def given():
        return AlignmentInput.checked(*measured, settings, scenario.imu, window.gravity)

    shared = given()
    before = [array.tobytes() for array in arrays_of(shared)]
    assert len(before) > 15
    together = {name: estimate(name, shared) for name in METHODS}
    assert [array.tobytes() for array in arrays_of(shared)] == before
    for name in METHODS:
        alone = estimate(name, given())
        assert [a.tobytes() for a in arrays_of(alone)] == [a.tobytes() for a in arrays_of(together[name])]
    # An outcome of one is not that of another.
    assert len({id(found.fix_outcome) for found in together.values()}) == len(METHODS)


@pytest.mark.parametrize("case", ["noise", "stuck", "full scale", "not a number", "beyond"])
def test_compiled_look_at_a_record_is_the_readable_one(case):
    rng = np.random.default_rng(8)
    increments = rng.normal(size=(200, 6))
    if case == "stuck":
        increments[50:60, 1] = increments[50, 1]
        increments[90:94:2, 3] = 0.1
    elif case == "full scale":
        increments[:, :3] = np.minimum(increments[:, :3], 1.0)
        increments[:, 3:] = np.maximum(increments[:, 3:], -1.0)
    elif case == "not a number":
        increments[7, 2] = increments[8, 2] = np.nan
        increments[9, 4] = np.inf
    elif case == "beyond":
        increments[0, 5] = 11.0
    most, again = np.full(6, 10.0), np.zeros(6, np.int64)
    possible = count_repeats(increments, most, 4, again)
    assert possible == (np.abs(increments) <= most).all()
    rest = increments[1:]
    ends = [np.sum(rest == end(rest, axis=0), axis=0) for end in (np.max, np.min)]
    pairs = sum(np.sum(rest[lag:] == rest[:-lag], axis=0) for lag in range(1, 5))
    np.testing.assert_array_equal(again, np.maximum(*ends) + pairs)
