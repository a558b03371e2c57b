"""Fixes of an antenna away from the IMU: the truth of it, and filters that know, estimate or ignore the
arm."""

import numpy as np
import pytest
from fleetalign.align.consistency import mean_band
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.methods import estimate
from fleetalign.cosim.antenna import at_antenna
from fleetalign.cosim.run import simulate, true_lever_arm
from fleetalign.cosim.scenario import replaced
from fleetalign.cosim.score import errors_against
from fleetalign.sins import attitude, earth

ARM = (6.0, 1.0, -2.5)
RUNS = 12


def test_antenna_is_where_the_body_holds_it(window):
    antenna = at_antenna(window, ARM)
    offset = earth.displacement_n(antenna.lla, window.lla)
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), np.linalg.norm(ARM), rtol=1e-6)
    offset_b = attitude.rotate(attitude.conjugate(window.q_nb), offset)
    np.testing.assert_allclose(offset_b, [ARM] * len(offset), atol=1e-5)
    # Its velocity integrates to its positions: 40 s within the millimetres that a step of 0.01 s leaves.
    mean = 0.5 * (antenna.v_n[1:] + antenna.v_n[:-1])
    moved = earth.displacement_n(antenna.lla[1:], antenna.lla[:-1])
    assert np.abs(np.cumsum(moved - mean * window.dt, axis=0)[:500]).max() < 0.02
    assert at_antenna(window, (0, 0, 0)) is window


@pytest.fixture(scope="module")
def runs(stated, flight):
    """Errors at the end by how the arm is treated; the same IMU, and noise of the fixes, in all."""

    def errors(told):
        changes = {f"alignment.settings.{name}": value for name, value in told.items()}
        scenario = replaced(
            stated, {"alignment.filters": ["ekf_stamped", "l2linf"], **QUIET, **changes}, "test"
        )
        return [simulate(scenario, flight, i, 4) for i in range(RUNS)]

    return {
        "none": errors({}),
        "known": errors({"lever_arm_b_m": ARM}),
        "estimated": errors({"lever_arm_b_m": ARM, "lever_arm_sd_m": 0.5}),
    }


QUIET = {"fixes.position_sd_m": 1.0, "fixes.velocity_sd_mps": 0.03}
"""Fixes that see an arm."""


def rms(runs, window, name):
    ends = [errors_against(window, run.estimates[name])[-1] for run in runs]
    return np.sqrt(np.mean(np.square(ends), axis=0))


@pytest.mark.parametrize("name", ["ekf_stamped", "l2linf"])
def test_a_known_arm_costs_nothing(runs, window, name):
    ratio = rms(runs["known"], window, name) / rms(runs["none"], window, name)
    # The same noise run by run; with l2linf what the angular acceleration does in the delay is left out.
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)


@pytest.mark.parametrize("name", ["ekf_stamped", "l2linf"])
def test_an_arm_of_doubtful_survey_is_estimated(runs, name):
    estimates = [run.estimates[name] for run in runs["estimated"]]
    sd = np.array([e.sd[-1, 16:] for e in estimates])
    assert (sd < 0.45).all()
    assert (sd[:, [0, 1]] < 0.3).all()
    nis = np.concatenate([e.nis[e.fused] for e in estimates])
    low, high = mean_band(6, len(nis), 0.9999)
    assert low < nis.mean() < high


def test_the_estimate_is_nearer_to_the_true_arm_than_the_survey(stated, runs, flight):
    changes = {"alignment.settings.lever_arm_b_m": ARM, "alignment.settings.lever_arm_sd_m": 0.5}
    scenario = replaced(stated, {**QUIET, **changes}, "test")
    errors, sds = [], []
    for run in runs["estimated"]:
        estimate = run.estimates["ekf_stamped"]
        errors.append(estimate.lever_arm_b[-1] - true_lever_arm(scenario, run.run_id, 4))
        sds.append(estimate.sd[-1, 16:])
    normalised = np.square(np.array(errors) / sds)
    # 36 squares of unit variance: 1 +- 0.24, and a little more since the three components go together.
    assert 0.4 < normalised.mean() < 1.9
    assert np.sqrt(np.mean(np.square(errors))) < 0.35


def test_an_arm_that_nobody_told_of_shows(stated, flight, window):
    """Filters that are told of no arm on fixes of an antenna far off: NIS leaves its band."""
    scenario = replaced(stated, {"alignment.filters": ["ekf_stamped"], **QUIET}, "test")
    off = at_antenna(flight, (6.0, 0.0, -12.0))
    fixes = simulate(scenario, off, 0, 4).fixes
    own = simulate(scenario, flight, 0, 4)
    record = (own.imu.time, own.imu.dtheta_b, own.imu.dv_b, own.q_nb_coarse)
    told = scenario.alignment.settings, scenario.imu, window.gravity
    blind = estimate("ekf_stamped", AlignmentInput.checked(*record, fixes, *told))
    assert blind.nis[blind.fused].mean() > mean_band(6, int(blind.fused.sum()), 0.9999)[1]
