"""The four airframes fly the mission inside its bounds; a mission that cannot be flown says why."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.aircraft import envelope, guidance, simulator
from fleetalign.aircraft.airframe import airframe_names, load_airframe
from fleetalign.aircraft.envelope import FlightError
from fleetalign.aircraft.flight import Flight
from fleetalign.aircraft.mission import Air, BankProfile, FlightPlan, SManeuver, Start, Turbulence
from fleetalign.aircraft.phases import maneuver_bank, s_bank
from fleetalign.aircraft.simulator import fly
from fleetalign.sins import attitude, earth

SHORT = FlightPlan(s_start_s=145.0, tail_s=2.0)


@pytest.fixture(scope="module", params=airframe_names())
def flight(request) -> Flight:
    return fly(SHORT.model_copy(update={"airframe": request.param}))


def limits(flight: Flight):
    return next(a.limits for a in map(load_airframe, airframe_names()) if a.name == flight.airframe)


def held(flight: Flight, phase: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors of altitude, m, and speed, m/s, in a phase."""
    mark = flight.phase(phase)
    rows = flight.window(mark.start_s, mark.end_s)
    return rows.lla[:, 2] - 1015.0, np.linalg.norm(rows.v_n, axis=1) - 200.0


def test_takes_off_from_rest_on_its_gear(flight):
    roll = flight.window(0.0, flight.phase("takeoff").end_s)
    assert np.linalg.norm(flight.v_n[0]) < 0.01
    assert flight.lla[0, 2] == pytest.approx(5.0, abs=0.01)
    assert np.degrees(flight.lla[0, :2]) == pytest.approx([30.0, 120.0], abs=1e-5)
    assert np.degrees(attitude.to_euler(flight.q_nb[0]))[[0, 2]] == pytest.approx([0.0, 45.0], abs=0.01)
    assert np.abs(roll.lla[:, 2] - 5.0).max() < 1.0
    # Rotation: the nose comes up before the wheels leave.
    assert np.degrees(attitude.to_euler(roll.q_nb)[-1, 1]) > 4.0
    assert np.all(flight.window(flight.phase("climb").start_s, 140.0).lla[:, 2] > 14.0)


def test_phases_follow_one_another(flight):
    assert [p.name for p in flight.phases] == [
        *("takeoff", "initial_climb", "climb", "capture", "level", "s_maneuver", "tail")
    ]
    assert [p.start_s for p in flight.phases[1:]] == [p.end_s for p in flight.phases[:-1]]
    assert flight.phases[0].start_s == flight.time[0] == 0.0
    assert flight.time[-1] == pytest.approx(SHORT.end_s)
    assert len({len(getattr(flight, n)) for n in ("time", "lla", "v_n", "q_nb", "dtheta_b", "dv_b")}) == 1
    assert not flight.dtheta_b[0].any()
    assert not flight.dv_b[0].any()


def test_level_flight_holds_altitude_and_speed(flight):
    altitude, speed = held(flight, "level")
    assert np.abs(altitude).max() < 1.0
    assert np.abs(speed).max() < 0.5


def test_s_maneuver_holds_altitude_and_speed(flight):
    altitude, speed = held(flight, "s_maneuver")
    assert np.abs(altitude).max() < 10.0
    assert np.abs(speed).max() < 2.0
    s = flight.phase("s_maneuver")
    bank = np.degrees(flight.window(s.start_s, s.end_s).bank)
    assert bank.max() == pytest.approx(SHORT.s_maneuver.bank_deg, abs=3.0)
    assert bank.min() == pytest.approx(-SHORT.s_maneuver.bank_deg, abs=3.0)
    assert np.abs(bank[[0, -1]]).max() < 4.0


def test_stays_inside_the_airframes_limits(flight):
    bounds = limits(flight)
    assert bounds.load_factor_min_g < flight.load_factor.min()
    assert flight.load_factor.max() < bounds.load_factor_max_g
    assert np.degrees(np.abs(flight.bank)).max() < bounds.bank_deg


