"""Settings of foreign radars, whose chirps disturb the terminals'."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field

from isac_rt.frame.settings import Array
from isac_rt.scenario.swarm import Uav
from isac_rt.settings import ClockDrift, Decibels, Node, Positive, Problem, Vector
from isac_rt.world.settings import Rcs, Waypoint

FLIGHT = ("position_m", "velocity_mps", "waypoints", "boresight", "mount_deg")
"""Keys that an emitter shares with a UAV."""
TRANSPARENT_DBSM = -200.0
"""Cross-section of what does not scatter."""


class Emitter(Node):
    """A foreign FMCW radar: where it is, where it looks, and its chirps, all alike."""

    position_m: Vector | None = None
    """Position at the start of the run: x east, y north, z up [m]. An emitter has either this or
    `waypoints`."""
    velocity_mps: Vector = (0.0, 0.0, 0.0)
    """Velocity of a straight flight: east, north, up [m/s]. By default it stands."""
    waypoints: tuple[Waypoint, ...] | None = None
    """Places with their times on a smooth curve, in place of `position_m`."""
    boresight: Literal["velocity"] | Vector = "velocity"
    """Direction [x, y, z] in which its antenna looks, of any length, or `velocity`, the default:
    where it moves to."""
    mount_deg: Vector = (0.0, 0.0, 0.0)
    """How the antenna is turned against its boresight: yaw, pitch, roll [degrees]. By default
    not."""
    power_dbm: Decibels = 12.0
    """Transmit power [dBm]. The default is what one channel of a 77 GHz radar chip delivers."""
    array: Array = Array()
    """Pattern of its antenna: `element_pattern`, `element_gain_dbi` and `field_of_view_deg` of one
    element. By default a patch antenna."""
    start_hz: Annotated[float, Field(ge=1e9, le=1e12, allow_inf_nan=False)]
    """Frequency at which its chirps start [Hz]."""
    slope_mhz_per_us: Annotated[float, Field(ge=-1e4, le=1e4, allow_inf_nan=False)]
    """Slope of its chirps [MHz/us], negative for falling ones."""
    ramp_us: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
    """Duration of the ramp of a chirp [us]."""
    idle_us: Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
    """Pause between a ramp's end and the next one's start [us]."""
    offset_us: Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)] | None = None
    """Start of its first chirp, or of the first of each burst, after time 0 [us]. null, the
    default: drawn within one repetition by `seed` and name."""
    clock_drift_ppm: ClockDrift = 0.0
    """How much later its clock gets [microseconds per second]: its chirps slide against ours, its
    frequencies are lower by as much. Crystals: 20. By default none."""
    burst_chirps: Annotated[int, Field(ge=1, le=100_000)] | None = None
    """Chirps in a burst. null, the default: it sends without a pause."""
    burst_interval_s: Positive | None = None
    """Time from burst to burst [s], with `burst_chirps`."""

    def uav(self) -> Uav:
        """Return the emitter as a transparent body that sends."""
        body = {"body_radius_m": 0, "rcs": Rcs(value_dbsm=TRANSPARENT_DBSM), "array": self.array}
        return Uav(role="active", **body, **self._flight)

    @property
    def _flight(self) -> dict[str, Any]:
        return {key: getattr(self, key) for key in FLIGHT if key in self.model_fields_set}

    def problems(self) -> Iterator[Problem]:
        yield from Uav.model_construct(role="active", **self._flight).problems()
        if not any(self.boresight):
            yield Problem((("boresight",),), "points nowhere; give a direction such as [0, 1, 0]")
        end = self.slope_mhz_per_us * self.ramp_us * 1e6 + self.start_hz
        if not 0 < end <= 1e12:
            over = "above 1e12 Hz" if end > 0 else "below 0 Hz"
            message = f"ends {over}; shorten the ramp, or give start_hz in hertz"
            yield Problem((("ramp_us",), ("start_hz",)), message)
        if (self.burst_chirps is None) != (self.burst_interval_s is None):
            message = "goes with burst_interval_s, and this with it; state both or none"
            yield Problem((("burst_chirps",), ("burst_interval_s",)), message)
            return
        if self.burst_chirps is not None and self.burst_interval_s is not None:
            length = self.burst_chirps * (self.ramp_us + self.idle_us) * 1e-6
            if length > self.burst_interval_s * (1 + 1e-12):
                message = f"is shorter than a burst, which lasts {length:.4g} s; lengthen it"
                yield Problem((("burst_interval_s",), ("burst_chirps",)), message)
