"""Plants for `fleetalign lmi` that come with fleetalign, one TOML a plant."""
