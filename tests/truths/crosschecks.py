"""The same numbers from software that nobody here wrote. Only Sionna RT comes with the program; the
others are looked for."""

from __future__ import annotations

import datetime
import warnings

import numpy as np

from isac_rt import scenario as tree
from isac_rt.frame.cube import Transmission
from isac_rt.frame.link import Link
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.cfar import greatest_of_factor
from isac_rt.results.metrics import gospa
from isac_rt.scenario.file import load
from isac_rt.signal.methods import Direct
from isac_rt.simulation.audit import CHECK_RAYS, present, tracer_of
from isac_rt.simulation.plan import MATTERS_DB
from isac_rt.simulation.setup import prepare
from isac_rt.world.city import load_city
from reproduce import SCENES
from truths import stage, truths
from truths.case import Errors, case, slow_traced, traced

PLACES = ((-11.37, 2.13, 14.21), (17.93, -3.31, 9.67), (4.41, 1.73, 20.3))
"""Places of the three bodies in Sionna's street canyon."""


@traced(
    "Sionna RT's own Paths.cir",
    "0.05 of the sum",
    "their delays and phases are float32: up to 0.05 rad at 40 m",
)
def paths_of_a_canyon_against_sionna() -> float:
    """The channel of a street canyon, paths sorted by delay: complex amplitudes with the carrier
    phase."""
    import mitsuba as mi
    import sionna.rt as rt

    from isac_rt.world.city.scene import build_scene

    city = load_city(
        tree.City(source="builtin", name="simple_street_canyon"),
        ".",
        truths.CARRIER,
        (0.31, -0.17, 0.9),
    )
    poses = stage.swarm(*PLACES, moving=False)
    ours = stage.tracer(city, 2).trace(poses, 0.0, [Link("A", "P")]).paths[Link("A", "P")]
    ours = ours.select(ours.target < 0)
    scene = build_scene(city, truths.CARRIER).scene
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    local = {n: mi.Point3f(*(poses[n].position - city.origin).tolist()) for n in "AP"}
    scene.add(rt.Transmitter("tx", local["A"]))
    scene.add(rt.Receiver("rx", local["P"]))
    found = rt.PathSolver()(scene, max_depth=2, samples_per_src=20_000, refraction=False)
    a, tau = found.cir(normalize_delays=False, out_type="numpy")
    a, tau = np.asarray(a).ravel(), np.asarray(tau, float).ravel()
    a, tau = a[tau >= 0], tau[tau >= 0]
    if a.size != len(ours):
        return np.inf
    mine = (ours.gain * np.exp(-2j * np.pi * ((truths.CARRIER * ours.delay) % 1)))[
        np.argsort(ours.delay)
    ]
    return stage.relative(mine, a[np.argsort(tau)])


@slow_traced(
    "Sionna RT's own PathSolver with 300,000 rays in each of three frames",
    "0 paths",
    "over -10 dB of the noise of a cell; 5 x 60,000 rays about each frame find the chains of walls",
)
def paths_missed_in_a_city() -> float:
    """Mirror images and ghosts of a swarm between the walls of Munich that matter: none is
    missed."""
    setup = prepare(
        load(SCENES / "munich_swarm.yaml", ["clutter.model=none", "receiver_preset=plain"])
    )
    tracer, missed = tracer_of(setup), 0
    assert tracer is not None
    for number in (5, 31, 69):
        poses, found = setup.find(number)
        epoch = setup.timetable.epoch(number)
        truth = tracer.by_sionna(CHECK_RAYS).trace(poses, epoch, list(found)).paths
        for link, paths in truth.items():
            level = setup.noise_power(poses, link) / setup.plan.cell_noise_gain(link.tx)
            over = paths.select(paths.power > level * 10 ** (MATTERS_DB / 10))
            missed += int((~present(over, found[link])).sum())
    return missed


@slow_traced(
    "Sionna RT's own RCSSolver with a body in the scene",
    "0.01 relative",
    "what turns horizontal on one segment and back on the other is left out here, 0.23 % at most",
)
def echoes_against_sionna() -> float:
    """Echo and ghosts of a target over floor and wall: the same paths with the same complex
    amplitudes."""
    import mitsuba as mi
    import sionna.rt as rt
    from sionna.rt.rcs import ConstantRCSSensingTarget, RCSSolver

    from isac_rt.world.city.scene import build_scene

    city = load_city(
        tree.City(source="builtin", name="floor_wall"), ".", truths.CARRIER, (0.31, -0.17, 0.9)
    )
    poses = stage.swarm((1.13, -0.41, 2.71), (1.71, 0.33, 0.31), (1.31, 0.43, 1.63))
    ours = stage.tracer(city, 2).trace(poses, 0.0, [Link("A", "P")]).paths[Link("A", "P")]
    ours = ours.select(ours.target == 2)
    scene = build_scene(city, truths.CARRIER).scene
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    local = {n: mi.Point3f(*(p.position - city.origin).tolist()) for n, p in poses.items()}
    scene.add(rt.Transmitter("tx", local["A"]))
    scene.add(rt.Receiver("rx", local["P"]))
    size = {"length": 0.02, "width": 0.02, "height": 0.02}
    scene.add(ConstantRCSSensingTarget("body", sigma=10**-1.17, position=local["U"], **size))
    theirs = RCSSolver(deterministic=True)(
        scene, max_depth=3, buffer_size_per_sp=10_000, samples_per_sp=20_000, refraction=False
    )
    valid = np.asarray(theirs.valid).ravel()
    gain = (np.asarray(theirs.a[0], float) + 1j * np.asarray(theirs.a[1], float)).ravel()[valid]
    order = np.argsort(np.asarray(theirs.tau, float).ravel()[valid])
    if gain.size != len(ours):
        return np.inf
    return float(np.abs(ours.gain[np.argsort(ours.delay)] / gain[order] - 1).max())


