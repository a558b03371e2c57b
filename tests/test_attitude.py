import numpy as np
import pytest
from fleetalign.sins import attitude
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

angles = st.floats(-np.pi, np.pi)
components = st.floats(-1, 1)
vectors = st.tuples(components, components, components).map(np.array)
rotvecs = st.tuples(vectors, st.floats(0, np.pi - 1e-3)).map(
    lambda pair: pair[0] * (pair[1] / max(np.linalg.norm(pair[0]), 1e-3))
)
quaternions = (
    st.tuples(components, components, components, components)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


def oracle(q):
    """scipy's rotation, which has the scalar last."""
    return Rotation.from_quat(np.roll(q, -1, axis=-1))


def assert_same_rotation(q, expected, atol=1e-14):
    """Equal up to sign."""
    sign = 1.0 if q @ expected >= 0 else -1.0
    np.testing.assert_allclose(sign * q, expected, rtol=0, atol=atol)


@given(quaternions, quaternions, vectors)
def test_product_composes_rotations(p, q, v):
    pq = attitude.multiply(p, q)
    np.testing.assert_allclose(attitude.to_dcm(pq), attitude.to_dcm(p) @ attitude.to_dcm(q), atol=1e-14)
    np.testing.assert_allclose(
        attitude.rotate(pq, v), attitude.rotate(p, attitude.rotate(q, v)), rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(attitude.multiply(q, attitude.conjugate(q)), [1, 0, 0, 0], atol=1e-15)


@given(quaternions, vectors)
def test_direction_cosines_are_those_of_scipy(q, v):
    C = attitude.to_dcm(q)
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(C, oracle(q).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(attitude.rotate(q, v), C @ v, atol=1e-14)


@given(quaternions)
def test_quaternion_comes_back_from_direction_cosines(q):
    back = attitude.from_dcm(attitude.to_dcm(q))
    assert_same_rotation(back, q)
    assert back[0] >= 0


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.8, 0), (0, -0.6, 0.8)])
@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-9])
def test_direction_cosines_of_half_a_turn(axis, angle):
    q = attitude.from_rotvec(angle * np.array(axis))
    assert_same_rotation(attitude.from_dcm(attitude.to_dcm(q)), q)


@given(rotvecs)
def test_rotation_vector_round_trip(rotvec):
    q = attitude.from_rotvec(rotvec)
    assert_same_rotation(q, np.roll(Rotation.from_rotvec(rotvec).as_quat(), 1))
    np.testing.assert_allclose(attitude.to_rotvec(q), rotvec, rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(attitude.to_rotvec(-q), rotvec, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-16, 1e-9, 1e-8, 3e-8, 1e-6])
def test_small_rotation_vector_keeps_its_digits(size):
    rotvec = size * np.array([0.36, -0.48, 0.8])
    np.testing.assert_allclose(attitude.to_rotvec(attitude.from_rotvec(rotvec)), rotvec, rtol=1e-14, atol=0)


@given(angles, st.floats(-1.56, 1.56), angles)
def test_euler_round_trip(roll, pitch, heading):
    q = attitude.from_euler(roll, pitch, heading)
    np.testing.assert_allclose(
        attitude.to_dcm(q), Rotation.from_euler("ZYX", [heading, pitch, roll]).as_matrix(), atol=1e-14
    )
    back = attitude.to_euler(q)
    # The angles lose digits towards the zenith as 1/cos(pitch); the arc sine loses as many.
    np.testing.assert_allclose(
        attitude.wrapped(back - [roll, pitch, heading]), 0, atol=1e-14 / np.cos(pitch) ** 2
    )


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_euler_angles_stay_finite_at_the_zenith(pitch):
    roll, back, heading = attitude.to_euler(attitude.from_euler(0.3, pitch, 0.1))
    assert back == pytest.approx(pitch, abs=3e-8)
    assert np.isfinite([roll, heading]).all()


