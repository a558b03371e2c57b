"""The documentation holds: links, names, commands, examples, claims, and the order of the rooms."""

import ast
import importlib
import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from fleetalign.aircraft.airframe import airframe_names
from fleetalign.align.filters import FILTERS
from fleetalign.cosim import cli, outputs, score
from fleetalign.cosim.bound import bounds_of
from fleetalign.cosim.mistakes import UNITS
from fleetalign.cosim.network_score import NetworkScorer
from fleetalign.cosim.run import simulate
from fleetalign.cosim.scenario import load_scenario, replaced
from fleetalign.cosim.variants import run_variants
from fleetalign.sins import attitude, earth, error_model
from fleetalign.sins.error_model import ACCEL, GYRO, MISALIGN
from typer.main import get_command

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
README = (ROOT / "README.md").read_text("utf-8")
ROOMS = ("sins", "aircraft", "network", "align", "cosim", "scenarios")
MAY_IMPORT = {
    "sins": set(),
    "aircraft": {"sins"},
    "network": {"sins"},
    "align": {"sins", "network.fixes"},
    "cosim": {"sins", "aircraft", "network", "align"},
    "scenarios": set(),
}
"""What each room may import besides itself: a room, or one module of it."""


def modules(room):
    return sorted((ROOT / room).rglob("*.py"))


