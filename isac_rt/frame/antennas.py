"""Arrays in the body frame, L-shaped or with their elements anywhere in a plane, and element
patterns.

Body frame: X to the right, Y along the boresight, Z up. Each of the two arrays is given about its
own centroid, which is the body's position.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from isac_rt.frame.link import Link
from isac_rt.frame.settings import Array, Elements
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.settings import AspectTable
from isac_rt.world.aspect import in_table

PatternModel = Literal["isotropic", "sector", "cosine", "table"]
Layout = tuple[tuple[float, float], ...]
"""Elements of an array by (x, z) in its plane [m], from any origin."""

SAME_POSITION_M = 1e-6
"""Elements nearer than this along an axis do not tell directions along it."""


@lru_cache(maxsize=64)
def l_shape(num_x: int, num_z: int, spacing: float, step_x: int = 1, step_z: int = 1) -> np.ndarray:
    """Elements of an L (num_x + num_z - 1, 3) [m] about their centroid.

    Order as in the paper: element 0 is farthest along X, then inwards to the corner (index
    ``num_x - 1``), then up along Z. Neighbours stand `step_x` (`step_z`) spacings apart.
    """
    x = np.concatenate([np.arange(num_x)[::-1] * step_x, np.zeros(num_z - 1)])
    z = np.concatenate([np.zeros(num_x), np.arange(1, num_z) * step_z])
    positions = spacing * np.stack([x, np.zeros_like(x), z], axis=1)
    positions -= positions.mean(axis=0)
    positions.setflags(write=False)
    return positions


@lru_cache(maxsize=64)
def centred(layout: Layout) -> np.ndarray:
    """Elements (L, 3) [m] in the body frame about their centroid."""
    x, z = np.array(layout, float).reshape(-1, 2).T
    positions = np.stack([x, np.zeros_like(x), z], axis=1)
    positions -= positions.mean(axis=0)
    positions.setflags(write=False)
    return positions


def folded(cosines: npt.ArrayLike, cosine_period: npt.ArrayLike) -> np.ndarray:
    """Direction cosines (..., 2), or differences of some, less the multiples of `cosine_period`
    (2,) that they are nearest to (`Antennas.cosine_period`)."""
    u = np.asarray(cosines)
    finite = np.where(np.isfinite(cosine_period), cosine_period, 0.0)
    return np.asarray(u - finite * np.round(u / cosine_period))


def unit_vector(cosines: npt.ArrayLike) -> np.ndarray:
    """Body-frame unit vectors (..., 3) of direction cosines (u_x, u_z) (..., 2) in the front
    half-space; outside the unit disc the Y component is 0."""
    u_x, u_z = np.moveaxis(np.asarray(cosines), -1, 0)
    forward = np.sqrt(np.maximum(1 - u_x**2 - u_z**2, 0.0))
    return np.stack([u_x, forward, u_z], axis=-1)


def azimuth_elevation(cosines: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation [rad] (...) of direction cosines (u_x, u_z) (..., 2) in the front
    half-space; NaN outside the unit disc."""
    u_x, u_z = np.moveaxis(np.asarray(cosines), -1, 0)
    forward = 1 - u_x**2 - u_z**2
    seen = np.where(forward >= 0, 1.0, np.nan)
    return np.arctan2(u_x, np.sqrt(np.maximum(forward, 0.0))) * seen, np.arcsin(u_z * seen)


