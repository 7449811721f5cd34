"""Geometry, delay and Doppler against long double and closed forms."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path

import numpy as np
from scipy.integrate import quad

from isac_rt import scenario as tree
from isac_rt.extensions.city_files.extrude import building
from isac_rt.frame.antennas import Arrays
from isac_rt.frame.link import Link
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.segments.geometry import Segments, plane_of_each_face, straight, unfold
from isac_rt.world.city import load_city
from isac_rt.world.city.georeference import LONLAT, GeoReference, plane_about
from isac_rt.world.city.materials import MaterialUse
from isac_rt.world.city.mesh import clean
from isac_rt.world.city.prism import Finish
from isac_rt.world.swarm import Pose, Trajectory
from truths import stage, truths
from truths.case import Errors, case, slow_traced, traced
from truths.truths import chain_length, derivatives, flown, wide

C = 299_792_458.0
LONGEST_ROUNDING = "float64 over coordinates of 1 km: a few times 1e-13 m"
FRONT, SIDE, FLOOR = (
    ((0.1, -1.0, 0.05), (0.0, 52.0, 3.0)),
    ((-1.0, 0.1, 0.1), (47.0, 0.0, 0.0)),
    ((0.02, -0.03, 1.0), (24.0, 17.0, 6.9)),
)
TX = ((1.37, -2.21, 11.3), (4.3, -7.1, 1.9), (0.7, 1.1, -2.3))
RX = ((23.9, 17.3, 8.77), (-6.2, 2.9, 3.1), (-1.3, 0.4, 0.9))
BODY = ((9.7, 31.1, 14.9), (3.7, 8.3, -2.2), (2.1, -0.6, 1.7))


def _unfolded(planes: tuple, start: Pose, end: Pose) -> Segments:
    normals = np.array([np.array(n, float) / np.linalg.norm(n) for n, _ in planes]).reshape(
        1, -1, 3
    )
    offsets = np.array(
        [[n @ np.array(p, float) for n, (_, p) in zip(normals[0], planes, strict=True)]]
    ).reshape(1, -1)
    return unfold(normals, offsets, start, end)


def _over(planes: tuple, distances: tuple[float, ...] = (1.013, 9.87, 101.3, 997.7)) -> Errors:
    """Largest error of the length over a chain of planes, for ends so far apart."""
    for d in distances:
        end = np.array(TX[0]) + d * np.array([0.61, 0.73, 0.309])
        found = _unfolded(planes, stage.pose(TX[0]), stage.pose(end)).length[0]
        yield abs(found - chain_length(planes, np.array(TX[0]), end))


def _free_space(poses: dict[str, Pose], tx: str, rx: str):
    s = stage.scenario(traced=False)
    return (
        FreeSpace(s.swarm, Arrays(stage.FEW), truths.WAVELENGTH, s.seed)
        .trace(poses, 0.0, [Link(tx, rx)])
        .paths[Link(tx, rx)]
    )


def _doppler_error(found: float, length) -> float:
    """Error of a Doppler [Hz] against the derivative of a length in long double."""
    return abs(-truths.CARRIER * found - -truths.CARRIER / C * derivatives(length)[0])


NANOMETRE = "1e-9 m is 1.6e-6 rad of the carrier; " + LONGEST_ROUNDING
DIFFERENCE = (
    "4th-order differences over 1 ms leave h^4/30 of the fifth derivative, 1e-9 m/s, "
    "which is 3e-7 Hz"
)


@case("distance in long double", "1e-9 m", NANOMETRE)
def delay_of_the_line_of_sight() -> Errors:
    """The length of the line of sight from 1 m to 1 km is good to a nanometre."""
    for d in (1.013, 9.87, 101.3, 997.7):
        end = np.array(TX[0]) + d * np.array([0.61, 0.73, 0.309])
        yield (
            abs(
                straight(stage.pose(TX[0]), end[None]).length[0]
                - chain_length((), np.array(TX[0]), end)
            )
        )


@case("sqrt(d^2 + (h1 + h2)^2) in long double", "1e-9 m", NANOMETRE)
def delay_over_the_ground() -> Errors:
    """The ground's reflection is the image under the ground, from 1 m to 1 km."""
    for d in (1.013, 9.87, 101.3, 997.7):
        segments = _unfolded(
            (((0, 0, 1), (3.3, 1.7, 0.41)),), stage.pose((0, 0, 9.87)), stage.pose((d, 0, 4.31))
        )
        h = wide([9.87, 4.31]).sum() - 2 * np.longdouble(0.41)
        yield abs(segments.length[0] - np.sqrt(np.longdouble(d) ** 2 + h * h))


