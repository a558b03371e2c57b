"""The alignment filters against the same filters in readable numpy."""

from functools import partial

from fleetalign.align.estimate import Estimate
from fleetalign.align.filters import FILTERS, align
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.settings import DelayModel, Transform

from .harness import Harness, Row
from .material import Material
from .numpy_filter import NumpyFilter

TARGET = 400e3
"""Samples per second and core."""


def rows(harness: Harness, material: Material) -> list[Row]:
    """One row for each filter: samples per second and core, the call from Python included."""
    samples = len(material.run.imu.time) - 1
    rate_hz = 1 / material.window.dt
    found = []
    for name, delay in FILTERS.items():
        times = harness.times(
            f"filter {name}",
            {
                "ours": partial(aligned, material, delay),
                "numpy": NumpyFilter(*material.measured, delay).align,
            },
            rounds=3,
            repeats={"ours": 20},
        )
        rate, oracle_rate = samples / times["ours"].best, samples / times["numpy"].best
        found.append(
            Row(
                f"Filter `{name}`, {16 if delay is DelayModel.ESTIMATED else 15} states, one core",
                times["ours"].rate(samples),
                f"the same in numpy: {times['numpy'].rate(samples)}",
                f"{rate / oracle_rate:.0f} times",
                "400 k/s",
                rate >= TARGET,
                f"`AlignmentInput.checked` and `filters.align` over a record of {samples / rate_hz:.0f} s at"
                f" {rate_hz:.0f} Hz with {len(material.run.fixes)} fixes, the covariance carried at every"
                " sample.",
            )
        )
    return [*found, _by_points(harness, material, samples)]


def aligned(material: Material, delay: DelayModel, transform: Transform = Transform.DERIVATIVES) -> Estimate:
    """From arrays to an estimate."""
    return align(AlignmentInput.checked(*material.measured), delay, transform)


def _by_points(harness: Harness, material: Material, samples: int) -> Row:
    """The square-root cubature filter against the same filter by derivatives."""
    subjects = {
        "ours": partial(aligned, material, DelayModel.STAMPED, Transform.SQUARE_ROOT),
        "ekf": partial(aligned, material, DelayModel.STAMPED),
    }
    times = harness.times("filter srckf_stamped", subjects, rounds=3, repeats={"ours": 3, "ekf": 20})
    return Row(
        "Filter `srckf_stamped`, 32 points, one core",
        times["ours"].rate(samples),
        f"`ekf_stamped`: {times['ekf'].rate(samples)}",
        f"{times['ekf'].best / times['ours'].best:.3f} times",
        note="Each point goes through the mechanisation at every sample.",
    )
