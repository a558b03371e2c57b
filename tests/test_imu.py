import numpy as np
import pytest
from fleetalign.sins.allan import allan_deviation
from fleetalign.sins.imu import DrawnImuErrors, ImuError, ImuErrors, simulate_imu
from pydantic import ValidationError

# Units by hand, so that the package's own constants are tested too.
DEG_H = np.pi / 180 / 3600
ARCSEC = np.pi / 180 / 3600
G = 9.80665

NONE = ImuErrors(
    gyro_bias_deg_h=0, accel_bias_ug=0, gyro_arw_deg_sqrt_h=0, accel_vrw_ug_sqrt_hz=0, vibration_mps=0
)
# Each error alone, well above zero.
ALONE = {
    "gyro_bias_deg_h": 0.02,
    "accel_bias_ug": 100.0,
    "gyro_arw_deg_sqrt_h": 0.01,
    "accel_vrw_ug_sqrt_hz": 5.0,
    "vibration_mps": 0.01,
    "gyro_scale_factor_ppm": 50.0,
    "accel_scale_factor_ppm": 200.0,
    "gyro_misalignment_arcsec": 20.0,
    "accel_misalignment_arcsec": 30.0,
    "gyro_g_sensitivity_deg_h_g": 0.3,
    "gyro_bias_instability_deg_h": 0.05,
    "accel_bias_instability_ug": 40.0,
}


def only(**errors):
    return NONE.model_copy(update=errors)


def motion(n=200, dt=0.01):
    """Ideal increments of some lively motion."""
    rng = np.random.default_rng(11)
    return np.arange(n) * dt + 3.0, 0.01 * rng.normal(size=(n, 3)), 0.1 * rng.normal(size=(n, 3))


def at_rest(n, dt):
    return np.arange(n) * dt, np.zeros((n, 3)), np.zeros((n, 3))


def simulate(data, errors, seed=0):
    return simulate_imu(*data, errors, np.random.default_rng(seed))


def draws(errors, runs, field) -> np.ndarray:
    """One drawn constant of many runs, one row each."""
    data = at_rest(2, 0.01)
    rng = np.random.default_rng(5)
    return np.array([getattr(simulate_imu(*data, errors, rng).errors, field).ravel() for _ in range(runs)])


def assert_deviation(values, expected):
    """Zero mean and the expected standard deviation, each within five of its own."""
    n = np.size(values)
    assert np.abs(np.mean(values)) < 5 * expected / np.sqrt(n)
    assert np.std(values) == pytest.approx(expected, rel=5 / np.sqrt(2 * n))


def test_defaults_are_those_of_table_1():
    errors = ImuErrors()
    stated = (
        "gyro_bias_deg_h",
        "gyro_arw_deg_sqrt_h",
        "accel_bias_ug",
        "accel_vrw_ug_sqrt_hz",
        "vibration_mps",
    )
    assert [getattr(errors, name) for name in stated] == [0.02, 0.01, 100, 5, 0.01]
    assert all(getattr(errors, name) == 0 for name in ALONE if name not in stated)


def test_ideal_imu_passes_the_increments_on():
    time, dtheta, dv = motion()
    imu = simulate((time, dtheta, dv), NONE)
    np.testing.assert_array_equal(imu.time, time)
    np.testing.assert_array_equal(imu.dtheta_b[1:], dtheta[1:])
    np.testing.assert_array_equal(imu.dv_b[1:], dv[1:])
    assert not imu.dtheta_b[0].any()
    assert not imu.dv_b[0].any()
    assert imu.errors.vibration is None
    assert imu.gyro_bias.shape == imu.accel_bias.shape == (200, 3)
    assert not imu.gyro_bias.any()


