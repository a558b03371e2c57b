"""The paper's ten states, and what constant gains designed for them do on a record."""

import numpy as np
import pytest
from fleetalign.align.estimate import FixOutcome, NavStatus, RunOutcome
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.lmi.alignment import align_lmi, ekf_ten, gain_schedule, white
from fleetalign.align.lmi.design import DesignError, Kind, Outcome, design
from fleetalign.align.lmi.plant import MATRICES, Plant
from fleetalign.align.lmi.sins_plant import (
    QUATERNION,
    SinsPlantSettings,
    level_attitude,
    misalignment_of,
    nine_of_ten,
    quaternion_axes,
    sins_plant,
)
from fleetalign.align.settings import FilterSettings
from fleetalign.cosim.plants import load_plant
from fleetalign.network.fixes import Fixes
from fleetalign.sins import attitude, earth
from fleetalign.sins.earth import GravityModel
from fleetalign.sins.imu import ImuErrors
from fleetalign.sins.mechanization import NavigationState, mechanize

PROMPT = SinsPlantSettings(rho=1.0)
GRAVITY = GravityModel.J2
SIDE = 6.0
COURSE = np.radians(120.0)


def turning_record(dt=0.01):
    """Straight, then right, left and right again at 6 m/s^2, 40 s; increments and the truth they make."""
    turn = np.arctan2(SIDE, 9.8)
    plan = np.interp(
        np.arange(0, 40, dt), [0, 2, 4, 12, 16, 24, 28, 40], turn * np.array([0, 0, 1, 1, -1, -1, 1, 1])
    )
    rate = SIDE / 200 * np.tan(plan) / np.tan(turn)
    dtheta = np.column_stack([np.gradient(plan, dt), rate * np.sin(plan), rate * np.cos(plan)]) * dt
    dv = np.column_stack([0 * plan, 0 * plan, -9.79 / np.cos(plan)]) * dt
    # Without noise, axes that repeat themselves would be taken for stuck.
    rng = np.random.default_rng(5)
    dtheta += 1e-7 * rng.standard_normal(dtheta.shape)
    dv += 1e-5 * rng.standard_normal(dv.shape)
    time = np.arange(len(plan)) * dt
    start = NavigationState(
        np.array([0.52, 2.1, 1015.0]),
        200 * np.array([np.cos(COURSE), np.sin(COURSE), 0.0]),
        attitude.from_euler(0.0, 0.0, COURSE),
    )
    return time, dtheta, dv, mechanize(time, dtheta, dv, start, GRAVITY)


def fixes_of(time, truth, rng, rate_hz=10):
    """Good to 10 m and 0.1 m/s, 25 ms late."""
    at = np.arange(5, len(time) - 5, round(1 / (rate_hz * 0.01)))
    k = len(at)
    metres = 10 * rng.standard_normal((k, 3))
    lla = truth.lla[at].copy()
    R_N, R_E = earth.radii_of_curvature(lla[:, 0])
    lla += np.column_stack([metres[:, 0] / R_N, metres[:, 1] / (R_E * np.cos(lla[:, 0])), metres[:, 2]])
    cov = np.tile(np.diag([100.0] * 3 + [0.01] * 3), (k, 1, 1))
    return Fixes(
        t_valid=time[at],
        t_stamp=time[at],
        t_arrival=time[at] + 0.025,
        lla=lla,
        v_n=truth.v_n[at] + 0.1 * rng.standard_normal((k, 3)),
        cov=cov,
        source=np.zeros(k, np.int64),
        sequence=np.arange(k),
    )


@pytest.fixture(scope="module")
def record():
    """Times, increments, truth, fixes, and an attitude that is 1 deg off in level and 10 in heading."""
    time, dtheta, dv, truth = turning_record()
    rng = np.random.default_rng(3)
    coarse = attitude.from_euler(*np.radians([1.0, -1.0, 130.0]))
    return time, dtheta, dv, truth, fixes_of(time, truth, rng), coarse


@pytest.fixture(scope="module")
def level(flight_cache):
    return gain_schedule(PROMPT)


@pytest.fixture(scope="module")
def scheduled(flight_cache):
    return gain_schedule(PROMPT, SIDE)


def errors(estimate, record):
    """Roll, pitch, arcsec, and heading, arcmin, at the end of a record."""
    error = np.degrees(attitude.attitude_error(estimate.q_nb[-1], record[3].q_nb[-1]))
    return np.abs(error * np.array([3600, 3600, 60]))


