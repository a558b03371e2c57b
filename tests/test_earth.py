import numpy as np
import pytest
from fleetalign.sins import attitude, earth
from fleetalign.sins.earth import GravityModel
from hypothesis import given
from hypothesis import strategies as st

MILLIGAL = 1e-5
# Heights of aircraft, and above.
latitudes = st.floats(-np.pi / 2, np.pi / 2)
longitudes = st.floats(-np.pi, np.pi)
heights = st.floats(-500.0, 100e3)
positions = st.tuples(latitudes, longitudes, heights).map(np.array)
# Where the east direction is well conditioned.
off_pole = st.tuples(st.floats(-1.5, 1.5), longitudes, heights).map(np.array)


def test_ellipsoid_has_the_published_semi_minor_axis_and_pole_radius():
    np.testing.assert_allclose(earth.ecef_from_lla([np.pi / 2, 0, 0])[2], 6356752.3142, atol=1e-4)
    np.testing.assert_allclose(earth.ecef_from_lla([0, np.pi / 2, 0]), [0, 6378137.0, 0], atol=1e-8)
    np.testing.assert_allclose(earth.radii_of_curvature(np.pi / 2), 6399593.6258, atol=1e-4)
    np.testing.assert_allclose(earth.radii_of_curvature(0.0), [6335439.3273, 6378137.0], atol=1e-4)


@given(positions)
def test_position_round_trip(lla):
    r_e = earth.ecef_from_lla(lla)
    back = earth.lla_from_ecef(r_e)
    np.testing.assert_allclose(earth.ecef_from_lla(back), r_e, atol=2e-8)
    assert back[0] == pytest.approx(lla[0], abs=1e-14)
    assert back[2] == pytest.approx(lla[2], abs=2e-8)


@given(positions)
def test_down_is_against_the_gradient_of_height(lla):
    up = np.array([0, 0, 50.0])
    step = earth.ecef_from_lla(lla + up) - earth.ecef_from_lla(lla - up)
    np.testing.assert_allclose(earth.C_en(lla[0], lla[1])[:, 2], -step / 100, atol=1e-10)


@given(positions)
def test_direction_cosines_are_orthonormal(lla):
    C = earth.C_en(lla[0], lla[1])
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(C) == pytest.approx(1)


@given(off_pole, st.tuples(*[st.floats(-10, 10)] * 3).map(np.array))
def test_displacement_agrees_with_the_geocentric_one(lla, d):
    moved = earth.displaced(lla, d)
    np.testing.assert_allclose(earth.displacement_n(moved, lla), d, atol=1e-8)
    geocentric = earth.ecef_from_lla(moved) - earth.ecef_from_lla(lla)
    # What is left is second order: the curvature of the meridian and of the parallel.
    curvature = d @ d * (1 + abs(np.tan(lla[0]))) / 6.3e6
    np.testing.assert_allclose(earth.C_en(lla[0], lla[1]).T @ geocentric, d, atol=curvature + 1e-8)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_displacement_across_the_antimeridian(shape):
    west_of_it = np.broadcast_to([0.5, np.pi - 1e-6, 100.0], (*shape, 3))
    d = np.broadcast_to([30.0, 40.0, -5.0], (*shape, 3))
    moved = earth.displaced(west_of_it, d)
    # 40 m are 7 urad here: the longitude is now a western one.
    np.testing.assert_allclose(moved[..., 1], -np.pi + 6.1e-6, rtol=0, atol=1e-7)
    np.testing.assert_allclose(earth.displacement_n(moved, west_of_it), d, rtol=0, atol=1e-6)
    back = earth.displaced(moved, -d)
    np.testing.assert_allclose(earth.displacement_n(west_of_it, moved), -d, rtol=0, atol=1e-3)
    np.testing.assert_allclose(back[..., 1], np.pi - 1e-6, rtol=0, atol=1e-9)


def potential_j2(r_e):
    """Gravity potential in e, m^2/s^2: point mass, J2 and centrifugal."""
    x, y, z = r_e
    r = np.sqrt(x**2 + y**2 + z**2)
    oblateness = earth.J2 * (earth.EQUATORIAL_RADIUS / r) ** 2 * (1.5 * (z / r) ** 2 - 0.5)
    return earth.GRAVITATIONAL_PARAMETER / r * (1 - oblateness) + 0.5 * earth.EARTH_RATE**2 * (x**2 + y**2)