@dataclass(frozen=True, kw_only=True)
class Antennas:
    """The transmit and receive arrays of a terminal and the pattern of their elements.

    Both are an L each, or `placed` element by element.

    Attributes
    ----------
    tx_x, tx_z, rx_x, rx_z : elements along each arm of an L, the corner counted in both
    spacing : distance of an L's neighbouring receive elements d_a [m]; transmit elements stand rx_x
        (rx_z) of these apart, so that an echo sees a gapless virtual L
    tx_layout, rx_layout : elements of any two arrays in the plane, in place of the L's; None: the
        L's
    gain : power gain of an element on boresight (linear); with ``isotropic`` everywhere
    pattern : "isotropic"; "sector": `gain` inside the field of view, nothing outside;
        "cosine": gain * cos(angle)^q in the front hemisphere, q = gain/2 - 1 so that it radiates
        its own power, and at least 0; "table": gain times that of `table`
    table : decibels over `gain` by direction, for "table"
    half_view : half of the field of view per axis [rad]; what lies outside has no place in the
        estimates (for "sector" nothing is sent or received there)

    Examples
    --------
    Two transmit elements four receive elements apart: a row of eight virtual ones.

    >>> a = Antennas.placed([(0, 0), (0.008, 0)], [(0.002 * i, 0) for i in range(4)])
    >>> (1e3 * a.virtual_positions[:, 0]).round(3).tolist()
    [-7.0, -5.0, -3.0, -1.0, 1.0, 3.0, 5.0, 7.0]
    """

    tx_x: int = 1
    tx_z: int = 1
    rx_x: int = 1
    rx_z: int = 1
    spacing: float = 0.0
    tx_layout: Layout | None = None
    rx_layout: Layout | None = None
    gain: float = 1.0
    pattern: PatternModel = "isotropic"
    half_view: float = np.pi / 3
    table: AspectTable | None = None

    @classmethod
    def placed(cls, tx: npt.ArrayLike, rx: npt.ArrayLike, **element: Any) -> Antennas:
        """Arrays with their elements at (x, z), (L_tx, 2) and (L_rx, 2) [m].

        `element`: gain, pattern and half_view.

        Raises
        ------
        ValueError  If these are no two lists of finite places, one at least in each.
        """
        layouts = {}
        for name, value in (("tx", tx), ("rx", rx)):
            array = np.asarray(value, float)
            if array.ndim != 2 or array.shape[1] != 2 or not array.size:
                raise ValueError(
                    f"{name}: needs positions (x, z) of (L, 2) numbers, not {array.shape}"
                )
            if not np.isfinite(array).all():
                raise ValueError(f"{name}: places must be finite numbers [m]")
            layouts[name] = tuple((float(x), float(z)) for x, z in array)
        return cls(tx_layout=layouts["tx"], rx_layout=layouts["rx"], **element)

    @property
    def num_tx(self) -> int:
        return self.tx_x + self.tx_z - 1 if self.tx_layout is None else len(self.tx_layout)

    @property
    def num_rx(self) -> int:
        return self.rx_x + self.rx_z - 1 if self.rx_layout is None else len(self.rx_layout)

    @property
    def tx_positions(self) -> np.ndarray:
        """(num_tx, 3) [m] body frame, about the centroid."""
        if self.tx_layout is not None:
            return centred(self.tx_layout)
        return l_shape(self.tx_x, self.tx_z, self.spacing, self.rx_x, self.rx_z)

    @property
    def rx_positions(self) -> np.ndarray:
        """(num_rx, 3) [m] body frame, about the centroid."""
        if self.rx_layout is not None:
            return centred(self.rx_layout)
        return l_shape(self.rx_x, self.rx_z, self.spacing)

    @property
    def virtual_positions(self) -> np.ndarray:
        """(num_tx num_rx, 3) [m] of an echo's virtual channels, transmit element by transmit
        element: the sums of both ends' places."""
        return (self.tx_positions[:, None] + self.rx_positions[None]).reshape(-1, 3)

    def cosine_period(self, wavelength: float, passes: int) -> np.ndarray:
        """(2,) shifts of u_x and u_z that turn no channel of an echo (passes = 2) or no receive
        element against another: the wavelength over the step of which all their distances along
        the axis are multiples. inf: none."""
        return wavelength * _cosine_period(self, passes)

    def observes(self, passes: int) -> tuple[bool, bool]:
        """Return whether directions along X and along Z are observable: the channels of an echo
        (passes = 2), or the receive elements for one pass, span that axis."""
        return self.places(passes)[0] > 1, self.places(passes)[1] > 1

    def places(self, passes: int) -> tuple[int, int]:
        """Numbers of different places along X and along Z of the channels of an echo (passes = 2),
        or of the receive elements."""
        return _places(self, passes)

    @property
    def view_limit(self) -> float:
        """Largest |u_x| and |u_z| of the field of view."""
        return float(np.sin(min(self.half_view, np.pi / 2)))

    def in_view(self, direction: np.ndarray) -> np.ndarray:
        """Mark the body-frame unit vectors (..., 3) in the field of view on both axes."""
        limit = self.view_limit
        return (
            (direction[..., 1] > 0)
            & (np.abs(direction[..., 0]) <= limit)
            & (np.abs(direction[..., 2]) <= limit)
        )

    @property
    def look_back(self) -> bool:
        """True if elements radiate or receive behind the plane across their boresight."""
        return self.pattern == "isotropic" or (self.pattern != "sector" and self.table is not None)

    def element_gain(self, direction: np.ndarray) -> np.ndarray:
        """Power gain of an element towards body-frame unit vectors (..., 3) (linear)."""
        if self.pattern == "isotropic":
            return np.full(direction.shape[:-1], self.gain)
        if self.pattern == "sector":
            return np.where(self.in_view(direction), self.gain, 0.0)
        if self.table is not None:
            return self.gain * 10 ** (in_table(self.table, direction) / 10)
        exponent = max(self.gain / 2 - 1, 0.0)
        forward = np.clip(direction[..., 1], 0.0, None)
        return self.gain * np.where(forward > 0, forward**exponent, 0.0)


