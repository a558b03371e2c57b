"""Truth against JSBSim's own outputs; increments against rates, forces and our own mechanisation."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from fleetalign.aircraft import simulator
from fleetalign.aircraft.flight import Flight
from fleetalign.aircraft.mission import Air, FlightPlan, SManeuver, Start, Turbulence
from fleetalign.aircraft.simulator import fly
from fleetalign.aircraft.truth import InertialStates, gravitation_i, increments, navigation_truth, summed
from fleetalign.sins import attitude, earth
from fleetalign.sins.mechanization import NavigationState, mechanize

FOOT = 0.3048
ARCSEC = np.pi / 180 / 3600


@pytest.fixture(scope="module")
def flown_and_logged() -> tuple[Flight, dict[str, np.ndarray]]:
    """A short flight, and JSBSim's own outputs at guidance's rate."""
    log: dict[float, tuple] = {}
    names = [
        *("position/lat-geod-rad", "position/long-gc-rad", "position/geod-alt-ft"),
        *(f"velocities/v-{axis}-fps" for axis in ("north", "east", "down")),
        *(f"velocities/{axis}i-rad_sec" for axis in "pqr"),
        *(f"forces/fb{axis}-total-lbs" for axis in "xyz"),
        "inertia/mass-slugs",
    ]
    sense = simulator._Model.sense

    def logging_sense(model):
        row = [model.fdm[name] for name in names]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PendingDeprecationWarning)
            C_be = np.array(model.fdm.get_propagate().get_Tec2b())
        log[round(model.fdm.get_sim_time() - simulator.SETTLING_S, 2)] = (row, C_be)
        return sense(model)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator._Model, "sense", logging_sense)
        flight = fly(FlightPlan(s_start_s=130.0, s_maneuver=SManeuver(duration_s=20.0), tail_s=0.0))
    rows = np.array([row for row, _ in log.values()])
    C_be = np.array([C for _, C in log.values()])
    index = np.searchsorted(flight.time, np.array(list(log)) - 1e-6)
    return flight, {"index": index, "rows": rows, "C_be": C_be}


def test_position_and_velocity_are_jsbsims(flown_and_logged):
    flight, log = flown_and_logged
    index, rows = log["index"], log["rows"]
    # JSBSim's own geodetic latitude and height are iterated to some 1e-11 rad and 15 um.
    assert np.abs(flight.lla[index, :2] - rows[:, :2]).max() < 2e-11
    assert np.abs(flight.lla[index, 2] - rows[:, 2] * FOOT).max() < 3e-5
    assert np.abs(flight.v_n[index] - rows[:, 3:6] * FOOT).max() < 1e-6


def test_euler_angles_are_against_the_geodetic_level(flown_and_logged):
    flight, log = flown_and_logged
    index = log["index"]
    C_en = earth.C_en(flight.lla[index, 0], flight.lla[index, 1])
    C_eb = C_en @ attitude.to_dcm(flight.q_nb[index])
    assert np.abs(C_eb - np.swapaxes(log["C_be"], 1, 2)).max() < 1e-8
    # The geocentric level differs by 0.17 deg at this latitude, so the check can tell.
    geocentric = flight.lla[index, 0] - 2.9e-3
    C_eb = earth.C_en(geocentric, flight.lla[index, 1]) @ attitude.to_dcm(flight.q_nb[index])
    assert np.abs(C_eb - np.swapaxes(log["C_be"], 1, 2)).max() > 1e-3


def test_increments_are_jsbsims_rates_and_specific_forces(flown_and_logged):
    flight, log = flown_and_logged
    airborne = (log["index"] > np.searchsorted(flight.time, flight.phase("climb").start_s)) & (
        log["index"] < len(flight.time) - 1
    )
    index, rows = log["index"][airborne], log["rows"][airborne]
    rate = (flight.dtheta_b[index] + flight.dtheta_b[index + 1]) / (2 * flight.dt)
    force = (flight.dv_b[index] + flight.dv_b[index + 1]) / (2 * flight.dt)
    specific_force = rows[:, 9:12] / rows[:, 12:] * FOOT
    assert np.sqrt(np.mean((rate - rows[:, 6:9]) ** 2)) < 1e-3
    assert np.abs(np.mean(rate - rows[:, 6:9], axis=0)).max() < 2e-5
    assert np.sqrt(np.mean((force - specific_force) ** 2)) < 2e-2
    assert np.abs(np.mean(force - specific_force, axis=0)).max() < 2e-3


def replayed(flight: Flight) -> tuple[float, float, float]:
    """Largest drift of a perfect IMU: arcsec, m/s, m."""
    start = NavigationState(flight.lla[0], flight.v_n[0], flight.q_nb[0])
    found = mechanize(flight.time, flight.dtheta_b, flight.dv_b, start, flight.gravity)
    misalignment = np.linalg.norm(attitude.misalignment(found.q_nb, flight.q_nb), axis=1)
    position = np.linalg.norm(earth.displacement_n(found.lla, flight.lla), axis=1)
    velocity = np.linalg.norm(found.v_n - flight.v_n, axis=1)
    return misalignment.max() / ARCSEC, velocity.max(), position.max()


def test_a_perfect_imu_returns_to_the_truth_over_the_whole_flight(flight):
    assert flight.time[-1] == pytest.approx(545.0)
    assert flight.dt == pytest.approx(0.01)
    arcsec, velocity, position = replayed(flight)
    assert arcsec < 0.01
    assert velocity < 1e-3
    assert position < 0.1


def test_a_fast_perfect_imu_returns_to_the_truth_in_turbulence():
    air = Air(turbulence=Turbulence.MILSPEC, turbulence_severity=4)
    plan = FlightPlan(s_start_s=145.0, s_maneuver=SManeuver(duration_s=5.0), air=air, seed=1, imu_rate_hz=400)
    at_400_hz = fly(plan)
    names = ("time", "lla", "v_n", "q_nb")
    # The flight model runs at the same rate for 200 Hz.
    assert plan.model_rate_hz == FlightPlan(imu_rate_hz=200, air=air).model_rate_hz
    at_200_hz = replace(
        at_400_hz,
        **{name: getattr(at_400_hz, name)[::2].copy() for name in names},
        dtheta_b=summed(at_400_hz.dtheta_b[1:], 2),
        dv_b=summed(at_400_hz.dv_b[1:], 2),
    )
    for flight in (at_200_hz, at_400_hz):
        arcsec, _, position = replayed(flight)
        assert arcsec < 0.1
        assert position < 1.0


def test_the_wrong_gravity_model_drifts(flight):
    _, _, position = replayed(replace(flight, gravity=earth.GravityModel.SOMIGLIANA))
    assert position > 1.0


def test_gravitation_is_earths_gravity_without_the_centrifugal_part():
    rng = np.random.default_rng(1)
    lla = np.stack([rng.uniform(-1.5, 1.5, 50), rng.uniform(-3, 3, 50), rng.uniform(0, 2e4, 50)], axis=1)
    r_e = earth.ecef_from_lla(lla)
    north, down = earth.gravity(earth.GravityModel.J2, lla[:, 0], lla[:, 2])
    g_n = np.stack([north, 0 * north, down], axis=1)
    g_e = (earth.C_en(lla[:, 0], lla[:, 1]) @ g_n[..., None])[..., 0]
    centrifugal = earth.EARTH_RATE**2 * r_e * [1.0, 1.0, 0.0]
    assert gravitation_i(r_e) == pytest.approx(g_e - centrifugal, abs=1e-14)


def test_increments_of_a_body_at_rest_on_the_earth():
    lla = np.array([0.5, 2.0, 100.0])
    dt, n = 0.01, 21
    angle = 0.3 + earth.EARTH_RATE * dt * np.arange(n)
    x, y, z = earth.ecef_from_lla(lla)
    c, s = np.cos(angle), np.sin(angle)
    r_i = np.stack([c * x - s * y, s * x + c * y, z + 0 * angle])
    v_i = earth.EARTH_RATE * np.stack([-r_i[1], r_i[0], 0 * angle])
    euler = np.tile([0.1, -0.2, 1.0], (n, 1))
    states = InertialStates(r_i.T, v_i.T, euler, 0.3, dt)
    found_lla, v_n, q_nb, q_ib = navigation_truth(states)
    assert found_lla == pytest.approx(np.tile(lla, (n, 1)), abs=2e-9)
    assert v_n == pytest.approx(np.zeros((n, 3)), abs=1e-12)
    dtheta, dv = (summed(part, 4) for part in increments(states, q_ib))
    assert dtheta.shape == dv.shape == (6, 3)
    w_ie = attitude.rotate(attitude.conjugate(q_nb[0]), np.array(earth.earth_rate_n(0.5)))
    g_north, g_down = earth.gravity(earth.GravityModel.J2, 0.5, 100.0)
    f_b = -attitude.rotate(attitude.conjugate(q_nb[0]), np.array([g_north, 0.0, g_down]))
    assert not dtheta[0].any()
    assert dtheta[1:] == pytest.approx(np.tile(w_ie * 4 * dt, (5, 1)), abs=1e-13)
    assert dv[1:] == pytest.approx(np.tile(f_b * 4 * dt, (5, 1)), abs=1e-10)


def test_load_factor_and_bank_are_the_motions(flight):
    level = flight.phase("level")
    rows = flight.window(level.start_s, level.end_s)
    assert rows.load_factor == pytest.approx(np.full(len(rows.time), 1.0), abs=0.01)
    assert np.degrees(rows.bank) == pytest.approx(np.zeros(len(rows.time)), abs=0.5)


def test_interpolation(flight):
    s = flight.phase("s_maneuver")
    fine = flight.window(s.start_s, s.end_s)
    names = ("time", "lla", "v_n", "q_nb", "dtheta_b", "dv_b")
    coarse = replace(fine, **{name: getattr(fine, name)[::2] for name in names})
    assert coarse.dt == pytest.approx(0.02)
    lla, v_n, q_nb = coarse.at(fine.time)
    assert np.abs(earth.displacement_n(lla, fine.lla)).max() < 1e-5
    assert np.abs(v_n - fine.v_n).max() < 2e-3
    assert np.abs(attitude.misalignment(q_nb, fine.q_nb)).max() < 1e-4
    # At the rows themselves nothing is lost.
    assert np.abs(lla[::2] - coarse.lla).max() < 1e-12
    assert np.abs(v_n[::2] - coarse.v_n).max() < 1e-9
    # Any shape of times, the ends among them.
    lla, v_n, q_nb = coarse.at([[s.start_s, s.end_s]])
    assert (lla.shape, v_n.shape, q_nb.shape) == ((1, 2, 3), (1, 2, 3), (1, 2, 4))
    assert v_n[0, 1] == pytest.approx(coarse.v_n[-1])
    with pytest.raises(ValueError, match="outside the flight"):
        coarse.at(s.end_s + 1.0)
    with pytest.raises(ValueError, match="outside the flight"):
        coarse.at([s.start_s, np.nan])


def test_times_asked_for_again_are_where_they_were(flight):
    """Known from the last time, whatever the asker did to it; and no others take their place."""
    s = flight.phase("s_maneuver")
    window = flight.window(s.start_s, s.end_s)
    t = np.linspace(s.start_s, s.end_s, 7)
    first = window.at(t)
    kept = [column.copy() for column in first]
    for column in first:
        column[:] = 0.0
    for found, true in zip(window.at(t), kept, strict=True):
        np.testing.assert_array_equal(found, true)
    other = window.at(t + 0.003 * (t < s.end_s))[0]
    assert (other[:-1] != kept[0][:-1]).any(axis=1).all()
    np.testing.assert_array_equal(window.at(t)[0], kept[0])


def test_interpolation_across_the_antimeridian():
    plan = FlightPlan(start=Start(longitude_deg=179.9), s_start_s=130.0, tail_s=0.0, fdm_rate_hz=200)
    across = fly(plan.model_copy(update={"s_maneuver": SManeuver(duration_s=5.0)}))
    assert across.lla[0, 1] > 3.1
    assert across.lla[-1, 1] < -3.1
    t = np.arange(0.0, across.time[-1], 0.0037)
    lla, v_n, _ = across.at(t)
    assert np.all((lla[:, 1] >= -np.pi) & (lla[:, 1] < np.pi))
    steps = earth.displacement_n(lla[1:], lla[:-1])
    assert np.abs(steps - 0.0037 * (v_n[1:] + v_n[:-1]) / 2).max() < 1e-3
    at_rows = across.at(across.time)[0]
    assert np.abs(earth.displacement_n(at_rows, across.lla)).max() < 1e-6


def test_window(flight):
    part = flight.window(100.0, 110.0)
    assert (part.time[0], part.time[-1], len(part.time)) == (pytest.approx(100.0), pytest.approx(110.0), 1001)
    assert not part.dtheta_b[0].any()
    assert not part.dv_b[0].any()
    row = np.searchsorted(flight.time, 99.999)
    assert flight.dv_b[row].any()
    assert part.dv_b[1:].tobytes() == flight.dv_b[row + 1 : row + 1001].tobytes()
    assert replayed(part)[2] < 1e-3
    assert part.phases == flight.phases
    with pytest.raises(ValueError, match="fewer than two rows"):
        flight.window(100.0, 100.001)
    with pytest.raises(KeyError, match="no phase 'landing'"):
        flight.phase("landing")
