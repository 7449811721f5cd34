"""Amplitudes against closed forms, integrals and published numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.integrate import dblquad, quad

from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.level import thermal_noise_power
from isac_rt.frame.link import Link
from isac_rt.frame.settings import Noise
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.rcs import CrossSection, large_uav_db
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.propagation.settings import Clutter
from isac_rt.simulation.setup import propagation_in
from isac_rt.world.city import CityMesh
from isac_rt.world.city.materials import Material, resolve_materials, water_permittivity
from isac_rt.world.city.materials import MaterialUse as Use
from isac_rt.world.settings import Rcs
from truths import stage, truths
from truths.case import Errors, case, traced
from truths.truths import WAVELENGTH, slab_reflection

SIGMA = 10**-1.17
ROUNDING = "float64 rounding; the largest that was seen is a hundredth of the bound"
PLACES = ((1.37, -2.21, 11.3), (23.9, 17.3, 8.77), (9.7, 31.1, 14.9))


def _gap(i: int, j: int) -> float:
    return float(np.linalg.norm(np.subtract(PLACES[i], PLACES[j])))


def _free(tx: str, rx: str, gain: float = 1.0):
    s = stage.scenario(traced=False)
    antennas = replace(stage.FEW, gain=gain)
    return (
        FreeSpace(s.swarm, Arrays(antennas), WAVELENGTH, s.seed)
        .trace(stage.swarm(*PLACES), 0.0, [Link(tx, rx)])
        .paths[Link(tx, rx)]
    )


@case("(lambda / 4 pi d)^2 G G", "1e-9 dB", "float64 rounding")
def friis() -> float:
    """Received power of a line of sight with elements of 3.1 dBi."""
    gain = 10**0.31
    found = _free("A", "P", gain)
    power = found.power[found.kind == PathKind.LINE_OF_SIGHT][0]
    return abs(10 * np.log10(power) - (6.2 + 20 * np.log10(WAVELENGTH / (4 * np.pi * _gap(0, 1)))))


@case("G G lambda^2 sigma / ((4 pi)^3 r1^2 r2^2)", "1e-9 dB", "float64 rounding")
def radar_equation() -> Errors:
    """Received power of an echo, monostatic and bistatic."""
    for rx, second in (("A", _gap(0, 2)), ("P", _gap(1, 2))):
        found = _free("A", rx, 10**0.31)
        power = found.power[found.target == 2][0]
        truth = (
            6.2
            + 10 * np.log10(WAVELENGTH**2 * SIGMA / (4 * np.pi) ** 3)
            - 20 * np.log10(_gap(0, 2) * second)
        )
        yield abs(10 * np.log10(power) - truth)


def _ground(conductivity: float, permittivity: float = 5.31) -> CityMesh:
    return stage.rectangle(
        (-900, -900, 0), (1800, 0, 0), (0, 1800, 0), stage.material(permittivity, conductivity)
    )


def _two_rays(
    distance: float, low: float, high: float, permittivity: float, conductivity: float
) -> complex:
    """Field of both rays over the line of sight's amplitude, carrier phases included, in long
    double."""
    d, h1, h2 = (np.longdouble(v) for v in (distance, low, high))
    direct, folded = np.sqrt(d * d + (h1 - h2) ** 2), np.sqrt(d * d + (h1 + h2) ** 2)
    reflection = slab_reflection(permittivity, conductivity, 0.1, float((h1 + h2) / folded))[1]
    turn = (folded - direct) / (truths.LIGHT / np.longdouble(truths.CARRIER))
    return 1 + reflection * float(direct / folded) * np.exp(
        -2j * np.pi * float(turn - np.floor(turn))
    )


@traced("two rays in long double, Fresnel by inner echoes", "1e-9 of the direct field", ROUNDING)
def two_rays_across_the_breakpoint() -> Errors:
    """The sum of direct and ground ray over concrete from well before the breakpoint (at 98 m) to
    well beyond it, vertical polarisation."""
    low, high, eps, sigma = 0.31, 0.307, 5.31, 1.9
    model = stage.tracer(_ground(sigma, eps), 1)
    for distance in (7.3, 23.9, 61.7, 97.1, 203.0, 411.0):
        poses = stage.swarm((0, 0, low), (distance, 0, high), (3.0, 40.0, 11.0), moving=False)
        paths = model.trace(poses, 0.0, [Link("A", "P")]).paths[Link("A", "P")]
        paths = paths.select(paths.target < 0)
        turn = (truths.CARRIER * (paths.delay - paths.delay[0])) % 1.0
        field = (paths.gain * np.exp(-2j * np.pi * turn)).sum() / np.abs(paths.gain[0])
        yield abs(field - _two_rays(distance, low, high, eps, sigma)) if len(paths) == 2 else np.inf


@traced(
    "image of a perfect conductor, lambda / (4 pi 2 d), times Fresnel's 0.9991 of the "
    "tracer's metal",
    "1e-13 relative",
    ROUNDING,
)
def conducting_plate() -> float:
    """A large metal plate at right angles returns one image to its radar: amplitude and delay, on
    the seam of its triangles."""
    plate = stage.rectangle(
        (31.7, -20, -20), (0, 40, 0), (0, 0, 40), stage.material(conductivity=stage.METAL)
    )
    poses = stage.swarm((0.3, 0.0, 0.0), (5.1, 9.0, 3.3), (2.2, -9.0, 4.4))
    paths = stage.tracer(plate).trace(poses, 0.0, [Link("A", "A")]).paths[Link("A", "A")]
    paths = paths.select(paths.kind == PathKind.SPECULAR)
    if len(paths) != 1:
        return np.inf
    reflection = abs(slab_reflection(5.31, stage.METAL, 0.1, 1.0)[0])
    amplitude = abs(abs(paths.gain[0]) / (reflection * WAVELENGTH / (4 * np.pi * 62.8)) - 1)
    return max(amplitude, abs(299_792_458.0 * paths.delay[0] / 62.8 - 1))


@traced(
    "image of two perfect conductors, lambda / (4 pi 2 d), times 0.9991 twice",
    "1e-13 relative",
    ROUNDING,
)
def conducting_corner() -> float:
    """A vertical edge of two metal walls at right angles returns one image, twice the distance to
    the edge away."""
    corner = np.array([21.3, -14.7, 0.0])
    points = (
        40 * np.array([(0, 0, -1), (0, 0, 1), (1, 0, -1), (1, 0, 1), (0, 1, -1), (0, 1, 1)], float)
        + corner
    )
    faces = np.array([(0, 2, 3), (0, 3, 1), (0, 1, 5), (0, 5, 4)], np.int32)
    mesh = CityMesh(
        "corner",
        points,
        faces,
        np.zeros(4, np.int16),
        (stage.material(conductivity=stage.METAL),),
        np.zeros(3),
    )
    away = np.array([9.3, 13.1, 0.0])
    radar = corner + away + np.array([0, 0, 1.7])
    poses = stage.swarm(radar, radar + 3.1, radar + np.array([2.0, -3.1, 1.7]))
    paths = stage.tracer(mesh, 2).trace(poses, 0.0, [Link("A", "A")]).paths[Link("A", "A")]
    paths = paths.select((paths.kind == PathKind.SPECULAR) & (paths.bounces == 2))
    if len(paths) != 1:
        return np.inf
    cosines = away[:2] / np.linalg.norm(away)
    reflection = np.prod(
        [abs(slab_reflection(5.31, stage.METAL, 0.1, float(c))[0]) for c in cosines]
    )
    return abs(
        abs(paths.gain[0]) / (reflection * WAVELENGTH / (8 * np.pi * np.linalg.norm(away))) - 1
    )


@traced(
    "Fresnel's equations with the slab's inner echoes added up",
    "1e-13 of the image",
    ROUNDING,
)
def reflection_of_a_slab() -> Errors:
    """Amplitude and phase of the ground's ray off concrete and off a pane, above, near and far
    below Brewster's angle."""
    for eps, sigma, thickness in ((5.31, 1.9, 0.1), (2.7, 0.6, 0.004)):
        mesh = stage.rectangle(
            (-150, -150, 0), (300, 0, 0), (0, 300, 0), stage.material(eps, sigma, 0.0, thickness)
        )
        model = stage.tracer(mesh, 1)
        for h in (0.9, 7.3, 31.0):
            poses = stage.swarm((-9.7, 3.1, h), (13.9, -4.3, 0.7 * h), (0.5, 40.0, 11.0))
            paths = model.trace(poses, 0.0, [Link("A", "P")]).paths[Link("A", "P")]
            paths = paths.select(paths.kind == PathKind.SPECULAR)
            length = np.sqrt(23.6**2 + 7.4**2 + (1.7 * h) ** 2)
            truth = slab_reflection(eps, sigma, thickness, 1.7 * h / length)[1]
            yield abs(paths.gain[0] / (WAVELENGTH / (4 * np.pi * length)) - truth)