@dataclass(frozen=True)
class Arrays:
    """Antennas of all terminals of a run, with the same number of transmit elements each.

    Attributes
    ----------
    common : of the terminals that have none of their own
    own : of the others, by name

    Examples
    --------
    >>> four, eight = (Antennas.placed([(0, 0)], [(0.002 * i, 0) for i in range(n)])
    ...                for n in (4, 8))
    >>> arrays = Arrays(four, {"PT1": eight})
    >>> arrays.of("AT").num_rx, arrays.at(Link("AT", "PT1")).num_rx
    (4, 8)
    """

    common: Antennas
    own: Mapping[str, Antennas] = field(default_factory=dict)

    def of(self, name: str) -> Antennas:
        """Return the antennas of a terminal."""
        return self.own.get(name, self.common)

    def at(self, link: Link) -> Antennas:
        """Return the antennas that a link's receiver works with: the transmitter's transmit
        elements and its own receive elements and field of view. `gain` is the geometric mean of
        both ends'; `element_gain` has no meaning unless both ends have the same antennas."""
        sent, received = (self.of(name) for name in link)
        if sent == received:
            return received
        places = tuple((float(x), float(z)) for x, _, z in sent.tx_positions)
        return replace(received, tx_layout=places, gain=float(np.sqrt(sent.gain * received.gain)))

    def __iter__(self) -> Iterator[Antennas]:
        yield self.common
        yield from self.own.values()


@lru_cache(maxsize=64)
def _places(antennas: Antennas, passes: int) -> tuple[int, int]:
    positions = antennas.virtual_positions if passes == 2 else antennas.rx_positions
    return different(positions[:, 0]), different(positions[:, 2])


def different(along: np.ndarray) -> int:
    """Number of different places among those of elements (L,) [m]."""
    return np.unique(np.round(along / SAME_POSITION_M)).size


@lru_cache(maxsize=64)
def _cosine_period(antennas: Antennas, passes: int) -> np.ndarray:
    """`Antennas.cosine_period` of a wavelength of 1 m: the steps by Euclid's algorithm."""
    places = antennas.virtual_positions if passes == 2 else antennas.rx_positions
    steps = np.zeros(2)
    for axis, along in enumerate(places[:, [0, 2]].T):
        for spacing in along - along.min():
            while spacing > SAME_POSITION_M:
                rest = steps[axis] % spacing
                steps[axis], spacing = spacing, rest if spacing - rest > SAME_POSITION_M else 0.0
    with np.errstate(divide="ignore"):
        return 1 / steps


