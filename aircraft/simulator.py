"""The JSBSim loop: flies a plan and returns the flight."""

import math
import time as wall
from array import array
from collections.abc import Callable

import jsbsim
import numpy as np

from ..sins.earth import EQUATORIAL_RADIUS, GravityModel
from ..sins.units import DEG
from .airframe import Airframe, load_airframe
from .envelope import Envelope, FlightError
from .failures import EngineOut, Jammed
from .flight import Flight, Phase
from .guidance import Controls, Guidance, Sensed
from .mission import GUIDANCE_RATE_HZ, FlightPlan, Turbulence
from .phases import mission_phases
from .truth import InertialStates, increments, navigation_truth, summed

Progress = Callable[[float, float], None]
"""Called with the time flown and the whole time, s."""

FOOT = 0.3048
POUND_PER_SQUARE_FOOT = 47.88025898
SETTLING_S = 10.0
"""On the brakes before time zero, so that the gear's springs come to rest."""
PROGRESS_INTERVAL_S = 0.06
ROUGH_FROM_MPS = 30.0
"""Airspeed from which there is turbulence. At rest JSBSim's shakes the rates that a flight control system may
integrate there: that of the F-16 does, and keeps the sum for the flight."""
TURBULENCE_TYPE = {Turbulence.NONE: 0, Turbulence.MILSPEC: 3, Turbulence.TUSTIN: 4}