@traced(
    "image theory: the radar equation with one segment folded",
    "1e-13 relative",
    "the truth holds the 0.9991 of the tracer's metal per bounce; " + ROUNDING,
)
def ghosts_over_a_conducting_wall() -> float:
    """Echo and ghosts of a target beside a metal wall: each is a product of a straight and a folded
    segment."""
    wall = stage.rectangle(
        (-60, 25.0, -40), (120, 0, 0), (0, 0, 80), stage.material(conductivity=stage.METAL)
    )
    a, u = np.array([1.3, -2.7, 0.9]), np.array([9.1, 6.3, 0.9])
    paths = (
        stage.tracer(wall, 2)
        .trace(stage.swarm(a, (-30.0, -20.0, 3.0), u), 0.0, [Link("A", "A")])
        .paths[Link("A", "A")]
    )
    paths = paths.select(paths.target == 2)
    image = np.array([u[0], 50 - u[1], u[2]])
    direct, folded = np.linalg.norm(u - a), np.linalg.norm(image - a)
    reflection = abs(slab_reflection(5.31, stage.METAL, 0.1, float((image - a)[1] / folded))[0])
    truth = [(direct, direct, 0), (direct, folded, 1), (direct, folded, 1), (folded, folded, 2)]
    expected = np.array(
        [
            WAVELENGTH * np.sqrt(SIGMA / (4 * np.pi) ** 3) / (p * q) * reflection**b
            for p, q, b in truth
        ]
    )
    found = np.abs(paths.gain)[np.argsort(paths.delay)]
    return float(np.abs(found / expected - 1).max()) if found.size == 4 else np.inf