def blocks(text, language):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def prose(text):
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(text):
    """Anchors of the headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", prose(text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_resolve(page):
    text = page.read_text("utf-8")
    for target in re.findall(r"\]\(([^)]+)\)", prose(text)):
        if target.startswith(("http://", "https://")):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{page.name}: {target}"
        if anchor:
            assert anchor in anchors(file.read_text("utf-8")), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_modules_and_names_that_pages_mention_exist(page):
    """``align.bound`` is a module, ``cosim.run.generator`` a name in one."""
    text = prose(page.read_text("utf-8"))
    for dotted in re.findall(rf"`((?:{'|'.join(ROOMS)})\.[\w.]+)`", text):
        room, *names = dotted.split(".")
        found, path = importlib.import_module(f"fleetalign.{room}"), ROOT / room
        for name in names:
            path = path / name
            if path.is_dir() or path.with_suffix(".py").exists():
                found = importlib.import_module(f"{found.__name__}.{name}")
            else:
                assert hasattr(found, name), f"{page.name}: {dotted}"
                found = getattr(found, name)


def test_setup_and_use_stand_in_the_readme_as_they_are_run():
    shell = [block.strip() for block in blocks(README, "sh")]
    script = (ROOT / ".ci" / "run").read_text("utf-8")
    assert shell == [
        "python -m pip install . && fleetalign run",
        'python -m pip install ".[test]" && python -m pytest -n auto',
    ]
    assert 'python -m pip install --quiet ".[test]" && python -m pytest -n auto' in script
    assert re.search(r"python -m pip install --quiet \. && .*fleetalign run", script)


def test_commands_and_options_are_those_of_the_program():
    commands = get_command(cli.app).commands
    told = set(re.findall(r"^\| `fleetalign (\w+)", README, re.MULTILINE))
    assert told == set(commands)
    options = {}
    for first, where in re.findall(r"^\| (`--.*?) \| (.*?) \|", README, re.MULTILINE):
        for option in re.findall(r"`(--[\w-]+)", first):
            options[option] = set(re.findall(r"`(\w+)`", where))
    actual = {}
    for name, command in commands.items():
        for parameter in command.params:
            for option in parameter.opts:
                if option.startswith("--"):
                    actual.setdefault(option, set()).add(name)
    assert options == actual


def test_example_scenario_is_good(tmp_path):
    (example,) = blocks(README, "toml")
    path = tmp_path / "mine.toml"
    path.write_text(example, "utf-8")
    assert load_scenario(str(path))[1].flight.airframe in airframe_names()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_examples_run(page, flight_cache, capsys):
    for example in blocks(page.read_text("utf-8"), "python"):
        exec(compile(example.replace("RUNS = 100", "RUNS = 1"), page.name, "exec"), {})
        printed = capsys.readouterr().out
        assert all(name in printed for name in FILTERS)


def test_summary_has_the_keys_that_the_readme_names(gao2009, flight, window):
    variants = {"other": {"fixes.fleet.nodes": 30}, "false": {"faults.packets.outlier_share": 0.1}}
    scenario = replaced(gao2009, {"runs": 1, "variants": variants})
    scorer, network = score.Scorer(window, scenario.alignment.filters), NetworkScorer()
    run = simulate(scenario, flight, 0, seed=7)
    scorer.add(run)
    network.add(run.network)
    bounds = {
        name: score.standard_deviations(window, bound, scenario.imu.vibration_mps)
        for name, bound in bounds_of(scenario, window, [run.fixes]).items()
    }
    summary = outputs.summarize("x", scenario, 7, flight, scorer.scores(), bounds, network.score())
    summary |= run_variants(scenario, flight, scorer.scores())
    told = set(re.findall(r"`(\w+)`", README.split("`summary.json` has")[1].split("\n## ")[0]))
    one = next(iter(summary["filters"].values()))
    keys = {*summary} - {"bound", "paper"} | set(summary["flight"]) | set(one) | {"ci95"}
    broken = set(summary["faults"]["false"]["filters"]["ekf"]) & {"over_clean"}
    assert told == keys | set(summary["network"]) | broken
    assert set(summary["variants"]["other"]) == {"filters", "network", "paired"}
    assert set(summary["bound"]) == {"stamped", "delay_unknown", "smoothed"}
    assert set(summary["paper"]) == {"ekf", "l2linf"}
    json.dumps(summary, allow_nan=False)


def test_every_ending_of_a_unit_is_explained():
    text = (ROOT / "docs" / "conventions.md").read_text("utf-8")
    for ending in UNITS:
        assert f"`{ending}`" in text, ending


def test_every_dependency_has_its_sentence():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    text = (ROOT / "docs" / "dependencies.md").read_text("utf-8")
    told = dict(re.findall(r"^\| (\S+) \| (.+) \|$", text, re.MULTILINE))
    for dependency in project["dependencies"]:
        assert re.split(r"[<>=\[]", dependency)[0] in told, dependency
    for extra, packages in project["optional-dependencies"].items():
        assert f"`{extra}`" in told
        for package in packages:
            name = re.split(r"[<>=\[]", package)[0]
            assert name == "fleetalign" or name in told[f"`{extra}`"], package


@pytest.mark.parametrize("room", ROOMS)
def test_imports_point_down_and_are_relative(room):
    for path in modules(room):
        place = path.relative_to(ROOT).parts[:-1]
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                absolute = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                absolute = [node.module or ""]
            else:
                absolute = []
            for name in absolute:
                assert name.split(".")[0] not in (*ROOMS, "fleetalign"), f"{path}: import {name}"
            if not isinstance(node, ast.ImportFrom) or node.level == 0:
                continue
            base = ("fleetalign", *place)[: 1 + len(place) - (node.level - 1)]
            for alias in node.names:
                parts = (*base, *(node.module.split(".") if node.module else ()), alias.name)
                target = parts[1:]
                assert base[:1] == ("fleetalign",), f"{path}: too many dots"
                allowed = target[0] == room or any(
                    target[: len(may.split("."))] == tuple(may.split(".")) for may in MAY_IMPORT[room]
                )
                assert allowed, f"{path}: {room} must not import {'.'.join(target)}"


def test_errors_of_a_frozen_point_are_invisible():
    """docs/derivations.md, 5.5: any misalignment hides behind biases while nothing changes."""
    C_nb = attitude.to_dcm(attitude.from_euler(0.5, 0.1, -0.7))
    lla, v_n = np.array([0.55, 2.1, 1015.0]), np.array([150.0, -130.0, 4.0])
    f_n = np.array([2.0, -5.0, -10.0])
    w_in = np.add(earth.earth_rate_n(lla[0]), earth.transport_rate_n(lla[0], lla[2], v_n[0], v_n[1]))
    F = error_model.system_matrix(lla, v_n, f_n, C_nb)
    for phi in np.eye(3):
        x = np.zeros(15)
        x[MISALIGN] = phi
        x[ACCEL] = -C_nb.T @ np.cross(f_n, phi)
        x[GYRO] = -C_nb.T @ np.cross(w_in, phi)
        np.testing.assert_allclose(F @ x, 0, atol=1e-13)


def test_kalman_filter_reaches_the_least_energy_to_peak_gain():
    """docs/derivations.md, 5.2, on a small system whose matrices change with time.

    The gain of a filter to its error at a step is the greatest singular value of the map from initial error
    and disturbances to that error; the map is built by filtering all unit disturbances at once.
    """
    rng = np.random.default_rng(11)
    n, m, width, steps = 4, 2, 5, 12
    A, C = 0.5 * rng.normal(size=(steps, n, n)), rng.normal(size=(steps, m, n))
    B, D = np.zeros((steps, n, width)), np.zeros((steps, m, width))
    B[..., :3], D[..., 3:] = rng.normal(size=(steps, n, 3)), rng.normal(size=(steps, m, 2))
    H, P0 = rng.normal(size=(2, n)), np.diag([1.0, 2.0, 0.5, 3.0])

    P, kalman, least = P0, [], []
    for k in range(steps):
        S = C[k] @ P @ C[k].T + D[k] @ D[k].T
        kalman.append(P @ C[k].T @ np.linalg.inv(S))
        P = P - kalman[k] @ S @ kalman[k].T
        least.append(np.linalg.eigvalsh(H @ P @ H.T)[-1])
        P = A[k] @ P @ A[k].T + B[k] @ B[k].T

    def squared_gain(gains, last):
        disturbances = np.eye(n + steps * width)
        error = np.sqrt(P0) @ disturbances[:n]
        for k in range(last + 1):
            w = disturbances[n + k * width : n + (k + 1) * width]
            filtered = error - gains[k] @ (C[k] @ error + D[k] @ w)
            error = A[k] @ filtered + B[k] @ w
        return np.linalg.norm(H @ filtered, 2) ** 2

    for last in range(steps):
        np.testing.assert_allclose(squared_gain(kalman, last), least[last], rtol=1e-9)
        for _ in range(3):
            other = [K + 0.05 * rng.normal(size=K.shape) for K in kalman]
            assert squared_gain(other, last) > least[last]