@case("Householder matrix in long double", "1e-9 m", NANOMETRE)
def delay_over_a_slanting_wall() -> Errors:
    """The reflection off a wall of any attitude, from 1 m to 1 km."""
    return _over((FRONT,))


@case("product of Householder matrices in long double", "1e-9 m", NANOMETRE)
def delay_over_two_planes() -> Errors:
    """Paths over two planes, from 1 m to 1 km."""
    return _over((FRONT, SIDE))


@case("product of Householder matrices in long double", "1e-9 m", NANOMETRE)
def delay_over_three_planes() -> Errors:
    """Paths over three planes, from 1 m to 1 km."""
    return _over((FRONT, FLOOR, SIDE))


@case("twice the distance to the corner", "1e-9 m", NANOMETRE)
def corner_of_three_right_angles() -> float:
    """A corner of three planes at right angles returns a wave along its own way, twice the distance
    to the corner."""
    turn, _ = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))
    corner, radar = np.array([31.3, -24.7, 13.9]), np.array([9.3, 13.1, 7.7])
    segments = _unfolded(tuple((n, corner) for n in turn), stage.pose(radar), stage.pose(radar))
    away = float(truths.norm(wide(radar) - wide(corner)))
    straight_back = float(np.abs(segments.departure[0] - segments.arrival[0]).max()) * away
    return max(abs(segments.length[0] - 2 * away), straight_back)


@case(
    "Householder matrices of the undisplaced world in long double",
    "1e-9 m",
    "float64 holds 1e5 m to 1.5e-11 m, and a plane's offset is a mean of three such corners",
)
def city_100_km_from_the_origin() -> float:
    """A mesh file whose city lies 100 km from the world's origin keeps its delays after recentring:
    two walls, from file to length."""
    far = np.array([71003.271, -69012.133, 812.437])
    corners = {
        "front": [(-40, 52, -30), (40, 61, -30), (40, 61, 30), (-40, 52, 30)],
        "side": [(47, -60, -30), (41, 60, -30), (41, 60, 30), (47, -60, 30)],
    }
    text, planes = "", []
    for i, (name, place) in enumerate(corners.items()):
        text += f"o {name}\n" + "".join(
            "v " + " ".join(f"{c:.9f}" for c in far + np.array(p)) + "\n" for p in place
        )
        text += f"f {4 * i + 1} {4 * i + 2} {4 * i + 3}\nf {4 * i + 1} {4 * i + 3} {4 * i + 4}\n"
        a, b, d = (wide(p) for p in np.array(place, float)[[0, 1, 3]])
        planes.append((np.cross(b - a, d - a), a))
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "city.obj").write_text(text)
        city = load_city(
            tree.City(source="mesh", file="city.obj"),
            folder,
            truths.CARRIER,
            far + np.array([7.3, 3.1, 1.9]),
        )
    normals, offsets = plane_of_each_face(city)
    start, end = np.array([1.37, -2.21, 3.3]), np.array([23.9, 17.3, 8.77])
    truth = chain_length(planes, start, end)
    order = [
        int(np.argmax((city.corners + city.origin - far).mean(axis=1) @ n))
        for n in ((0, 1, 0), (1, 0, 0))
    ]
    segments = unfold(
        normals[order][None],
        offsets[order][None],
        *(stage.pose(far + p - city.origin) for p in (start, end)),
    )
    return float(abs(segments.length[0] - truth))


