"""Scatterers pinned to the mesh: advancing them to a frame against tracing anew, and leaving the
faintest out.

Two errors, told apart by `error_of`. Advancing: the mean power of all scatterers of the field
against that of Sionna RT's diffuse solution with as many rays, averaged over the same frames,
|P/P_sionna - 1|; the re-trace is the oracle of cost. Samples: noise-free samples of the scatterers
that are kept against those of all, ||Y - Y_all||/||Y_all||, both by the gridded synthesis.

The scene is `town` with its active terminal alone: one link, frames that follow each other, tests
of sight on the way included.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.measure import cpu_seconds, floor_seconds
from benchmarks.scenes import alone
from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Gridded
from isac_rt.simulation.audit import tracer_of
from isac_rt.simulation.plan import faintest
from isac_rt.simulation.setup import Setup, prepare
from isac_rt.world.swarm import Pose

if TYPE_CHECKING:
    import sionna.rt as rt

    from isac_rt.propagation.clutter.field import ClutterField
    from isac_rt.world.city.mesh import CityMesh

AREAS = (1.0, 0.25, 0.06, 0.015)
"""Largest area of a cell over its distance [m]: four times fewer scatterers each."""
LEFT_OUT = (1e-4, 1e-3, 1e-2, 1e-1)
"""Share of a range cell's power that may be left out."""
FRAMES = 24
"""Frames in a row that are advanced: 4 m of flight, so eight tests of sight."""
BLOCKS = 3
PILOT_RAYS = 20_000
LINK = Link("AT", "AT")


def rows(quick: bool) -> list[dict[str, object]]:
    """Cost against the number of scatterers, and error and cost of leaving the faintest out of the
    samples."""
    floor, out = floor_seconds((3, 15, 120, 1024)), []
    for area in AREAS[:2] if quick else AREAS:
        setup = prepare(_scene(model="field", cell_area_per_metre_m=area))
        out += _of_tracing(setup, floor)
    return out + _of_samples(setup, floor, 3 if quick else 7)


def _field(setup: Setup) -> ClutterField:
    tracer = tracer_of(setup)
    assert tracer is not None and tracer.field is not None
    return tracer.field.whole()


def _scene(**clutter: Any) -> Scenario:
    return alone(frames=FRAMES * (BLOCKS + 1) + 2, clutter=clutter)


def sionna_scene(city: CityMesh, carrier: float, place: np.ndarray) -> rt.Scene:
    """Sionna RT's scene with an isotropic transmitter and receiver at one place."""
    import mitsuba as mi
    import sionna.rt as rt

    from isac_rt.world.city.scene import build_scene

    scene = build_scene(city, carrier).scene
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    scene.add(rt.Transmitter("tx", mi.Point3f(*place.tolist())))
    scene.add(rt.Receiver("rx", mi.Point3f(*place.tolist())))
    return scene


def traced_anew(scene: rt.Scene, place: np.ndarray, rays: int) -> np.ndarray:
    """Power gains (paths,) of Sionna RT's diffuse paths from a place back to itself."""
    import mitsuba as mi
    import sionna.rt as rt

    for device in (scene.get("tx"), scene.get("rx")):
        device.position = mi.Point3f(*place.tolist())
    options = {"los": False, "specular_reflection": False, "refraction": False}
    found = rt.PathSolver()(
        scene,
        max_depth=1,
        samples_per_src=rays,
        max_num_paths_per_src=rays,
        diffuse_reflection=True,
        **options,
    )
    real, imag = (np.asarray(x, np.float64).ravel() for x in found.a)
    return (real**2 + imag**2)[np.asarray(found.valid).ravel()]


