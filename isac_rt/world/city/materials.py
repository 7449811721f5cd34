"""Materials of the city's surfaces at the carrier.

Dielectric constants follow ITU-R P.2040 [1]_ where it has a fit at the carrier. Where it has none,
the rule by which a value is reached is stated in the material's `source`: interpolated between two
fits, continued beyond a fit, or taken from another model. P.2040 calls its frequency ranges
indicative, except those of the three grounds; these are replaced above 10 GHz.

Scattering coefficients are the field's weakest numbers: measured ones lie between 0.2 and 0.4 for
facades at UHF and microwaves [2]_, and nothing comparable is agreed at 77 GHz. The defaults here
stay in that range, ordered by roughness; `materials:` of the scenario overrides each.

References
----------
.. [1] Recommendation ITU-R P.2040, "Effects of building materials and structures on radiowave
propagation above about
   100 MHz", Table 3 (rows of revision 3).
.. [2] V. Degli-Esposti et al., "Measurement and modelling of scattering from buildings", IEEE
Trans. Antennas Propag. 55(1),
   2007, doi:10.1109/TAP.2006.888422.
.. [3] M. C. Dobson et al., "Microwave dielectric behavior of wet soil - Part II", IEEE Trans.
Geosci. Remote Sens. GE-23(1),
   1985, doi:10.1109/TGRS.1985.289498; adopted, to 1000 GHz, by Recommendation ITU-R P.527.
.. [4] H. J. Liebe, G. A. Hufford, T. Manabe, "A model for the complex permittivity of water at
frequencies below 1 THz",
   Int. J. Infrared Millim. Waves 12, 1991, doi:10.1007/BF01008897.
.. [5] C. Mätzler, "Microwave (1-100 GHz) dielectric model of leaves", IEEE Trans. Geosci. Remote
Sens. 32(4), 1994,
   doi:10.1109/36.298024.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from isac_rt.runtime import UserError
from isac_rt.world.settings import MaterialOverride

Pattern = Literal["lambertian", "directive", "backscattering"]
VACUUM_PERMITTIVITY = 8.8541878128e-12
"""[F/m]"""
MAX_MATERIALS = 1000
"""In a city."""


class CityError(UserError):
    """The city cannot be built from what the scenario says; the text says what, where and what to
    do, in one line: names in a file may be long and hold anything."""

    def __init__(self, text: str) -> None:
        line = "".join(c if c.isprintable() else " " for c in text)
        super().__init__(line if len(line) < 900 else f"{line[:600]} ... {line[-250:]}")


@dataclass(frozen=True)
class Material:
    """One material at the carrier.

    Parameters
    ----------
    name : str
    relative_permittivity : float
        Real part. [-]
    conductivity : float
        Everything that loses: the imaginary part of the permittivity is conductivity / (2 pi f
        eps_0). [S/m]
    scattering_coefficient : float
        S: the share S^2 of the reflected power leaves diffusely. [-]
    scattering_pattern : {'lambertian', 'directive', 'backscattering'}
    pattern_exponent : int
        Of both lobes of the last two patterns; the backscattering pattern has half its power in
        each lobe.
    thickness : float
        Of the slab that a face stands for. [m]
    source : str
        Where the numbers come from.
    """

    name: str
    relative_permittivity: float
    conductivity: float
    scattering_coefficient: float
    scattering_pattern: Pattern
    pattern_exponent: int
    thickness: float
    source: str


@dataclass(frozen=True)
class MaterialUse:
    """Material of a surface as a source states it: a name of the table, perhaps a thickness, or the
    material itself.

    `defined` is a material that a Mitsuba file spells out in numbers; its name need not be in the
    table.
    """

    name: str
    thickness: float | None = None
    defined: Material | None = None


@dataclass(frozen=True)
class Fit:
    """eps' = a f^b, sigma = c f^d, f in GHz, from `low` to `high` GHz."""

    low: float
    high: float
    a: float
    b: float
    c: float
    d: float

    def at(self, frequency_ghz: float) -> tuple[float, float]:
        """Permittivity [-] and conductivity [S/m]."""
        return self.a * frequency_ghz**self.b, self.c * frequency_ghz**self.d


