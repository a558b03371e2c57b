"""Where the nodes of a network are, from ranges between them and from what its anchors know.

Positions are Cartesian, (n, 3) m, along north, east and down of one level frame that touches the earth at
the fleet's centre (`network.fleet`). `problem` says what is measured and what comes of it; `chain` goes from
nothing to an estimate with its covariance.
"""