@case(
    "mmWrt's cube of the same three scatterers, to a common phase",
    "1e-6 relative",
    "they take the receive frequency at the sample for the phase: the same at rest; complex64",
    package="mmWrt",
)
def cube_against_mmwrt() -> float:
    """IF samples of three scatterers at rest, one chirp, four receivers in a row."""
    from mmWrt.Raytracing import rt_points
    from mmWrt.Scene import Antenna, Radar, Receiver, Scatterer, Transmitter

    w = Waveform(num_groups=1, num_tx=1, num_chirps=2, num_samples=200)
    places = [(3.7, 31.2, 1.1), (-9.1, 44.7, 2.9), (14.3, 27.1, -3.3)]
    row = np.array([(k * 0.5774 * w.wavelength, 0.0, 0.0) for k in range(4)])
    begin = w.chirp_duration - w.sampled_duration
    radar = Radar(
        transmitter=Transmitter(
            chirp_start_freq=77e9 + w.slope * begin,
            chirp_slope=w.slope,
            chirp_end_time=w.sampled_duration * 1.05,
            chirp_period=w.slot_duration,
            chirp_count=1,
            frame_count=1,
            antennas=[Antenna()],
        ),
        receiver=Receiver(
            adc_sample_rate=w.sampling_rate,
            antennas=[Antenna(x=x) for x, _, _ in row],
            adc_sample_count=w.num_samples,
        ),
    )
    late = 12  # their chirp is not there before it has arrived; their speed of light is 3e8 m/s
    cube = rt_points([radar], [Scatterer(*p) for p in places], radar, datatype=np.complex128)[
        "adc_cube"
    ]
    theirs = np.asarray(cube).reshape(4, w.num_samples)[:, late:]
    ours = np.zeros((4, w.num_samples), complex)
    antennas = stage.arrays(w, tx_x=1, tx_z=1)
    here = stage.pose((0, 0, 0))
    sender = Transmission(
        name="A",
        pose=here,
        antennas=antennas,
        schedule=np.zeros((1, 2), np.int64),
        payload=unmodulated(w),
    )
    along = np.array([[0.0, 1.0, 0.0]])
    for i, element in enumerate(row):
        ways = [np.linalg.norm(p) + np.linalg.norm(np.array(p) - element) for p in places]
        paths = make_paths(
            gain=np.ones(3),
            delay=np.array(ways) / 3e8,
            departure=np.repeat(along, 3, 0),
            kind=PathKind.TARGET,
            arrival=np.repeat(along, 3, 0),
            epoch=w.frame_duration / 2,
            tx="A",
            rx="A",
        )
        centre = stage.synthesise(
            w, [(sender, paths)], here, Direct(), 0.0, stage.arrays(w, tx_x=1, tx_z=1, spacing=1e-9)
        )
        ours[i] = centre[0, 0, 0]
    ours = ours[:, late:]
    turn = (theirs * ours.conj()).sum()
    return stage.relative(ours * turn / abs(turn), theirs)


@case(
    "mmWrt's cell-averaging factor",
    "0.0001 relative",
    "trapezoid over 4001 points",
    package="mmWrt",
)
def cfar_against_mmwrt() -> float:
    """Threshold factor of one channel over 8 and 16 cells of one side, at 1e-2 and 1e-5."""
    from mmWrt.RadarSignalProcessing import cfar_alpha

    return max(
        abs(greatest_of_factor(rate, 1.0, float(n), 0.0) / cfar_alpha(n, rate) - 1)
        for n in (8, 16)
        for rate in (1e-2, 1e-5)
    )


@case(
    "Stone Soup's GOSPAMetric on the same data", "1e-9 m", "float64 rounding", package="stonesoup"
)
def gospa_against_stone_soup() -> Errors:
    """GOSPA distances of fifty random scenes of up to seven targets and seven tracks."""
    from stonesoup.metricgenerator.ospametric import GOSPAMetric
    from stonesoup.types.state import State

    rng, now = np.random.default_rng(4), datetime.datetime(2026, 1, 1)
    metric = GOSPAMetric(p=2, c=2.7)
    for _ in range(50):
        x, y = (rng.uniform(0, 4, (int(rng.integers(1, 8)), 3)) for _ in range(2))
        states = [[State(p[:, None], timestamp=now) for p in side] for side in (y, x)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found, _ = metric.compute_gospa_metric(*states)
        yield abs(gospa(x, y, 2.7).distance - float(found.value["distance"]))