class _Model:
    """One JSBSim instance, on the runway with its engines running and its brakes set."""

    def __init__(self, plan: FlightPlan, airframe: Airframe) -> None:
        jsbsim.FGJSBBase().debug_lvl = 0
        self.plan = plan
        self._wind = plan.air.wind_north_mps, plan.air.wind_east_mps, plan.air.wind_down_mps
        self.fdm = jsbsim.FGFDMExec(None)
        if not self.fdm.load_model(airframe.model):
            raise FlightError("preparation", 0.0, f"JSBSim has no usable model {airframe.model!r}")
        self.fdm.set_dt(1.0 / plan.model_rate_hz)
        self._place(airframe)
        engines = range(airframe.engines)
        self._throttles = [self._setter(f"fcs/throttle-cmd-norm[{i}]") for i in engines]
        self._surfaces = [
            self._setter(f"fcs/{name}-cmd-norm") for name in ("elevator", "aileron", "rudder", "steer")
        ]
        self._brakes = [self._setter(f"fcs/{side}-brake-cmd-norm") for side in ("left", "right", "center")]
        self.set_gear = self._setter("gear/gear-cmd-norm")
        self._gusts = [self._setter(f"atmosphere/gust-{axis}-fps") for axis in ("north", "east", "down")]
        names = (
            "position/geod-alt-ft position/h-agl-ft velocities/v-north-fps velocities/v-east-fps"
            " velocities/v-down-fps attitude/phi-rad attitude/theta-rad attitude/psi-rad"
            " velocities/p-rad_sec velocities/q-rad_sec velocities/r-rad_sec aero/alpha-rad"
            " accelerations/Nz aero/qbar-psf gear/wow position/distance-from-start-mag-mt"
            " position/lat-geod-rad position/long-gc-rad"
        )
        self._sensors = [self._getter(name) for name in names.split()]
        states = (
            "position/eci-x-ft position/eci-y-ft position/eci-z-ft"
            " velocities/eci-x-fps velocities/eci-y-fps velocities/eci-z-fps"
            " attitude/phi-rad attitude/theta-rad attitude/psi-rad"
        )
        self.state_getters = [self._getter(name) for name in states.split()]

    def _node(self, name: str):
        node = self.fdm.get_property_manager().get_node(name)
        if node is None:
            raise FlightError("preparation", 0.0, f"the flight model has no property {name!r}")
        return node

    def _getter(self, name: str) -> Callable[[], float]:
        return self._node(name).get_double_value

    def _setter(self, name: str) -> Callable[[float], object]:
        return self._node(name).set_double_value

    def _set(self, values: dict[str, float]) -> None:
        for name, value in values.items():
            self._setter(name)(value)

    def _place(self, airframe: Airframe) -> None:
        start, air = self.plan.start, self.plan.air
        self._set(
            {
                "ic/long-gc-deg": start.longitude_deg,
                "ic/lat-geod-deg": start.latitude_deg,
                "ic/terrain-elevation-ft": (start.altitude_m - airframe.gear_height_m) / FOOT,
                "ic/h-agl-ft": airframe.gear_height_m / FOOT,
                "ic/psi-true-deg": start.heading_deg,
                "gear/gear-cmd-norm": 1.0,
            }
        )
        if not self.fdm.run_ic():
            raise FlightError("preparation", 0.0, "JSBSim refuses the initial conditions")
        self._set(
            {
                "simulation/randomseed": self.plan.seed % (2**31 - 2) + 1,  # 0 and 1 would be one
                "propulsion/set-running": -1,
                "atmosphere/wind-north-fps": air.wind_north_mps / FOOT,
                "atmosphere/wind-east-fps": air.wind_east_mps / FOOT,
                "atmosphere/wind-down-fps": air.wind_down_mps / FOOT,
                "atmosphere/turb-type": TURBULENCE_TYPE[Turbulence.NONE],
                "atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps": air.turbulence_wind_mps / FOOT,
                "atmosphere/turbulence/milspec/severity": air.turbulence_severity,
            }
        )

    def set_turbulence(self) -> None:
        """There is some from now on, if the plan has any."""
        self._set({"atmosphere/turb-type": TURBULENCE_TYPE[self.plan.air.turbulence]})

    def set_gust(self, north: float, east: float, down: float) -> None:
        """Velocity of the gusts, m/s."""
        for setter, speed in zip(self._gusts, (north, east, down), strict=True):
            setter(speed / FOOT)

    def cut_off(self, engine: int) -> None:
        """No more fuel for an engine, counted from 1."""
        self._set({"propulsion/active_engine": engine - 1, "propulsion/cutoff_cmd": 1.0})

    def _to_the_right(self, latitude: float, longitude: float) -> float:
        """Of the centre line, m, near the runway."""
        start = self.plan.start
        heading, cosine = start.heading_deg * DEG, math.cos(start.latitude_deg * DEG)
        north, east = latitude - start.latitude_deg * DEG, longitude - start.longitude_deg * DEG
        across = -math.sin(heading) * north + math.cos(heading) * cosine * math.remainder(east, 2 * math.pi)
        return EQUATORIAL_RADIUS * across

    def set_brakes(self, value: float) -> None:
        for brake in self._brakes:
            brake(value)

    def command(self, controls: Controls) -> None:
        elevator, aileron, rudder, steer = self._surfaces
        elevator(controls.elevator)
        aileron(controls.aileron)
        rudder(controls.rudder)
        steer(controls.steer)
        for throttle in self._throttles:
            throttle(controls.throttle)

    def sense(self) -> Sensed:
        (
            altitude,
            height,
            north,
            east,
            down,
            roll,
            pitch,
            heading,
            p,
            q,
            r,
            alpha,
            nz,
            qbar,
            wow,
            distance,
            latitude,
            longitude,
        ) = [sensor() for sensor in self._sensors]
        wind_north, wind_east, wind_down = self._wind
        # In the order of the fields: names would take as long as the reading.
        return Sensed(
            altitude * FOOT,
            height * FOOT,
            -down * FOOT,
            math.hypot(north * FOOT - wind_north, east * FOOT - wind_east, down * FOOT - wind_down),
            roll,
            pitch,
            heading,
            p,
            q,
            r,
            alpha,
            nz,
            qbar * POUND_PER_SQUARE_FOOT,
            wow > 0.5,
            distance,
            self._to_the_right(latitude, longitude),
        )