def test_summary_says_what_the_flight_was(flight):
    summary = flight.summary
    assert 5.0 < summary["liftoff_s"] < 40.0 < summary["altitude_reached_s"] < 120.0
    assert summary["altitude_m"] == pytest.approx(1015.0, abs=1.0)
    assert summary["speed_mps"] == pytest.approx(200.0, abs=0.5)
    assert (summary["s_start_s"], summary["s_duration_s"]) == (145.0, 40.0)
    assert 0.0 < summary["s_altitude_deviation_m"] < 10.0
    assert summary["airframe"] == flight.airframe


@pytest.mark.parametrize("name", airframe_names())
def test_steep_s_at_any_phase(name):
    maneuver = SManeuver(duration_s=36.0, lateral_acceleration_mps2=11.5, period_s=36.0, phase_deg=30.0)
    turning = fly(
        FlightPlan(airframe=name, s_start_s=142.0, s_maneuver=maneuver, tail_s=0.0, fdm_rate_hz=200)
    )
    altitude, speed = held(turning, "s_maneuver")
    assert np.abs(altitude).max() < 10.0
    assert np.abs(speed).max() < 2.0


# One way and then the other at 59 deg, with rolls at 30 deg/s that start and stop at 30 deg/s^2 or less.
TURNS = BankProfile(
    times_s=(0, 0.5, 2.2, 2.7, 8, 8.5, 12.2, 12.7, 18, 18.5, 20.2, 20.7),
    banks_deg=(0, 4, 55, 59, 59, 55, -55, -59, -59, -55, -4, 0),
)


@pytest.mark.parametrize("name", airframe_names())
def test_a_bank_profile_is_followed(name):
    plan = FlightPlan(airframe=name, s_start_s=145.0, s_maneuver=TURNS, tail_s=0.0, fdm_rate_hz=200)
    turning = fly(plan)
    altitude, speed = held(turning, "s_maneuver")
    assert np.abs(altitude).max() < 10.0
    assert np.abs(speed).max() < 3.0
    s = turning.phase("s_maneuver")
    assert s.end_s - s.start_s == pytest.approx(20.7, abs=0.03)
    window = turning.window(s.start_s, s.end_s)
    asked = np.degrees([maneuver_bank(TURNS, t - s.start_s) for t in window.time])
    error = np.degrees(window.bank) - asked
    steady = (np.abs(asked) > 58.0) & (np.arange(len(asked)) % 850 > 600)
    side_g = window.dv_b[:, 1] / turning.dt / 9.80665
    assert np.abs(side_g[steady]).max() < 0.06  # coordinated: the F-16's damper alone makes 0.13 g
    # Without what is fed forward the bank lags by 8 deg and more.
    assert np.abs(error).max() < 6.0
    assert np.sqrt(np.mean(error**2)) < 2.5


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"banks_deg": (0, 10, 20, 0)}, "times_s has 3 values and banks_deg has 4"),
        ({"times_s": (1, 10, 20)}, r"from 1 to 20 s: from 0 to within \[5, 40\] s"),
        ({"times_s": (0, 10, 41)}, r"from 0 to 41 s: from 0 to within \[5, 40\] s"),
        ({"times_s": (0, 21, 20)}, "20 s after 21 s; knots are at least 0.01 s apart"),
        ({"banks_deg": (0, 10, 5)}, "from 0 to 5 deg: both ends must be 0 deg"),
        ({"banks_deg": (0, -86, 0)}, "reaches 86 deg"),
        ({"banks_deg": (0, float("nan"), 0)}, "finite number"),
    ],
)
def test_a_bank_profile_that_makes_no_sense_is_refused(changes, told):
    with pytest.raises(ValueError, match=told):
        BankProfile(**{"times_s": (0, 10, 20), "banks_deg": (0, 30, 0)} | changes)


@pytest.mark.parametrize(
    ("profile", "reason"),
    [
        ({"times_s": (0, 10, 20), "banks_deg": (0, 64, 0)}, r"needs 64\.0 deg of bank, .* F-16 63\.0 deg"),
        (
            {"times_s": (0, 0.5, 20), "banks_deg": (0, 40, 0)},
            r"of 80\.0 deg/s, .* F-16 60\.0 deg/s",
        ),
    ],
)
def test_a_bank_profile_beyond_the_airframe_is_refused_before_flight(profile, reason):
    with pytest.raises(FlightError, match=reason):
        fly(QUICK.model_copy(update={"s_maneuver": BankProfile(**profile)}))