def test_input_is_left_as_it_was():
    data = motion()
    copies = [array.copy() for array in data]
    simulate(data, ImuErrors())
    for array, copy in zip(data, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_constant_bias_in_its_unit():
    imu = simulate(at_rest(1001, 0.01), only(gyro_bias_deg_h=0.02, accel_bias_ug=100.0, bias_draw="constant"))
    np.testing.assert_allclose(imu.dtheta_b.sum(0), 10 * 0.02 * DEG_H, rtol=1e-12)
    np.testing.assert_allclose(imu.dv_b.sum(0), 10 * 1e-4 * G, rtol=1e-12)
    np.testing.assert_allclose(imu.gyro_bias, 0.02 * DEG_H)
    np.testing.assert_allclose(imu.accel_bias, 1e-4 * G)


def test_bias_of_random_sign():
    biases = draws(ImuErrors(bias_draw="random_sign"), 200, "gyro_bias") / (0.02 * DEG_H)
    np.testing.assert_allclose(np.abs(biases), 1, rtol=1e-12)
    assert np.abs(biases.mean()) < 5 / np.sqrt(biases.size)


@pytest.mark.parametrize(
    ("name", "drawn", "unit", "part"),
    [
        ("gyro_bias_deg_h", "gyro_bias", DEG_H, slice(None)),
        ("accel_bias_ug", "accel_bias", 1e-6 * G, slice(None)),
        ("gyro_scale_factor_ppm", "gyro_coupling", 1e-6, slice(0, None, 4)),
        ("accel_scale_factor_ppm", "accel_coupling", 1e-6, slice(0, None, 4)),
        ("gyro_misalignment_arcsec", "gyro_coupling", ARCSEC, [1, 2, 3, 5, 6, 7]),
        ("accel_misalignment_arcsec", "accel_coupling", ARCSEC, [1, 2, 3, 5, 6, 7]),
        ("gyro_g_sensitivity_deg_h_g", "gyro_g_sensitivity", DEG_H / G, slice(None)),
    ],
)
def test_constants_of_a_run_have_the_stated_deviation(name, drawn, unit, part):
    values = draws(only(**{name: ALONE[name]}), 400, drawn)
    assert_deviation(values[:, part], ALONE[name] * unit)
    # The rest of a coupling matrix stays zero, and axes are independent.
    np.testing.assert_array_equal(np.delete(values, part, axis=1), 0)
    correlation = np.corrcoef(values[:, part].T)
    assert np.abs(correlation - np.eye(len(correlation))).max() < 5 / np.sqrt(400)


@pytest.mark.parametrize("dt", [0.01, 0.0025])
def test_white_noise_has_its_root_psd_at_any_rate(dt):
    imu = simulate(at_rest(20001, dt), only(gyro_arw_deg_sqrt_h=0.01, accel_vrw_ug_sqrt_hz=5.0))
    # 0.01 deg after one hour; 5 ug of noise averaged over one second.
    assert_deviation(imu.dtheta_b[1:], np.radians(0.01) * np.sqrt(dt / 3600))
    assert_deviation(imu.dv_b[1:], 5e-6 * G * np.sqrt(dt))


def test_vibration_is_sensed_but_does_not_accumulate():
    imu = simulate(at_rest(20001, 0.01), only(vibration_mps=0.01))
    velocity = np.cumsum(imu.dv_b, axis=0)
    np.testing.assert_allclose(velocity, imu.errors.vibration, atol=1e-14)
    assert_deviation(velocity[1:], 0.01)
    assert not imu.dtheta_b.any()


def test_errors_act_in_the_documented_order():
    time, dtheta, dv = motion()
    large = {name: 100 * value for name, value in ALONE.items()}
    errors = only(**(large | {"gyro_arw_deg_sqrt_h": 0, "accel_vrw_ug_sqrt_hz": 0}))
    imu = simulate((time, dtheta, dv), errors)
    drawn = imu.errors
    assert drawn.vibration is not None
    shaken = dv[1:] + np.diff(drawn.vibration, axis=0)
    rate = dtheta[1:] @ (np.eye(3) + drawn.gyro_coupling).T + shaken @ drawn.gyro_g_sensitivity.T
    force = shaken @ (np.eye(3) + drawn.accel_coupling).T
    np.testing.assert_allclose(imu.dtheta_b[1:], rate + 0.01 * imu.gyro_bias[1:], rtol=0, atol=1e-15)
    np.testing.assert_allclose(imu.dv_b[1:], force + 0.01 * imu.accel_bias[1:], rtol=0, atol=1e-14)


def test_quantisation_carries_the_remainder():
    data = motion(2000)
    exact = simulate(data, ImuErrors())
    counted = simulate(data, ImuErrors(gyro_quantum_arcsec=100.0, accel_quantum_mps=0.02))
    for quantum, increments, whole in (
        (100 * ARCSEC, exact.dtheta_b, counted.dtheta_b),
        (0.02, exact.dv_b, counted.dv_b),
    ):
        counts = whole / quantum
        np.testing.assert_allclose(counts, np.round(counts), rtol=0, atol=1e-9)
        remainder = np.cumsum(increments, axis=0) - np.cumsum(whole, axis=0)
        assert np.abs(remainder).max() <= 0.5 * quantum * (1 + 1e-9)
        assert np.std(remainder) == pytest.approx(quantum / np.sqrt(12), rel=0.1)


def drawn_parts(errors: ImuErrors) -> dict[str, np.ndarray]:
    """Every error of a run by its name in `ALONE`; noise as what it adds to the data."""
    data = at_rest(400, 0.01)
    imu, drawn = simulate(data, errors), simulate(data, errors).errors
    quiet = simulate(data, errors.model_copy(update={"gyro_arw_deg_sqrt_h": 0, "accel_vrw_ug_sqrt_hz": 0}))
    off_diagonal = ~np.eye(3, dtype=bool)
    return {
        "gyro_bias_deg_h": drawn.gyro_bias,
        "accel_bias_ug": drawn.accel_bias,
        "gyro_arw_deg_sqrt_h": imu.dtheta_b - quiet.dtheta_b,
        "accel_vrw_ug_sqrt_hz": imu.dv_b - quiet.dv_b,
        "vibration_mps": _or_zero(drawn, "vibration"),
        "gyro_scale_factor_ppm": np.diag(drawn.gyro_coupling),
        "accel_scale_factor_ppm": np.diag(drawn.accel_coupling),
        "gyro_misalignment_arcsec": drawn.gyro_coupling[off_diagonal],
        "accel_misalignment_arcsec": drawn.accel_coupling[off_diagonal],
        "gyro_g_sensitivity_deg_h_g": drawn.gyro_g_sensitivity,
        "gyro_bias_instability_deg_h": _or_zero(drawn, "gyro_bias_variation"),
        "accel_bias_instability_ug": _or_zero(drawn, "accel_bias_variation"),
    }


def _or_zero(drawn: DrawnImuErrors, field: str) -> np.ndarray:
    history = getattr(drawn, field)
    return np.zeros((400, 3)) if history is None else history


@pytest.mark.parametrize("name", ALONE)
def test_switching_one_error_off_leaves_the_others(name):
    every = drawn_parts(only(**ALONE))
    without = drawn_parts(only(**(ALONE | {name: 0.0})))
    assert not without.pop(name).any()
    assert every.pop(name).any()
    for other, value in every.items():
        # Noise is found by a difference of increments, so to rounding.
        np.testing.assert_allclose(without[other], value, rtol=0, atol=1e-12 * np.abs(value).max())


def test_a_seed_repeats_and_a_generator_goes_on():
    data, rng = motion(), np.random.default_rng(0)
    first, second = (simulate_imu(*data, ImuErrors(), rng) for _ in range(2))
    np.testing.assert_array_equal(first.dv_b, simulate(data, ImuErrors(), seed=0).dv_b)
    assert not np.array_equal(first.errors.gyro_bias, second.errors.gyro_bias)


def gauss_markov_allan_variance(tau, sigma, correlation_s):
    """IEEE Std 952-1997, annex C, with the stationary deviation for sigma."""
    x = tau / correlation_s
    return 2 * sigma**2 / x * (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x))


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_allan_deviation_recovers_noise_and_bias_instability(sensor):
    dt, correlation_s, n = 0.05, 20.0, 400_000
    errors = ImuErrors(
        vibration_mps=0,
        gyro_bias_instability_deg_h=1.5,
        gyro_bias_correlation_s=correlation_s,
        accel_bias_instability_ug=20.0,
        accel_bias_correlation_s=correlation_s,
    )
    imu = simulate(at_rest(n, dt), errors, seed=2)
    increments, noise, instability = {
        "gyro": (imu.dtheta_b, np.radians(0.01) / 60, 1.5 * DEG_H),
        "accel": (imu.dv_b, 5e-6 * G, 20e-6 * G),
    }[sensor]
    clusters = np.array([1, 3, 10, 30, 100, round(1.89 * correlation_s / dt), 2000])
    tau, deviation = allan_deviation(increments[1:], dt, clusters)
    pooled = np.mean(deviation**2, axis=1)
    expected = noise**2 / tau + gauss_markov_allan_variance(tau, instability, correlation_s)
    # At least n / clusters degrees of freedom an axis (NIST SP 1065, 5.4); five deviations.
    margin = 5 * np.sqrt(2 * clusters / (3 * n))
    assert np.all(np.abs(pooled / expected - 1) < margin)
    # Read as off the plot: the noise where it rules, the instability at the hump.
    assert deviation[0] * np.sqrt(tau[0]) == pytest.approx(noise, rel=0.02)
    hump = np.sqrt(np.mean(deviation[5] ** 2) - noise**2 / tau[5])
    assert hump / 0.617 == pytest.approx(instability, rel=margin[5])


