"""The stochastic H-infinity filter, against closed forms, brute force and simulation."""

import numpy as np
import pytest
from fleetalign.align.lmi.design import DesignError, Outcome
from fleetalign.align.lmi.stochastic_hinf import Form, NoisyPlant, closed_loop, confirmed, design

ONE = np.eye(1)


def scalar(a=1.0, a_s=0.3, b=0.5, d=1.0, c=1.0):
    return NoisyPlant(a * ONE, a_s * ONE, np.array([[b, 0.0]]), c * ONE, np.array([[0.0, d]]), ONE)


def tracking(noise=0.05, walk=0.03):
    """Position and velocity, a period of 1 s with a random error."""
    A, A_s = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0, noise], [0.0, 0.0]])
    B, D = np.array([[0.0, 0, 0], [walk, 0, 0]]), np.array([[0.0, 0.2, 0], [0, 0, 0.1]])
    return NoisyPlant(A, A_s, B, np.eye(2), D, np.eye(2))


def scalar_gain(plant, k, form):
    """Energy gain of the scalar loop: where f^2 P + f_s^2 P - P + 1 + f^2 P^2 g / (gamma^2 - P g) = 0 has
    its last root, from the quadratic's discriminant."""
    a, a_s, c = (float(m[0, 0]) for m in (plant.A, plant.A_s, plant.C))
    b, d = float(plant.B[0, 0]), float(plant.D[0, 1])
    kept = 1 if form is Form.PREDICTED else 1 - k * c
    f = a - k * c if form is Form.PREDICTED else kept * a
    s = a_s if form is Form.PREDICTED else kept * a_s
    g = (kept * b) ** 2 + (k * d) ** 2
    low, high = 0.0, 1e6
    for _ in range(60):
        middle = (low + high) / 2
        # (q P + 1)(gamma^2 - P g) + f^2 P^2 g = 0, q = f^2 + s^2 - 1.
        q = f**2 + s**2 - 1
        roots = np.roots([f**2 * g - q * g, q * middle - g, middle])
        good = [r.real for r in roots if abs(r.imag) < 1e-12 and 0 < r.real * g < middle]
        low, high = (low, middle) if q < 0 and good else (middle, high)
    return np.sqrt(high)


@pytest.mark.parametrize("form", Form)
def test_least_gamma_is_that_of_all_gains(form):
    """A scan of all scalar gains, each with its closed form, finds no less; to the scan's own step."""
    plant = scalar()
    made = design(plant, form)
    scanned = min(scalar_gain(plant, k, form) for k in np.linspace(0.1, 1.2, 60))
    assert made.gamma == pytest.approx(scanned, rel=2e-3)
    assert scalar_gain(plant, float(made.K[0, 0]), form) == pytest.approx(made.gamma, rel=1e-3)


@pytest.mark.parametrize("form", Form)
def test_white_noise_spreads_as_stated(form):
    """Plant and corrected navigator as written down, with a random period: 40,000 runs tell variances to
    2 % (three standard errors, 3 sqrt(2 / N), heavier tails allowed for)."""
    plant = tracking(noise=1.0, walk=0.2)
    made = design(plant, form, 2 * design(plant, form).gamma)
    rng = np.random.default_rng(3)
    e = np.zeros((40_000, 2))
    for _ in range(60):
        q, v = rng.standard_normal((len(e), 1)), rng.standard_normal((len(e), 3))
        if form is Form.FILTERED:
            e = e @ plant.A.T + q * (e @ plant.A_s.T) + v @ plant.B.T
            e = e - (e @ plant.C.T + v @ plant.D.T) @ made.K.T
        else:
            y = e @ plant.C.T + v @ plant.D.T
            e = e @ plant.A.T + q * (e @ plant.A_s.T) + v @ plant.B.T - y @ made.K.T
    np.testing.assert_allclose(e.var(axis=0), made.white_sd**2, rtol=0.03)


def test_a_known_fix_helps_and_variance_can_be_bought():
    plant = tracking()
    predicted, filtered = design(plant, Form.PREDICTED), design(plant, Form.FILTERED)
    assert filtered.gamma < predicted.gamma
    mixed = design(plant, Form.FILTERED, 1.3 * filtered.gamma)
    assert mixed.energy_gain <= 1.3 * filtered.gamma * 1.001
    assert (mixed.white_sd < 0.9 * filtered.white_sd).all()


def test_a_lying_gamma_is_not_confirmed():
    plant = tracking()
    made = design(plant)
    assert confirmed(plant, made.K, Form.PREDICTED, made.gamma).gamma == made.gamma
    with pytest.raises(DesignError) as error:
        confirmed(plant, made.K, Form.PREDICTED, 0.95 * made.gamma)
    assert error.value.outcome is Outcome.NOT_CONFIRMED
    with pytest.raises(DesignError, match="spectral radius"):
        confirmed(plant, np.zeros((2, 2)), Form.PREDICTED, made.gamma)
    with pytest.raises(DesignError, match="not finite"):
        confirmed(plant, np.full((2, 2), np.nan), Form.PREDICTED, made.gamma)


def test_what_cannot_be_held_is_refused():
    with pytest.raises(DesignError):
        design(scalar(a=1.2, c=0.0))  # grows and is not seen
    with pytest.raises(DesignError):
        design(scalar(a_s=1.1))  # its random part alone grows
    with pytest.raises(ValueError, match="A_s is 2 by 2: must be 1 by 1"):
        NoisyPlant(ONE, np.eye(2), ONE, ONE, ONE, ONE)
    with pytest.raises(ValueError, match="B: must be a matrix of finite numbers"):
        NoisyPlant(ONE, ONE, np.nan * ONE, ONE, ONE, ONE)


def test_random_part_raises_the_gain_of_a_given_filter():
    calm, rough = tracking(0.0), tracking(0.5)
    K = design(calm).K
    gains = [closed_loop(plant, K, Form.PREDICTED).spectral_radius for plant in (calm, rough)]
    assert gains[1] > gains[0]
    assert design(rough).gamma > design(calm).gamma
