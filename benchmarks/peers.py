"""Other packages on the same record: what each can be compared in, per sample and core.

Their inputs are converted beforehand, outside the time taken; calls once a sample are theirs to pay,
since none of them takes a whole record.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
from fleetalign.align.filters import FILTERS
from fleetalign.align.settings import DelayModel, initial_sd, noise_density
from fleetalign.sins import attitude, earth
from fleetalign.sins.error_model import transition_matrix
from fleetalign.sins.mechanization import NavigationState, mechanize

from .filters import aligned
from .harness import Harness, Row, package_version
from .material import Material

Work = Callable[[], object]


@dataclass(frozen=True)
class Peer:
    """A package, what of it is timed, and whether the work stands beside the mechanisation or the filter."""

    package: str
    subject: str
    beside: str
    make: Callable[[Material], Work]
    remark: str


def rows(harness: Harness, material: Material) -> list[Row]:
    """One row for each peer; those not installed are named."""
    ours = {
        "mechanisation": _mechanization(material),
        "filter `ekf`": partial(aligned, material, FILTERS["ekf"]),
    }
    samples = len(material.run.imu.time) - 1
    found = []
    for beside, work in ours.items():
        peers = [peer for peer in PEERS if peer.beside == beside]
        subjects: dict[str, Work] = {
            peer.subject: peer.make(material) for peer in peers if package_version(peer.package)
        }
        times = harness.times(f"peers, {beside}", {"ours": work, **subjects}, rounds=5, repeats={"ours": 5})
        for peer in peers:
            what, note = f"{beside.capitalize()} beside {peer.package}", f"`{peer.subject}`: {peer.remark}"
            ours_rate = times["ours"].rate(samples)
            if peer.subject not in times:
                found.append(Row(what, ours_rate, "not installed", "", note=note))
                continue
            theirs = times[peer.subject]
            ratio = theirs.best / times["ours"].best
            found.append(Row(what, ours_rate, theirs.rate(samples), f"{ratio:.3g} times", note=note))
    return found


def _mechanization(material: Material) -> Work:
    w, imu = material.window, material.run.imu
    initial = NavigationState(w.lla[0], w.v_n[0], w.q_nb[0])
    return partial(mechanize, imu.time, imu.dtheta_b, imu.dv_b, initial, w.gravity)


def _sidereon_start(material: Material, lla: np.ndarray, v_n: np.ndarray, q_nb: np.ndarray) -> Any:
    C_en = earth.C_en(lla[0], lla[1])
    return import_module("sidereon").NavState(
        float(material.window.time[0]),
        earth.ecef_from_lla(lla).tolist(),
        (C_en @ v_n).tolist(),
        np.ascontiguousarray(C_en @ attitude.to_dcm(q_nb)),
    )


def _sidereon_samples(material: Material) -> list[Any]:
    imu = material.run.imu
    increment = import_module("sidereon").ImuSample.increment
    dt = material.window.dt
    return [
        increment(float(t), dv.tolist(), dtheta.tolist(), dt)
        for t, dv, dtheta in zip(imu.time[1:], imu.dv_b[1:], imu.dtheta_b[1:], strict=True)
    ]


def _sidereon_mechanizer(material: Material) -> Work:
    mechanizer = import_module("sidereon").StrapdownMechanizer
    w, samples = material.window, _sidereon_samples(material)
    start = _sidereon_start(material, w.lla[0], w.v_n[0], w.q_nb[0])

    def work() -> Any:
        navigator = mechanizer(start)
        for sample in samples:
            navigator.propagate(sample)
        return navigator.state

    return work


def _by_arrival(material: Material) -> dict[int, list[int]]:
    """Rows of the fixes by the epoch at which they count, for those that arrive within the record."""
    fixes, time = material.run.fixes, material.run.imu.time
    epochs = np.searchsorted(time, fixes.t_arrival)
    found: dict[int, list[int]] = {}
    for row, epoch in enumerate(epochs):
        if 0 < epoch < len(time):
            found.setdefault(int(epoch), []).append(row)
    return found


def _sidereon_filter(material: Material) -> Work:
    sidereon = import_module("sidereon")
    run, imu = material.run, material.scenario.imu
    sd = initial_sd(material.scenario.alignment.settings, imu, DelayModel.IGNORED)[:15]
    start = _sidereon_start(material, run.fixes.lla[0], run.fixes.v_n[0], run.q_nb_coarse)
    state = sidereon.InsFilterState.from_diagonal(start, sidereon.ErrorStateLayout.FIFTEEN, (sd**2).tolist())
    density = noise_density(imu)
    # Constant biases: a drift of next to nothing over a time without end.
    spec = sidereon.ImuSpec(float(np.sqrt(density[3])), float(np.sqrt(density[6])), 1e-9, 1e-12, 1e6, 1e6)
    samples, measurements = _sidereon_samples(material), {}
    for epoch, fixes in _by_arrival(material).items():
        measurements[epoch] = []
        for row in fixes:
            lla = run.fixes.lla[row]
            C_en = earth.C_en(lla[0], lla[1])
            T = np.kron(np.eye(2), C_en)
            measurements[epoch].append(
                sidereon.GnssFixMeasurement.position_velocity(
                    float(run.imu.time[epoch]),
                    earth.ecef_from_lla(lla).tolist(),
                    (C_en @ run.fixes.v_n[row]).tolist(),
                    T @ run.fixes.cov[row] @ T.T,
                    10,
                )
            )

    def work() -> Any:
        navigator = sidereon.InertialFilter(state, spec)
        for k, sample in enumerate(samples, start=1):
            navigator.propagate(sample)
            for measurement in measurements.get(k, ()):
                navigator.update_loose(measurement)
        return navigator.state.nominal

    return work


def _gtsam_preintegration(material: Material, measurements: str, parameters: str) -> Work:
    gtsam = import_module("gtsam")
    imu, dt = material.run.imu, material.window.dt
    density = noise_density(material.scenario.imu)
    settings = getattr(gtsam, parameters).MakeSharedD(earth.STANDARD_GRAVITY)
    settings.setAccelerometerCovariance(density[3] * np.eye(3))
    settings.setGyroscopeCovariance(density[6] * np.eye(3))
    settings.setIntegrationCovariance(1e-12 * np.eye(3))
    force, rate = list(imu.dv_b[1:] / dt), list(imu.dtheta_b[1:] / dt)

    def work() -> Any:
        integrated = getattr(gtsam, measurements)(settings)
        for f_b, w_b in zip(force, rate, strict=True):
            integrated.integrateMeasurement(f_b, w_b, dt)
        return integrated

    return work


def _filterpy(material: Material) -> Work:
    kalman = import_module("filterpy.kalman").KalmanFilter
    window, imu, fixes = material.window, material.run.imu, material.run.fixes
    dt = window.dt
    transitions = []
    for k in range(1, len(imu.time)):
        C_nb = attitude.to_dcm(window.q_nb[k])
        f_n = C_nb @ imu.dv_b[k] / dt
        transitions.append(transition_matrix(window.lla[k], window.v_n[k], f_n, C_nb, dt))
    sd = initial_sd(material.scenario.alignment.settings, material.scenario.imu, DelayModel.IGNORED)[:15]
    Q = np.diag(noise_density(material.scenario.imu)[:15] * dt)
    H, z, arrivals = np.eye(6, 15), np.zeros((6, 1)), _by_arrival(material)

    def work() -> Any:
        estimator = kalman(dim_x=15, dim_z=6)
        estimator.P = np.diag(sd**2)
        for k, Phi in enumerate(transitions, start=1):
            estimator.predict(F=Phi, Q=Q)
            for row in arrivals.get(k, ()):
                estimator.update(z, R=fixes.cov[row], H=H)
        return estimator.P

    return work


PEERS = (
    Peer(
        "sidereon",
        "StrapdownMechanizer.propagate",
        "mechanisation",
        _sidereon_mechanizer,
        "the same increments on the rotating ellipsoid, in earth-fixed axes.",
    ),
    Peer(
        "gtsam",
        "PreintegratedImuMeasurements.integrateMeasurement",
        "mechanisation",
        partial(
            _gtsam_preintegration,
            measurements="PreintegratedImuMeasurements",
            parameters="PreintegrationParams",
        ),
        "preintegration over a flat earth at rest, with a 9 by 9 covariance and bias Jacobians, which the"
        " mechanisation does not carry.",
    ),
    Peer(
        "sidereon",
        "InertialFilter.propagate, update_loose",
        "filter `ekf`",
        _sidereon_filter,
        "the same fixes taken at their arrival, 15 error states.",
    ),
    Peer(
        "gtsam",
        "PreintegratedCombinedMeasurements.integrateMeasurement",
        "filter `ekf`",
        partial(
            _gtsam_preintegration,
            measurements="PreintegratedCombinedMeasurements",
            parameters="PreintegrationCombinedParams",
        ),
        "a 15 by 15 covariance at every sample over a flat earth at rest; no fixes are fused.",
    ),
    Peer(
        "filterpy",
        "KalmanFilter.predict, update",
        "filter `ekf`",
        _filterpy,
        "the matrices alone, 15 states and fixes of 6: the navigation and its transition matrices are given.",
    ),
)
