"""Patterns of antennas: grids and cuts as CSV, Planet's MSI, and tables that HFSS exports.

Azimuth counts to the right, elevation upwards. A file that states its gain in dBi also sets
`element_gain_dbi`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from isac_rt.scenario.tables import (
    INPUT_NOTES,
    MAX_ROWS,
    by_aspect,
    number,
    opened,
    read_csv,
    text_of,
)

Values = NDArray[np.float64]
DIPOLE_DBI = 2.15
"""Gain of a half-wave dipole, the reference of dBd [dBi]."""
MAX_DIRECTIONS = 721 * 361
"""Rows of HFSS's table: steps of half a degree."""
_CUT = re.compile(r"(db\((?:realized)?gaintotal\).*)phi='(-?[\d.]+)deg'")
"""Column of one cut, as a rectangular plot of HFSS has them: dB(GainTotal) [] - Freq='77GHz'
Phi='5deg'."""
MAX_PHI_STEP_DEG = 90.0
"""Largest step of HFSS's Phi: that of the two principal planes."""
CROSSING_DB = 1.0
"""Largest difference of two cuts where they cross [dB]."""
SPHERE_ROWS = 90
"""Steps in elevation of a sphere that is sampled anew: 2 degrees, for which `MAX_ROWS` has room."""


def antenna_pattern(path: Path) -> dict[str, Any]:
    """Return the keys of `array` that a pattern's file states, told by its ending and its header,
    or raise ValueError with the line and the remedy."""
    if path.suffix.lower() in (".msi", ".pln"):
        return _planet(path)
    names = opened(path)[2]
    if any(name.startswith(("theta", "phi", "db(")) for name in names):
        return _hfss(path, names)
    if "angle_deg" in names:
        return _cuts(path, "dbi" if "azimuth_dbi" in names else "db")
    return {"pattern": by_aspect("dbi")(path)["table"]}


def _cuts(path: Path, unit: str) -> dict[str, Any]:
    """Read two cuts through the boresight: gains in azimuth and in elevation by angle."""
    wanted = "angle_deg", f"azimuth_{unit}", f"elevation_{unit}"
    c = read_csv(path, wanted)
    angles, azimuth, elevation = (np.array(c[name]) for name in wanted)
    at = np.flatnonzero(angles == 0)
    if not at.size or abs(azimuth[at[0]] - elevation[at[0]]) > CROSSING_DB:
        raise ValueError("needs one gain at angle_deg 0, where both cuts cross; correct that row")
    found = _summed((angles, azimuth - azimuth[at[0]]), (angles, elevation))
    return _absolute(*found) if unit == "dbi" else _keys(*found)


def _planet(path: Path) -> dict[str, Any]:
    """Read Planet's MSI: attenuations of two cuts below a gain, in dBd unless it says dBi. The
    vertical cut counts downwards from the horizon."""
    gain: float | None = None
    rows: list[tuple[float, float]] = []
    cuts: dict[str, tuple[int, float, list[tuple[float, float]]]] = {}
    for at, line in enumerate(text_of(path).splitlines(), start=1):
        key, *rest = line.upper().split() or [""]
        if key == "GAIN":
            said = "".join(rest)
            dipole = 0.0 if said.endswith("DBI") else DIPOLE_DBI
            gain = number(said.removesuffix("DBI").removesuffix("DBD"), at, key) + dipole
        elif key in ("HORIZONTAL", "VERTICAL"):
            rows = []
            cuts[key] = at, number("".join(rest), at, key), rows
        elif cuts and len(rest) == 1:
            rows.append((number(key, at, "angle"), number(rest[0], at, "attenuation")))
            if rows[-1][1] < 0:
                raise ValueError(f"line {at}: an attenuation is not negative; leave the - out")
    for key, (at, count, rows) in cuts.items():
        if len(rows) != count or not rows:
            raise ValueError(f"line {at}: {key} {count:g} has {len(rows)} rows; correct either")
    if gain is None or len(cuts) < 2:
        raise ValueError("needs GAIN, HORIZONTAL and VERTICAL as Planet's MSI has them; add them")
    (right, across), (down, along) = (np.array(cuts[k][2]).T for k in ("HORIZONTAL", "VERTICAL"))
    return _keys(*_summed((right, -across), (-down, -along))) | {"element_gain_dbi": gain}


def _summed(
    azimuth: tuple[Values, Values], elevation: tuple[Values, Values]
) -> tuple[Values, Values, Values]:
    """Return azimuths (A,), elevations (E,) [degrees] and G(az) + G(el) - G0 [dB] (E, A) of two
    cuts (angles, gains), from one of which the gain G0 where they cross is taken already.

    Elevations beyond the zenith are left out: the cut in azimuth says what goes backwards.

    Source: 3GPP TR 38.901, table 7.3-1; for its error off the cuts F. Gil et al., "A 3D
    interpolation method for base-station-antenna radiation patterns", IEEE Antennas and
    Propagation Magazine 43(2), 2001.
    """
    cuts = []
    for angles, gains in (azimuth, elevation):
        wrapped, first = np.unique((angles + 180) % 360 - 180, return_index=True)
        cuts.append((wrapped, gains[first]))
    (right, across), (up, along) = cuts
    step = math.ceil(math.sqrt(right.size * np.sum(np.abs(up) <= 90) / MAX_ROWS))
    columns, rows = (slice(int(np.abs(a).argmin()) % step, None, step) for a in (right, up))
    right, across, up, along = right[columns], across[columns], up[rows], along[rows]
    front = np.abs(up) <= 90
    return right, up[front], along[front, None] + across