def advance(setup: Setup, frames: range) -> tuple[float, float, int]:
    """CPU seconds per frame of advancing the field through some frames, its mean power gain and how
    many scatterers were in sight."""
    field, power, seen = _field(setup), 0.0, 0
    begin = time.process_time()
    for frame in frames:
        when = setup.timetable.epoch(frame)
        pose = _local(setup, when)
        found = field.seen(LinkState(LINK, when, pose, pose))
        gain = field.cells.amplitude[found.index] * found.magnitude
        power += float((found.magnitude.astype(float) ** 2).sum())
        seen = len(gain)
    return (time.process_time() - begin) / len(frames), power / len(frames), seen


def _local(setup: Setup, when: float) -> Pose:
    pose = setup.swarm.poses(when)["AT"]
    return replace(pose, position=pose.position - setup.city.origin)


def _of_tracing(setup: Setup, floor: float) -> list[dict[str, object]]:
    """Advancing and tracing anew in turns, the first turn to warm up."""
    scatterers = len(_field(setup).cells)
    place = _local(setup, 0.0).position
    scene = sionna_scene(setup.city, setup.waveform.carrier_frequency, place)
    rays = round(scatterers * PILOT_RAYS / len(traced_anew(scene, place, PILOT_RAYS)))
    seconds: dict[str, list[float]] = {"advanced": [], "traced anew by Sionna RT": []}
    powers: list[list[float]] = []
    for block in range(BLOCKS + 1):
        frames = range(FRAMES * block, FRAMES * (block + 1))
        cost, power, _ = advance(setup, frames)
        seconds["advanced"].append(cost)
        place = _local(setup, setup.timetable.epoch(frames[FRAMES // 2])).position
        begin = time.process_time()
        gains = traced_anew(scene, place, rays)
        seconds["traced anew by Sionna RT"].append(time.process_time() - begin)
        powers.append([power, float(gains.sum())])
    total = np.sum(powers, axis=0)
    row: dict[str, Any] = {
        "kind": "clutter",
        "size": scatterers,
        "unit": "scatterers",
        "floor_s": floor,
        "error_of": "mean power against Sionna RT",
        "job": f"{FRAMES} frames in a row, one link",
    }
    out = []
    for (method, of), error in zip(
        seconds.items(), (float(abs(total[0] / total[1] - 1)), 0.0), strict=True
    ):
        cpu = median(of[1:])
        out.append(
            {
                **row,
                "method": method,
                "error": error,
                "cost": cpu / floor,
                "seconds": cpu,
                "oracle": error == 0,
            }
        )
    return out


def _of_samples(setup: Setup, floor: float, repeats: int) -> list[dict[str, object]]:
    """Samples of all scatterers, and of those that are left when the faintest of each range cell
    are left out."""
    poses, found = setup.find(0)
    paths = found[LINK].select(found[LINK].kind == PathKind.DIFFUSE)
    cell = np.floor(paths.delay / setup.waveform.delay_step).astype(int)
    share = paths.power / np.bincount(cell, paths.power)[cell]
    sent = setup.transmission("AT", 0, poses["AT"])

    def samples(some: PathSet) -> np.ndarray:
        return if_signal(
            setup.waveform,
            [(sent, some)],
            ReceiveArray(poses["AT"], setup.antennas),
            Reference(setup.timetable.start_time(0, "AT")),
            Gridded(),
        ).samples

    truth, out = samples(paths), []
    for limit in (0.0, *LEFT_OUT):
        kept = paths.select(~faintest(share, cell, limit)[0]) if limit else paths
        method = f"samples, {limit:g} of a cell's power left out" if limit else "samples of all"
        error = (
            float(np.linalg.norm(samples(kept) - truth) / np.linalg.norm(truth)) if limit else 0.0
        )
        seconds = cpu_seconds(partial(samples, kept), repeats)
        out.append(
            {
                "kind": "clutter",
                "method": method,
                "size": len(kept),
                "unit": "scatterers",
                "error": error,
                "oracle": not limit,
                "error_of": "samples",
                "cost": seconds / floor,
                "seconds": seconds,
                "floor_s": floor,
            }
        )
    return out