@case("derivative of the long-double length", "1e-5 Hz", DIFFERENCE)
def doppler_of_a_moving_transmitter() -> float:
    """Doppler of the line of sight when only the transmitter flies (a receding one is negative)."""
    segments = straight(stage.pose(*TX), np.array([RX[0]]))
    return _doppler_error(segments.rate[0] / C, lambda t: truths.norm(wide(RX[0]) - flown(*TX, t)))


@case("derivative of the long-double length", "1e-5 Hz", DIFFERENCE)
def doppler_of_a_moving_receiver() -> float:
    """Doppler of the line of sight when only the receiver flies."""
    segments = straight(stage.pose(TX[0]), np.array([RX[0]]), np.array(RX[1]), np.array(RX[2]))
    return _doppler_error(segments.rate[0] / C, lambda t: truths.norm(flown(*RX, t) - wide(TX[0])))


@case("derivative of the long-double length over the wall where it then is", "1e-5 Hz", DIFFERENCE)
def doppler_of_a_moving_reflector() -> float:
    """A mirror in motion is unfolded in its own frame: Doppler of a wall that moves along and
    across while both ends rest."""
    w = np.array([3.3, -5.7, 1.1])
    normal, point = SIDE
    segments = _unfolded((SIDE,), stage.pose(TX[0], -w), stage.pose(RX[0], -w))

    def length(t: np.longdouble) -> np.longdouble:
        return chain_length(((normal, wide(point) + t * wide(w)),), wide(TX[0]), wide(RX[0]))

    return _doppler_error(segments.rate[0] / C, length)


@case("derivative of the long-double length", "1e-5 Hz", DIFFERENCE)
def doppler_of_a_moving_target() -> float:
    """Doppler of an echo over two terminals at rest when only the target flies."""
    poses = {"A": stage.pose(TX[0]), "P": stage.pose(RX[0]), "U": stage.pose(*BODY)}
    paths = _free_space(poses, "A", "P")
    rate = paths.delay_rate[paths.kind == PathKind.TARGET][0]
    return _doppler_error(
        rate,
        lambda t: (
            truths.norm(flown(*BODY, t) - wide(TX[0])) + truths.norm(flown(*BODY, t) - wide(RX[0]))
        ),
    )


@case("derivative of the long-double length", "1e-5 Hz", DIFFERENCE)
def doppler_of_a_scatterer() -> float:
    """Doppler over a scatterer at rest when both ends fly: the sum of two segments."""
    point = np.array([-11.3, 24.1, 5.7])
    rate = sum(straight(stage.pose(*end), point[None]).rate[0] for end in (TX, RX)) / C
    return _doppler_error(
        rate,
        lambda t: (
            truths.norm(wide(point) - flown(*TX, t)) + truths.norm(wide(point) - flown(*RX, t))
        ),
    )


@case("derivative of the long-double length", "1e-5 Hz", DIFFERENCE)
def doppler_of_everything_at_once() -> float:
    """Doppler of ghosts, off one wall to the target and off two on the way back, all three bodies
    in curved flight."""
    there, back = (FRONT,), (FLOOR, SIDE)
    rate = (
        _unfolded(there, stage.pose(*TX), stage.pose(*BODY)).rate[0]
        + _unfolded(back, stage.pose(*BODY), stage.pose(*RX)).rate[0]
    ) / C
    return _doppler_error(
        rate,
        lambda t: (
            chain_length(there, flown(*TX, t), flown(*BODY, t))
            + chain_length(back, flown(*BODY, t), flown(*RX, t))
        ),
    )


@case(
    "second derivative of the long-double length",
    "1e-8 m/s^2",
    "4th-order second differences over 1 ms: rounding 1e-18 * 50 m / h^2 and h^4/90 of the "
    "sixth derivative",
)
def acceleration_of_a_folded_path() -> float:
    """Second derivative of the length over three planes, both ends in curved flight."""
    planes = (FRONT, FLOOR, SIDE)
    found = _unfolded(planes, stage.pose(*TX), stage.pose(*RX)).accel[0]
    return abs(found - derivatives(lambda t: chain_length(planes, flown(*TX, t), flown(*RX, t)))[1])