def test_quaternion_error_is_misalignment_and_norm():
    q = attitude.from_euler(0.4, -0.2, 1.3)
    axes = quaternion_axes(q)
    np.testing.assert_allclose(axes.T @ axes, np.eye(4), atol=1e-15)
    phi = 1e-6 * np.array([1.0, -2.0, 3.0])
    computed = attitude.multiply(attitude.from_rotvec(-phi), q)  # q = exp(phi) q_computed
    np.testing.assert_allclose(misalignment_of(q) @ (computed - q), phi, atol=1e-11)
    np.testing.assert_allclose(axes[:, 0] @ (computed - q), 0, atol=1e-11)
    np.testing.assert_allclose(misalignment_of(q) @ q, 0, atol=1e-15)


def test_norm_of_a_quaternion_that_nothing_normalises_is_undetectable():
    plant = sins_plant(PROMPT)
    q = level_attitude(0.0)
    A = plant.A.copy()
    A[QUATERNION, QUATERNION] += np.outer(q, q)
    with pytest.raises(DesignError) as refused:
        design(Plant(A, plant.B, plant.C, plant.D, plant.H), Kind.FEEDBACK, use_cache=False)
    assert refused.value.outcome is Outcome.UNDETECTABLE


def test_filter_beside_the_navigator_is_refused():
    """Position and velocity errors do not fade unless they are corrected."""
    with pytest.raises(DesignError) as refused:
        design(sins_plant(PROMPT), Kind.L2LINF, use_cache=False)
    assert refused.value.outcome is Outcome.UNSTABLE


def test_gains_of_the_inequality_are_nearly_the_kalman_filters(level, scheduled):
    """White noise tells: nine signals in units of the least deviation have an RMS of 3 at best."""
    for found in scheduled.designs:
        assert 3 < found.analyses[0].white_rms < 3.05
        assert found.gamma == pytest.approx(found.analyses[0].peak_adapted, rel=1e-4)
    np.testing.assert_array_equal(level.gains[0], scheduled.gains[1])


def test_gamma_is_what_the_units_make_it():
    """Other units of z, another gamma: 0.46 without them says nothing."""
    plant = sins_plant(PROMPT, SIDE)
    doubled = Plant(plant.A, plant.B, plant.C, plant.D, plant.H / 2)
    ratio = design(doubled, Kind.FEEDBACK).gamma / design(plant, Kind.FEEDBACK).gamma
    assert ratio == pytest.approx(0.5, rel=1e-4)


def test_left_turn_is_the_mirror_image_of_the_right(scheduled):
    left = design(sins_plant(PROMPT, -SIDE), Kind.FEEDBACK)
    gains = nine_of_ten(level_attitude(-SIDE)) @ left.filter.Bf
    size = np.abs(gains).max(axis=1, keepdims=True)
    # The inequality leaves some freedom where another direction sets the peak; a sign would make it 2.
    np.testing.assert_allclose(scheduled.gains[0] / size, gains / size, atol=0.2)


def test_bundled_plant_is_that_of_the_settings():
    _, kind, (plant,) = load_plant("gao_level")
    assert kind == "feedback"
    made = sins_plant(SinsPlantSettings())
    for name in MATRICES:
        matrix = getattr(made, name)
        np.testing.assert_allclose(getattr(plant, name), matrix, atol=1e-9 * np.abs(matrix).max(), rtol=1e-6)


def given(*measured):
    return AlignmentInput.checked(*measured, FilterSettings(), ImuErrors(), GRAVITY)


def test_schedule_levels_and_finds_the_heading_in_turns(record, scheduled):
    time, dtheta, dv, _, fixes, coarse = record
    found = align_lmi(given(time, dtheta, dv, coarse, fixes), scheduled)
    assert found.outcome is RunOutcome.ALIGNED
    assert np.isfinite(found.q_nb[5:]).all()
    roll, pitch, heading = errors(found, record)
    assert max(roll, pitch) < 1200
    assert heading < 60
    # Velocities 25 ms late are up to 0.15 m/s off in a turn, and the gain for position is a slow one.
    assert np.abs(earth.displacement_n(record[3].lla[-1], found.lla[-1])).max() < 40
    assert np.abs(found.v_n[-1] - record[3].v_n[-1]).max() < 0.3
    assert np.isnan(found.sd).all()
    assert np.isnan(found.misalignment_cov).all()
    assert found.fix_outcome[0] == FixOutcome.INITIALIZED
    assert found.count(FixOutcome.FUSED) == len(fixes) - 1


