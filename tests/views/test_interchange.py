"""What others read: the same samples back, the same paths as Sionna's, the same geometry as Stone
Soup's models."""

from __future__ import annotations

import datetime
import json

import numpy as np
import pytest
import xarray as xr

from isac_rt.extensions.hardware.readers import read_sigmf
from isac_rt.extensions.hardware.store import cube_dataset, load_cube, save_cube
from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.frame.settings import Array, Modulation, Noise
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.propagation.settings import Propagation
from isac_rt.results.files import ResultsError
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.views.interchange import (
    from_sionna,
    stonesoup_detections,
    write_ledger,
    write_sigmf,
)

W = Waveform(num_samples=64, num_chirps=12)


@pytest.fixture
def cube() -> IFCube:
    rng = np.random.default_rng(3)
    samples = (
        rng.normal(size=(W.num_groups, 5, 12, 64, 2)).astype(np.float32).view(np.complex64)[..., 0]
    )
    return IFCube(
        samples=samples,
        waveform=W,
        schedule=rng.permuted(np.arange(36).reshape(3, 12) % 3, axis=1),
        start_time=0.7 / 3,
    )


def same(a: IFCube, b: IFCube) -> None:
    assert np.array_equal(a.samples, b.samples)
    assert np.array_equal(a.schedule, b.schedule)
    assert (a.waveform, a.start_time) == (b.waveform, b.start_time)


def test_a_cube_comes_back_from_netcdf(cube, tmp_path):
    save_cube(cube, tmp_path / "c.nc")
    same(cube, load_cube(tmp_path / "c.nc"))
    d = cube_dataset(cube)
    assert float(d.slot_time[5]) == pytest.approx(cube.start_time + 5 * W.slot_duration, abs=0)
    assert all(v.attrs["units"] and v.attrs["long_name"] for v in d.variables.values())


def test_a_cube_comes_back_from_sigmf_and_another_reader_finds_a_sample(cube, tmp_path):
    """The library `sigmf` reads sample n of chirp p of antenna l in group m at row p N + n, channel
    m L + l.

    Planted bug: channels and samples exchanged."""
    sigmf = pytest.importorskip("sigmf")
    data, meta = write_sigmf(cube, tmp_path / "c")
    # the base, and the names that are printed
    for name in (tmp_path / "c", data, meta, str(meta)):
        same(cube, read_sigmf(name))
    theirs = sigmf.fromfile(str(meta))
    theirs.validate()
    read = theirs.read_samples()
    assert read.shape == (12 * 64, 15)
    m, rx, p, n = 2, 3, 7, 41
    assert read[p * 64 + n, m * 5 + rx] == cube.samples[m, rx, p, n]
    assert theirs.get_global_field("core:sample_rate") == W.sampling_rate
    assert theirs.get_captures()[0]["core:frequency"] == W.carrier_frequency
    assert len(theirs.get_annotations()) == 12
    assert data.stat().st_size == cube.samples.nbytes


def test_what_is_no_cube_is_said_so(tmp_path):
    (tmp_path / "x.nc").write_text("no")
    with pytest.raises(ResultsError, match="save_cube"):
        load_cube(tmp_path / "x.nc")
    (tmp_path / "y.sigmf-meta").write_text(json.dumps({"global": {}}))
    with pytest.raises(ResultsError, match="write_sigmf"):
        read_sigmf(tmp_path / "y")


def test_the_ledger_has_positive_doppler_of_what_comes_nearer(tmp_path):
    """By hand: closing at 12 m/s at 77 GHz is 3.08 kHz. Planted bug: the sign of the rate."""
    c = 299792458.0
    paths = make_paths(
        gain=[1e-3, 1e-4],
        delay=[80 / c, 90 / c],
        delay_rate=[-12 / c, 7.5 / c],
        departure=np.array([[0.0, 1, 0]] * 2),
        arrival=np.array([[0.0, 1, 0]] * 2),
        kind=PathKind.TARGET,
        tx="A",
        rx="P",
        epoch=0.1,
        target_names=("A", "P"),
    )
    write_ledger({Link("A", "P"): paths}, tmp_path / "p.nc", {"A": 77e9}, {})
    with xr.open_dataset(tmp_path / "p.nc") as found:
        assert found.doppler.values == pytest.approx([12 / c * 77e9, -7.5 / c * 77e9])


