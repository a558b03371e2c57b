"""The aircraft: JSBSim flies a mission plan and yields true motion with ideal IMU increments.

`simulator.fly` flies a `mission.FlightPlan` and returns a `flight.Flight`; `cache.cached_flight` does so
unless the same plan was flown before. Conventions as in `sins`.
"""