def test_a_turn_beyond_the_load_factor_is_refused_before_flight(monkeypatch):
    with_airframe(monkeypatch, limits__load_factor_max_g=1.5)
    steep = BankProfile(times_s=(0, 5, 10), banks_deg=(0, 50, 0))
    with pytest.raises(FlightError, match=r"the bank profile needs 1\.6 g, guidance allows the F-16 1\.5 g"):
        fly(QUICK.model_copy(update={"s_maneuver": steep}))


def test_s_command_starts_and_ends_level():
    maneuver = SManeuver(phase_deg=90.0)
    assert s_bank(maneuver, 0.0) == pytest.approx(0.0, abs=1e-12)
    assert s_bank(maneuver, maneuver.duration_s) == pytest.approx(0.0, abs=1e-12)
    assert np.degrees(s_bank(maneuver, 20.0)) == pytest.approx(maneuver.bank_deg)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("name", airframe_names())
def test_flies_in_a_crosswind(name, side):
    cross = side * 10.0 / np.sqrt(2)
    air = Air(wind_north_mps=-cross, wind_east_mps=cross)
    plan = FlightPlan(airframe=name, s_start_s=145.0, s_maneuver=SManeuver(duration_s=5), tail_s=0.0, air=air)
    drifting = fly(plan.model_copy(update={"fdm_rate_hz": 200}))
    mark = drifting.phase("level")
    v_n = drifting.window(mark.start_s, mark.end_s).v_n
    through_air = v_n - [air.wind_north_mps, air.wind_east_mps, 0.0]
    assert np.abs(np.linalg.norm(through_air, axis=1) - 200.0).max() < 0.5
    # The nose stays on the heading, so the wind carries the aircraft to its side.
    drift = np.degrees(np.arctan2(10.0, 200.0))
    assert np.degrees(np.arctan2(v_n[-1, 1], v_n[-1, 0])) - 45.0 == pytest.approx(drift * side, abs=0.3)
    # On the runway of 45 m till lift-off; the F-16 turns into the wind once its nose wheel is up.
    roll = drifting.window(0.0, drifting.phase("takeoff").end_s)
    north, east, _ = earth.displacement_n(roll.lla, np.tile(roll.lla[0], (len(roll.lla), 1))).T
    assert np.abs(east - north).max() / np.sqrt(2) < (15.0 if name == "f16" else 6.0)


QUICK = FlightPlan(s_start_s=130.0, s_maneuver=SManeuver(duration_s=5.0), tail_s=0.0, fdm_rate_hz=200)


