"""The co-simulation: scenario, run, score, recording, report, and the command line."""
