"""Outages of the fixes in a scenario, whatever their source, and what is put out in them."""

from types import SimpleNamespace

import numpy as np
import pytest
from fleetalign.cosim.outages import outage_rows, told_outages
from fleetalign.cosim.run import fixes_of, simulate, without
from fleetalign.cosim.scenario import ScenarioError, load_scenario, replaced
from fleetalign.cosim.score import Scorer
from fleetalign.network.fixes import write_fixes

OUTAGES = [{"start_s": 5.0, "duration_s": 2.0}, {"start_s": 20.0, "duration_s": 8.0}]


def inside(t):
    return ((t >= 5) & (t < 7)) | ((t >= 20) & (t < 28))


@pytest.mark.parametrize("kind", ["simulated", "network", "replay"])
def test_no_fix_is_valid_in_them_and_the_others_stay(kind, stated, gao2009, flight, window, tmp_path):
    scenario = gao2009 if kind == "network" else stated
    if kind == "replay":
        file = tmp_path / "fixes.csv"
        write_fixes(fixes_of(stated, flight, 0, 3)[0], file)
        scenario = replaced(stated, {"fixes": {"kind": "replay", "file": str(file)}})
    if kind == "network":
        scenario = replaced(scenario, {"alignment.duration_s": 30.0})
    every, _ = fixes_of(scenario, flight, 1, 3)
    left, _ = fixes_of(replaced(scenario, {"outages": OUTAGES}), flight, 1, 3)
    out = inside(every.t_valid - window.time[0])
    assert out.sum() > 20
    np.testing.assert_array_equal(left.lla, every.lla[~out])
    np.testing.assert_array_equal(left.t_arrival, every.t_arrival[~out])


def test_an_outage_holds_its_begin_and_not_its_end(stated, flight):
    fixes, _ = fixes_of(stated, flight, 0, 1)
    t = np.sort(fixes.t_valid)
    left = without(fixes, [(t[10], t[20])])
    assert t[10] not in left.t_valid
    assert {t[9], t[20]} <= set(left.t_valid)
    assert without(fixes, [(t[0] - 2, t[0] - 1)]) is fixes


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"outages": [{"start_s": -1.0, "duration_s": 2.0}]}, "outages.0.start_s = -1"),
        ({"outages": [{"start_s": 1.0, "duration_s": 0.0}]}, "outages.0.duration_s = 0"),
        (
            {"outages": [{"start_s": 35.0, "duration_s": 6.0}]},
            r"outages\[0\] from 35 s for 6 s: must end with the alignment, at 40 s",
        ),
        (
            {"outages": [{"start_s": 5.0, "duration_s": 3.0}, {"start_s": 7.0, "duration_s": 1.0}]},
            r"outages\[1\] from 7 s for 1 s: must not begin before the end of the one before it, 8 s",
        ),
        (
            {"outages": [{"start_s": 2.0, "duration_s": 1.0}], "alignment.bridging": "mlp"},
            r"outages\[0\] from 2 s for 1 s: bridging = 'mlp' learns from 4 s or more before it",
        ),
        ({"alignment.bridging": "svm"}, "alignment.bridging = 'svm'"),
    ],
)
def test_mistakes_are_told_in_a_line(stated, changes, told):
    with pytest.raises(ScenarioError, match=told) as error:
        replaced(stated, changes)
    assert "\n" not in str(error.value)


def test_what_knows_the_whole_record_has_nothing_to_bridge(stated, flight):
    changes = {"outages": OUTAGES, "alignment.filters": ["smoother"]}
    coast, bridge = (
        simulate(replaced(stated, {**changes, "alignment.bridging": name}), flight, 0, 1).estimates[
            "smoother"
        ]
        for name in ("coast", "lssvm")
    )
    np.testing.assert_array_equal(coast.lla, bridge.lla)
    np.testing.assert_array_equal(coast.sd, bridge.sd)


RUNS = 20


@pytest.fixture(scope="module")
def bridges(stated, flight, window):
    """Rows of ekf_stamped over the second outage by bridging, and one run of each."""
    changes = {"outages": OUTAGES, "alignment.filters": ["ekf_stamped"]}
    found = {}
    for name in ("coast", "lssvm"):
        scenario = replaced(stated, {**changes, "alignment.bridging": name})
        scorer = Scorer(window, scenario.alignment.filters)
        runs = [simulate(scenario, flight, i, 1) for i in range(RUNS)]
        for run in runs:
            scorer.add(run)
        found[name] = outage_rows(scenario, scorer.scores()["ekf_stamped"]), runs[0]
    return found


def test_bridges_hold_to_outages(bridges, window):
    one, other = (bridges[name][1].estimates["ekf_stamped"] for name in ("coast", "lssvm"))
    differs = (one.lla != other.lla).any(axis=1)
    t = one.time - window.time[0]
    assert differs[inside(t) & (t > 5.05) & ~np.isclose(t, 20)].all()
    assert not differs[~inside(t)].any()
    np.testing.assert_array_equal(one.q_nb, other.q_nb)


def test_coasting_is_consistent_and_no_worse_than_a_learnt_bridge(bridges):
    """The NEES of position within four of its standard deviations over the runs, sqrt(6 / runs); the learnt
    bridge errs more, and knows it: no more than twice the NEES."""
    coast, bridge = bridges["coast"][0][1], bridges["lssvm"][0][1]
    assert coast["start_s"] == 20.0
    assert abs(coast["position_nees"][0] - 3) < 4 * np.sqrt(6 / RUNS)
    assert bridge["position_nees"][0] < 6
    assert coast["velocity_mps"][0] < bridge["velocity_mps"][0]
    assert coast["position_m"][1:] == [None, None]  # too few runs for an interval


def test_rows_are_of_the_last_epoch_of_an_outage(stated):
    """An error that grows by 1 m in each of 0.1 s: at 6.9 s, the last in [5, 7), it is 69 m in each axis."""
    time = np.arange(1, 401) / 10
    errors = 10 * np.tile(time[:, None], (2, 1, 5))
    score = SimpleNamespace(
        time=time, errors=errors, position_errors=errors[..., :3], position_nees=errors[..., 0]
    )
    row = outage_rows(replaced(stated, {"outages": OUTAGES}), score)[0]
    assert row["position_m"][0] == pytest.approx(69 * np.sqrt(3))
    assert row["velocity_mps"][0] == pytest.approx(69 * np.sqrt(2))
    assert row["position_nees"][0] == pytest.approx(69)


def test_lines_tell_each_filter_and_variant():
    row = {"start_s": 5.0, "duration_s": 2.0, "position_m": [1.0, None, None]}
    row |= {"velocity_mps": [0.1, 0.09, 0.11], "position_nees": [None, None, None]}
    block = {"filters": {"ekf": {"outages": [row]}, "l2linf": {}}}
    lines = told_outages({**block, "variants": {"mlp": block}})
    assert (
        lines[0] == "ekf, end of outage 5 to 7 s: 1.0 m, 0.100 (0.090 to 0.110) m/s, NEES of position - of 3"
    )
    assert lines[1].startswith("mlp: ekf, end")
    assert len(lines) == 2


def test_the_bundled_scenario_has_outages_and_bridges():
    _, scenario = load_scenario("outage")
    assert len(scenario.outages) == 2
    assert {scenario.variant(name).alignment.bridging for name in scenario.variants} == {"lssvm", "mlp"}
