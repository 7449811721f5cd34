"""The whole input of a run: YAML <-> a frozen, typed tree. The only file that knows YAML.

Units stand in the key names. Unknown keys are refused. Everything inside the program is SI, radians and
linear power; the conversions from decibels and degrees happen where a value leaves this tree.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]


class Node(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class MaterialOverride(Node):
    """What a scenario changes of a material; what is left out keeps its table value."""

    relative_permittivity: Annotated[float, Field(ge=1)] | None = None
    conductivity_s_per_m: Annotated[float, Field(ge=0)] | None = None
    scattering_coefficient: Fraction | None = None
    scattering_pattern: Literal["lambertian", "directive", "backscattering"] | None = None
    pattern_exponent: Annotated[int, Field(ge=1, le=20)] | None = None
    thickness_m: Positive | None = None


class City(Node):
    """Where the mesh comes from. `source` decides which of the keys below it apply."""

    source: Literal["builtin", "mitsuba", "mesh", "footprints", "canyon", "blocks"]
    # builtin: name of a scene that ships with Sionna RT; mitsuba, mesh, footprints: a file beside the scenario
    name: str | None = None
    file: str | None = None
    # mesh files
    up_axis: Literal["y", "z"] = "z"
    scale: Positive = 1.0
    material: str = "concrete"
    material_map: dict[str, str] = {}
    # footprints
    coordinates: Literal["auto", "metres", "lonlat"] = "auto"
    height_property: str = "height"
    default_height_m: Positive = 10.0
    wall_material: str = "concrete"
    roof_material: str = "concrete"
    ground_material: str = "asphalt"
    ground_margin_m: Annotated[float, Field(ge=0)] = 50.0
    # canyon and blocks
    street_width_m: Positive = 20.0
    street_length_m: Positive = 120.0
    building_height_m: Positive = 20.0
    height_spread_m: Annotated[float, Field(ge=0)] = 0.0
    block_size_m: Positive = 40.0
    blocks_x: Annotated[int, Field(ge=1, le=100)] = 3
    blocks_y: Annotated[int, Field(ge=1, le=100)] = 3
    # all
    keep_radius_m: Positive | None = None
    materials: dict[str, MaterialOverride] = {}


class Radio(Node):
    carrier_hz: Positive = 77e9
    bandwidth_hz: Positive = 640e6
    sampling_rate_hz: Positive = 20e6
    samples_per_chirp: Annotated[int, Field(ge=16, le=65536)] = 1024
    chirps_per_frame: Annotated[int, Field(ge=2, le=4096)] = 120
    groups: Annotated[int, Field(ge=1, le=16)] = 3
    filter_transition_hz: Positive = 0.4e6
    """Width of the IF filter's skirts on each side of its passband [0, sampling rate)."""


class Array(Node):
    tx_x: Annotated[int, Field(ge=1, le=16)] = 2
    tx_z: Annotated[int, Field(ge=1, le=16)] = 2
    rx_x: Annotated[int, Field(ge=2, le=64)] = 8
    rx_z: Annotated[int, Field(ge=2, le=64)] = 8
    spacing_wavelengths: Positive = 0.5774
    schedule: Literal["pseudo_random", "conventional"] = "pseudo_random"
    element_pattern: Literal["isotropic", "sector", "cosine"] = "cosine"
    element_gain_dbi: Finite = 5.0
    field_of_view_deg: Annotated[float, Field(gt=0, le=180)] = 120.0


class Modulation(Node):
    dpsk_order: Literal[2, 4, 8, 16] = 8
    acquisition_frames: Annotated[int, Field(ge=1)] = 3
    """Unmodulated frames at the start, from which every terminal acquires."""
    pilot_every_frames: Annotated[int, Field(ge=2)] | None = 25
    """One unmodulated frame in so many, for late and lost terminals; null: none after the start."""