def test_gauss_markov_bias_is_stationary_and_correlated():
    errors = only(gyro_bias_instability_deg_h=1.0, gyro_bias_correlation_s=0.5)
    data, rng = at_rest(151, 0.01), np.random.default_rng(3)
    runs = np.array([simulate_imu(*data, errors, rng).errors.gyro_bias_variation for _ in range(300)]) / DEG_H
    start, after_tau = runs[:, 0].ravel(), runs[:, 50].ravel()
    for row in (0, 50, 150):
        assert_deviation(runs[:, row], 1.0)
    assert np.mean(start * after_tau) == pytest.approx(np.exp(-1), abs=5 / np.sqrt(900))


def test_allan_deviation_of_a_known_signal():
    # A ramp of slope r has the Allan deviation r tau / sqrt(2).
    dt, slope = 0.1, 0.3
    rate = slope * dt * np.arange(500)
    tau, deviation = allan_deviation(rate * dt, dt)
    assert tau[0] == dt
    assert tau[-1] == pytest.approx(500 // 3 * dt)
    np.testing.assert_allclose(deviation, slope * tau / np.sqrt(2), rtol=1e-9)
    _, both = allan_deviation(np.stack([rate * dt, 2 * rate * dt], axis=-1), dt)
    np.testing.assert_allclose(both, np.stack([deviation, 2 * deviation], axis=-1))


@pytest.mark.parametrize("clusters", [0, 251])
def test_allan_deviation_refuses_impossible_clusters(clusters):
    with pytest.raises(ValueError, match=rf"1 to 250 samples long; got {clusters}"):
        allan_deviation(np.zeros(500), 0.1, clusters)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, w, f: (t, w[:-1], f), r"got \(200,\), \(199, 3\), \(200, 3\)"),
        (lambda t, w, f: (t, w, f[:, :2]), r"got \(200,\), \(200, 3\), \(200, 2\)"),
        (lambda t, w, f: (t[:1], w[:1], f[:1]), "n >= 2"),
        (lambda t, w, f: (t + 0.005 * (np.arange(200) > 120), w, f), "row 121 is at 4.215"),
        (lambda t, w, f: (np.where(np.arange(200) == 7, np.nan, t), w, f), "row 7 is at nan"),
        (lambda t, w, f: (t[::-1], w, f), "apart throughout"),
    ],
)
def test_unusable_increments_are_refused(change, message):
    with pytest.raises(ImuError, match=message):
        simulate(change(*motion()), ImuErrors())


@pytest.mark.parametrize(
    "settings",
    [{name: -1e-9} for name in ALONE]
    + [
        {"gyro_bias_deg_h": float("nan")},
        {"accel_bias_ug": float("inf")},
        {"gyro_bias_correlation_s": 0},
        {"gyro_quantum_arcsec": -1},
        {"accel_quantum_mps": -1},
        {"bias_draw": "sometimes"},
        {"gyro_bias": 0.02},
    ],
)
def test_impossible_error_budgets_are_refused(settings):
    with pytest.raises(ValidationError):
        ImuErrors(**settings)
