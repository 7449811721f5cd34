"""Where a city lies on Earth: its coordinate reference system, and the way to metres about an
origin."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isac_rt.world.city.materials import CityError

LONLAT_FOOTPRINT = 0.05
"""No building is this many degrees across (5 km), and hardly any is this few metres."""
LONLAT = "OGC:CRS84"
LARGEST_SCALE_ERROR = 0.005
"""Of a grid whose units are taken for metres: national grids and UTM stay below 0.001, Web Mercator
is off by 1/cos(latitude)."""
MAX_CRS_TEXT = 100_000
"""Letters of a coordinate reference system."""
_OF_FILES = re.compile(r"init\s*=|grids\s*=|parameter_?file|^\s*\{.*\\", re.IGNORECASE | re.DOTALL)
"""What makes PROJ open a file that the text names; backslashes of JSON could hide it."""
_AUTHORITY = re.compile(
    r"(EPSG|ESRI|IGNF|OGC(?=[:/](?:[\d.]*[:/])?CRS))[:/](?:[\d.]*[:/])?(\w{1,20})", re.IGNORECASE
)
_WHOLE_M = 100.0
"""An origin that is chosen lies at whole multiples of this."""


@dataclass(frozen=True)
class GeoReference:
    """Relation between world coordinates and those of a city's file.

    Parameters
    ----------
    crs : str
        Name of the file's coordinate reference system, such as ``EPSG:2056``; "" if unknown.
    origin : (x, y, z)
        The world's origin in coordinates of the file, longitude first.
    plane : str
        PROJ text of the plane about the origin that the world lies in; "" where world coordinates
        are those of the file less the origin.
    """

    crs: str
    origin: tuple[float, float, float]
    plane: str = ""

    @cached_property
    def _geodetic(self) -> Any:
        """From the file's coordinates to longitude and latitude; None where they are these."""
        from pyproj import CRS, Transformer

        crs = CRS.from_user_input(self.crs)
        if crs.is_geographic or crs.geodetic_crs is None:
            return None
        return Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)

    @cached_property
    def _plane(self) -> Any:
        from pyproj import Proj

        return Proj(self.plane)

    @property
    def is_lonlat(self) -> bool:
        """Return whether the file's coordinates are longitude and latitude."""
        return bool(self.plane) and self._geodetic is None

    def to_world(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 2) or (N, 3) of the file to metres about the origin."""
        out = np.array(points, dtype=np.float64)
        if self.plane:
            x, y = points[:, 0], points[:, 1]
            if self._geodetic is not None:
                x, y = self._geodetic.transform(x, y)
            out[:, 0], out[:, 1] = self._plane(x, y)
        else:
            out[:, :2] -= self.origin[:2]
        out[:, 2:] -= self.origin[2]
        return out

    def to_file(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 2) or (N, 3) of the world [m] to coordinates of the file."""
        out = np.array(points, dtype=np.float64)
        if self.plane:
            x, y = self._plane(points[:, 0], points[:, 1], inverse=True)
            if self._geodetic is not None:
                x, y = self._geodetic.transform(x, y, direction="INVERSE")
            out[:, 0], out[:, 1] = x, y
        else:
            out[:, :2] += self.origin[:2]
        out[:, 2:] += self.origin[2]
        return out

    def from_degrees(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) by longitude, latitude [degrees] and height [m] of the file to metres about
        the origin, of a place whose `crs` is known."""
        from pyproj import Transformer

        out = np.array(points, dtype=np.float64)
        if self.plane:
            out[:, 0], out[:, 1] = self._plane(points[:, 0], points[:, 1])
            out[:, 2] -= self.origin[2]
            return out
        grid = Transformer.from_crs(LONLAT, self.crs, always_xy=True)
        out[:, 0], out[:, 1] = grid.transform(points[:, 0], points[:, 1])
        return self.to_world(out)

    def words(self) -> str:
        """One sentence for people."""
        x, y, z = self.origin
        above = f", height {z:g} m" if z else ""
        if not self.plane:
            return f"world origin at {x:.10g}, {y:.10g}{above} of {self.crs or 'the file'}"
        unit = "longitude {:.7f}, latitude {:.7f} degrees" if self._geodetic is None else "{}, {}"
        named = "" if self._geodetic is None else f" of {self.crs}"
        return f"world origin at {unit.format(x, y)}{above}{named} (azimuthal equidistant, WGS 84)"


def plane_about(lon: float, lat: float) -> str:
    """PROJ text of the plane of a point: azimuthal equidistant, WGS 84.

    Distances from the point are exact; elsewhere they are off by about (r / 6400 km)^2 / 6: 1e-8 at
    2 km.
    """
    return f"+proj=aeqd +lat_0={lat!r} +lon_0={lon!r} +ellps=WGS84"


def is_lonlat(boxes: NDArray[np.float64]) -> bool:
    """Return whether footprints look like degrees.

    Parameters
    ----------
    boxes : (B, 4) float64
        West, south, east, north of each footprint, in the file's unit.
    """
    west, south, east, north = boxes.T
    in_range = (west >= -180) & (east <= 180) & (south >= -90) & (north <= 90)
    size = np.median(np.maximum(east - west, north - south))
    return bool(in_range.mean() > 0.5 and size < LONLAT_FOOTPRINT)


def crs_name(text: str) -> str | None:
    """The name of a horizontal coordinate reference system, of what a file or a key says of it;
    None if it is unknown.

    Examples
    --------
    >>> crs_name("urn:ogc:def:crs:EPSG::3857"), crs_name("https://www.opengis.net/def/crs/EPSG/0/7415")
    ('EPSG:3857', 'EPSG:28992')
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if len(text) > MAX_CRS_TEXT or _OF_FILES.search(text):
        return None
    found = _AUTHORITY.search(text[:2000])
    try:
        crs: Any = CRS.from_user_input(f"{found[1]}:{found[2]}" if found else text)
        while crs.is_compound or crs.is_bound:
            crs = crs.sub_crs_list[0] if crs.is_compound else crs.source_crs
        if crs.is_geocentric or crs.is_vertical:
            return None
        crs = crs.to_2d()
        known = crs.to_authority(min_confidence=100)
        return ":".join(known) if known else str(crs.to_wkt())
    except (CRSError, AttributeError, TypeError):
        return None


