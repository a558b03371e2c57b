"""The best manoeuvre: derivatives, limits, the optimum beside simple manoeuvres, its flight, the command."""

import json
import tomllib
from functools import partial

import casadi as ca
import numpy as np
import pytest
from fleetalign.aircraft.cache import cached_flight
from fleetalign.aircraft.mission import BankProfile
from fleetalign.align.maneuver import (
    SLACK,
    ManeuverError,
    ManeuverSearch,
    Problem,
    Profile,
    SearchOutcome,
    best_maneuver,
)
from fleetalign.align.maneuver_bound import AlignmentTask, bound_function, headings, knot_covariances
from fleetalign.align.maneuver_limits import ManeuverLimits
from fleetalign.align.maneuver_starts import starts, turns
from fleetalign.align.settings import FilterSettings
from fleetalign.cosim import maneuver as study
from fleetalign.cosim.maneuver import align_on, grid_of, task_of, with_profile, with_stated_fixes
from fleetalign.cosim.scenario import Scenario, ScenarioError, load_scenario, replaced
from fleetalign.cosim.scenario_file import scenario_toml
from fleetalign.sins.units import ARCMIN, ARCSEC, DEG

TASK = AlignmentTask(velocity_sd_mps=0.03, heading=45 * DEG, latitude=30 * DEG)
LIMITS = ManeuverLimits()
COARSE = ManeuverSearch(knot_s=1.0, simple_starts=2, random_starts=0, max_iterations=80)


@pytest.fixture(scope="module")
def best():
    return best_maneuver(TASK, LIMITS, COARSE)


def test_both_forms_of_the_bound_agree():
    bank = turns(np.arange(81) * 0.5, LIMITS, (8.0,))
    heading = headings(bank, 0.5, TASK)
    level, course = map(float, bound_function(80, 0.5, TASK)(bank, heading))
    P = knot_covariances(bank, 0.5, TASK)[-1]
    # The one leaves out the turn of the earth: 0.003 rad in 40 s.
    assert level == pytest.approx(0.5 * (P[0, 0] + P[1, 1]), rel=0.005)
    assert course == pytest.approx(P[2, 2], rel=0.005)


def test_the_bound_hardly_depends_on_the_grid():
    bounds = []
    for n in (80, 320):
        time = np.linspace(0, 40, n + 1)
        bank = np.interp(time, np.linspace(0, 40, 41), turns(np.linspace(0, 40, 41), LIMITS, (8.0,)))
        bounds.append(np.sqrt(np.diag(knot_covariances(bank, 40 / n, TASK)[-1])))
    np.testing.assert_allclose(bounds[0], bounds[1], rtol=0.03)


def test_without_a_turn_heading_is_hardly_seen():
    P = knot_covariances(np.zeros(41), 1.0, TASK)
    assert np.sqrt(P[-1, 2, 2]) > 60 * ARCMIN
    assert np.sqrt(P[-1, 0, 0]) == pytest.approx(100e-6, rel=0.2)  # the accelerometer's bias, as a tilt


def test_derivatives_are_those_of_finite_differences():
    problem = Problem(TASK, LIMITS, COARSE, 20)
    inner = ca.MX.sym("bank", 19)
    gradient = ca.Function("gradient", [inner], [ca.gradient(problem.cost(inner), inner)])
    bank = 0.9 * starts(LIMITS, 2.0, 20, 2, 0, 1)["three turns"][1:-1]
    exact = np.array(gradient(bank)).ravel()
    steps = 1e-5 * np.eye(19)
    numeric = [(float(problem.cost(bank + s)) - float(problem.cost(bank - s))) / 2e-5 for s in steps]
    np.testing.assert_allclose(exact, numeric, rtol=1e-5, atol=1e-6)
    assert np.abs(exact).max() > 0.1