def _field_tracer(poses: dict, city: CityMesh, **clutter: Any) -> Any:
    where = {
        n: {"role": r, "position_m": poses[n].position.tolist()}
        for n, r in (("A", "active"), ("P", "passive"))
    }
    s = stage.scenario(
        swarm=where, frames=40, propagation={"max_bounces": 0}, clutter={"model": "field"} | clutter
    )
    return propagation_in(city, s)


def _field_power(tx: str, rx: str, poses: dict, city: CityMesh) -> float:
    field = _field_tracer(poses, city).field
    return float(
        (field.seen(LinkState(Link(tx, rx), 0.0, poses[tx], poses[rx])).magnitude ** 2).sum()
    )


@traced(
    "double integral of Lambert's law over the wall",
    "0.02 dB",
    "cells of 0.05 m^2 and up against the integral at 10 m and beyond; metal reflects 0.9998 "
    "of the power but for grazing angles",
)
def lambertian_wall() -> Errors:
    """Mean power that the clutter field of a wall of 120 m x 60 m returns, to its radar and to a
    second terminal."""
    city = stage.rectangle(
        (-60.0, 50.0, -30.0),
        (120.0, 0, 0),
        (0, 0, 60.0),
        stage.material(conductivity=stage.METAL, scattering=0.43),
    )
    poses = {
        "A": stage.pose((1.3, 28.3, 2.1), boresight=(0, 1, 0)),
        "P": stage.pose((-13.1, 25.3, -6.6), boresight=(0, 1, 0)),
    }
    for tx, rx in (("A", "A"), ("A", "P")):
        truth = truths.lambertian_wall(
            poses[tx].position, poses[rx].position, 0.43, 50.0, (60.0, 30.0)
        )
        yield abs(10 * np.log10(_field_power(tx, rx, poses, city) / truth))