def _layout_of(elements: Elements | None, waveform: Waveform, cascade: int) -> Layout | None:
    """Elements that a scenario states; `cascade`: 0 for sending, 1 for receiving."""
    if elements is None:
        return None
    if elements.shape == "ti_cascade":
        return ti_cascade()[cascade]
    unit = waveform.wavelength if elements.unit == "wavelengths" else 1.0
    if elements.shape == "positions":
        return tuple((unit * x, unit * z) for x, z in elements.positions or ())
    rows = elements.rows if elements.shape == "planar" else 1
    d_x, d_z = (unit * d for d in elements.spacing)
    return tuple((d_x * i, d_z * k) for k in range(rows) for i in range(elements.columns))


def antennas_of(a: Array, waveform: Waveform) -> Antennas:
    """The arrays that a scenario states; the spacing is in wavelengths of the carrier f_c."""
    return Antennas(
        tx_layout=_layout_of(a.tx, waveform, 0),
        rx_layout=_layout_of(a.rx, waveform, 1),
        tx_x=a.tx_x,
        tx_z=a.tx_z,
        rx_x=a.rx_x,
        rx_z=a.rx_z,
        spacing=a.spacing_wavelengths * waveform.wavelength,
        gain=10 ** (a.element_gain_dbi / 10),
        pattern=a.element_pattern,
        table=a.pattern,
        half_view=np.deg2rad(a.field_of_view_deg) / 2,
    )


CASCADE_HZ = 76.8e9
"""Frequency at whose half wavelengths TI's cascade board places its elements."""
_CASCADE_RX = (11, 12, 13, 14, 50, 51, 52, 53, 46, 47, 48, 49, 0, 1, 2, 3)
_CASCADE_TX = (11, 10, 9, 32, 28, 24, 20, 16, 12, 8, 4, 0)
_CASCADE_TX_UP = (6, 4, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0)


def ti_cascade() -> tuple[Layout, Layout]:
    """Transmit (12) and receive (16) elements of TI's 4-chip cascade board MMWCAS-RF (x, z) [m], in
    the order of its channels.

    References
    ----------
    .. [1] Texas Instruments, "mmWave cascade imaging radar RF evaluation module user's guide",
       SWRU553; the numbers are those of TI's MATLAB examples (`module_params.m`).
    """
    half = SPEED_OF_LIGHT / CASCADE_HZ / 2
    tx = zip(_CASCADE_TX, _CASCADE_TX_UP, strict=True)
    return tuple((half * x, half * z) for x, z in tx), tuple((half * x, 0.0) for x in _CASCADE_RX)


def resolutions(waveform: Waveform, antennas: Antennas, passes: int) -> np.ndarray:
    """Resolution of range [m], velocity [m/s], u_x and u_z (4,).

    The array's is wavelength over aperture: that of the virtual array (transmit times receive
    elements of an arm) for an echo (passes = 2), of the receive array alone for one pass. It is
    beyond all angles along an axis that the array does not observe.
    """
    cells = [waveform.range_cell(passes), waveform.velocity_cell(passes)]
    in_arms = antennas.rx_layout is None and (passes == 1 or antennas.tx_layout is None)
    if not in_arms:
        positions = antennas.virtual_positions if passes == 2 else antennas.rx_positions
        return np.array(
            [*cells, *(waveform.wavelength / aperture_of(positions[:, i]) for i in (0, 2))]
        )
    across = antennas.rx_x * (antennas.tx_x if passes == 2 else 1)
    up = antennas.rx_z * (antennas.tx_z if passes == 2 else 1)
    step = waveform.wavelength / antennas.spacing
    return np.array([*cells, step / across, step / up])


def aperture_of(along: np.ndarray) -> float:
    """Length [m] of an array with elements at `along` (L,): from the first to the last and one mean
    step more, which is n d of a filled row; next to nothing where all stand at one place."""
    steps = different(along) - 1
    return float(np.ptp(along) * (steps + 1) / steps) if steps else SAME_POSITION_M
