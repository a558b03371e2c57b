"""What the paper's filter is designed for: noise, rate and delay of the fixes, and a record's turns."""

import numpy as np
import pytest
from fleetalign.align.lmi.task import sins_plant_settings, steepest_side_mps2
from fleetalign.align.settings import FilterSettings
from fleetalign.network.fixes import Fixes
from fleetalign.sins.imu import ImuErrors


def fixes(interval_s=0.2, position_sd_m=7.0, velocity_sd_mps=0.045, k=50):
    t = interval_s * np.arange(k)
    cov = np.tile(np.diag(np.repeat([position_sd_m**2, velocity_sd_mps**2], 3)), (k, 1, 1))
    cov[3:4] = np.nan
    ids = np.zeros(k, np.int64)
    return Fixes(t, t, t, np.zeros((k, 3)), np.zeros((k, 3)), cov, ids, np.arange(k))


def test_designs_are_for_the_fixes_that_come():
    settings = FilterSettings(delay_mean_ms=30.0, delay_sd_ms=40.0)
    told = sins_plant_settings(fixes(), settings, ImuErrors(gyro_bias_deg_h=0.05, accel_bias_ug=30.0))
    assert (told.fix_interval_s, told.position_sd_m, told.velocity_sd_mps) == (0.2, 7.0, 0.045)
    assert told.rho == pytest.approx(0.85)
    assert (told.gyro_sd_deg_h, told.accel_sd_ug) == (0.05, 30.0)
    # 50 ms of delay in turns of 6 m/s^2: 0.21 m/s.
    turning = sins_plant_settings(fixes(), settings, ImuErrors(), side_mps2=6.0)
    assert turning.velocity_sd_mps == pytest.approx(np.hypot(0.045, 0.05 * 6 / np.sqrt(2)), rel=0.05)


def test_delays_beyond_an_interval_leave_something_prompt():
    assert sins_plant_settings(fixes(), FilterSettings(delay_mean_ms=500.0), ImuErrors()).rho == 0.05
    assert sins_plant_settings(fixes(k=0), FilterSettings(), ImuErrors()).fix_interval_s == 0.1


@pytest.mark.parametrize("side", [0.0, 6.0])
def test_steep_turns_show_in_the_specific_force(side):
    time = 0.01 * np.arange(4001)
    turning = np.where((time > 10) & (time < 30), side, 0.0)
    dv_b = np.zeros((len(time), 3))
    dv_b[:, 2] = -0.01 * np.hypot(9.80665, turning)
    dv_b[500] = np.nan
    found = steepest_side_mps2(time, dv_b)
    assert found is None if side == 0 else found == pytest.approx(side, rel=0.02)