def test_the_optimum_is_better_than_every_s_of_the_grid_and_than_8_s_and_32_s(best):
    assert best.outcome is SearchOutcome.CONVERGED
    grid = grid_of(TASK, LIMITS, COARSE, steps=(2, 4, 2))
    assert len(grid) > 5
    assert best.cost < min(point.cost for point in grid)
    # Its roll steps at the knots are no finer than those of the profile that is sought.
    two_turns = Profile(turns(best.profile.time, LIMITS, (8.0,)), best.profile.dt, TASK)
    assert best.cost < two_turns.cost(COARSE.heading_weight)
    assert best.cost == pytest.approx(best.profile.cost(1.0))
    assert best.cost <= min(a.cost for a in best.attempts if a.outcome is SearchOutcome.CONVERGED)
    assert best.profile.level_arcsec[-1] < 8.0
    assert best.profile.heading_arcmin[-1] < 0.2


def test_the_optimum_is_a_minimum(best):
    """Steps along any feasible direction to another end of a start do not lower the cost."""
    for attempt in best.attempts:
        step = 0.02 * (attempt.profile.bank - best.profile.bank)
        moved = Profile(best.profile.bank + step, best.profile.dt, TASK)
        assert moved.cost(1.0) > best.cost - 0.01


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"max_load_factor_g": 1.3, "duration_s": 30},
        {"max_bank_deg": 45, "max_roll_rate_deg_s": 15, "max_roll_acceleration_deg_s2": 10},
        {"course_tolerance_deg": 1, "max_heading_excursion_deg": 40},
    ],
)
def test_limits_are_held(changes):
    limits = ManeuverLimits(**changes)
    search = COARSE.model_copy(update={"simple_starts": 1, "max_iterations": 25})
    profile = best_maneuver(TASK, limits, search).profile
    # Written anew: nothing of the check that the search makes.
    bank, dt = profile.bank / DEG, profile.dt
    rate = np.diff(bank) / dt
    over = 1 + 1.1 * SLACK
    assert np.abs(bank).max() <= (limits.max_bank_deg - limits.bank_margin_deg) * over
    assert 1 / np.cos(np.abs(profile.bank).max()) <= limits.max_load_factor_g * over
    assert np.abs(rate).max() <= limits.max_roll_rate_deg_s * over
    assert np.abs(np.diff([0, *rate, 0])).max() <= limits.max_roll_acceleration_deg_s2 * dt * over
    turn = np.degrees(
        np.cumsum(9.80665 / 200 * 0.5 * dt * (np.tan(profile.bank[1:]) + np.tan(profile.bank[:-1])))
    )
    assert np.abs(turn).max() <= limits.max_heading_excursion_deg * over
    assert abs(turn[-1]) <= limits.course_tolerance_deg * over
    assert (bank[[0, -1]] == 0).all()
    assert np.abs(bank).max() > 10


@pytest.mark.parametrize(
    ("bank", "told"),
    [
        ([0, 61, 61, 0], ["bank 61.00 deg", "load factor 2.06 g"]),
        ([0, 40, 0, 0], ["roll rate 40.00", "roll acceleration 80.00"]),
        ([0, 20, 20, 20], ["course at the end", "bank at an end 20.00 deg"]),
        ([0, 10, 0, -10, 0], []),
    ],
)
def test_a_broken_limit_is_told(bank, told):
    limits = ManeuverLimits(
        bank_margin_deg=0, max_load_factor_g=2, course_tolerance_deg=2.5, max_roll_acceleration_deg_s2=62
    )
    banks = np.array(bank) * DEG
    broken = limits.broken(banks, 1.0, headings(banks, 1.0, TASK))
    for text in told:
        assert any(line.startswith(text) for line in broken), broken
    assert told or not broken


def test_a_full_circle_counts_as_a_course_regained_if_asked():
    heading = np.linspace(0, 360, 21) * DEG
    check = partial(ManeuverLimits().broken, np.zeros(21), 1.0, heading)
    assert any("course at the end" in line for line in check())
    limits = ManeuverLimits(whole_turns=True, course_tolerance_deg=1, max_heading_excursion_deg=400)
    assert limits.broken(np.zeros(21), 1.0, heading) == []
    slow = AlignmentTask(velocity_sd_mps=0.03, speed_mps=120.0)
    limits = ManeuverLimits(
        whole_turns=True, course_tolerance_deg=1, max_heading_excursion_deg=400, max_bank_deg=70
    )
    long_turn = Problem(slow, limits, COARSE, 40).solve("turn", turns(np.arange(41.0), limits, ()))
    turned = (long_turn.profile.heading[-1] - long_turn.profile.heading[0]) / DEG
    assert turned == pytest.approx(360, abs=1.1)