ITU_FITS: dict[str, tuple[Fit, ...]] = {
    "vacuum": (Fit(0.001, 100, 1.0, 0, 0.0, 0),),
    "concrete": (Fit(1, 100, 5.24, 0, 0.0462, 0.7822), Fit(110, 330, 5.17, 0, 0.0145, 1.0900)),
    "brick": (Fit(1, 40, 3.91, 0, 0.0238, 0.16), Fit(110, 330, 4.15, 0, 0.0006, 1.5712)),
    "plasterboard": (Fit(1, 100, 2.73, 0, 0.0085, 0.9395), Fit(110, 330, 2.56, 0, 0.0001, 1.7799)),
    "wood": (Fit(0.001, 100, 1.99, 0, 0.0047, 1.0718), Fit(110, 330, 1.82, 0, 0.0040, 1.0761)),
    "glass": (Fit(0.1, 100, 6.31, 0, 0.0036, 1.3394), Fit(220, 450, 5.79, 0, 0.0004, 1.658)),
    "ceiling_board": (Fit(1, 100, 1.48, 0, 0.0011, 1.0750), Fit(220, 450, 1.52, 0, 0.0029, 1.029)),
    "chipboard": (Fit(1, 100, 2.58, 0, 0.0217, 0.7800),),
    "plywood": (Fit(1, 40, 2.71, 0, 0.33, 0), Fit(110, 330, 1.94, 0, 0.0067, 0.9982)),
    "marble": (Fit(1, 60, 7.074, 0, 0.0055, 0.9262), Fit(110, 330, 7.94, 0, 0.0001, 1.7330)),
    "floorboard": (Fit(50, 100, 3.66, 0, 0.0044, 1.3515),),
    "vinyl_tile": (Fit(1, 40, 3.62, 0, 0.0051, 0.8422),),
    "carpet_tile": (Fit(1, 40, 2.08, 0, 0.0009, 0.8200),),
    "asphalt": (Fit(1, 40, 4.83, 0, 0.0108, 1.3969),),
    "metal": (Fit(1, 100, 1.0, 0, 1e7, 0),),
    "very_dry_ground": (Fit(1, 10, 3.0, 0, 0.00015, 2.52),),
    "medium_dry_ground": (Fit(1, 10, 15.0, -0.1, 0.035, 1.63),),
    "wet_ground": (Fit(1, 10, 30.0, -0.4, 0.15, 1.30),),
}
SOIL_MOISTURE = {"very_dry_ground": 0.02, "medium_dry_ground": 0.15, "wet_ground": 0.30}
"""Our choice of volumetric moisture for the names that P.2040 gives without one."""
LEAF_DRY_MATTER = 0.3

# S by roughness (see the module's text), and the slab that a face stands for: what is thick and
# lossy is a half-space at 77 GHz.
_SCATTERING = {
    "vacuum": 0.0,
    "concrete": 0.3,
    "brick": 0.4,
    "plasterboard": 0.2,
    "wood": 0.3,
    "glass": 0.1,
    "ceiling_board": 0.3,
    "chipboard": 0.3,
    "plywood": 0.2,
    "marble": 0.2,
    "floorboard": 0.2,
    "vinyl_tile": 0.1,
    "carpet_tile": 0.4,
    "asphalt": 0.4,
    "metal": 0.1,
    "very_dry_ground": 0.4,
    "medium_dry_ground": 0.4,
    "wet_ground": 0.4,
    "vegetation": 0.9,
    "water": 0.1,
}
_THICKNESS = {
    "glass": 0.012,
    "plasterboard": 0.0125,
    "metal": 0.01,
    "plywood": 0.02,
    "vegetation": 0.0003,
}
DEFAULT_SCATTERING = 0.3
DEFAULT_THICKNESS = 0.1
DEFAULT_EXPONENT = 4
"""The width of the directive lobe that fitted the rural and suburban buildings of Degli-Esposti
(2007)."""