def fly(plan: FlightPlan, progress: Progress | None = None) -> Flight:
    """Fly the plan in JSBSim.

    ``progress`` is called some 15 times a second of wall time with the time flown and the whole time, s.
    The same plan gives the same flight, bit for bit. Raises FlightError, which names phase and time, when
    the plan cannot be flown, and ValueError for an unknown airframe.
    """
    airframe = load_airframe(plan.airframe)
    model = _Model(plan, airframe)
    rate = plan.model_rate_hz
    steps = rate // GUIDANCE_RATE_HZ
    run = model.fdm.run
    model.set_brakes(1.0)
    for _ in range(round(SETTLING_S * rate)):
        run()
    model.set_brakes(0.0)
    earth_angle = model.fdm["position/epa-rad"]

    guidance = Guidance(airframe, 1 / GUIDANCE_RATE_HZ)
    envelope = Envelope(plan, airframe)
    record = array("d")
    rows: list[float] = []
    extend = rows.extend
    rx, ry, rz, vx, vy, vz, roll, pitch, heading = model.state_getters
    extend((rx(), ry(), rz(), vx(), vy(), vz(), roll(), pitch(), heading()))

    marks: list[Phase] = []
    tick = 0
    rough = False
    jammed = Jammed(plan.failures)
    engines_out = sorted((f for f in plan.failures if isinstance(f, EngineOut)), key=lambda f: f.time_s)
    next_report = wall.perf_counter()
    for phase in mission_phases(plan, airframe):
        start = tick / GUIDANCE_RATE_HZ
        model.set_gear(phase.gear)
        while True:
            t = tick / GUIDANCE_RATE_HZ
            sensed = model.sense()
            if phase.finished(t, sensed):
                break
            envelope.check(phase, t, t - start, sensed)
            if not rough and sensed.airspeed > ROUGH_FROM_MPS:
                rough = True
                model.set_turbulence()
            if plan.air.gusts:
                model.set_gust(*plan.air.gust_n(t))
            while engines_out and engines_out[0].time_s <= t:
                model.cut_off(engines_out.pop(0).engine)
            model.command(jammed(t, guidance.update(sensed, phase.target(t, sensed))))
            for _ in range(steps):
                run()
                extend((rx(), ry(), rz(), vx(), vy(), vz(), roll(), pitch(), heading()))
            record.fromlist(rows)
            rows.clear()
            tick += 1
            if progress is not None and wall.perf_counter() >= next_report:
                progress(t, plan.end_s)
                next_report = wall.perf_counter() + PROGRESS_INTERVAL_S
        marks.append(Phase(phase.name, start, t))
    if progress is not None:
        progress(plan.end_s, plan.end_s)
    return _flight(plan, airframe, record, earth_angle, tuple(marks))


def _flight(
    plan: FlightPlan,
    airframe: Airframe,
    record: "array[float]",
    earth_angle: float,
    phases: tuple[Phase, ...],
) -> Flight:
    rows = np.frombuffer(record).reshape(-1, 9)
    rate = plan.model_rate_hz
    states = InertialStates(rows[:, :3] * FOOT, rows[:, 3:6] * FOOT, rows[:, 6:], earth_angle, 1 / rate)
    lla, v_n, q_nb, q_ib = navigation_truth(states)
    dtheta, dv = increments(states, q_ib)
    ratio = rate // plan.imu_rate_hz
    return Flight(
        time=np.arange(len(lla[::ratio])) / plan.imu_rate_hz,
        lla=lla[::ratio].copy(),
        v_n=v_n[::ratio].copy(),
        q_nb=q_nb[::ratio].copy(),
        dtheta_b=summed(dtheta, ratio),
        dv_b=summed(dv, ratio),
        phases=phases,
        airframe=airframe.name,
        gravity=GravityModel.J2,
    )