@case("second derivative of the long-double length", "1e-8 m/s^2", "as for folded paths")
def acceleration_of_an_echo() -> float:
    """Second derivative of an echo's length, all three bodies in curved flight."""
    poses = {"A": stage.pose(*TX), "P": stage.pose(*RX), "U": stage.pose(*BODY)}
    paths = _free_space(poses, "A", "P")
    found = paths.delay_accel[paths.kind == PathKind.TARGET][0] * C
    return abs(
        found
        - derivatives(
            lambda t: (
                truths.norm(flown(*BODY, t) - flown(*TX, t))
                + truths.norm(flown(*BODY, t) - flown(*RX, t))
            )
        )[1]
    )


@case(
    "Fermat: the length is stationary, by moving each point along its wall",
    "1e-6 rad",
    "slope of the length, by differences of 1e-5 m over lengths known to 1e-14 m; curvature "
    "cancels",
)
def mirror_points_obey_fermat() -> Errors:
    """The interaction points of a path over three planes are where its length is stationary; they
    lie on the planes."""
    planes = (FRONT, FLOOR, SIDE)
    points = _unfolded(planes, stage.pose(TX[0]), stage.pose(RX[0])).points[0]
    for b, (normal, point) in enumerate(planes):
        n = np.array(normal) / np.linalg.norm(normal)
        yield abs(n @ (points[b] - np.array(point)))
        for along in (np.cross(n, [0.3, 0.5, 0.8]), np.cross(n, [0.9, -0.2, 0.1])):
            sides = []
            for step in (-1e-5, 1e-5):
                moved = points.copy()
                moved[b] += step * along / np.linalg.norm(along)
                sides.append(np.linalg.norm(np.diff([TX[0], *moved, RX[0]], axis=0), axis=1).sum())
            yield abs(sides[1] - sides[0]) / 2e-5


@case("the same chain walked backwards", "1e-9 m", NANOMETRE)
def reciprocity_of_folded_paths() -> float:
    """The way back over the same planes has the same length and rate, and the two directions change
    places."""
    planes = (FRONT, FLOOR, SIDE)
    on = _unfolded(planes, stage.pose(*TX), stage.pose(*RX))
    back = _unfolded(planes[::-1], stage.pose(*RX), stage.pose(*TX))
    turned = np.abs(on.departure - back.arrival).max() + np.abs(on.arrival - back.departure).max()
    return float(max(abs(on.length[0] - back.length[0]), abs(on.rate[0] - back.rate[0]), turned))


@slow_traced(
    "images of a box: an integer lattice",
    "3e-6 m",
    "the scene's file holds its corners as float32 numbers of up to 10 m, half an ulp 5e-7 m, "
    "times the bounces",
)
def every_path_of_a_box() -> float:
    """The ray tracer finds every path in a closed box up to two bounces, once each, and no other: a
    lattice of images."""
    city = load_city(
        tree.City(source="builtin", name="box"), ".", truths.CARRIER, (0.31, -0.17, 0.9)
    )
    low, high = city.bounds() + city.origin
    a, p = np.array([-1.73, 2.31, 1.91]), np.array([2.93, -1.13, 3.37])
    lattice = []
    for index in itertools.product(range(-2, 3), repeat=3):
        if np.abs(index).sum() <= 2:
            image = [_image(a[i], low[i], high[i], index[i]) for i in range(3)]
            lattice.append(np.linalg.norm(p - np.array(image)))
    paths = (
        stage.tracer(city, 2)
        .trace(stage.swarm(a, p, (0.71, 1.37, 2.03)), 0.0, [Link("A", "P")])
        .paths[Link("A", "P")]
    )
    found = np.sort(C * paths.delay[paths.target < 0])
    return float(np.abs(found - np.sort(lattice)).max()) if found.size == len(lattice) else np.inf


def _image(x: float, low: float, high: float, crossings: int) -> float:
    """Coordinate of the image after so many walls, counted with the sign of the side."""
    width = high - low
    return x + crossings * width if crossings % 2 == 0 else low + high - x + crossings * width


