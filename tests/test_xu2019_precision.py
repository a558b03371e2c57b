"""How both forms of the cubature filter are compared in single precision, on states that are made up."""

import numpy as np
import pytest
from fleetalign.cosim.papers import xu2019_precision
from fleetalign.cosim.papers.xu2019_precision import Case
from fleetalign.cosim.papers.xu2019_settings import MovingAnchor
from fleetalign.network.localization.cubature import Filter, State

SETTINGS = MovingAnchor(kind="moving_anchor", nodes=2)
DRAWS, SD = 30, 0.1
NODES = 2 * DRAWS


def state(off_sd, lost=None):
    """Of all nodes, so many standard deviations of 10 cm north of where they are."""
    off_sd = np.broadcast_to(np.asarray(off_sd, float), NODES)
    x = np.column_stack([SD * off_sd, np.zeros(NODES)])
    lost = np.zeros(NODES, bool) if lost is None else lost
    return State(x, np.tile(SD**2 * np.eye(2), (NODES, 1, 1)), np.zeros(NODES), np.ones(NODES), lost)


@pytest.fixture
def compared(monkeypatch):
    def call(reference, single):
        states = {np.float32: single, np.float64: reference}
        monkeypatch.setattr(xu2019_precision, "_last", lambda kind, case, dtype: states[dtype])
        wide = np.tile(np.diag([100.0, 1.0]), (NODES, 1, 1))
        bound = np.tile(SD**2 / 2 * np.eye(2), (NODES, 1, 1))
        case = Case("", np.zeros((NODES, 2)), np.zeros((NODES, 2)), wide, None, None, bound)
        found = xu2019_precision._compared(SETTINGS, case, Filter.CUBATURE, reference)
        return {key: value.value for key, value in found.items()}

    return call


def test_a_node_is_off_from_half_a_deviation_of_the_reference(compared):
    found = compared(state(0.0), state(np.repeat([0.49, 0.51], [45, 15])))
    assert found["off_single_percent"] == pytest.approx(25.0)
    assert found["lost_single_percent"] == found["lost_double_percent"] == 0.0
    # The reference itself is 1 sd out: single precision that is where it is, is not off.
    assert compared(state(1.0), state(1.0))["off_single_percent"] == 0.0


def test_lost_nodes_are_off_and_count_in_errors_and_not_in_the_nees(compared):
    lost = np.arange(NODES) % 2 == 0
    found = compared(state(0.0), state(np.where(lost, 30.0, 0.2), lost))
    assert found["off_single_percent"] == found["lost_single_percent"] == pytest.approx(50.0)
    assert found["lost_double_percent"] == 0.0
    assert found["nees_single"] == pytest.approx(0.04)
    # Squares of 900 and 0.04 by halves, over a bound of a variance of 1 in two directions together.
    assert found["over_bound_single"] == pytest.approx(np.sqrt((900 + 0.04) / 2), rel=1e-6)
    assert np.isnan(compared(state(0.0), state(30.0, np.ones(NODES, bool)))["nees_single"])
    # Lost where the reference stands: off all the same.
    assert compared(state(0.0), state(0.0, lost))["off_single_percent"] == pytest.approx(50.0)


def test_figures_in_double_precision_are_of_their_own_states(compared):
    found = compared(state(1.5), state(0.5))
    assert found["nees_double"] == pytest.approx(2.25)
    assert found["nees_single"] == pytest.approx(0.25)
    assert found["over_bound_double"] == pytest.approx(1.5)
    # 100 m^2 at the start, 0.01 m^2 at the end.
    assert found["condition_log10"] == pytest.approx(4.0)


def test_rows_are_both_forms_of_each_case(monkeypatch):
    def named(settings, draws, random):
        assert len(draws) == 40
        yield from (Case(told, *[None] * 6) for told in ("one", "two"))

    monkeypatch.setattr(xu2019_precision, "_cases", named)
    seen = []
    monkeypatch.setattr(xu2019_precision, "_last", lambda *of: of)
    monkeypatch.setattr(xu2019_precision, "_compared", lambda *of: seen.append(of[1:]) or {})
    rows = xu2019_precision.arithmetic(SETTINGS, 55, lambda draw, name: None).rows
    assert [row.method for row in rows] == ["CKF, one", "SR-CKF, one", "CKF, two", "SR-CKF, two"]
    for case, kind, reference in seen:
        assert reference == (Filter.CUBATURE, case, np.float64)
        assert kind in (Filter.CUBATURE, Filter.SQUARE_ROOT)
    assert [kind for _, kind, _ in seen] == [Filter.CUBATURE, Filter.SQUARE_ROOT] * 2
