"""Scattering centres fixed on a target: 3GPP's with one in the middle of each face, or stated ones.

TR 38.901 (v19) clause 7.9.2.1 has lobes of a vehicle, an automated guided vehicle (AGV) and a large
UAV, each a target of one point (tables -2, -4, -6). Its tables of several points (-5, -7) follow
from these to 0.02 dB by a rule that is applied to all three here (docs/moving.md). The random
component of each centre is a smooth field over the aspect (`CrossSection`), so that the sum is
coherent over frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from isac_rt.extensions.street.motion import CentreModel, Motion
from isac_rt.extensions.street.walker import HUMAN_DBSM
from isac_rt.propagation.rcs import (
    LARGE_BISTATIC,
    LARGE_LOBES,
    TR38901_STD_DB,
    CrossSection,
    Lobe,
    lobe_db,
)
from isac_rt.settings import AspectTable
from isac_rt.world.aspect import in_table
from isac_rt.world.settings import Centre, Extent, Rcs


class Kind(NamedTuple):
    """Lobes of a target, k_1 and k_2 of eq. 7.9.2-3, the standard deviation of the random component
    [dB], and width, length and height [m]."""

    lobes: tuple[Lobe, ...]
    bistatic: tuple[float, float]
    std_db: float
    size: tuple[float, float, float]


KINDS = {
    "uav": Kind(LARGE_LOBES, LARGE_BISTATIC, TR38901_STD_DB["large"], (1.5, 1.6, 0.7)),
    "vehicle": Kind(
        (
            Lobe(90.0, 26.90, 79.70, 44.42, 20.75, 13.68),
            Lobe(180.0, 36.32, 79.65, 36.73, 14.56, 7.50),
            Lobe(270.0, 26.90, 79.70, 44.42, 20.75, 13.68),
            Lobe(0.0, 40.54, 71.75, 29.13, 15.52, 8.45),
            Lobe(None, np.inf, 0.0, 18.13, 21.26, 14.19),
        ),
        (6.0, 1.65),
        3.41,
        (2.0, 5.0, 1.6),  # TR 37.885, passenger vehicle
    ),
    "agv": Kind(
        (
            Lobe(0.0, 13.68, 90.0, 13.68, 13.02, 23.29),
            Lobe(90.0, 15.53, 75.0, 20.03, 7.33, 17.60),
            Lobe(180.0, 12.49, 90.0, 11.89, 11.01, 21.28),
            Lobe(270.0, 15.53, 75.0, 20.03, 7.33, 17.60),
            Lobe(None, np.inf, 0.0, 11.44, 11.79, 22.06),
        ),
        (12.0, 1.45),
        2.51,
        (1.0, 0.5, 0.5),
    ),
}
"""Targets of TR 38.901 (tables 7.9.2.1-2, -4 and -6; sizes: tables 7.9.1-1 and -4, option 1)."""


@dataclass(frozen=True)
class Fixed(CentreModel):
    """Centres that rest in a target's axes, and the cross-section of each.

    Attributes
    ----------
    phases : tables of cosine and sine of the phase of those echoes that have any, by centre
    """

    places: np.ndarray
    sections: tuple[CrossSection, ...]
    phases: Mapping[int, tuple[AspectTable, AspectTable]] = field(default_factory=dict)

    def described(self) -> str:
        return f"{len(self.places)} scattering centres"

    def amplitudes(
        self, incident: np.ndarray, observed: np.ndarray, time: np.ndarray
    ) -> np.ndarray:
        ends = [np.broadcast_to(u, (time.size, *self.places.shape)) for u in (incident, observed)]
        out = np.zeros(ends[0].shape[:2], complex)
        for k, section in enumerate(self.sections):
            one, other = (end[:, k] for end in ends)
            out[:, k] = np.sqrt(section.square_metres(one, other))
            if k in self.phases:
                size = np.linalg.norm(one + other, axis=1, keepdims=True)
                half = (one + other) / np.maximum(size, 1e-9)
                cosine, sine = (in_table(table, half) for table in self.phases[k])
                out[:, k] *= np.exp(1j * np.arctan2(sine, cosine))
        return out

    def square_metres(self, incident: np.ndarray, observed: np.ndarray) -> Any:
        return sum(section.square_metres(incident, observed) for section in self.sections)

    def motion(self, time: np.ndarray) -> Motion:
        rest = np.zeros((time.size, *self.places.shape))
        return Motion(self.places + rest, rest, rest)


class Section(CrossSection):
    """Cross-section of one centre: a lobe with a random field."""

    def __init__(self, lobe: Lobe, kind: Kind, name: str, seed: int) -> None:
        super().__init__(Rcs(model="constant", fluctuation_db=kind.std_db), name, seed)
        self.lobe, self._bistatic = lobe, kind.bistatic

    def _mean_db(self, bisector: np.ndarray, half_bistatic: np.ndarray) -> np.ndarray:
        return lobe_db(self.lobe, self._bistatic, bisector, half_bistatic)


def section_of(extent: Extent, seed: int, name: str) -> Fixed | CrossSection:
    """Return the cross-section of a target by aspect, its centres added by power."""
    if extent.kind == "pedestrian":
        return CrossSection(Rcs(model="constant", value_dbsm=HUMAN_DBSM), name, seed)
    return fixed_of(extent, seed, name)


def fixed_of(extent: Extent, seed: int, name: str) -> Fixed:
    """Return the centres of a target."""
    if extent.kind == "centres":
        return stated(extent.centres)
    kind = KINDS[extent.kind]
    lobes = of_several(kind.lobes)
    sections = (Section(lobe, kind, f"{name}/{i}", seed) for i, lobe in enumerate(lobes))
    size = np.array(extent.size_m or kind.size)
    return Fixed(np.array([_outward(lobe) for lobe in lobes]) * size / 2, tuple(sections))


def stated(centres: Sequence[Centre]) -> Fixed:
    """Return the centres of a scenario or a file."""
    sections = (
        Rcs(model="constant", value_dbsm=c.value_dbsm or 0.0)
        if c.table is None
        else Rcs(model="table", table=c.table)
        for c in centres
    )
    phases = {}
    for k, centre in enumerate(centres):
        if (table := centre.phase_table) is not None:
            angle = np.radians(table.values_db)
            parts = (tuple(map(tuple, f(angle).tolist())) for f in (np.cos, np.sin))
            cosine, sine = (table.model_copy(update={"values_db": part}) for part in parts)
            phases[k] = cosine, sine
    places = np.array([c.position_m for c in centres])
    return Fixed(places, tuple(CrossSection(rcs, "", 0) for rcs in sections), phases)


def of_several(lobes: tuple[Lobe, ...]) -> list[Lobe]:
    """Return lobes of one point as those of as many points."""
    out = []
    for lobe in lobes:
        floor = lobe.peak - lobe.depth - 10 * np.log10(len(lobes))
        power = 10 ** (lobe.peak / 10) - (len(lobes) - 1) * 10 ** (floor / 10)
        peak = float(10 * np.log10(power))
        out.append(lobe._replace(peak=peak, depth=peak - floor))
    return out


def _outward(lobe: Lobe) -> np.ndarray:
    """Return the normal of the face that a lobe leaves, in the target's axes."""
    if lobe.azimuth is None:
        return np.array([0.0, 0.0, 1.0 if lobe.zenith < 90 else -1.0])
    azimuth = np.radians(lobe.azimuth)
    return np.round([-np.sin(azimuth), np.cos(azimuth), 0.0])