@traced(
    "double integral of Lambert's law over the wall, one end at its image under the ground",
    "0.04 dB",
    "cells of 0.05 m^2 and up against the integral, 0.02 dB; metal ground takes 0.4 % of a "
    "vertical wave at these angles, 0.02 dB",
)
def lambertian_wall_by_way_of_the_ground() -> float:
    """Mean power of clutter of two bounces: a metal ground and a wall of 120 m x 60 m on it, in
    either order."""
    share, metal = 0.43, stage.material(conductivity=stage.METAL, scattering=0.43)
    wall = stage.rectangle((-60.0, 50.0, -30.0), (120.0, 0, 0), (0, 0, 60.0), metal)
    ground = stage.rectangle((-80.0, -30.0, -30.0), (160.0, 0, 0), (0, 110.0, 0), metal)
    faces = np.concatenate([wall.faces, ground.faces + len(wall.vertices)]).astype(np.int32)
    city = CityMesh(
        "wall and ground",
        np.concatenate([wall.vertices, ground.vertices]),
        faces,
        np.zeros(4, np.int16),
        (metal,),
        np.zeros(3),
    )
    poses = {
        "A": stage.pose((1.3, 28.3, 2.1), boresight=(0, 1, 0)),
        "P": stage.pose((-13.1, 25.3, -6.6), boresight=(0, 1, 0)),
    }
    ways = _field_tracer(poses, city, mirrors=2).two_bounces.seen(
        LinkState(Link("A", "P"), 0.0, poses["A"], poses["P"])
    )
    worst, count = 0.0, 0
    for part in ways:
        if abs(part.mirror.normal[2]) > 0.5:
            ends = [poses["A"].position, poses["P"].position]
            ends[0 if part.before else 1] = ends[0 if part.before else 1] * [1, 1, -1] - [
                0,
                0,
                60.0,
            ]
            truth = (1 - share**2) * truths.lambertian_wall(
                ends[0], ends[1], share, 50.0, (60.0, 30.0)
            )
            worst = max(
                worst, abs(10 * np.log10((part.seen.magnitude.astype(float) ** 2).sum() / truth))
            )
            count += 1
    return worst if count == 2 else np.inf


@traced(
    "inner echoes added up from Fresnel's equations",
    "1e-9 of the power",
    "400 echoes leave less than float64 resolves; both sides are float64",
)
def reflectivity_of_scatterers() -> Errors:
    """Power reflectivity of a slab for both polarisations, from grazing to upright incidence, as
    the clutter field uses it."""
    from isac_rt.propagation.segments.reflection import slab_coefficients

    cosines = np.array([0.03, 0.21, 0.5, 0.83, 1.0])
    for eps, sigma, thickness in ((5.31, 1.9, 0.1), (6.31, 1.21, 0.012)):
        slab = stage.material(eps, sigma, 0.3, thickness)
        found = np.abs(slab_coefficients(slab, cosines, WAVELENGTH, whole=True)) ** 2
        truth = np.array(
            [[abs(r) ** 2 for r in slab_reflection(eps, sigma, thickness, c)] for c in cosines]
        ).T
        yield np.abs(found - truth).max()


@traced(
    "integral of the lobe over the half-space",
    "1e-6 relative",
    "quadrature to 1e-9; the edge of the half-space cuts the lobe",
)
def lobes_radiate_their_power() -> Errors:
    """The norm of the directive scattering pattern, for exponents 1, 4 and 7 and directions from
    grazing to upright."""
    from isac_rt.propagation.clutter.field import lobe_norm

    for alpha in (1, 4, 7):
        for cosine in (0.13, 0.6, 1.0):
            sine = np.sqrt(1 - cosine**2)

            def lobe(mu: float, phi: float, alpha=alpha, cosine=cosine, sine=sine) -> float:
                return ((1 + cosine * mu + sine * np.sqrt(1 - mu * mu) * np.cos(phi)) / 2) ** alpha

            truth = dblquad(lobe, 0, 2 * np.pi, 0, 1, epsrel=1e-9)[0]
            of = Material("x", 5.0, 1.0, 0.4, "directive", alpha, 0.1, "validation")
            yield abs(float(lobe_norm(of, np.array([cosine]))[0]) / truth - 1)


@case(
    "Recommendation ITU-R P.2040-3, Table 3, evaluated by hand",
    "0.0005 relative",
    "the truth is written with four digits",
)
def materials_at_77_ghz() -> Errors:
    """Permittivity and conductivity of concrete, glass and plasterboard at the carrier."""
    truth = {"concrete": (5.24, 1.381), "glass": (6.31, 1.211), "plasterboard": (2.73, 0.5033)}
    _, found = resolve_materials([Use(name) for name in truth], truths.CARRIER, {})
    for one in found:
        eps, sigma = truth[one.name]
        yield abs(one.relative_permittivity / eps - 1)
        yield abs(one.conductivity / sigma - 1)


