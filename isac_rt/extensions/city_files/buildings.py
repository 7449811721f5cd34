"""Buildings among the polygons of a map, and their heights: by the tags of OpenStreetMap where a
file has them, else by a property with heights."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import shapely
from pydantic_core import from_json

from isac_rt.world import settings
from isac_rt.world.city.heights import parse_length, roof_over_ground
from isac_rt.world.city.materials import CityError

Tags = Mapping[str, Any]
OTHER_KEYS = tuple(
    "landuse natural water waterway leisure amenity highway railway aeroway man_made barrier power "
    "place boundary tourism".split()
)
"""Keys of OpenStreetMap that say what a polygon without a building tag is."""
STOREY_M = 3.0
"""Height of a storey: that of OpenStreetMap's Simple 3D Buildings."""
PLATE_M = 0.3
"""Thickness of a roof without walls."""
REPLACED_SHARE = 0.5
"""Building parts replace an outline of which they cover at least this share; else both stand."""
_HEIGHTS = ("height", "building:height", "est_height", "measuredHeight", "gesamthoehe")
"""Keys of heights beside the scenario's own: OpenStreetMap's, CityGML's, swissBUILDINGS3D's."""
_CALLED_HEIGHT = re.compile(
    r"height|hgt|hoe?he|höhe|hoogte|hauteur|altura|altezza|wysoko|^h(_?m)?$|_h$|^h_", re.IGNORECASE
)
_OTHER_HEIGHT = re.compile(r"min|base|ground|roof|sea|above|boden|sol$|terrain|unit", re.IGNORECASE)
"""Heights of something else than of a building's top over its ground."""
_NO = ("no", "none", "false", "0", "")
_HSTORE = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')


@dataclass(frozen=True)
class Feature:
    """A thing of a map: its polygons in coordinates of the file, empty if it has none, what the
    file says of it, and how messages call it."""

    shape: shapely.Geometry
    properties: Tags
    what: str


@dataclass(frozen=True)
class Roof:
    """A roof as OpenStreetMap tells it: `flat`, `gabled`, `hipped` or `pyramidal`, its own height
    [m] or None, and whether its ridge runs across the longer side."""

    shape: str = "flat"
    height: float | None = None
    across: bool = False


@dataclass(frozen=True)
class Outline:
    """A footprint to be extruded.

    Parameters
    ----------
    shape : shapely.Geometry
    what : str
        For messages.
    height : float or None
        Of the highest point over the ground [m]; None if nobody says.
    above : float
        Of the lowest point over the ground. [m]
    roof : Roof
    foot : float or None
        Where it stands [m]; None: on the ground, wherever that is.
    """

    shape: shapely.Geometry
    what: str
    height: float | None
    above: float = 0.0
    roof: Roof = Roof()
    foot: float | None = None


def tags_of(properties: Tags) -> dict[str, Any]:
    """Return a feature's tags: flat, under `tags`, or in GDAL's `other_tags`."""
    found = dict(properties)
    inner, other = properties.get("tags"), properties.get("other_tags")
    if isinstance(inner, str) and inner.startswith("{"):
        try:
            inner = from_json(inner)
        except ValueError:
            inner = None
    if isinstance(inner, dict):
        found |= inner
    if isinstance(other, str):
        found |= {key: value for key, value in _HSTORE.findall(other) if key not in properties}
    return found


def _says(tags: Tags, key: str) -> bool:
    return key in tags and tags[key] is not None and str(tags[key]).strip().lower() not in _NO


def _value(tags: Tags, key: str) -> Any:
    """A property, however it is capitalised (Shapefiles know capitals only)."""
    if key in tags:
        return tags[key]
    low = key.casefold()
    return next((value for name, value in tags.items() if str(name).casefold() == low), None)


@dataclass
class _Heights:
    """Reads heights, and counts those that are none."""

    city: settings.City
    read: int = 0
    wrong: list[str] = field(default_factory=list)

    def metres(self, tags: Tags, what: str, *keys: str) -> float | None:
        """Return the length under the first key that holds one; zero is none, and a negative number
        is how tables write that it is not known."""
        for key in keys:
            value = _value(tags, key)
            if isinstance(value, int | float) and value < 0:
                continue
            try:
                found = parse_length(value)
            except ValueError as problem:
                self.wrong.append(f"{what}: {key} {problem}")
                continue
            if found:
                self.read += 1
                return found
        return None

    def levels(self, tags: Tags, what: str, *keys: str) -> float | None:
        """Height of so many storeys. [m]"""
        found = self.metres(tags, what, *keys)
        return None if found is None else found * STOREY_M

    def outline(self, feature: Feature, tags: Tags) -> Outline:
        """A building as its tags describe it."""
        what, own = feature.what, self.city.height_property
        keys = dict.fromkeys((own, *_HEIGHTS))
        height = self.metres(tags, what, *keys)
        roof = self.metres(tags, what, "roof:height", "roof_height")
        if roof is None:
            roof = self.levels(tags, what, "roof:levels")
        if height is None:
            storeys = self.levels(tags, what, "building:levels", "levels", "num_floors")
            height = storeys if storeys is None else storeys + (roof or 0.0)
        if height is None:
            height = roof_over_ground(tags)
        above = self.metres(tags, what, "min_height", "building:min_height")
        if above is None:
            above = self.levels(tags, what, "building:min_level", "min_floor") or 0.0
        if tags.get("building") == "roof" or tags.get("building:part") == "roof":
            above = max(above, (height or self.city.default_height_m) - PLATE_M)
        said = str(tags.get("roof:shape") or tags.get("roof_shape") or "flat").strip().lower()
        across = str(tags.get("roof:orientation", "")).strip().lower() == "across"
        return Outline(feature.shape, what, height, above, Roof(said, roof, across))

    def tell(self, given: int, notes: list[str]) -> None:
        """Say what was no height.

        Raises
        ------
        CityError  If nothing was one.
        """
        if self.wrong and not self.read:
            raise CityError(f"{self.wrong[0]}; correct it, or name another city.height_property")
        if self.wrong:
            notes.append(
                f"{len(self.wrong)} heights of {given} buildings that are none, such as of "
                f"{self.wrong[0]}: taken as unknown"
            )


