"""Many runs of a scenario: one flight; each run has its own sensor errors and fixes, seen by all filters."""

import os
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from ..aircraft.flight import Flight
from ..align.bridging.outage import bridged
from ..align.estimate import Array, Estimate
from ..align.inputs import AlignmentInput
from ..align.methods import METHODS, estimates
from ..align.settings import FilterSettings
from ..network import packet_faults
from ..network.fixes import Fixes
from ..network.fleet import CentrePath
from ..network.fleet_network import FleetNetwork, fly_network
from ..network.record import NetworkRecord
from ..network.source import draw_fixes
from ..sins import attitude, imu_faults
from ..sins.earth import GravityModel
from ..sins.imu import Imu, ImuErrors, simulate_imu
from ..sins.units import DEG
from .antenna import at_antenna
from .scenario import CoarseAttitude, Scenario, ScenarioError

Progress = Callable[[float, float], None]


@dataclass(frozen=True)
class Run:
    """One run: what its filters were given, and what they made of it."""

    run_id: int
    imu: Imu
    fixes: Fixes
    q_nb_coarse: Array
    estimates: dict[str, Estimate]
    network: NetworkRecord | None = None
    outlier: NDArray[np.bool_] | None = None
    """(k,) which of the fixes were made false (`packet_faults`): for the scores."""


def generator(seed: int, run_id: int, source: str) -> np.random.Generator:
    """The random numbers of one source in one run: they depend on these three alone."""
    return np.random.default_rng(seed_of(seed, run_id, source))


def seed_of(seed: int, run_id: int, source: str) -> np.random.SeedSequence:
    """What `generator` begins with."""
    return np.random.SeedSequence(seed, spawn_key=(run_id, zlib.crc32(source.encode())))


def alignment_window(scenario: Scenario, flight: Flight) -> Flight:
    """The part of the flight in which to align. Raises `ScenarioError` if the flight does not hold it."""
    alignment = scenario.alignment
    try:
        start = alignment.start
        start_s = flight.phase(start).start_s if isinstance(start, str) else start
    except KeyError as error:
        raise ScenarioError(f"alignment.start: {error.args[0]}") from error
    end_s = start_s + alignment.duration_s
    if start_s < flight.time[0] or end_s > flight.time[-1] + 0.5 * flight.dt:
        raise ScenarioError(
            f"alignment: {start_s:.2f} to {end_s:.2f} s is not inside the flight,"
            f" {flight.time[0]:.2f} to {flight.time[-1]:.2f} s"
        )
    return flight.window(start_s, end_s)


def simulate(scenario: Scenario, flight: Flight, run_id: int, seed: int) -> Run:
    """One run over the alignment window of a flight."""
    return aligned([measured(scenario, flight, run_id, seed)], scenario, flight)[0]


def measured(scenario: Scenario, flight: Flight, run_id: int, seed: int) -> tuple[Run, AlignmentInput]:
    """One run before its filters: no estimates yet, and what they are to be made from."""
    window = alignment_window(scenario, flight)
    imu = simulate_imu(window.time, window.dtheta_b, window.dv_b, scenario.imu, seed_of(seed, run_id, "imu"))
    imu = imu_faults.faulty(imu, scenario.faults.imu)
    fixes, network = fixes_of(scenario, flight, run_id, seed)
    rng = generator(seed, run_id, "coarse attitude")
    q_nb_coarse = coarse_attitude(window.q_nb[0], scenario.alignment.coarse, rng)
    outlier = None
    if scenario.faults.packets.at_work:
        rng = generator(seed, run_id, "packet faults")
        outlier = packet_faults.outliers(fixes, scenario.faults.packets, rng)
    record = imu.time, imu.dtheta_b, imu.dv_b, q_nb_coarse, fixes
    gravity = scenario.alignment.gravity_model(window.gravity)
    span_s = float(window.time[0]), float(window.time[-1])
    given = AlignmentInput.checked(*record, scenario.alignment.settings, scenario.imu, gravity, span_s)
    return Run(run_id, imu, fixes, q_nb_coarse, {}, network, outlier), given


def aligned(runs: Sequence[tuple[Run, AlignmentInput]], scenario: Scenario, flight: Flight) -> list[Run]:
    """Runs, as `measured` has them, with the estimates of the scenario's filters."""
    outages = outage_times(scenario, alignment_window(scenario, flight))
    given, bridging = [one for _, one in runs], scenario.alignment.bridging
    found = {name: estimates(name, given) for name in scenario.alignment.filters}
    for name in found:
        if METHODS[name].in_flight:  # what knows the whole record has nothing to bridge
            found[name] = [
                bridged(one, of_one.record, of_one.gravity, outages, bridging)
                for one, of_one in zip(found[name], given, strict=True)
            ]
    return [
        replace(run, estimates={name: of_runs[i] for name, of_runs in found.items()})
        for i, (run, _) in enumerate(runs)
    ]


def fixes_of(
    scenario: Scenario, flight: Flight, run_id: int, seed: int
) -> tuple[Fixes, NetworkRecord | None]:
    """The fixes of one run, which are of its antenna, and the record of the network where they come from
    one."""
    flight = at_antenna(flight, true_lever_arm(scenario, run_id, seed))
    window = alignment_window(scenario, flight)
    start_s, end_s = window.time[0], window.time[-1]
    outages = outage_times(scenario, window)
    network = None
    if isinstance(scenario.fixes, FleetNetwork):
        path = CentrePath(flight, flight.time[0], flight.time[-1])
        made, network = fly_network(path, start_s, end_s, scenario.fixes, partial(generator, seed, run_id))
    else:
        made = draw_fixes(window, start_s, end_s, scenario.fixes, seed_of(seed, run_id, "fixes"))
    made, faults = without(made, outages), scenario.faults.packets
    if faults.at_work:
        rng = partial(generator, seed, run_id, "packet faults")
        sent, made = made, packet_faults.faulty(made, faults, rng())
        if network is not None:
            came_from = packet_faults.origins(sent, faults, rng())
            network = _arriving(network, sent.t_arrival[came_from], made.t_arrival)
    return made, network