@pytest.mark.sionna
def test_paths_of_sionna_are_those_of_geometry():
    """Line of sight and floor bounce between two moving terminals over a floor, against mirror
    geometry in float64: delays to 1e-5 m (theirs are float32), Doppler from unit vectors,
    directions, kinds. Planted bug: the sign of the Doppler shift."""
    from isac_rt.runtime import activate

    activate()
    import mitsuba as mi
    import sionna.rt as rt

    from isac_rt.world.city import load_city
    from isac_rt.world.city.scene import build_scene
    from isac_rt.world.settings import City

    scene = build_scene(
        load_city(City(source="builtin", name="floor_wall"), ".", 77e9, (0.0, 0.0, 0.0)), 77e9
    ).scene
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    a, b, va, vb = (
        np.array([-1.3, 0.4, 2.7]),
        np.array([1.1, -0.7, 3.9]),
        np.array([3.1, -1.7, 0.4]),
        np.array([-0.9, 2.2, 1.3]),
    )
    scene.add(rt.Transmitter("tx", mi.Point3f(*a.tolist()), velocity=mi.Vector3f(*va.tolist())))
    scene.add(rt.Receiver("rx", mi.Point3f(*b.tolist()), velocity=mi.Vector3f(*vb.tolist())))
    found = from_sionna(rt.PathSolver()(scene, max_depth=1, refraction=False), 77e9, epoch=0.25)
    c = 299792458.0
    direct = found.select(found.kind == PathKind.LINE_OF_SIGHT)
    assert len(direct) == 1
    along = (b - a) / np.linalg.norm(b - a)
    assert direct.delay[0] * c == pytest.approx(np.linalg.norm(b - a), abs=1e-5)
    assert direct.delay_rate[0] * c == pytest.approx(along @ (vb - va), rel=1e-5, abs=0)
    assert direct.departure[0] == pytest.approx(along, abs=1e-6)
    assert direct.arrival[0] == pytest.approx(-along, abs=1e-6)
    assert abs(direct.gain[0]) == pytest.approx(
        c / 77e9 / (4 * np.pi * np.linalg.norm(b - a)), rel=1e-4, abs=0
    )
    image = b * [1, 1, -1]  # the floor is z = 0
    length = np.linalg.norm(image - a)
    bounced = found.select(found.kind == PathKind.SPECULAR)
    k = int(np.abs(bounced.delay * c - length).argmin())
    assert bounced.delay[k] * c == pytest.approx(length, abs=1e-5)
    assert bounced.bounces[k] == 1
    assert bounced.delay_rate[k] * c == pytest.approx(
        (image - a) / length @ (vb * [1, 1, -1] - va), rel=1e-5, abs=0
    )
    assert found.epoch == 0.25


def flight():
    body = {"rcs": {"model": "constant", "value_dbsm": 5.0}}
    return simulate.run(
        Scenario(
            name="s",
            seed=4,
            frames=4,
            radio=Radio(samples_per_chirp=256, bandwidth_hz=320e6, chirps_per_frame=60),
            array=Array(element_pattern="isotropic", element_gain_dbi=0),
            propagation=Propagation(leakage={"enabled": False}),
            noise=Noise(model="snr", snr_db=0.0),
            modulation=Modulation(acquisition_frames=2, pilot_every_frames=None),
            swarm={
                "A": Uav(
                    role="active",
                    position_m=(3.1, -2.2, 50),
                    velocity_mps=(1.3, 2.9, 0.4),
                    boresight=(0.3, 1, 0.2),
                    **body,
                ),
                "P": Uav(
                    role="passive",
                    position_m=(7.9, 15.1, 53.3),
                    velocity_mps=(-2.1, 1.7, 0.3),
                    boresight=(-0.2, -1, 0),
                    **body,
                ),
            },
        )
    )


def test_stone_soup_would_have_measured_what_was_detected():
    """Its measurement model applied to the true state gives each detection within five of its
    deviations (floor: 1e-3 of a cell, for what the grid leaves). Planted bugs: bearing from north;
    the observer's own velocity left out."""
    pytest.importorskip("stonesoup")
    from stonesoup.types.state import State

    d = flight().dataset
    start = datetime.datetime(2026, 1, 2, 3, 4, 5)
    for observer, other in (("A", 1), ("P", 0)):
        sets = stonesoup_detections(d, observer, start)
        assert [len(s) for s in sets] == [1, 1, 1, 1]
        for frame, detections in enumerate(sets):
            (one,) = detections
            truth = np.ravel(
                np.column_stack(
                    [d.uav_position.values[frame, other], d.uav_velocity.values[frame, other]]
                )
            )
            expected = one.measurement_model.function(State(truth.reshape(-1, 1)), noise=False)
            off = np.array([float(v) for v in (one.state_vector - expected)])
            std = np.sqrt(np.diag(one.measurement_model.noise_covar.astype(float)))
            assert (np.abs(off) < 5 * std + [1e-4, 1e-4, 5e-4, 5e-3]).all(), (
                observer,
                frame,
                off,
                std,
            )
            assert one.timestamp == start + datetime.timedelta(seconds=float(d.time[frame]))
            assert np.linalg.eigvalsh(one.measurement_model.noise_covar.astype(float)).min() > 0