def buildings(
    features: Sequence[Feature], city: settings.City, name: str, notes: list[str]
) -> list[Outline]:
    """The buildings among the features of a map.

    Parameters
    ----------
    features : sequence of Feature
    city : settings.City
        Which property holds heights, and how high a storey is.
    name : str
        Of the file, for messages.
    notes : list of str
        Grows by what was left out and assumed.

    Raises
    ------
    CityError  If there is none.
    """
    tags = [tags_of(feature.properties) for feature in features]
    mapped = any(_says(t, "building") or _says(t, "building:part") for t in tags)
    heights, left, found, parts = _Heights(city), Counter[str](), list[Outline](), list[Outline]()
    for feature, own in zip(features, tags, strict=True):
        reason = _no_building(feature, own, city, mapped)
        if reason:
            left[reason] += 1
            continue
        outline = heights.outline(feature, own)
        (parts if _says(own, "building:part") else found).append(outline)
    if left:
        counted = ", ".join(f"{count} {why}" for why, count in left.most_common(8))
        more = left.total() - sum(count for _, count in left.most_common(8))
        rest = f", {more} others" if more else ""
        notes.append(f"left out as no buildings: {counted}{rest}")
    if not found and not parts:
        said = notes[-1] if left else "it holds nothing"
        raise CityError(f"{name}: there is no polygon of a building in it ({said}); give buildings")
    heights.tell(len(found) + len(parts), notes)
    missing = sum(outline.height is None for outline in (*found, *parts))
    if 2 * missing > len(found) + len(parts) and (likely := _likely_height(tags)):
        notes.append(f"{likely!r} looks like a height: is city.height_property: {likely} meant?")
    return [*_without_parts(found, parts, notes), *parts]


def _likely_height(tags: Sequence[Tags]) -> str | None:
    """Return the property that is called a height in some language and is one in most features."""
    found = Counter[str]()
    for name, value in (item for own in tags for item in own.items()):
        if _CALLED_HEIGHT.search(str(name)) and not _OTHER_HEIGHT.search(str(name)):
            with suppress(ValueError):
                found[str(name)] += bool(parse_length(value))
    best, count = found.most_common(1)[0] if found else ("", 0)
    return best[:60] if 2 * count > len(tags) else None


def _no_building(feature: Feature, tags: Tags, city: settings.City, mapped: bool) -> str | None:
    """Return what a feature is that is no building; None if it is one."""
    if feature.shape.is_empty:
        return "without a polygon"
    if _says(tags, "is_underground") or tags.get("location") == "underground":
        return "underground"
    if _says(tags, "building") or _says(tags, "building:part"):
        return "underground" if _says(tags, "tunnel") else None
    other = next((key for key in OTHER_KEYS if isinstance(tags.get(key), str)), None)
    if mapped:
        return f"of {other}" if other else "without a building tag"
    high = any(_value(tags, key) is not None for key in (city.height_property, "height"))
    return f"of {other}" if other and not high else None


def _without_parts(found: list[Outline], parts: list[Outline], notes: list[str]) -> list[Outline]:
    """The outlines that building parts do not replace."""
    if not parts or not found:
        return found
    inner = shapely.point_on_surface([shapely.make_valid(part.shape) for part in parts])
    area = shapely.area([part.shape for part in parts])
    shapes = [shapely.make_valid(outline.shape) for outline in found]
    outer, inside = shapely.STRtree(inner).query(shapes, predicate="contains")
    covered = Counter[int]()
    for whole, part in zip(outer.tolist(), inside.tolist(), strict=True):
        covered[whole] += area[part]
    replaced = {i for i, of in covered.items() if of >= REPLACED_SHARE * shapes[i].area}
    if replaced:
        used = sum(whole in replaced for whole in outer.tolist())
        notes.append(f"{len(replaced)} buildings drawn by their {used} parts")
    if len(covered) > len(replaced):
        notes.append(
            f"{len(covered) - len(replaced)} buildings whose parts cover less than half of them "
            "stand beside their parts"
        )
    return [outline for i, outline in enumerate(found) if i not in replaced]


def moved(outline: Outline, shape: shapely.Geometry) -> Outline:
    """The same elsewhere."""
    return replace(outline, shape=shape)