@pytest.mark.parametrize("turbulence", [Turbulence.MILSPEC, Turbulence.TUSTIN])
def test_turbulence_is_repeatable_and_seeded(turbulence):
    # Slower than a plan may state in turbulence: the truth is coarse, but must repeat all the same.
    plan = QUICK.model_copy(update={"air": Air(turbulence=turbulence), "seed": 3})
    first, again = fly(plan), fly(plan)
    other = fly(plan.model_copy(update={"seed": 4}))
    for name in ("lla", "v_n", "q_nb", "dtheta_b", "dv_b"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
        assert getattr(first, name).tobytes() != getattr(other, name).tobytes()
    level = first.phase("level")
    assert np.std(first.window(level.start_s, level.end_s).load_factor) > 0.02


def test_is_silent_reports_progress_and_leaves_no_file(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = []
    fly(QUICK, progress=lambda t, total: told.append((t, total)))
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())
    assert len(told) > 3
    assert told == sorted(told)
    assert told[-1] == (QUICK.end_s, QUICK.end_s)


def with_airframe(monkeypatch, **changes):
    """Flights get an F-16 that differs; ``limits__x`` changes a limit."""
    airframe = load_airframe("f16")
    bounds = {k.removeprefix("limits__"): v for k, v in changes.items() if k.startswith("limits__")}
    own = {k: v for k, v in changes.items() if not k.startswith("limits__")}
    altered = airframe.model_copy(update={**own, "limits": airframe.limits.model_copy(update=bounds)})
    monkeypatch.setattr(simulator, "load_airframe", lambda name: altered)


@pytest.mark.parametrize(
    ("changes", "phase", "reason"),
    [
        ({"engines": 0}, "takeoff", "not finished within 90 s"),
        ({"engines": 3}, "preparation", r"no property 'fcs/throttle-cmd-norm\[1\]'"),
        ({"model": "no-such-aircraft"}, "preparation", "no usable model"),
        ({"limits__alpha_max_deg": 3.0}, "initial_climb", "stall: angle of attack"),
        ({"limits__load_factor_max_g": 1.1}, "initial_climb", "load factor"),
        ({"limits__bank_deg": 40.0, "rotation_speed_mps": 149.0}, "takeoff", "runway of 1000 m overrun"),
    ],
)
def test_a_flight_outside_its_envelope_names_phase_time_and_reason(monkeypatch, changes, phase, reason):
    with_airframe(monkeypatch, **changes)
    start = Start(runway_length_m=1000.0)
    with pytest.raises(FlightError, match=reason) as caught:
        fly(QUICK.model_copy(update={"start": start}))
    assert caught.value.phase == phase
    assert caught.value.time_s > 0.0 or phase == "preparation"
    assert f"phase {phase} at {caught.value.time_s:.2f} s" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_altitude_bust(monkeypatch):
    # Levelling off harder than the climb rate may change overshoots.
    monkeypatch.setattr(guidance, "LEVEL_OFF", 100.0)
    with pytest.raises(FlightError, match="more than 50 m off 1015 m") as caught:
        fly(QUICK)
    assert caught.value.phase == "capture"
    assert 40.0 < caught.value.time_s < 80.0


def test_bank_beyond_the_limit(monkeypatch):
    with_airframe(monkeypatch, limits__bank_deg=20.0)
    monkeypatch.setattr(envelope, "MAX_BANK_SHARE", 2.0)
    monkeypatch.setattr(guidance, "MAX_BANK_SHARE", 2.0)
    with pytest.raises(FlightError, match=r"bank .* beyond 20 deg") as caught:
        fly(QUICK.model_copy(update={"s_maneuver": SManeuver()}))
    assert caught.value.phase == "s_maneuver"


def test_s_too_steep_for_the_airframe_is_refused_before_flight():
    plan = QUICK.model_copy(update={"s_maneuver": SManeuver(lateral_acceleration_mps2=25.0)})
    with pytest.raises(FlightError, match=r"guidance allows the F-16 63\.0 deg") as caught:
        fly(plan)
    assert (caught.value.phase, caught.value.time_s) == ("s_maneuver", 130.0)


def test_s_before_level_flight_has_settled():
    with pytest.raises(FlightError, match="has not settled when the S-manoeuvre is due") as caught:
        fly(QUICK.model_copy(update={"s_start_s": 70.0}))
    assert caught.value.phase == "capture"


def test_ground_contact_and_lost_state_end_a_flight():
    plan = FlightPlan()
    monitor = envelope.Envelope(plan, load_airframe("f16"))
    level = simulator.mission_phases(plan, load_airframe("f16"))
    phase = next(p for p in level if p.name == "level")
    sensed = guidance.Sensed(1015.0, 1010.0, 0, 200.0, 0, 0, 0, 0, 0, 0, 0.02, 1.0, 2e4, False, 1e4)
    monitor.check(phase, 200.0, 50.0, sensed)
    with pytest.raises(FlightError, match="ground contact"):
        monitor.check(phase, 200.0, 50.0, replace(sensed, on_wheels=True))
    with pytest.raises(FlightError, match="no longer finite"):
        monitor.check(phase, 200.0, 50.0, replace(sensed, q=float("nan")))


@pytest.mark.parametrize(
    ("changes", "elapsed", "reason"),
    [
        ({"alpha": np.radians(25.1)}, 0.5, r"stall: angle of attack 25\.1 deg"),
        ({"alpha": np.radians(-8.1)}, 0.5, "stall"),
        ({"load_factor": 7.1}, 0.5, r"load factor 7\.10 g"),
        ({"roll": np.radians(71.0)}, 0.5, "bank"),
        ({"height": -0.1}, 0.5, "ground contact"),
        ({"on_wheels": True}, 2.5, "ground contact"),
        ({"on_wheels": True}, 0.5, None),
        ({"distance": 3501.0}, 0.5, "runway of 3500 m overrun"),
        ({"heading": 0.4}, 0.5, "left the runway's heading"),
        ({}, 2.5, None),
    ],
)
def test_the_initial_climb_is_watched(changes, elapsed, reason):
    plan = FlightPlan(start=Start(heading_deg=0.0))
    monitor = envelope.Envelope(plan, load_airframe("f16"))
    phase = next(p for p in simulator.mission_phases(plan, load_airframe("f16")) if p.name == "initial_climb")
    sensed = guidance.Sensed(10.0, 5.0, 5.0, 90.0, 0, 0.17, 0, 0, 0, 0, 0.1, 1.0, 5e3, False, 1e3)
    if reason is None:
        monitor.check(phase, 20.0, elapsed, replace(sensed, **changes))
        return
    with pytest.raises(FlightError, match=f"phase initial_climb at 20.00 s: {reason}"):
        monitor.check(phase, 20.0, elapsed, replace(sensed, **changes))


def test_airframes_by_name():
    assert airframe_names() == ["a4", "f16", "f4n", "t38"]
    assert load_airframe("F4N") == load_airframe("f4n")
    assert FlightPlan(airframe="F4N") == FlightPlan(airframe="f4n")
    with pytest.raises(ValueError, match="unknown airframe 'concorde': one of a4, f16, f4n, t38"):
        load_airframe("concorde")
    with pytest.raises(ValueError, match="unknown airframe; known: a4, f16, f4n, t38"):
        FlightPlan(airframe="concorde")


@pytest.mark.parametrize("rates", [{"fdm_rate_hz": 250}, {"imu_rate_hz": 60, "fdm_rate_hz": 120}])
def test_rates_must_divide(rates):
    with pytest.raises(ValueError, match="a multiple of imu_rate_hz"):
        FlightPlan(**rates)


@pytest.mark.parametrize(("imu_rate", "rate"), [(797, 39850), (333, 16650)])
@pytest.mark.parametrize("turbulence", [Turbulence.NONE, Turbulence.MILSPEC])
def test_an_imu_rate_that_would_drive_the_flight_model_too_fast_is_refused(imu_rate, rate, turbulence):
    least = 100 if turbulence is Turbulence.NONE else 1200
    with pytest.raises(ValueError, match=rf"would be {rate} Hz; allowed are {least} to 3200 Hz"):
        FlightPlan(imu_rate_hz=imu_rate, air=Air(turbulence=turbulence))


@pytest.mark.parametrize(("imu_rate", "rate", "least"), [(100, 400, 800), (50, 750, 800), (200, 1000, 1200)])
@pytest.mark.parametrize("turbulence", [Turbulence.MILSPEC, Turbulence.TUSTIN])
def test_a_slow_flight_model_is_refused_in_turbulence(imu_rate, rate, least, turbulence):
    rates = {"imu_rate_hz": imu_rate, "air": Air(turbulence=turbulence)}
    with pytest.raises(ValueError, match=f"fdm_rate_hz {rate}: {least} to 3200 Hz in this air"):
        FlightPlan(fdm_rate_hz=rate, **rates)
    assert FlightPlan(fdm_rate_hz=least, **rates).model_rate_hz == least
    assert FlightPlan(fdm_rate_hz=rate, imu_rate_hz=imu_rate).model_rate_hz == rate


@pytest.mark.parametrize(
    ("imu_rate", "rate", "rough"),
    [(100, 500, 800), (200, 600, 1200), (80, 800, 800), (400, 800, 1200), (800, 800, 1600), (64, 1600, 1600)],
)
def test_default_rate_of_the_flight_model(imu_rate, rate, rough):
    assert FlightPlan(imu_rate_hz=imu_rate).model_rate_hz == rate
    assert FlightPlan(imu_rate_hz=imu_rate, air=Air(turbulence=Turbulence.TUSTIN)).model_rate_hz == rough