def _arriving(network: NetworkRecord, sent: Array, arrival: Array) -> NetworkRecord:
    """The record, with the intruder's packets as they arrive after what befell all: at ``arrival`` (k,) s,
    where they would have come at ``sent`` (k,) s."""
    record = network.faults
    if record is None:
        return network
    forged, replayed = (arrival[np.isin(sent, t)] for t in (record.forged_arrival, record.replayed_arrival))
    return replace(network, faults=replace(record, forged_arrival=forged, replayed_arrival=replayed))


def outage_times(scenario: Scenario, window: Flight) -> tuple[tuple[float, float], ...]:
    """Begin and end of the outages, s of the simulation clock."""
    start_s = float(window.time[0])
    return tuple((start_s + outage.start_s, start_s + outage.end_s) for outage in scenario.outages)


def without(fixes: Fixes, outages: Sequence[tuple[float, float]]) -> Fixes:
    """Those fixes that are valid in no outage: before its begin, or at its end and after."""
    kept = np.ones(len(fixes), bool)
    for begin, end in outages:
        kept &= (fixes.t_valid < begin) | (fixes.t_valid >= end)
    return fixes if kept.all() else fixes[kept]


def true_lever_arm(scenario: Scenario, run_id: int, seed: int) -> Array:
    """The true lever arm of one run: the surveyed one and what the survey erred."""
    settings = scenario.alignment.settings
    arm = np.array(settings.lever_arm_b_m)
    if settings.lever_arm_sd_m > 0:
        arm += settings.lever_arm_sd_m * generator(seed, run_id, "lever arm").standard_normal(3)
    return arm


def coarse_attitude(q_nb: Array, coarse: CoarseAttitude, rng: np.random.Generator) -> Array:
    """The attitude (4,) that alignment starts from: the true one with the coarse errors."""
    if coarse.unknown_heading:
        tilts = rng.uniform(-1, 1, 2) * np.array([coarse.roll_error_deg, coarse.pitch_error_deg]) * DEG
        roll, pitch = attitude.to_euler(q_nb)[:2] + tilts
        return attitude.from_euler(roll, pitch, rng.uniform(-np.pi, np.pi))
    signs = rng.choice([-1.0, 1.0], 3) if coarse.signs == "random" else np.ones(3)
    errors = np.array([coarse.roll_error_deg, coarse.pitch_error_deg, coarse.heading_error_deg]) * DEG
    return attitude.from_euler(*(attitude.to_euler(q_nb) + signs * errors))


def simulate_all(
    scenario: Scenario,
    flight: Flight,
    runs: int,
    seed: int,
    progress: Progress | None = None,
    first: int = 0,
) -> Iterator[Run]:
    """So many runs from the ``first`` on, in order, worked on by all cores; what a run yields depends on its
    id alone."""
    workers = os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        ids = iter(range(first, first + runs))
        # A few runs in flight at a time, so that their records do not pile up.
        pending = [pool.submit(simulate, scenario, flight, i, seed) for i in islice(ids, 4 * workers)]
        done = 0
        while pending:
            yield pending.pop(0).result()
            done += 1
            for i in islice(ids, 1):
                pending.append(pool.submit(simulate, scenario, flight, i, seed))
            if progress:
                progress(done, runs)


@contextmanager
def compiling_ahead(scenario: Scenario) -> Iterator[None]:
    """Compile the loops that a scenario's runs take in a process of its own, while this one does something
    else.

    Compiled code is kept on disk, so that this process finds it there when the context ends.
    """
    called = f"{list(scenario.alignment.filters)}, {scenario.fixes.kind == 'network'}"
    program = f"from {__name__} import compile_loops; compile_loops({called})"
    nowhere = subprocess.DEVNULL
    process = subprocess.Popen([sys.executable, "-c", program], stdin=nowhere, stdout=nowhere, stderr=nowhere)
    try:
        yield
    except BaseException:
        process.terminate()
        raise
    finally:
        process.wait()


def compile_loops(filters: Sequence[str], network: bool) -> None:
    """Call these filters once, on a record of two samples, and the network if asked, at rest for a second."""
    if network:
        path = CentrePath(_Rest(), 0.0, 1.0)
        fly_network(path, 0.0, 1.0, FleetNetwork(), partial(generator, 0, 0))
    nothing, none, ids = np.zeros((2, 3)), np.empty(0), np.empty(0, np.int64)
    vectors = np.empty((0, 3))
    fixes = Fixes(none, none, none, vectors, vectors, np.empty((0, 6, 6)), ids, ids)
    rest = np.arange(2.0), nothing, nothing, np.array([1.0, 0.0, 0.0, 0.0]), fixes
    given = AlignmentInput.checked(*rest, FilterSettings(), ImuErrors(), GravityModel.J2)
    for name in filters:
        estimates(name, [given])


class _Rest:
    """A vehicle that stays where it is."""

    def at(self, t: Array, /) -> tuple[Array, Array, Array]:
        nothing = np.zeros((len(t), 3))
        return nothing, nothing, np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
