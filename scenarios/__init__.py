"""Scenario files that come with fleetalign, one TOML a scenario; `fleetalign list` names them."""