_ALIASES = {
    "asphalt_concrete": "asphalt",
    "ground": "medium_dry_ground",
    "soil": "medium_dry_ground",
    "stone": "marble",
}
_PREFIXES = ("mat-", "itu_", "itu-")
KNOWN_MATERIALS = tuple(sorted(_SCATTERING))


def canonical_name(name: str) -> str | None:
    """The table's name for a name as it stands in a file (``mat-itu_Concrete`` -> ``concrete``);
    None if there is none."""
    short = name.strip().lower()
    for prefix in _PREFIXES:
        short = short.removeprefix(prefix)
    short = short.replace("-", "_").replace(" ", "_")
    short = _ALIASES.get(short, short)
    return short if short in _SCATTERING else None


def material_within(name: str) -> str | None:
    """The table's name that is among the words of a name (``wet_ground_P.527`` -> ``wet_ground``),
    the longest of several; None if there is none."""
    words = f"_{re.sub('[^a-z]+', '_', name.lower())}_"
    found = [known for known in (*KNOWN_MATERIALS, *_ALIASES) if f"_{known}_" in words]
    return canonical_name(max(found, key=len)) if found else None


def water_permittivity(frequency: float, temperature_c: float = 20.0) -> complex:
    """Relative permittivity eps' - j eps'' of fresh water: double Debye model of Liebe et al. [4]_,
    below 1 THz.

    Parameters
    ----------
    frequency : float
        [Hz]
    temperature_c : float
        [degrees Celsius]
    """
    f, theta = frequency / 1e9, 300.0 / (temperature_c + 273.15) - 1.0
    static = 77.66 + 103.3 * theta
    middle = 0.0671 * static
    high = 3.52
    f_1 = 20.20 - 146.4 * theta + 316.0 * theta**2
    f_2 = 39.8 * f_1
    return high + (static - middle) / (1 + 1j * f / f_1) + (middle - high) / (1 + 1j * f / f_2)


def soil_permittivity(frequency: float, moisture: float) -> complex:
    """Relative permittivity eps' - j eps'' of a sandy loam at 20 degrees Celsius: mixing model of
    Dobson et al. [3]_.

    Parameters
    ----------
    frequency : float
        Fitted at 1.4-18 GHz; ITU-R P.527 uses it to 1000 GHz. [Hz]
    moisture : float
        Volumetric water content. [-]
    """
    sand, clay, bulk, solid, alpha = 0.5152, 0.1342, 1.6, 2.66, 0.65
    beta_real = 1.2748 - 0.519 * sand - 0.152 * clay
    beta_imag = 1.33797 - 0.603 * sand - 0.166 * clay
    ions = -1.645 + 1.939 * bulk - 2.25622 * sand + 1.594 * clay
    water = water_permittivity(frequency)
    water_imag = -water.imag + ions / (2 * np.pi * frequency * VACUUM_PERMITTIVITY) * (
        solid - bulk
    ) / (solid * moisture)
    solids = (1.01 + 0.44 * solid) ** 2 - 0.062
    real = (
        1 + bulk / solid * (solids**alpha - 1) + moisture**beta_real * water.real**alpha - moisture
    ) ** (1 / alpha)
    imag = (moisture**beta_imag * water_imag**alpha) ** (1 / alpha)
    return complex(real, -imag)