@traced("one plane has one image", "0 paths", "exact")
def a_wall_10_km_off_reflects_once() -> float:
    """Far from the tracer's origin Sionna finds one reflection several times at full amplitude; one
    is kept."""
    far = np.array([7100.3, -6900.7, 310.1])
    city = stage.rectangle(
        far + np.array([31.3, -60, -60]), (5.0, 120, 0), (0, 0, 120), stage.material()
    )
    poses = stage.swarm(
        far + np.array([0.3, 1.1, 9.3]),
        far + np.array([1.7, 17.4, 8.1]),
        far + np.array([-3.3, -2.2, 7.9]),
    )
    paths = stage.tracer(city, 1).trace(poses, 0.0, [Link("A", "P")]).paths[Link("A", "P")]
    return abs(paths.counts()["specular"] - 1)


@case(
    "differences of the positions",
    "5e-6 m/s",
    "central differences over 1 ms: h^2/6 of a third derivative of up to 30 m/s^3",
)
def velocity_along_waypoints() -> float:
    """Velocity and acceleration of a flight through waypoints are the derivatives of its position,
    and it passes through them."""
    points = [
        (0.0, (34, 54, 21)),
        (1.7, (46.3, 52.1, 21.5)),
        (3.6, (60.2, 49.7, 22.5)),
        (4.4, (63.9, 55.3, 20.1)),
    ]
    flight = Trajectory(
        tree.Uav.model_validate(
            {"role": "target", "waypoints": [{"time_s": t, "position_m": p} for t, p in points]}
        )
    )
    worst, h = max(float(np.abs(flight.pose(t).position - p).max()) for t, p in points), 1e-3
    for t in (0.731, 2.27, 3.93):
        before, now, after = (flight.pose(t + d) for d in (-h, 0, h))
        worst = max(
            worst, float(np.abs((after.position - before.position) / (2 * h) - now.velocity).max())
        )
        worst = max(
            worst,
            float(np.abs((after.velocity - before.velocity) / (2 * h) - now.acceleration).max())
            * h,
        )
    return worst


@case(
    "integral of the meridian's radius of curvature over WGS 84",
    "1e-6 m",
    "projection and quadrature to 1e-9 of 3 km",
)
def longitude_and_latitude_to_metres() -> float:
    """Distances along the meridian through the middle of a footprint file are true to the
    ellipsoid."""
    lat, away = 48.137, np.array([-0.0143, 0.0027, 0.0269])
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    place = GeoReference(LONLAT, (11.575, lat, 0.0), plane_about(11.575, lat))
    found = place.to_world(np.column_stack([np.full(3, 11.575), lat + away]))[:, 1]
    arcs = [
        quad(
            lambda x: a * (1 - e2) / (1 - e2 * np.sin(x) ** 2) ** 1.5,
            np.radians(lat),
            np.radians(lat + d),
            epsabs=1e-9,
        )[0]
        for d in away
    ]
    return float(np.abs(found - arcs).max())


@case(
    "area times height, area by the shoelace formula",
    "1e-12 relative",
    "float64 rounding over a few dozen triangles",
)
def buildings_are_closed_and_face_outward() -> float:
    """The volume of an extruded building with a courtyard, by the divergence theorem over its
    triangles."""
    import shapely

    outer = [(0, 0), (31.3, 2.1), (28.7, 19.9), (14.1, 12.3), (-3.3, 17.7)]
    yard = [(7.1, 4.3), (13.7, 5.1), (9.9, 9.7)]

    def shoelace(ring: list[tuple[float, float]]) -> float:
        x, y = np.array(ring).T
        return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2

    use = MaterialUse("concrete")
    vertices, faces, *_ = clean(
        building(shapely.Polygon(outer, [yard]), 1.3, 18.9, Finish(use, use, use), "house"),
        "house",
        np.array([4.0, 5.0, 6.0]),
        None,
    )
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    truth = (shoelace(outer) - shoelace(yard)) * 17.6
    return abs(float((a * np.cross(b, c)).sum()) / 6 / truth - 1)