def georeference_of(
    boxes: NDArray[np.float64],
    crs: str,
    coordinates: str,
    origin: Sequence[float] | None,
    name: str,
) -> GeoReference:
    """Where a city lies.

    Parameters
    ----------
    boxes : (B, 4) float64
        West, south, east, north of each footprint, in the file's unit.
    crs : str
        As `crs_name` gives it; "" if the file says nothing.
    coordinates : {'auto', 'metres', 'lonlat'}
        What the scenario says.
    origin : 2 or 3 numbers, optional
        In the file's coordinates; by default the middle of the footprints where there is a plane to
        lie in, else that of the file.
    name : of the file, for messages

    Raises
    ------
    CityError  If the coordinates cannot be what they are said to be.
    """
    if coordinates == "lonlat" or (coordinates == "auto" and is_lonlat(boxes)):
        crs = crs if crs and _is_geographic(crs) else LONLAT
    elif coordinates == "metres":
        crs = ""
    elif not crs:
        return GeoReference("", _three(origin or (0.0, 0.0)))
    if not crs:
        return GeoReference("", _three(origin or (0.0, 0.0)))
    if _is_geographic(crs):
        _check_degrees(boxes, name)
    middle = (boxes[:, :2].min(axis=0) + boxes[:, 2:].max(axis=0)) / 2
    x, y, z = _three(origin or (float(middle[0]), float(middle[1])))
    try:
        lon, lat, metric = _on_earth(crs, x, y)
    except RuntimeError as error:  # of PROJ
        raise CityError(
            f"{name}: {crs[:80]} leads nowhere on Earth ({str(error)[:200]}); correct city.crs"
        ) from None
    if not (abs(lon) <= 360 and abs(lat) <= 90):
        raise CityError(
            f"{name}: {x:.10g}, {y:.10g} lies outside of {crs}; correct city.crs or city.origin"
        )
    if metric:
        return GeoReference(crs, _three(origin or (0.0, 0.0)))
    return GeoReference(crs, (x, y, z), plane_about(lon, lat))


def _three(numbers: Sequence[float]) -> tuple[float, float, float]:
    return float(numbers[0]), float(numbers[1]), float(numbers[2]) if len(numbers) > 2 else 0.0


def _is_geographic(crs: str) -> bool:
    from pyproj import CRS

    return bool(CRS.from_user_input(crs).is_geographic)


def _on_earth(crs: str, x: float, y: float) -> tuple[float, float, bool]:
    """Longitude and latitude of a point [degrees], and whether a unit of its grid is a metre on the
    ground there."""
    from pyproj import CRS, Proj, Transformer

    system = CRS.from_user_input(crs)
    if system.is_geographic:
        return x, y, False
    if system.geodetic_crs is None:  # a building site's own
        return 0.0, 0.0, True
    lon, lat = Transformer.from_crs(system, system.geodetic_crs, always_xy=True).transform(x, y)
    if not (np.isfinite(lon) and np.isfinite(lat)):
        return np.inf, np.inf, False
    unit = system.axis_info[0].unit_conversion_factor
    factors = Proj(system).get_factors(lon, lat)
    scales = np.array([factors.meridional_scale, factors.parallel_scale]) * unit
    return float(lon), float(lat), bool((np.abs(scales - 1) < LARGEST_SCALE_ERROR).all())


def _check_degrees(boxes: NDArray[np.float64], name: str) -> None:
    """Refuse degrees that are none."""
    if np.median(np.abs(boxes[:, [1, 3]])) > 90:
        worst = float(boxes[:, [1, 3]].flat[np.argmax(np.abs(boxes[:, [1, 3]]))])
        raise CityError(
            f"{name}: latitude {worst:g} is beyond 90 degrees; longitude and latitude are swapped "
            "(GeoJSON has longitude first), or the file is in metres: city.coordinates: metres, or "
            "city.crs"
        )
    if np.median(np.abs(boxes[:, [0, 2]])) > 180:
        raise CityError(
            f"{name}: a longitude is beyond 180 degrees; if the file is in metres, set "
            "city.coordinates: metres, or city.crs"
        )


def local_origin(
    georeference: GeoReference, point: NDArray[np.float64]
) -> tuple[float, float, float]:
    """An origin near a world point (3,) in coordinates of the file: in a grid at whole hundreds of
    metres, so that people can add it."""
    found = georeference.to_file(point[None])[0]
    if georeference.is_lonlat:
        return round(float(found[0]), 7), round(float(found[1]), 7), round(float(found[2]))
    x, y = np.round(found[:2] / _WHOLE_M) * _WHOLE_M
    return float(x), float(y), round(float(found[2]))