def test_a_first_fix_that_is_off_is_forgotten(record, level):
    """On the level and straight, with an attitude that is right; 100 m fade by a third in 40 s."""
    n = 4000
    time, nothing = 0.01 * np.arange(n), np.zeros((n, 3))
    dv = np.tile([0.0, 0.0, -0.0979], (n, 1))
    start = NavigationState(record[3].lla[0], record[3].v_n[0], record[3].q_nb[0])
    truth = mechanize(time, nothing, dv, start, GRAVITY)
    fixes = fixes_of(time, truth, np.random.default_rng(4))
    R_N, R_E = earth.radii_of_curvature(fixes.lla[0, 0])
    fixes.lla[0] += np.array([100 / R_N, 100 / (R_E * np.cos(fixes.lla[0, 0])), -100])
    found = align_lmi(given(time, nothing, dv, truth.q_nb[0], fixes), level)
    error = earth.displacement_n(found.lla[-1], truth.lla[-1])
    assert (np.abs(error) < 80).all()


def test_constant_gain_leaves_the_heading(record, level):
    """In level flight no fix shows it, and the gain for level flight never asks."""
    time, dtheta, dv, _, fixes, coarse = record
    found = align_lmi(given(time, dtheta, dv, coarse, fixes), level)
    assert np.isfinite(found.q_nb[5:]).all()
    assert errors(found, record)[2] > 300


def test_ekf_on_the_ten_states_is_certain_of_too_much(record):
    """It aligns, and takes its level for better known than accelerometers of 100 ug can tell."""
    time, dtheta, dv, _, fixes, coarse = record
    found = ekf_ten(given(time, dtheta, dv, coarse, fixes))
    roll, pitch, heading = errors(found, record)
    assert max(roll, pitch) < 300
    assert heading < 10
    assert (found.accel_bias[5:] == 0).all()
    assert np.degrees(found.sd[-1, 6:8]).max() * 3600 < 15 < 20.6


def test_white_budget_keeps_what_a_bias_adds_over_the_time_it_is_held():
    budget = white(ImuErrors(gyro_bias_deg_h=0.03, gyro_arw_deg_sqrt_h=0.0, accel_vrw_ug_sqrt_hz=0.0), 0.25)
    assert budget.accel_vrw_ug_sqrt_hz == pytest.approx(50.0)
    assert budget.gyro_arw_deg_sqrt_h == pytest.approx(0.03 * 0.5 / 60)
    assert budget.accel_bias_ug == budget.gyro_bias_deg_h == 0


def test_fixes_that_do_not_count(record, level):
    """Twice the same, overtaken, not finite, and after the end; none at all is an outcome as well."""
    time, dtheta, dv, _, fixes, coarse = record
    n = 20
    index = np.r_[0:n, 7]
    some = Fixes(**{name: np.array(getattr(fixes, name)[index]) for name in Fixes.__dataclass_fields__})
    some.v_n[4, 0] = np.nan
    arrival = some.t_arrival.copy()
    arrival[[9, 10]] = arrival[10] + 0.03, arrival[9] + 0.03
    arrival[15], arrival[n] = 100.0, arrival[7] + 0.001
    some = Fixes(**{**vars(some), "t_arrival": arrival})
    found = align_lmi(given(time, dtheta, dv, coarse, some), level)
    order = np.argsort(arrival, kind="stable")
    outcome = dict(zip(order, found.fix_outcome, strict=True))
    assert outcome[0] == FixOutcome.INITIALIZED
    assert outcome[4] == FixOutcome.NOT_FINITE
    assert outcome[9] == FixOutcome.LATE
    assert outcome[n] == FixOutcome.DUPLICATE
    assert outcome[15] == FixOutcome.PENDING
    assert found.count(FixOutcome.FUSED) == n - 4
    since = found.time - arrival[n - 2]  # the last that counts
    assert set(found.status[(since < 2.9) & (found.time > 0.2)]) == {NavStatus.AIDED}
    assert set(found.status[since > 3.1]) == {NavStatus.DEAD_RECKONING}
    nothing = Fixes(**{name: getattr(some, name)[:0] for name in Fixes.__dataclass_fields__})
    found = align_lmi(given(time, dtheta, dv, coarse, nothing), level)
    assert found.outcome is RunOutcome.NO_FIX
    assert np.isnan(found.lla).all()
    assert set(found.status) == {NavStatus.NOT_STARTED}
