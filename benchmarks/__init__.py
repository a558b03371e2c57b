"""How fast fleetalign is: figures of one run, beside references measured in the same run.

`python -m benchmarks` from the root of the repository writes `docs/benchmarks.md`.
"""
