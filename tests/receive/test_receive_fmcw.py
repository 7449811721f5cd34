"""The plain radar's chain from samples made by formula: peak, velocity and direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from isac_rt.extensions.city_receivers.covariance import Bucketed
from isac_rt.extensions.city_receivers.power import Taper, expected_power
from isac_rt.extensions.hardware.store import load_cube, save_cube
from isac_rt.frame.antennas import Antennas, unit_vector
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.schedule import codes_of, conventional_schedule, schedule_of
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Sweep, Waveform
from isac_rt.receive.active import receive_active
from isac_rt.receive.directions import channel_search
from isac_rt.receive.known import Known
from isac_rt.receive.maps import channel_maps
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import cleaned
from isac_rt.receive.types import ExpectedClutter

RANGE, VELOCITY, U = 21.37, -7.3, (0.21, -0.13)


def waveform(scheme: str, bands: int, num_tx: int = 3) -> Waveform:
    return Waveform(
        carrier_frequency=76.2e9,
        sampling_rate=8e6,
        num_samples=128,
        num_chirps=96,
        num_groups=1,
        num_tx=num_tx,
        sweep=Sweep(30e12, 26e-6, 4e-6, 31e-6),
        carries_data=False,
        scheme=scheme,
        bands=bands,
    )


def by_formula(
    w: Waveform,
    a: Antennas,
    velocity: float = VELOCITY,
    direction: tuple[float, float] = U,
    distance: float = RANGE,
) -> IFCube:
    """Sum over transmit antennas of code times exp(j 2 pi (f t + S t (u - t/2))), each element's
    delay in t, sample by sample."""
    schedule = schedule_of("conventional", w, np.random.default_rng(1))
    codes = codes_of(w)
    if codes is None:
        codes = (schedule[0] == np.arange(w.num_tx)[:, None]).astype(complex)
    u = unit_vector(direction)
    fast = 4e-6 + np.arange(128) / 8e6
    t = np.arange(96)[:, None] * 31e-6 + fast - 96 * 31e-6 / 2
    samples = np.zeros((1, a.num_rx, 96, 128), complex)
    for tx, code in zip(a.tx_positions, codes, strict=True):
        for r, rx in enumerate(a.rx_positions):
            tau = (2 * (distance + velocity * t) - (tx + rx) @ u) / SPEED_OF_LIGHT
            cycles = 76.2e9 * tau + 30e12 * tau * (fast - tau / 2)
            samples[0, r] += code[:, None] * np.exp(2j * np.pi * cycles)
    return IFCube(
        samples=samples.astype(np.complex64), waveform=w, schedule=schedule, start_time=0.0
    )


@pytest.mark.parametrize(
    ("scheme", "bands"), [("tdm", 1), ("ddm", 4), ("ddm", 6), ("bpm", 4), ("bpm", 8)]
)
def test_one_target_by_formula(scheme, bands):
    """One detection where it is: the images of the other antennas are none. Bounds: a hundredth of
    a cell, and of a beam. Bugs: codes not conjugated; bands told apart by the weakest."""
    w = waveform(scheme, bands)
    a = Antennas(tx_x=2, tx_z=2, rx_x=4, rx_z=4, spacing=0.5 * w.wavelength)
    cube = by_formula(w, a)
    found = receive_active(cube, unmodulated(w), a, Receivers(), maps=True)
    d = found.detections
    assert len(d) == 1
    assert d.range[0] == pytest.approx(RANGE, abs=0.01 * w.range_cell(2))
    assert d.velocity[0] == pytest.approx(VELOCITY, abs=0.01 * w.velocity_cell(2))
    # the estimator takes a spherical wave's curvature out, which this plane wave has not
    assert d.direction[0] == pytest.approx(U, abs=2e-3)
    assert found.maps is not None and found.maps.range_doppler.shape == (128, 96)
    row, column = np.unravel_index(found.maps.range_doppler.argmax(), (128, 96))
    beat = (
        30e12 * 2 * RANGE / SPEED_OF_LIGHT + 2 * VELOCITY * w.carrier() / SPEED_OF_LIGHT
    ) * 16e-6
    assert row == round(float(beat))
    period = 2 * w.max_velocity(2) * (1 / 3 if scheme == "tdm" else 1)  # the map shows it again
    off = (found.maps.velocity_axis[column] - VELOCITY + period / 2) % period - period / 2
    assert abs(off) < 0.51 * w.velocity_cell(2)


def test_simo_is_one_antenna():
    """A single transmit antenna samples every slot; bug: N/2 range cells seen."""
    w = waveform("tdm", 1, num_tx=1)
    a = Antennas(tx_x=1, tx_z=1, rx_x=4, rx_z=4, spacing=0.5 * w.wavelength)
    cube = by_formula(w, a)
    assert (cube.schedule == conventional_schedule(1, 96, 1)).all()
    found = receive_active(cube, unmodulated(w), a, Receivers()).detections
    assert len(found) == 1 and found.range[0] > 64 * w.range_cell(2) / 2
    assert found.velocity[0] == pytest.approx(VELOCITY, abs=0.01 * w.velocity_cell(2))


def test_what_stands_still_goes_with_all_codes():
    """The notch takes a resting echo out of all bands, not of one; bug: codes left out of it."""
    w = waveform("ddm", 4)
    a = Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5 * w.wavelength)
    still = codes_of(w).sum(axis=0)[None, None, :, None] * np.exp(0.4j * np.arange(128))
    moving = by_formula(w, a)
    noise = np.random.default_rng(3).normal(size=(2, *moving.samples.shape)) * 0.05
    cube = IFCube(
        samples=(moving.samples + 30 * still + noise[0] + 1j * noise[1]).astype(np.complex64),
        waveform=w,
        schedule=moving.schedule,
        start_time=0.0,
    )
    plain = receive_active(cube, unmodulated(w), a, Receivers())
    notched = receive_active(cube, unmodulated(w), a, Receivers(clutter_filter="zero_doppler"))
    assert abs(plain.detections.velocity[0]) < w.velocity_cell(2)
    # the mean over the chirps takes a little of the moving echo too: 39 dB less of it at rest
    assert (notched.detections.snr[1:] < 1e-3 * notched.detections.snr[0]).all()
    assert notched.detections.velocity[0] == pytest.approx(VELOCITY, abs=0.05)


def test_a_cube_of_a_plain_radar_is_kept(tmp_path):
    """With its timing and its codes; bug: a sweep that comes back as a list."""
    w = waveform("ddm", 4)
    cube = by_formula(w, Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5 * w.wavelength))
    save_cube(cube, tmp_path / "cube.nc")
    again = load_cube(tmp_path / "cube.nc")
    assert again.waveform == w and (again.samples == cube.samples).all()
    assert hash(again.waveform) == hash(w)


BOARDS = {
    "raised": ([(0, 0), (1, 0.5), (2, 0)], [(i / 2, 0) for i in range(4)]),
    "row": ([(0, 0), (2, 0), (4, 0)], [(i / 2, 0) for i in range(4)]),
    "planar": ([(0, 0), (2, 0), (0, 1)], [(i / 2, k / 2) for k in (0, 1) for i in range(4)]),
    "sparse": ([(0, 0), (0.37, 1.1), (1.9, 0.6)], [(0, 0), (0.47, 0.2), (0.9, 1.3), (2.3, 0.7)]),
}
SCHEMES = ("tdm", 1), ("ddm", 4), ("ddm", 3), ("bpm", 4)


def board(kind: str, w: Waveform) -> Antennas:
    tx, rx = (w.wavelength * np.array(places) for places in BOARDS[kind])
    return Antennas.placed(tx, rx, half_view=np.pi / 3)


@pytest.mark.parametrize(("scheme", "bands"), SCHEMES)
@pytest.mark.parametrize("kind", [*BOARDS])
def test_all_channels_of_a_board_find_velocity_and_direction(scheme, bands, kind):
    """One target at 14 m/s, which antennas that take turns show at -7 m/s as well: one detection
    that could start a track, in the right span of velocities, within five deviations of the bound
    in direction. What is left of others is 4 times weaker. Planted bugs: chirps of all antennas at
    one time; spans that are not compared; the other axis of a row made up."""
    w = waveform(scheme, bands)
    a, rng = board(kind, w), np.random.default_rng(2)
    clean = by_formula(w, a, 14.0)
    settings = Receivers(clutter_detector="angle_doppler", update_false_alarm_rate=1e-4)
    nothing = ExpectedClutter(*np.zeros((3, 0)), *np.zeros((2, 0, 3)))
    noise = rng.standard_normal((*clean.samples.shape, 2)) @ [1, 1j]
    noisy = replace(clean, samples=clean.samples + (1.4 * noise).astype(np.complex64))
    found = receive_active(noisy, unmodulated(w), a, settings, clutter=nothing).detections
    d = found.select(found.snr > found.snr.max() / 4)
    assert len(d) == 1 and d.starts[0]
    assert abs(d.range[0] - RANGE) < 0.1 and abs(d.velocity[0] - 14) < 0.2
    seen = np.isfinite(d.std[0, 2:])
    assert seen.tolist() == [True, kind != "row"]
    assert (np.abs(d.direction[0] - U)[seen] < 5 * d.std[0, 2:][seen]).all()
    assert np.isnan(d.direction[0][~seen]).all()


@pytest.mark.parametrize(("scheme", "bands"), SCHEMES)
def test_clutter_shows_in_all_spans_of_velocities(scheme, bands):
    """Covariance and power of one scatterer wherever it shows, against its cube through the
    receiver's chain. Discretisation: tables of 1/32 cell. Planted bugs: the turn of an antenna's
    first slot conjugated; the echo and the channel of a code exchanged; the first span alone."""
    w = waveform(scheme, bands)
    a, u = board("raised", w), (0.31, 0.12)
    one = by_formula(w, a, -3.0, u, 14.3)
    spectra, sent = cleaned(one, Known.of(one, unmodulated(w), a, 2))
    spectra, sent = sent.decoded(spectra)
    maps = channel_maps(spectra, sent)
    x = maps.reshape(-1, *maps.shape[2:]).transpose(1, 2, 0)
    power = (np.abs(x) ** 2).mean(axis=2)
    cells = np.nonzero(power > 0.02 * power.max())
    towards = unit_vector(u)[None]
    far = np.array([2 * 14.3, -6.0, 299792458.0]) / 299792458.0
    clutter = ExpectedClutter(*far[:, None], towards, towards)
    noise, exact = 1e-3 * power.max(), Taper(0.0, 0.0, 0.0)
    search = channel_search(a, sent.wavenumber)
    R = Bucketed.of(clutter, sent, search, noise, exact).covariances(*cells)
    found = noise * (R - np.eye(R.shape[1]))
    truth = x[cells][:, :, None] * x[cells][:, None].conj()
    assert len(np.unique(cells[1] // (96 // len(sent.leaks)))) == len(sent.leaks) > 1
    assert np.linalg.norm(found - truth) < 0.08 * np.linalg.norm(truth)
    expected = np.fft.ifftshift(expected_power(clutter, sent, len(power), exact), axes=1)
    found, truth = expected.sum(axis=0), power.sum(axis=0)  # on half cells in range
    if scheme == "bpm":  # a channel adds the antennas' images by power, which directions average
        found, truth = found.sum(), truth.sum()
    assert found == pytest.approx(truth, abs=0.08 * float(truth.max()))
