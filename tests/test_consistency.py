"""Consistency where the bundled scenario does not reach, and where the bound is one."""

import numpy as np
import pytest
from fleetalign.align.consistency import chi_square_quantile, mean_band, nees
from fleetalign.cosim.bound import bound_of, no_bound_because
from fleetalign.cosim.run import fixes_of, simulate
from fleetalign.cosim.scenario import replaced
from fleetalign.sins import attitude
from scipy.stats import chi2

RUNS = 40
ONLY_STAMPED = {"alignment.filters": ["ekf_stamped"]}


def consistency(scenario, window, name="ekf_stamped"):
    """Mean NEES of the misalignment at the end and mean NIS over `RUNS` runs."""
    errors, covariances, nis = [], [], []
    for run_id in range(RUNS):
        estimate = simulate(scenario, window, run_id, seed=7).estimates[name]
        errors.append(attitude.misalignment(estimate.q_nb[-1], window.q_nb[-1]))
        covariances.append(estimate.misalignment_cov[-1])
        nis.append(np.mean(estimate.nis[estimate.fused]))
    return np.mean(nees(np.array(errors), np.array(covariances))), np.mean(nis)


@pytest.mark.parametrize(
    "changes",
    [
        {"imu.vibration_mps": 0.1},
        {"imu.gyro_bias_instability_deg_h": 0.5, "imu.accel_bias_instability_ug": 300.0},
        {"fixes.velocity_sd_mps": 0.03},
        {"fixes.loss_probability": 0.8},
    ],
)
def test_stamped_filter_is_consistent_elsewhere(stated, window, changes):
    mean_nees, mean_nis = consistency(replaced(stated, {**ONLY_STAMPED, **changes}), window)
    low, high = mean_band(3, RUNS, 0.999)
    assert low < mean_nees < high
    assert mean_nis == pytest.approx(6, abs=0.3)


def test_l2linf_told_the_spread_of_the_delay_is_consistent(stated, window):
    changes = {
        "alignment.filters": ["l2linf"],
        "fixes.delay": {"kind": "uniform", "min_ms": 0.0, "max_ms": 100.0},
        "alignment.settings.delay_sd_ms": 100 / np.sqrt(12),
    }
    mean_nees, mean_nis = consistency(replaced(stated, changes), window, "l2linf")
    low, high = mean_band(3, RUNS, 0.999)
    assert low < mean_nees < high
    assert mean_nis == pytest.approx(6, abs=0.3)


def test_chi_square_quantile_is_scipys():
    for dimension in (1, 6, 300, 240_000):
        probability = np.array([0.001, 0.025, 0.5, 0.975, 0.99999])
        np.testing.assert_allclose(
            chi_square_quantile(probability, dimension), chi2.ppf(probability, dimension)
        )


def test_losses_raise_the_bound(stated, window):
    lossy = replaced(stated, {"fixes.loss_probability": 0.9})
    full, lossy = (
        bound_of(scenario, window, [fixes_of(scenario, window, i, 1)[0] for i in range(20)])
        for scenario in (stated, lossy)
    )
    assert (np.trace(lossy.misalignment_cov[-1]) > 2 * np.trace(full.misalignment_cov[-1])).all()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, None),
        ({"imu.gyro_bias_instability_deg_h": 0.01}, None),
        ({"imu.gyro_bias_instability_deg_h": 0.01, "imu.gyro_bias_correlation_s": 10.0}, "random walk"),
        ({"imu.accel_scale_factor_ppm": 10.0}, "accel_scale_factor_ppm"),
        ({"imu.bias_draw": "random_sign"}, "not Gaussian"),
    ],
)
def test_there_is_no_bound_where_the_filter_does_not_model_what_happens(stated, window, changes, reason):
    scenario = replaced(stated, changes)
    told = no_bound_because(scenario)
    bound = bound_of(scenario, window, [fixes_of(scenario, window, 0, 1)[0]])
    if reason is None:
        assert told is None
        assert np.isfinite(bound.sd[-1]).all()
    else:
        assert reason in told
        assert np.isnan(bound.sd).all()
        assert np.isnan(bound.misalignment_cov).all()
