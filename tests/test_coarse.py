"""Coarse alignment in motion: what it finds, when, and what a filter makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align.coarse import HEADING_SD, LEVEL_SD, align_in_motion
from fleetalign.align.estimate import RunOutcome
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.methods import estimate
from fleetalign.align.problem import pose
from fleetalign.align.settings import DelayModel, FilterSettings
from fleetalign.cosim.antenna import at_antenna
from fleetalign.cosim.run import coarse_attitude, fixes_of, generator, simulate
from fleetalign.cosim.scenario import CoarseAttitude, replaced
from fleetalign.cosim.score import errors_against
from fleetalign.sins import attitude
from fleetalign.sins.imu import simulate_imu
from fleetalign.sins.units import DEG

NOWHERE = np.array([1.0, 0.0, 0.0, 0.0])
"""An attitude that tells nothing: the coarse stage must not look at it."""
EXACT = {"fixes.position_sd_m": 1e-3, "fixes.velocity_sd_mps": 1e-4, "fixes.delay": {"kind": "none"}}
IN_MOTION = FilterSettings(coarse_stage="in_motion")


def drawn(scenario, flight, window, run_id, settings=IN_MOTION, **changes):
    """Record, fixes and budget of one run."""
    scenario = replaced(scenario, changes, "test")
    imu = simulate_imu(window.time, window.dtheta_b, window.dv_b, scenario.imu, generator(3, run_id, "imu"))
    fixes, _ = fixes_of(scenario, at_antenna(flight, settings.lever_arm_b_m), run_id, 3)
    return (imu.time, imu.dtheta_b, imu.dv_b, NOWHERE, fixes), (settings, scenario.imu, window.gravity)


def given(record, budget):
    return AlignmentInput.checked(*record, *budget)


@pytest.mark.parametrize("delay", [DelayModel.STAMPED, DelayModel.ESTIMATED])
def test_errors_are_those_that_it_states(stated, flight, window, delay):
    ratios = []
    for run_id in range(20):
        record, (settings, *budget) = drawn(stated, flight, window, run_id)
        found = align_in_motion(pose(given(record, (settings, *budget)), delay))
        assert 1.0 < found.time - window.time[0] < 5.0
        assert (found.sd[:2] < LEVEL_SD).all()
        assert found.sd[2] < HEADING_SD
        ratios.append(attitude.misalignment(found.q_nb, window.q_nb[0]) / found.sd)
    # The mean of 60 squares of unit variance, nearly independent: 1 +- 0.18; and what is neglected.
    assert 0.5 < np.mean(np.square(ratios)) < 1.6


def test_exact_data_give_the_exact_attitude(stated, flight, window):
    record, budget = drawn(stated, flight, window, 0, **EXACT)
    exact = (window.time, window.dtheta_b, window.dv_b, *record[3:])
    found = align_in_motion(pose(given(exact, budget), DelayModel.STAMPED))
    # Velocities of 1e-4 m/s against 10 m/s of gravity and some m/s of manoeuvre a second.
    assert np.abs(attitude.misalignment(found.q_nb, window.q_nb[0])).max() < 2e-3


def test_antenna_far_from_the_imu_is_allowed_for(stated, flight, window):
    arm = FilterSettings(coarse_stage="in_motion", lever_arm_b_m=(20.0, 0.0, -5.0))
    record, budget = drawn(stated, flight, window, 0, settings=arm, **EXACT)
    told = align_in_motion(pose(given(record, budget), DelayModel.STAMPED))
    blind = align_in_motion(pose(given(record, (IN_MOTION, *budget[1:])), DelayModel.STAMPED))
    errors = [np.abs(attitude.misalignment(found.q_nb, window.q_nb[0])).max() for found in (told, blind)]
    assert errors[0] < 0.02 < errors[1]


def test_straight_flight_tells_no_heading(stated, flight):
    level = flight.window(400.0, 440.0)
    scenario = replaced(stated, {"alignment.start": 400.0}, "test")
    record, budget = drawn(scenario, flight, level, 0)
    result = estimate("ekf_stamped", given(record, budget))
    assert result.outcome is RunOutcome.NO_COARSE
    assert np.isnan(result.q_nb).all()
    assert len(result.fix_outcome) == len(record[4])


def test_duplicates_and_broken_fixes_are_left_out(stated, flight, window):
    record, budget = drawn(stated, flight, window, 0)
    fixes = record[4]
    v_n = fixes.v_n.copy()
    v_n[5] = np.nan
    noisy = replace(fixes, v_n=v_n)
    twice = noisy[np.repeat(np.arange(len(fixes)), 2)]
    once, again = (
        align_in_motion(pose(given((*record[:4], f), budget), DelayModel.STAMPED)) for f in (noisy, twice)
    )
    np.testing.assert_allclose(once.q_nb, again.q_nb, atol=1e-12)
    assert np.isfinite(once.q_nb).all()


def test_any_heading_ends_where_a_small_misalignment_does(stated, flight, window):
    """The filter from a heading of its own finding, run by run beside the one that was told it to 10 deg."""
    unknown = {
        "alignment.coarse": {"unknown_heading": True, "roll_error_deg": 5.0, "pitch_error_deg": 5.0},
        "alignment.settings.coarse_stage": "in_motion",
        "alignment.filters": ["ekf_stamped", "l2linf"],
    }
    told = replaced(stated, {"alignment.filters": ["ekf_stamped", "l2linf"]}, "test")
    for run_id in range(5):
        small, any_heading = (
            simulate(s, flight, run_id, 2) for s in (told, replaced(stated, unknown, "test"))
        )
        assert (any_heading.imu.dv_b == small.imu.dv_b).all()
        for name in told.alignment.filters:
            assert np.isnan(any_heading.estimates[name].q_nb[:20]).all()
            ends = [errors_against(window, run.estimates[name])[-1] for run in (small, any_heading)]
            # Where it linearised is another place: a part of the 20 arcsec and 1.3 arcmin of noise.
            assert (np.abs(ends[1] - ends[0]) < [8.0, 8.0, 0.3, 0.004, 0.004]).all()


def test_heading_is_drawn_from_the_whole_circle(window):
    coarse = CoarseAttitude(unknown_heading=True, roll_error_deg=5.0, pitch_error_deg=3.0)
    drawn = [coarse_attitude(window.q_nb[0], coarse, generator(1, i, "coarse attitude")) for i in range(400)]
    errors = attitude.to_euler(np.array(drawn)) - attitude.to_euler(window.q_nb[0])
    for i, limit in ((0, 5.0), (1, 3.0)):
        assert 0.95 * limit < np.abs(errors[:, i]).max() / DEG < limit + 1e-9
    counts, _ = np.histogram(attitude.wrapped(errors[:, 2]), 8, (-np.pi, np.pi))
    # 50 +- 7 in each eighth.
    assert counts.min() > 22
