"""Campaigns: many runs at many points of a scenario's settings, which survive what happens to them.

`plan` says which runs, `shard` does some of them, `ledger` keeps what is done, `engine` and `cluster` hand
out what is not, `summary` and `report` tell what came of it.
"""