def leaf_permittivity(frequency: float, dry_matter: float) -> complex:
    """Relative permittivity eps' - j eps'' of a leaf: Mätzler's model [5]_, 1-100 GHz, without the
    salt of the sap.

    Parameters
    ----------
    frequency : float
        [Hz]
    dry_matter : float
        Mass fraction of dry matter, 0.1-0.5. [-]
    """
    return (
        0.522 * (1 - 1.32 * dry_matter) * water_permittivity(frequency) + 0.51 + 3.84 * dry_matter
    )


def _constants(permittivity: complex, frequency: float) -> tuple[float, float]:
    return permittivity.real, -permittivity.imag * 2 * np.pi * frequency * VACUUM_PERMITTIVITY


def itu_constants(name: str, frequency: float) -> tuple[float, float, str]:
    """Permittivity [-], conductivity [S/m] and where they come from, for a name of the table at
    `frequency` [Hz].

    Inside a fit of P.2040: the fit. Between two fits: both constants interpolated over log f (the
    conductivity in its logarithm) between the fits' near ends. Beyond the fits: the nearest one
    continued.
    """
    f = frequency / 1e9
    if name == "vegetation":
        eps, sigma = _constants(leaf_permittivity(frequency, LEAF_DRY_MATTER), frequency)
        return (
            eps,
            sigma,
            f"Mätzler 1994 leaf model, dry matter {LEAF_DRY_MATTER:g}, salt neglected",
        )
    if name == "water":
        eps, sigma = _constants(water_permittivity(frequency), frequency)
        return eps, sigma, "Liebe 1991 model of fresh water, 20 degrees Celsius"
    fits = ITU_FITS[name]
    for fit in fits:
        if fit.low <= f <= fit.high:
            return *fit.at(f), f"ITU-R P.2040-3 fit for {fit.low:g}-{fit.high:g} GHz"
    if name in SOIL_MOISTURE and f > fits[-1].high:
        eps, sigma = _constants(soil_permittivity(frequency, SOIL_MOISTURE[name]), frequency)
        moisture = SOIL_MOISTURE[name]
        return (
            eps,
            sigma,
            f"Dobson 1985 soil model (ITU-R P.527), sandy loam, {100 * moisture:g} % water; P.2040 "
            "ends at 10 GHz",
        )
    for below, above in itertools.pairwise(fits):
        if below.high < f < above.low:
            (eps_0, sigma_0), (eps_1, sigma_1) = below.at(below.high), above.at(above.low)
            w = np.log(f / below.high) / np.log(above.low / below.high)
            sigma = float(np.exp((1 - w) * np.log(sigma_0) + w * np.log(sigma_1)))
            text = (
                f"interpolated over log f between the ITU-R P.2040-3 fits at {below.high:g} and "
                f"{above.low:g} GHz"
            )
            return float((1 - w) * eps_0 + w * eps_1), sigma, text
    nearest = fits[0] if f < fits[0].low else fits[-1]
    return *nearest.at(
        f
    ), f"ITU-R P.2040-3 fit for {nearest.low:g}-{nearest.high:g} GHz continued to {f:g} GHz"


def material_at(name: str, carrier_frequency: float) -> Material:
    """A material of the table at the carrier.

    Parameters
    ----------
    name : str
        As in `KNOWN_MATERIALS`, or with the prefixes of Mitsuba files (``mat-itu_concrete``).
    carrier_frequency : float
        [Hz]

    Raises
    ------
    CityError  If the name is unknown.
    """
    known = canonical_name(name)
    if known is None:
        raise CityError(
            f"material {name!r} is unknown; known are {', '.join(KNOWN_MATERIALS)}; "
            "or define it in city.materials with relative_permittivity and conductivity_s_per_m"
        )
    eps, sigma, source = itu_constants(known, carrier_frequency)
    return Material(
        known,
        float(eps),
        float(sigma),
        _SCATTERING[known],
        "lambertian",
        DEFAULT_EXPONENT,
        _THICKNESS.get(known, DEFAULT_THICKNESS),
        source + "; scattering: default by roughness",
    )


