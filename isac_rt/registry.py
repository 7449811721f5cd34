"""Parts that are imported by name: those that a scenario or a command line chooses among, this
package's own and those that installed packages register by an entry point of the group
`isac_rt.KIND`, and those that the core takes from the extensions.

A part is imported when it is used. Its page in the documentation is *extending*.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from isac_rt.runtime import UserError


@dataclass(frozen=True)
class Registry:
    """The parts of one kind, and the type of a setting that names one of them.

    Parameters
    ----------
    kind : the entry points' group is ``isac_rt.KIND``
    own : "module:object" of this package by name; no other package may take such a name

    Examples
    --------
    >>> PROPAGATION_MODELS.load("free_space").__name__
    'free_space'
    """

    kind: str
    own: Mapping[str, str]

    def installed(self) -> dict[str, EntryPoint]:
        """The parts of other packages by name."""
        entries = entry_points(group=f"isac_rt.{self.kind}")
        return {part.name: part for part in entries if part.name not in self.own}

    def names(self) -> list[str]:
        """All names: this package's first, then the others' in alphabetical order."""
        return [*self.own, *sorted(self.installed())]

    def load(self, name: str) -> Any:
        """Import a part.

        Raises
        ------
        UserError  If no part has this name, or another package's cannot be imported.
        """
        if name in self.own:
            return _imported(self.own[name])
        if (part := self.installed().get(name)) is None:
            raise UserError(f"no {self.kind} {name}; there are {', '.join(self.names())}")
        try:
            return part.load()
        except Exception as problem:
            source = part.dist.name if part.dist else "another package"
            raise UserError(
                f"{name} of {source} ({part.value}) cannot be imported: "
                f"{type(problem).__name__}: {problem}; mend or uninstall {source}"
            ) from problem

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Check that a setting names a part; for `Annotated[str, REGISTRY]`."""
        from pydantic_core import core_schema  # the command line's help needs none of it

        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return {"type": "string", "enum": self.names()}

    def _checked(self, name: str) -> str:
        if name not in self.own and name not in self.installed():
            *most, last = self.names()
            raise ValueError(f"must be {', '.join(most)} or {last}")
        return name


def _imported(path: str) -> Any:
    module, _, attribute = path.partition(":")
    return getattr(import_module(module), attribute)


def extension(part: str) -> Any:
    """Import a part of `EXTENSIONS`."""
    return _imported(EXTENSIONS[part])


DETECTORS = Registry(
    "detectors",
    {
        "cfar": "isac_rt.receive.chain:cfar_with",
        "comb_cfar": "isac_rt.extensions.street.comb:CombCfar",
        "angle_doppler": "isac_rt.extensions.city_receivers.angle_doppler:AngleDoppler",
    },
)
"""Functions of the settings `Receivers` and an `Estimator` that return a `Detector`, for active
terminals."""
PASSIVE_DETECTORS = Registry(
    "passive_detectors",
    {
        "cfar": "isac_rt.receive.chain:cfar_with",
        "beams": "isac_rt.extensions.city_receivers.bistatic:BeamSearch",
    },
)
"""The same for passive terminals, whose detector is a `Cfar`."""
SYMBOL_READERS = Registry(
    "symbol_readers",
    {
        "powers": "isac_rt.receive.symbols:ByPowers",
        "beams": "isac_rt.extensions.city_receivers.beams:ByBeams",
    },
)
"""Functions of the DPSK order and of the least run of clutter cells (or None) that return a
`ByPowers`."""
PROPAGATION_MODELS = Registry(
    "propagation_models",
    {
        "free_space": "isac_rt.propagation.build:free_space",
        "ray_traced": "isac_rt.propagation.build:ray_traced",
    },
)
"""Functions of `isac_rt.propagation.build.Ground` that return a `Propagation`."""
CITY_SOURCES = Registry(
    "city_sources",
    {
        name: f"isac_rt.world.city.sources:{name}"
        for name in ("builtin", "mitsuba", "mesh", "footprints", "canyon", "blocks")
    },
)
"""Functions of the settings `City` and the scenario's folder that return a `CityParts`."""
COMMANDS = Registry("commands", {})
"""Functions with typer's annotations, whose docstring is the help."""
EXTENSIONS = {
    "equipment": "isac_rt.extensions.city_receivers.standard:equipment_of",
    "two_bounces": "isac_rt.extensions.two_bounces.two_bounces:TwoBounces",
    "walls": "isac_rt.extensions.city_receivers.walls:Walls",
    "expected_clutter": "isac_rt.extensions.city_receivers.expectation:MeshExpectation",
    "cooperation": "isac_rt.extensions.cooperation.swarm:Cooperation",
    "access": "isac_rt.extensions.access.protocol:establish_links",
    "feedback": "isac_rt.extensions.access.feedback:exchange",
    "front_end": "isac_rt.extensions.hardware.front_end:front_end_of",
    "front_ends": "isac_rt.extensions.hardware.front_end:Ends",
    "hardware_samples": "isac_rt.extensions.hardware.received:received",
    "hardware_noise_left_out": "isac_rt.extensions.hardware.received:noise_left_out",
    "calibration": "isac_rt.extensions.hardware.calibrate:load_calibration",
    "calibrated": "isac_rt.extensions.hardware.calibrate:ideal",
    "map_files": "isac_rt.extensions.city_files.tables:table_files",
    "map_buildings": "isac_rt.extensions.city_files.footprints:footprints",
    "flight_log": "isac_rt.extensions.flights.logs:flight_log",
    "traffic": "isac_rt.extensions.flights.traffic:traffic",
    "emitters": "isac_rt.extensions.street.emitters:Emitters",
    "emitters_plan": "isac_rt.extensions.street.emitters:plan_row",
    "with_foreign": "isac_rt.extensions.street.emitters:WithForeign",
    "excised": "isac_rt.extensions.street.excision:excised",
    "boxes": "isac_rt.extensions.street.boxes:Boxes",
    "box_corners": "isac_rt.extensions.street.boxes:box_corners",
    "section_of_extent": "isac_rt.extensions.street.extent:section_of",
    "corners_of_mesh": "isac_rt.extensions.street.solid:corners_of_mesh",
    "solid_of_box": "isac_rt.extensions.street.solid:solid_of_box",
    "weather": "isac_rt.extensions.street.weather:Weathered",
    "weather_plan": "isac_rt.extensions.street.weather:plan_rows",
    "antenna_pattern": "isac_rt.extensions.antenna_files.patterns:antenna_pattern",
    "points_of_rotors": "isac_rt.extensions.street.rotors:points_of",
    "moving_centres": "isac_rt.extensions.street.centres:moving_centres",
    "map_georeference": "isac_rt.extensions.city_files.footprints:located",
}
"""Parts that the core takes from its extensions: "module:object" by what it is there."""