def test_a_search_that_ends_outside_the_limits_is_no_result(monkeypatch):
    monkeypatch.setattr(ManeuverLimits, "broken", lambda *_: ["bank"])
    with pytest.raises(ManeuverError, match="no start led to a bank profile within the limits"):
        best_maneuver(TASK, LIMITS, COARSE.model_copy(update={"simple_starts": 1, "max_iterations": 1}))


def test_a_search_that_is_cut_short_says_so():
    short = ManeuverSearch(knot_s=1.0, simple_starts=1, random_starts=0, max_iterations=4)
    found = best_maneuver(TASK, LIMITS, short)
    assert found.outcome is SearchOutcome.ITERATION_LIMIT
    assert any(a.solver_status == "Maximum_Iterations_Exceeded" for a in found.attempts)


@pytest.fixture(scope="module")
def scenario(stated) -> Scenario:
    noise = {"velocity_sd_mps": 0.03, "rate_hz": None}
    quick = replaced(stated, {"flight.s_start_s": 145.0, "flight.fdm_rate_hz": 200, "runs": 40})
    return with_stated_fixes(quick, "stated_fixes", LIMITS, noise)


def test_the_profile_is_flown_and_aligned_on(flight_cache, scenario, best):
    flying = with_profile(scenario, best.profile)
    # The file that the command writes is this scenario.
    assert Scenario.model_validate(tomllib.loads(scenario_toml(flying))) == flying
    flight, _ = cached_flight(flying.flight)
    flown = align_on(flying, flight)
    window = flown.window
    bank_error = (window.bank - flown.asked_bank) / DEG
    assert np.sqrt(np.mean(bank_error**2)) < 1.0
    assert np.abs(bank_error).max() < 3.0
    # Knots at 1 s let the roll rate step by 30 deg/s, twice as much as those at 0.5 s.
    assert np.abs(window.bank).max() < (LIMITS.max_bank_deg + 0.5) * DEG
    assert np.abs(window.lla[:, 2] - 1015.0).max() < 10.0
    # Designed and flown: the grid, the lag of the bank and 1 % of speed.
    assert task_of(flying) == TASK
    designed = best.profile
    level = np.sqrt(np.mean(flown.bound_sd[:, :2] ** 2, axis=1))
    for k in (10, 20, 30, 40):
        row = np.searchsorted(flown.bound.time - window.time[0], k - 0.01)
        assert level[row] == pytest.approx(designed.level_arcsec[k], rel=0.06)
        assert flown.bound_sd[row, 2] == pytest.approx(designed.heading_arcmin[k], rel=0.06)
    # An RMS over 40 runs spreads by 1 / sqrt(80): three of these, in level of two axes less.
    rms = flown.scores["ekf_stamped"].rms[-1]
    assert np.sqrt(np.mean(rms[:2] ** 2)) == pytest.approx(level[-1], rel=0.34)
    assert rms[2] == pytest.approx(flown.bound_sd[-1, 2], rel=0.34)


def test_a_scenario_on_a_network_gets_stated_fixes(gao2009):
    stated = with_stated_fixes(gao2009, "gao2009", ManeuverLimits(duration_s=20), {"rate_hz": 5.0})
    task = task_of(stated)
    assert (task.rate_hz, task.position_sd_m, task.velocity_sd_mps) == (5.0, 10.0, 0.03)
    assert stated.alignment.duration_s == stated.flight.s_maneuver.duration_s == 20
    assert stated.alignment.settings.delay_sd_ms == pytest.approx(50 / np.sqrt(12), abs=0.01)
    with pytest.raises(TypeError, match="the noise is not stated"):
        task_of(gao2009)