class Rcs(Node):
    """Radar cross-section of a UAV.

    constant: `value_dbsm`. tr38901: mean of TR 38.901's UAV of small or large size; with `fluctuation_db` it varies
    smoothly with aspect, alike on all links and frames. relative: the reflected path stands `level_db` above the
    reference path of its link (line of sight at a PT, strongest other target at the AT), whatever the geometry.
    """

    model: Literal["constant", "tr38901", "relative"] = "tr38901"
    value_dbsm: Finite = -12.81
    size: Literal["small", "large"] = "small"
    fluctuation_db: Annotated[float, Field(ge=0, le=20)] = 0.0
    level_db: Finite = -20.0


class Waypoint(Node):
    time_s: Finite
    position_m: Vector


class Uav(Node):
    """One UAV: position and velocity, or waypoints with times (flown as a smooth curve through them)."""

    role: Literal["active", "passive", "target"]
    position_m: Vector | None = None
    velocity_mps: Vector = (0.0, 0.0, 0.0)
    waypoints: tuple[Waypoint, ...] | None = None
    boresight: Literal["velocity"] | Vector = "velocity"
    rcs: Rcs = Rcs()


class Leakage(Node):
    """The transmitter heard by the receiver on the same body."""

    enabled: bool = True
    isolation_db: Annotated[float, Field(ge=0)] = 60.0
    delay_s: Annotated[float, Field(ge=0)] = 1e-9


class Propagation(Node):
    model: Literal["free_space", "ray_traced"] = "free_space"
    max_bounces: Annotated[int, Field(ge=0, le=6)] = 2
    """Specular bounces per leg (terminal to terminal, terminal to target)."""
    rays: Annotated[int, Field(ge=100, le=10_000_000)] = 20_000
    ghosts: bool = True
    specular: bool = True
    weakest_path_db: Annotated[float, Field(ge=0)] = 40.0
    """Paths this far below the noise of one range-Doppler-antenna cell are left out."""
    leakage: Leakage = Leakage()


class Clutter(Node):
    model: Literal["none", "diffuse"] = "none"
    rays: Annotated[int, Field(ge=100, le=10_000_000)] = 20_000


class Noise(Node):
    """link_budget: thermal noise and transmit power. snr: per-sample IF SNR of the reference path (the strongest target at
    the AT, the line of sight at a PT) as it would be unshadowed and in view."""

    model: Literal["link_budget", "snr"] = "link_budget"
    tx_power_dbm: Finite = 12.0
    noise_figure_db: Finite = 12.0
    temperature_k: Positive = 290.0
    snr_db: Finite = 10.0


class Receivers(Node):
    velocity_method: Literal["auto", "omp", "latin_union"] = "auto"
    false_alarm_rate: Annotated[float, Field(gt=0, lt=0.1)] = 1e-6
    """Of one cell of the range-Doppler map."""
    guard_cells: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = (3, 3)
    training_cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (8, 6)
    """Range, Doppler; on each side."""
    cluster_cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (1, 1)
    max_detections: Annotated[int, Field(ge=1, le=10_000)] = 64
    min_range_m: Annotated[float, Field(ge=0)] = 2.0
    active_every_frames: Annotated[int, Field(ge=1)] = 1
    """The AT processes one frame in so many."""


class Tracking(Node):
    acceleration_std_mps2: Positive = 1.0
    gate_probability: Annotated[float, Field(gt=0.5, lt=1)] = 0.999
    confirm_hits: Annotated[int, Field(ge=1)] = 3
    confirm_window: Annotated[int, Field(ge=1)] = 5
    drop_misses: Annotated[int, Field(ge=1)] = 8


class Scenario(Node):
    """Everything that a run depends on."""

    name: str = "unnamed"
    seed: Annotated[int, Field(ge=0)] = 1
    frames: Annotated[int, Field(ge=1)] = 100
    frame_interval_s: Positive | None = None
    """From the start of a frame to the next; null: contiguous frames."""
    radio: Radio = Radio()
    array: Array = Array()
    modulation: Modulation = Modulation()
    swarm: dict[str, Uav]
    city: City | None = None
    propagation: Propagation = Propagation()
    clutter: Clutter = Clutter()
    noise: Noise = Noise()
    receivers: Receivers = Receivers()
    tracking: Tracking = Tracking()