@case(
    "80.1 and 17.3 GHz at 20 degrees (CRC Handbook; Kaatze 1989)",
    "0.02 relative",
    "spread of the handbook values",
)
def water() -> float:
    """Static permittivity and relaxation frequency of water, on which the permittivity of soil and
    leaves rests."""
    f = np.linspace(10e9, 30e9, 2001)
    peak = f[np.argmax([-water_permittivity(x).imag for x in f])]
    return max(abs(water_permittivity(1e6).real / 80.1 - 1), abs(peak / 17.3e9 - 1))


@case("TR 38.901 v19, table 7.9.2.1-1 and eq. 7.9.2-2", "1e-9 dB", "float64 rounding")
def cross_section_of_a_small_uav() -> Errors:
    """-12.81 dBsm seen from where it is lit, 3 sin(beta/2) dB less under a bistatic angle beta."""
    section = CrossSection(Rcs(fluctuation_db=0), "U1", 7)
    for beta in (0.0, 0.41, 1.57, 2.6):
        u, v = np.array([[1.0, 0, 0]]), np.array([[np.cos(beta), np.sin(beta), 0]])
        yield abs(10 * np.log10(section.square_metres(u, v)[0]) - (-12.81 - 3 * np.sin(beta / 2)))


@case(
    "mean over all aspects as printed in TR 38.901 v19, table 7.9.2.1-2: -5.85 dBsm",
    "0.15 dB",
    "the lobes are read from printed widths of three digits",
)
def cross_section_of_a_large_uav() -> float:
    """The lobes of the large UAV, averaged over the sphere (Gauss-Legendre in the cosine, even in
    azimuth)."""
    mu, weight = np.polynomial.legendre.leggauss(400)
    phi = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    s = np.sqrt(1 - mu**2)[:, None]
    u = np.stack(
        [s * np.cos(phi), s * np.sin(phi), np.broadcast_to(mu[:, None], (400, 720))], axis=-1
    )
    mean = (10 ** (large_uav_db(u, np.zeros((400, 720))) / 10)).mean(axis=1) @ weight / 2
    return abs(10 * np.log10(mean) + 5.85)


@case(
    "the standard deviation asked for",
    "4.5 sigma",
    "false alarm 7e-6; 300 bodies in 10 aspects 0.8 rad apart and more, taken as one "
    "independent draw per body",
)
def fluctuation_of_a_cross_section() -> float:
    """A fluctuation of 3 dB varies with this standard deviation from body to body."""
    rng = np.random.default_rng(11)
    u = rng.normal(size=(10, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    of = Rcs(fluctuation_db=3.0)
    level = (
        np.array(
            [10 * np.log10(CrossSection(of, f"U{i}", 5).square_metres(u, u)) for i in range(300)]
        )
        + 12.81
        + np.log(10) / 20 * 9
    )
    return abs(float((level**2).mean()) / 9 - 1) / np.sqrt(2 / 300)


@case("integral of the gain over the sphere, 4 pi", "1e-6 relative", "quadrature")
def elements_radiate_their_power() -> float:
    """The cosine pattern of an element of 5 dBi radiates what it is given."""
    antennas = Antennas(
        tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=2e-3, gain=10**0.5, pattern="cosine"
    )

    def density(angle: float) -> float:
        return float(antennas.element_gain(np.array([np.sin(angle), np.cos(angle), 0.0]))) * np.sin(
            angle
        )

    return abs(quad(density, 0, np.pi / 2, epsabs=1e-10)[0] / 2 - 1)


@case(
    "-173.975 dBm/Hz at 290 K (k by the SI), bandwidth and noise figure in decibels",
    "0.001 dB",
    "the truth is printed to a thousandth",
)
def thermal_noise() -> float:
    """Noise of a complex sample over the sampling rate of 20 MHz with a noise figure of 11.3 dB;
    Gaussian clutter adds in power."""
    found = thermal_noise_power(Noise(noise_figure_db=11.3), Waveform())
    rise = Clutter(model="gaussian", clutter_to_noise_db=3.0103).noise_rise
    return max(
        abs(10 * np.log10(found / 1e-3) - (-173.975 + 10 * np.log10(20e6) + 11.3)),
        abs(rise - 3) / 3,
    )
