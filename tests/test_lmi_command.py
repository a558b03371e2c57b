"""The command `lmi`: what it prints, and how it refuses."""

import json
from functools import partial

import numpy as np
import pytest
from fleetalign.align.lmi.analysis import ClosedLoop, peak_gain
from fleetalign.align.lmi.design import Kind
from fleetalign.align.lmi.plant import Filter
from fleetalign.cosim import lmi_command
from fleetalign.cosim.plants import load_plant, plant_names

MATRICES = """
A = [[0.9, 0.2], [0.0, 0.7]]
B = [[0.3, 0.0, 0.0], [0.5, 0.1, 0.0]]
C = [[1.0, 0.0]]
D = [[0.0, 0.0, 0.5]]
H = [[1.0, 0.0]]
"""


@pytest.fixture
def command(command):
    """Runs `fleetalign lmi`."""
    return partial(command, "lmi")


def test_prints_the_design_of_the_bundled_plant(command):
    status, out, err = command()
    assert (status, err) == (0, "")
    assert "l2linf filter of order 3" in out
    status, out, err = command("--kind", "hinf")
    assert (status, err) == (0, "")
    assert "hinf filter of order 3" in out
    assert "confirms gamma" in out
    for told in (*lmi_command.ROWS, "Af", "Bf", "Cf", "Df"):
        assert told in out
    status, out, err = command("--quiet")
    assert (status, out, err) == (0, "", "")


def test_json_is_the_design(command):
    status, out, _ = command("two_vertices", "--order", 2, "--json")
    assert status == 0
    told = json.loads(out)
    *_, vertices = load_plant("two_vertices")
    filter_ = Filter(**{name: np.array(matrix) for name, matrix in told["filter"].items()})
    assert (told["kind"], told["outcome"], filter_.order) == ("theorem2", "CONFIRMED", 2)
    gains = [peak_gain(ClosedLoop.of(plant, filter_), adapted=True) for plant in vertices]
    np.testing.assert_allclose([each["peak_adapted"] for each in told["analyses"]][:2], gains, rtol=1e-6)
    assert max(gains) <= told["gamma"]


def test_kinds_are_those_that_there_are():
    assert set(lmi_command.KINDS) == {kind.value for kind in Kind}


def test_help_names_the_bundled_plants(command):
    status, out, _ = command("--help")
    assert status == 0
    assert all(name in out for name in plant_names())


def test_every_bundled_plant_is_good():
    assert "two_state" in plant_names()
    for name in plant_names():
        title, kind, vertices = load_plant(name)
        assert title
        assert kind == "feedback" or all(plant.spectral_radius < 1 for plant in vertices)
        assert all(plant.hidden_mode() is None for plant in vertices)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("A = [", "not TOML"),
        ("A = [[0.9]]", "B: missing"),
        (MATRICES + "rho = 2.0", "rho = 2.0: allowed is (0, 1]"),
        (MATRICES + "rhoo = 1", "rhoo: unknown field; known are A, B, C, D, H, kind, rho, title, vertex"),
        (MATRICES + "kind = 'h3'", "kind = 'h3': allowed are l2linf, feedback"),
        (MATRICES + "title = 3", "title = 3: must be text"),
        (MATRICES.replace("[[0.9, 0.2], ", "["), "A is 1 by 2: must be 1 by 1, where A has 1 rows"),
        (f"[[vertex]]\n{MATRICES}[[vertex]]\nA = [[0.9]]", "vertex 2: B: missing"),
        (f"{MATRICES}[[vertex]]\n{MATRICES}", "A: unknown field; known are kind, rho, title, vertex"),
        ("vertex = []", "a polytope has at least one vertex"),
        ("vertex = 1", "vertex: must be tables"),
        (MATRICES.replace("0.7]]", "1.0]]"), "UNSTABLE: the plant is not Schur stable: spectral radius"),
        (MATRICES.replace("0.2], [0.0, 0.7]", "0.0], [0.0, 1.0]"), "UNDETECTABLE: "),
    ],
)
def test_mistakes_are_told_in_one_line(command, tmp_path, text, told):
    path = tmp_path / "mine.toml"
    path.write_text(text, "utf-8")
    status, out, err = command(path)
    assert (status, out) == (2, "")
    assert err.startswith(f"fleetalign: {path}: {told}")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (
            ["nowhere"],
            f"nowhere: neither a bundled plant ({', '.join(plant_names())}) nor a .toml file",
        ),
        (["nowhere.toml"], "nowhere.toml: cannot be read"),
        (["--kind", "best"], "--kind best: allowed are l2linf, hinf, h2, theorem2, feedback"),
        (["--order", "9"], "two_state: order = 9: allowed is [1, 3]"),
        (["--kind", "h2", "--order", "2"], "two_state: kind = h2: one vertex and full order"),
        (["two_vertices", "--kind", "hinf"], "two_vertices: kind = hinf: one vertex and full order"),
    ],
)
def test_wrong_options_are_told_in_one_line(command, arguments, told):
    status, out, err = command(*arguments)
    assert (status, out) == (2, "")
    assert err.startswith(f"fleetalign: {told}")
    assert err.count("\n") == 1
