"""Settings of the trackers, and of what terminals believe wrongly."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from isac_rt.settings import Decibels, Finite, Node, Positive, Problem
from isac_rt.world.settings import MaterialOverride


class Tracking(Node):
    """The Kalman filters, and when a track begins and ends."""

    KEEPS_NULL: ClassVar[bool] = True
    REMOVED: ClassVar[dict[str, str]] = {
        "births": "initiation",
        "mirrors": "leave it out: initiation: unexplained confirms no track behind a wall",
    }

    acceleration_std_mps2: Positive = 3.0
    """Standard deviation of a UAV's acceleration along each axis, held for about a second (Singer's
    model) [m/s^2]. A higher value follows turns more quickly and smooths less; the default is PX4's
    limit for multicopters."""
    gate_probability: Annotated[float, Field(gt=0.5, lt=1)] = 0.999
    """Probability that a detection of a tracked UAV falls within the gate about its prediction. A
    higher value loses fewer detections and lets more false ones in; the default loses one in a
    thousand."""
    confirm_hits: Annotated[int, Field(ge=1)] = 3
    """Detections within `confirm_window` frames that confirm a track. Three of five, the default,
    let hardly any false alarm become a track; `initiation: unexplained` asks odds after two."""
    confirm_window: Annotated[int, Field(ge=1)] = 5
    """Frames within which `confirm_hits` detections must fall to confirm a track; more of them
    confirm weak targets too, and more false ones. The default is the usual three of five."""
    drop_misses: Annotated[int, Field(ge=1)] = 8
    """Frames without a detection in a row after which a confirmed track ends. The default bridges
    short shadows."""
    drop_after_s: Positive | None = None
    """Time without a detection after which a confirmed track ends, whatever `drop_misses` says [s];
    a younger one ends after as many misses as it had frames before. null, the default: only
    `drop_misses` counts."""
    target_size_m: Annotated[float, Field(ge=0, le=100)] = 0.0
    """Extent of the largest targets [m], such as 6 of cars: of detections nearer to each other only
    the strongest counts, and a track expects it anywhere on its target. By default 0: points."""
    initiation: Literal["all", "unexplained"] = "all"
    """Detections that start tracks. `all`, the default. `unexplained`: not those that the city
    explains, as images of terminals or UAVs, surfaces, or static clutter that the mesh lacks;
    confirmation and deletion use the same tests (docs/receiver.md)."""

    @property
    def needs_mesh(self) -> bool:
        """True if track initiations are tested against a city's mesh."""
        return self.initiation == "unexplained"

    def problems(self) -> Iterator[Problem]:
        if self.confirm_hits > self.confirm_window:
            yield Problem(
                (("confirm_hits",), ("confirm_window",)),
                f"{self.confirm_hits} hits cannot be reached within confirm_window = "
                f"{self.confirm_window}; lower it or widen the window",
            )


def _four_numbers(value: Any) -> Any:
    if (
        not isinstance(value, list | tuple)
        or len(value) != 4
        or not all(isinstance(v, int | float) for v in value)
    ):
        raise ValueError("must be four numbers [x_min, y_min, x_max, y_max]")
    if value[0] >= value[2] or value[1] >= value[3]:
        raise ValueError("holds nothing; state [x_min, y_min, x_max, y_max] in this order")
    return value


Rectangle = Annotated[tuple[Finite, Finite, Finite, Finite], BeforeValidator(_four_numbers)]


Deviation = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]


class Belief(Node):
    """Errors in what terminals believe of themselves and of the city, to measure their cost.
    Transmission and echoes follow the truth."""

    REMOVED: ClassVar[dict[str, str]] = {
        "position_m": "belief.position_std_m, of the errors drawn for each terminal",
        "velocity_mps": "belief.velocity_std_mps, of the errors drawn for each terminal",
        "attitude_deg": "belief.attitude_std_deg, of the errors drawn for each terminal",
    }

    missing_m: tuple[Rectangle, ...] = ()
    """Rectangles [x_min, y_min, x_max, y_max] on the ground whose buildings are missing in the
    terminals' mesh [m]: all faces that lie wholly within one. By default none."""
    position_std_m: Deviation = 0.0
    """Standard deviation of the position error on each axis [m], drawn once for each terminal. By
    default 0."""
    velocity_std_mps: Deviation = 0.0
    """Standard deviation of the velocity error on each axis [m/s], drawn once for each terminal. By
    default 0."""
    attitude_std_deg: Deviation = 0.0
    """Standard deviation of the attitude error about each axis [deg], drawn once for each terminal.
    By default 0."""
    level_db: Decibels = 0.0
    """Error of the clutter's level that terminals expect [dB]. By default none."""
    mesh_m: Deviation = 0.0
    """Standard deviation of the error of each plane of the terminals' mesh along its normal [m]:
    expected clutter, walls and mirror images lie where that mesh has them. By default 0."""
    materials: dict[str, MaterialOverride] = Field({})
    """Properties of the city's materials, by name, that terminals believe in place of the true
    ones; keys as in `city.materials`. By default the true ones."""