def test_the_task_is_that_of_the_filters():
    task = AlignmentTask(settings=FilterSettings(heading_sd_deg=3), velocity_sd_mps=0.04)
    assert np.sqrt(task.initial_variance[[2, 6, 8]]) == pytest.approx([10, 1 * DEG, 3 * DEG])
    assert task.initial_variance[3] == pytest.approx(0.04**2 + 0.01**2)
    assert Profile(np.zeros(9), 1.0, task).heading_arcmin[0] == pytest.approx(3 * DEG / ARCMIN)
    assert Profile(np.zeros(9), 1.0, task).level_arcsec[0] == pytest.approx(DEG / ARCSEC)


def test_the_bundled_scenario_flies_a_best_manoeuvre():
    _, scenario = load_scenario("best_maneuver")
    profile = scenario.flight.s_maneuver
    assert isinstance(profile, BankProfile)
    bank, dt = np.array(profile.banks_deg) * DEG, profile.times_s[1]
    limits = ManeuverLimits()
    task = task_of(scenario)
    # To the rounding of the file.
    assert limits.broken(bank, dt, headings(bank, dt, task), slack=0.003) == []
    assert Profile(bank, dt, task).level_arcsec[-1] < 8.0
    assert Profile(bank, dt, task).heading_arcmin[-1] < 0.2


SHORT = """
title = "A short manoeuvre"
runs = 2
[flight]
s_start_s = 145
fdm_rate_hz = 200
[fixes]
kind = "simulated"
velocity_sd_mps = 0.03
[alignment]
filters = ["ekf_stamped"]
"""


def test_the_command_writes_its_files(command, flight_cache, tmp_path, monkeypatch):
    monkeypatch.setattr(study, "grid_of", partial(grid_of, steps=(2, 2, 2)))
    scenario = tmp_path / "short.toml"
    scenario.write_text(SHORT, "utf-8")
    options = ("--duration-s", 15, "--random-starts", 0, "--max-iterations", 5, "--json")
    status, out, err = command("maneuver", scenario, *options, "--out", tmp_path / "out")
    assert (status, err) == (0, "")
    folder = tmp_path / "out"
    assert {path.name for path in folder.iterdir()} == {
        f"maneuver.{end}" for end in ("html", "json", "rrd", "toml")
    }
    summary = json.loads(out)
    assert summary == json.loads((folder / "maneuver.json").read_text())
    assert (
        summary["flown"]["best"]["bound"]["heading_arcmin"] < summary["flown"]["s"]["bound"]["heading_arcmin"]
    )
    page = (folder / "maneuver.html").read_text("utf-8")
    assert page.count("<svg") == 3
    assert f"{summary['profile']['level_arcsec'][-1]:.2f} arcsec" in page
    _, best = load_scenario(str(folder / "maneuver.toml"))
    assert best.flight.s_maneuver.duration_s == best.alignment.duration_s == 15


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--max-bank-deg", 90], "option: max_bank_deg = 90.0 deg: allowed is [5, 80] deg"),
        (["--duration-s", 41], "option: duration_s = 41.0 s: allowed is [5, 40] s"),
        (["--velocity-sd-mps", 0], "option: fixes.velocity_sd_mps = 0.0 m/s: allowed is [0.0001, 1000] m/s"),
        (["--heading-weight", -1], "option: heading_weight = -1.0: allowed is [0, 10000]"),
        (["no-such-scenario"], "no-such-scenario: neither a bundled scenario"),
        (["--max-load-factor", "much"], "--max-load-factor = 'much': must be a number"),
    ],
)
def test_bad_input_is_told_in_one_line(command, tmp_path, arguments, told):
    status, out, err = command("maneuver", *arguments, "--out", tmp_path)
    assert (status, out) == (2, "")
    assert told in err
    assert len(err.strip().splitlines()) == 1


def test_recorded_fixes_have_no_stated_noise(gao2009):
    class Recorded:
        kind = "replay"

    recorded = gao2009.model_copy(update={"fixes": Recorded()})
    with pytest.raises(ScenarioError, match="the noise of recorded fixes is not stated"):
        with_stated_fixes(recorded, "mine", LIMITS, {})