def _hfss(path: Path, names: Sequence[str]) -> dict[str, Any]:
    """Read a far field of HFSS: Theta from the boresight Z, Phi from X towards Y, which is up (X
    is to the left of who looks along Z)."""
    theta, phi, stated = _directions(path, names)
    phi = np.where(theta < 0, phi + 180, phi).round(5) % 360
    theta = np.abs(theta).round(5)
    rows, columns = np.unique(theta), np.unique(phi)
    table = np.full((rows.size, columns.size), np.nan)
    table[np.searchsorted(rows, theta), np.searchsorted(columns, phi)] = stated
    for pole in np.flatnonzero((rows == 0) | (rows == 180)):  # one direction for every Phi
        table[pole] = np.nanmean(table[pole])
    step = np.diff(columns, append=columns[0] + 360).max()
    if (
        rows.size < 2
        or rows[0]
        or rows[-1] > 180
        or step > MAX_PHI_STEP_DEG
        or np.isnan(table).any()
    ):
        raise ValueError(
            f"{theta.size} directions are no grid of Theta from 0 and of Phi all round; export one"
        )
    columns = np.append(columns, columns[0] + 360)
    right, up, gains = _turned(rows, columns, np.column_stack([table, table[:, 0]]))
    e, a = np.unravel_index(gains.argmax(), gains.shape)
    said = f"peak {gains[e, a]:.1f} dBi at azimuth {right[a]:g}, elevation {up[e]:g} degrees"
    quantity = next(name for name in names if name.startswith("db(")).split()[0]
    INPUT_NOTES.info("%s: %s, %s", path.name, quantity, said)
    return _absolute(right, up, gains)


def _directions(path: Path, names: Sequence[str]) -> tuple[Values, Values, Values]:
    """Read Theta and Phi [degrees] and gains [dB] (N,) of HFSS: a row for each direction, or a
    row for each Theta with a column for each Phi."""
    cuts = {name: cut for name in names if (cut := _CUT.match(name))}
    starts = ("theta",) if cuts else ("theta", "phi", ("db(gaintotal)", "db(realizedgaintotal)"))
    wanted = tuple(next((n for n in names if n.startswith(s)), "") for s in starts)
    if "" in wanted:
        raise ValueError(
            "its header needs Theta, Phi and dB(GainTotal) or dB(RealizedGainTotal), not "
            f"{', '.join(names)[:80]!r}; export a data table with Theta and Phi as columns"
        )
    if len({(cut[1], name[cut.end() :]) for name, cut in cuts.items()}) > 1:
        raise ValueError("has cuts of several frequencies or quantities; export one")
    rest = tuple(name for name in names if name not in (*wanted, *cuts))
    c = read_csv(path, (*wanted, *cuts), rest, most=MAX_DIRECTIONS)
    if several := [name for name in rest if np.ptp(c[name])]:
        raise ValueError(f"{several[0][:40]!r} has several values; export one")
    angles = [np.degrees(c[n]) if "[rad]" in n else np.array(c[n]) for n in wanted[:2]]
    if not cuts:
        return angles[0], angles[1], np.array(c[wanted[2]])
    phi = np.repeat([float(cut[2]) for cut in cuts.values()], angles[0].size)
    return np.tile(angles[0], len(cuts)), phi, np.concatenate([c[name] for name in cuts])


def _turned(theta: Values, phi: Values, table: Values) -> tuple[Values, Values, Values]:
    """Return azimuths, elevations and gains in the body's frame of a sphere of HFSS."""
    steps = min(math.ceil(180 / np.diff(theta).min()), SPHERE_ROWS)
    up = np.linspace(-90, 90, steps + 1)
    right = np.linspace(-180, 180, 2 * steps, endpoint=False)
    e, a = np.radians(up)[:, None], np.radians(right)
    x, y, z = -np.cos(e) * np.sin(a), np.sin(e) + 0 * a, np.cos(e) * np.cos(a)
    from_z = np.degrees(np.arccos(np.clip(z, -1, 1))).clip(0, theta[-1])
    from_x = phi[0] + (np.degrees(np.arctan2(y, x)) - phi[0]) % 360
    sphere = RegularGridInterpolator((theta, phi), table)
    return right, up, sphere(np.stack([from_z, from_x], axis=-1))


def _absolute(azimuth: Values, elevation: Values, gains: Values) -> dict[str, Any]:
    """Return gains [dBi] as keys of `array`: the peak and a table below it."""
    peak = float(gains.max())
    return _keys(azimuth, elevation, gains - peak) | {"element_gain_dbi": peak}


def _keys(azimuth: Values, elevation: Values, gains: Values) -> dict[str, Any]:
    axes = {"azimuth_deg": azimuth.tolist(), "elevation_deg": elevation.tolist()}
    return {"pattern": axes | {"values_db": gains.round(4).tolist()}}
