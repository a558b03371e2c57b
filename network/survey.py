"""All nodes of a fleet, observed and located at all epochs."""

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np

from ..sins import earth
from .faults import Trouble
from .fleet import OWN_SHIP, Fleet, FleetSettings
from .localization.chain import LocalizationSettings
from .localization.epochs import Epochs, Track
from .localization.following import Follower
from .localization.quarantine import Monitor
from .localization.tracking import Tracker
from .localization.watching import WatchedTracker
from .radio import Radio
from .record import Array, Booleans, Integers
from .topology import Topology

CHUNK_S = 1.0
"""Time at a time: nodes are started between chunks, and all pairs at all epochs would need much memory."""
SEGMENT = 100
"""Chunks after which all nodes are located from nothing again, so that no wrong start lasts; segments are
worked on side by side."""


@dataclass(frozen=True)
class Survey:
    """What localisation gives at k epochs of n nodes."""

    lla: Array
    """(k, n, 3) true positions, rad, rad, m."""
    error_n: Array
    """(k, n, 3) estimated less true position, NED at the fleet's centre, m; NaN where there is none."""
    sd_n: Array
    """(k, n, 3) m, likewise: stated standard deviations, of other nodes than the own ship once a chunk."""
    velocity_error_n: Array
    """(k, n, 3) m/s, likewise."""
    outcome: Integers
    """(k, n) `NodeOutcome`."""
    own_lla: Array
    """(k, 3) estimate of the own ship's position."""
    own_v_n: Array
    """(k, 3) and velocity, NED at the own ship, m/s."""
    own_cov: Array
    """(k, 6, 6) covariance of both, NED at the own ship."""
    clock_offset: Array
    """(k, n) s, true."""


@dataclass(frozen=True)
class _Sight:
    """A chunk as observed, with the truth."""

    epochs: Epochs
    x: Array
    v: Array
    lla: Array
    centre_e: Array
    C_en: Array
    clock_offset: Array

    @property
    def frames(self) -> tuple[Array, Array, Array]:
        """Times (k,), origins (k, 3) and axes (k, 3, 3) of the epochs' frames."""
        return self.epochs.t, self.centre_e, self.C_en


def survey(
    fleet: Fleet,
    radio: Radio,
    topology: Topology,
    t: Array,
    fleet_settings: FleetSettings,
    settings: LocalizationSettings,
    lost: Booleans | None = None,
    trouble: Trouble | None = None,
    monitor: Monitor | None = None,
) -> Survey:
    """Observe and locate all nodes at epochs ``t`` (k,), s, ascending.

    ``lost`` (k, sweeps, n) are broadcasts of the distributed solver that nobody received; none by default.
    ``monitor`` leaves out nodes that it finds out, and knows them then; segments wait for each other.

    The result does not depend on the number of cores.
    """

    follower = Follower(settings) if settings.tracker != "epoch" else None

    def located(sights: list[_Sight], before: Future[list[Survey]] | None) -> list[Survey]:
        tracker: Tracker | WatchedTracker = Tracker(
            fleet.formation.anchor,
            settings,
            fleet_settings.anchor_position_sd_m,
            fleet_settings.anchor_velocity_sd_mps,
            radio.settings.assumed_altitude_sd_m,
            radio.settings.clock if radio.settings.ranging == "one_way" else None,
        )
        if monitor is not None:
            if before is not None:
                before.result()  # It carries on from segment to segment.
            tracker = WatchedTracker(tracker, monitor)
        tracks = [tracker.advance(sight.epochs) for sight in sights]
        if follower is not None:
            if before is not None:
                before.result()  # So does this.
            tracks = [
                follower.advance(track, *sight.frames) for track, sight in zip(tracks, sights, strict=True)
            ]
        return [_located(track, sight) for track, sight in zip(tracks, sights, strict=True)]

    parts: list[Survey] = []
    latest: Future[list[Survey]] | None = None
    pending: deque[Future[list[Survey]]] = deque()
    workers = os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        # Observed in order, since a radio's draws carry on from chunk to chunk.
        for sights in _segments(fleet, radio, topology, t, lost, trouble):
            latest = pool.submit(located, sights, latest)
            pending.append(latest)
            if len(pending) > workers:
                parts += pending.popleft().result()
        for future in pending:
            parts += future.result()
    columns = [field.name for field in fields(Survey)]
    return Survey(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in columns})


