"""The fleet's network: where fixes come from, what delays them on their way, and what arrives.

`fleet_network` puts it together: `fleet` flies the nodes, `radio` lets them range each other,
`localization` finds where that puts them, and `protocol` carries the fixes. `source` has simpler sources;
all of them give `fixes`.
"""