def test_euler_angles_are_signed_as_pilots_do():
    nose_up = attitude.from_euler(0.0, np.radians(10), np.radians(90))
    # Heading east, ten degrees nose up: the nose points east and up, the right wing south.
    np.testing.assert_allclose(
        attitude.rotate(nose_up, [1, 0, 0]), [0, np.cos(np.radians(10)), -np.sin(np.radians(10))], atol=1e-15
    )
    np.testing.assert_allclose(attitude.rotate(nose_up, [0, 1, 0]), [-1, 0, 0], atol=1e-15)
    right_wing_down = attitude.from_euler(np.radians(30), 0.0, 0.0)
    assert attitude.rotate(right_wing_down, [0, 1, 0])[2] == pytest.approx(0.5)


def test_functions_take_leading_axes():
    rotvec = np.random.default_rng(3).normal(size=(2, 5, 3))
    q = attitude.from_rotvec(rotvec)
    for stacked in (
        attitude.to_dcm(q),
        attitude.from_dcm(attitude.to_dcm(q)),
        attitude.to_rotvec(q),
        attitude.to_euler(q),
        attitude.skew(rotvec),
        attitude.rotate(q, rotvec),
    ):
        assert stacked.shape[:2] == (2, 5)
    np.testing.assert_array_equal(attitude.to_dcm(q)[1, 3], attitude.to_dcm(q[1, 3]))
    np.testing.assert_array_equal(
        attitude.from_dcm(attitude.to_dcm(q))[1, 3], attitude.from_dcm(attitude.to_dcm(q[1, 3]))
    )


@given(vectors, vectors)
def test_skew_is_the_cross_product(u, v):
    np.testing.assert_allclose(attitude.skew(u) @ v, np.cross(u, v), atol=1e-15)


@given(st.floats(-20, 20))
def test_wrapped_angle(angle):
    wrapped = attitude.wrapped(angle)
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-14)


@given(quaternions, rotvecs)
def test_correction_by_the_misalignment_gives_the_truth(q_nb_true, phi):
    computed = attitude.multiply(attitude.from_rotvec(-phi), q_nb_true)
    np.testing.assert_allclose(attitude.misalignment(computed, q_nb_true), phi, rtol=1e-10, atol=1e-14)
    assert_same_rotation(attitude.corrected(computed, phi), q_nb_true)


def test_misalignment_has_the_documented_sign():
    q_nb = attitude.from_euler(0.2, -0.1, 2.0)
    phi = 1e-6 * np.array([1.0, -2.0, 3.0])
    C_nb_computed = (np.eye(3) - attitude.skew(phi)) @ attitude.to_dcm(q_nb)
    computed = attitude.from_dcm(C_nb_computed)
    np.testing.assert_allclose(attitude.misalignment(computed, q_nb), phi, atol=1e-11)


def test_attitude_error_is_computed_minus_true_and_wrapped():
    true = attitude.from_euler(0.1, 0.2, np.pi - 0.01)
    computed = attitude.from_euler(0.13, 0.18, -np.pi + 0.02)
    np.testing.assert_allclose(attitude.attitude_error(computed, true), [0.03, -0.02, 0.03], atol=1e-14)


@given(angles, st.floats(-1.4, 1.4), angles, vectors)
def test_attitude_error_matrix_is_the_derivative_of_the_error(roll, pitch, heading, direction):
    q_nb, phi = attitude.from_euler(roll, pitch, heading), 1e-5 * direction

    def error(phi):
        return attitude.attitude_error(attitude.multiply(attitude.from_rotvec(-phi), q_nb), q_nb)

    # A central difference: what is left is the third order in phi, steep towards the zenith.
    difference = 0.5 * (error(phi) - error(-phi))
    np.testing.assert_allclose(
        difference,
        attitude.attitude_error_matrix(q_nb) @ phi,
        rtol=0,
        atol=2e-15 / np.cos(pitch) ** 3 + 1e-14,
    )


def test_wrapped_angles():
    angles = [-np.pi, np.pi, 3.0, 3 * np.pi + 0.5, -4.0, 1e-20, np.nan, np.inf]
    expected = [-np.pi, -np.pi, 3.0, -np.pi + 0.5, 2 * np.pi - 4.0, 1e-20, np.nan, np.nan]
    np.testing.assert_allclose(attitude.wrapped(angles), expected, rtol=1e-15)
    for angle in np.nextafter([-np.pi, np.pi], [-4.0, 0.0]):
        assert -np.pi <= attitude.wrapped(angle) < np.pi