def _override(material: Material, change: MaterialOverride) -> Material:
    fields = {
        "relative_permittivity": change.relative_permittivity,
        "conductivity": change.conductivity_s_per_m,
        "scattering_coefficient": change.scattering_coefficient,
        "scattering_pattern": change.scattering_pattern,
        "thickness": change.thickness_m,
    }
    given = {key: value for key, value in fields.items() if value is not None}
    if not given:
        return material
    source = f"{material.source}; scenario: {', '.join(given)}"
    return replace(material, **given, source=source)  # type: ignore[arg-type]  # checked by the scenario


def _base(use: MaterialUse, carrier_frequency: float, change: MaterialOverride | None) -> Material:
    if use.defined is not None:
        return use.defined
    if canonical_name(use.name) is None and change is not None:
        if change.relative_permittivity is None or change.conductivity_s_per_m is None:
            raise CityError(
                f"city.materials.{use.name}: {use.name!r} is not in the table, so "
                "relative_permittivity and "
                "conductivity_s_per_m must both be given"
            )
        return Material(
            use.name,
            1.0,
            0.0,
            DEFAULT_SCATTERING,
            "lambertian",
            DEFAULT_EXPONENT,
            DEFAULT_THICKNESS,
            "scenario",
        )
    material = material_at(use.name, carrier_frequency)
    if use.thickness is not None:
        return replace(
            material, thickness=use.thickness, source=material.source + "; thickness: scene file"
        )
    return material


def _by_name(changes: Mapping[str, MaterialOverride]) -> dict[str, MaterialOverride]:
    """Changes by the names that the table gives materials."""
    return {canonical_name(name) or name: change for name, change in changes.items()}


def believed_materials(
    materials: Sequence[Material], changes: Mapping[str, MaterialOverride]
) -> tuple[Material, ...]:
    """Materials of a city with the properties that terminals believe, by name.

    Raises
    ------
    CityError  If the city has no such material.
    """
    wanted = _by_name(changes)
    names = {m.name for m in materials}
    for name in wanted.keys() - names:
        raise CityError(
            f"belief.materials.{name}: the city has no such material; it has "
            f"{', '.join(sorted(names)) or 'none'}"
        )
    return tuple(_override(m, wanted[m.name]) if m.name in wanted else m for m in materials)


def resolve_materials(
    uses: Sequence[MaterialUse], carrier_frequency: float, overrides: Mapping[str, MaterialOverride]
) -> tuple[list[int], tuple[Material, ...]]:
    """The materials of a city's surfaces at the carrier, each once.

    Parameters
    ----------
    uses : sequence of MaterialUse
        One per surface.
    carrier_frequency : float
        [Hz]
    overrides : mapping from material name to MaterialOverride
        `City.materials` of the scenario. A name outside the table defines a new material.

    Returns
    -------
    index : list of int
        Of each use's material.
    materials : tuple of Material
        One name that occurs with several thicknesses becomes several materials; the later ones
        carry theirs in the name.

    Raises
    ------
    CityError  If a name is unknown.
    """
    changes = _by_name(overrides)
    found: dict[MaterialUse, int] = {}
    materials: list[Material] = []
    index = []
    for use in uses:
        known = canonical_name(use.name) if use.defined is None else None
        key = replace(use, name=known or use.name)
        if key not in found:
            change = changes.get(key.name)
            material = _base(key, carrier_frequency, change)
            material = _override(material, change) if change is not None else material
            if material in materials:
                found[key] = materials.index(material)
            else:
                if any(other.name == material.name for other in materials):
                    material = replace(material, name=f"{material.name} {material.thickness:g} m")
                if len(materials) == MAX_MATERIALS:
                    raise CityError(
                        f"material {key.name!r} is one of more than {MAX_MATERIALS}; join like ones"
                    )
                found[key] = len(materials)
                materials.append(material)
        index.append(found[key])
    return index, tuple(materials)