@given(positions)
def test_j2_gravity_is_the_gradient_of_its_potential(lla):
    r_e, step = earth.ecef_from_lla(lla), 100.0
    gradient = [
        (potential_j2(r_e + step * axis) - potential_j2(r_e - step * axis)) / (2 * step) for axis in np.eye(3)
    ]
    north, down = earth.gravity(GravityModel.J2, lla[0], lla[2])
    np.testing.assert_allclose([north, 0.0, down], earth.C_en(lla[0], lla[1]).T @ gradient, rtol=0, atol=1e-8)


def test_somigliana_gravity_has_the_published_values():
    assert earth.gravity(GravityModel.SOMIGLIANA, 0.0, 0.0) == (0.0, pytest.approx(9.7803253359, abs=1e-10))
    pole = earth.gravity(GravityModel.SOMIGLIANA, np.pi / 2, 0.0)
    assert pole == (0.0, pytest.approx(9.8321849378, abs=1e-10))


@given(latitudes)
def test_gravity_models_differ_by_the_fourth_harmonic(lat):
    difference = np.subtract(
        earth.gravity(GravityModel.SOMIGLIANA, lat, 0.0), earth.gravity(GravityModel.J2, lat, 0.0)
    )
    r_e = earth.ecef_from_lla([lat, 0.0, 0.0])
    r = np.linalg.norm(r_e)
    s, c = r_e[2] / r, r_e[0] / r
    # J4 of the WGS84 ellipsoid; what is left is J6 (0.05 mGal) and the vertical's 0.2 deg.
    scale = earth.GRAVITATIONAL_PARAMETER / r**2 * -2.37091e-6 * (earth.EQUATORIAL_RADIUS / r) ** 4
    north = -scale * 2.5 * (7 * s**3 - 3 * s) * c
    down = -5 * scale * (35 * s**4 - 30 * s**2 + 3) / 8
    np.testing.assert_allclose(difference / MILLIGAL, np.array([north, down]) / MILLIGAL, rtol=0, atol=0.1)


def test_gravity_models_differ_as_measured_at_the_mission_altitude():
    at = np.radians(30), 1015.0
    difference = np.subtract(earth.gravity(GravityModel.J2, *at), earth.gravity(GravityModel.SOMIGLIANA, *at))
    # Both bend the plumb line alike; the fourth harmonic remains.
    np.testing.assert_allclose(difference / MILLIGAL, [3.2, 3.3], atol=0.1)


@given(latitudes, st.floats(0, 20e3))
def test_gravity_models_fall_alike_with_height(lat, height):
    def loss(model):
        return earth.gravity(model, lat, 0.0)[1] - earth.gravity(model, lat, height)[1]

    # They differ by the fourth zonal harmonic, whose part in the gradient is about 1e-5 of the whole.
    assert loss(GravityModel.J2) == pytest.approx(loss(GravityModel.SOMIGLIANA), rel=1e-4, abs=1e-12)


@given(positions)
def test_earth_rate_points_to_the_pole(lla):
    rate_e = earth.C_en(lla[0], lla[1]) @ earth.earth_rate_n(lla[0])
    np.testing.assert_allclose(rate_e, [0, 0, 7.292115e-5], atol=1e-19)


@given(off_pole, st.floats(-300, 300), st.floats(-300, 300))
def test_transport_rate_turns_the_navigation_frame(lla, v_north, v_east):
    def C_en_after(t):
        lat, lon, _ = earth.displaced(lla, np.array([v_north, v_east, 0.0]) * t)
        return earth.C_en(lat, lon)

    t = 0.01
    turn = attitude.to_rotvec(attitude.from_dcm(C_en_after(-t).T @ C_en_after(t)))
    rate = earth.transport_rate_n(lla[0], lla[2], v_north, v_east)
    # In n, the change of C_en is C_en [rate x]; 1e-16 of rounding over 20 ms, and the turn's square.
    np.testing.assert_allclose(turn / (2 * t), rate, rtol=1e-6, atol=1e-13)