def _segments(
    fleet: Fleet,
    radio: Radio,
    topology: Topology,
    t: Array,
    lost: Booleans | None,
    trouble: Trouble | None,
) -> Iterator[list[_Sight]]:
    # The small part lets an epoch that falls on a second's end but for rounding begin the next.
    cuts = np.flatnonzero(np.diff(np.floor((t - t[0]) / CHUNK_S + 1e-6))) + 1
    chunks = np.split(np.arange(len(t)), cuts)
    for first in range(0, len(chunks), SEGMENT):
        yield [
            _seen(fleet, radio, topology, t[chunk], None if lost is None else lost[chunk], trouble)
            for chunk in chunks[first : first + SEGMENT]
        ]


def _seen(
    fleet: Fleet,
    radio: Radio,
    topology: Topology,
    t: Array,
    lost: Booleans | None,
    trouble: Trouble | None,
) -> _Sight:
    """What the nodes measure at a chunk of epochs, in level frames at the fleet's centre."""
    x_e, v_e = fleet.at(t)
    lla = earth.lla_from_ecef(x_e)
    seen = radio.observe(t, x_e, v_e, lla[..., 2])
    i, j = seen.pairs.T
    ranging = topology.ranging[topology.at(t)][:, i, j]
    centre = fleet.centre(t)
    centre_e, C_en = earth.ecef_from_lla(centre), earth.C_en(centre[:, 0], centre[:, 1])
    believed_x, believed_v = fleet.believed(t, x_e, v_e)
    if trouble is not None:
        believed_x += trouble.lies.positions_n(t) @ C_en.transpose(0, 2, 1)
        ranging = ranging & ~trouble.silenced[i] & ~trouble.silenced[j]
    R_N, R_E = earth.radii_of_curvature(centre[0, 0])
    epochs = Epochs(
        t=t,
        pairs=seen.pairs,
        ranges=seen.ranges,
        range_sd=seen.range_sd,
        rates=seen.range_rates,
        rate_sd=seen.range_rate_sd,
        heard=seen.heard & ranging,
        belief_x=(believed_x - centre_e[:, None]) @ C_en,
        belief_v=believed_v @ C_en,
        height=None if seen.altitude is None else seen.altitude - centre[:, 2:],
        curvature=float(1 / np.sqrt(R_N * R_E)),
        lost=lost,
    )
    x = (x_e - centre_e[:, None]) @ C_en
    return _Sight(epochs, x, v_e @ C_en, lla, centre_e, C_en, seen.clock_offset)


def _located(track: Track, sight: _Sight) -> Survey:
    """A chunk's estimates, less the truth, and the own ship's in its own axes."""
    own_e = sight.centre_e + np.einsum("kij,kj->ki", sight.C_en, track.x[:, OWN_SHIP])
    own_lla = earth.lla_from_ecef(own_e)
    # From the axes of the fleet's centre to those of the own ship.
    turn = earth.C_en(own_lla[:, 0], own_lla[:, 1]).transpose(0, 2, 1) @ sight.C_en
    sd_n = np.where(np.isfinite(track.x), track.sd[:, :3], np.nan)
    sd_n[:, OWN_SHIP] = np.sqrt(np.einsum("kii->ki", track.own_cov[:, :3, :3]))
    both = np.zeros((len(turn), 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = turn
    return Survey(
        lla=sight.lla,
        error_n=track.x - sight.x,
        sd_n=sd_n,
        velocity_error_n=track.v - sight.v,
        outcome=track.outcome,
        own_lla=own_lla,
        own_v_n=np.einsum("kij,kj->ki", turn, track.v[:, OWN_SHIP]),
        own_cov=both @ track.own_cov @ both.transpose(0, 2, 1),
        clock_offset=sight.clock_offset,
    )
