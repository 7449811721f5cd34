"""Kernels of the receivers against their numpy twins, on generic numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS
from twins import assert_twins_agree

from isac_rt.extensions.city_receivers import covariance
from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.jit import TWINS
from isac_rt.kernels.receive_directions import REACH, TABLE_STEPS
from isac_rt.kernels.receive_estimate import Chirps, WindowAxis
from isac_rt.kernels.receive_maps import ROWS
from isac_rt.kernels.vector import LANES, PART, aligned
from isac_rt.receive import cfar, directions, estimate, maps, omp, pursuit, spectrum
from isac_rt.receive.joint import moments
from isac_rt.receive.joint.tones import JointPath, Tones, powers_of_time
from isac_rt.receive.known import Known

TWINNED = cfar, covariance, estimate, pursuit, spectrum
SINGLE = 3e-6  # float32 sums of some hundred numbers


def complex_noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.standard_normal((*shape, 2)) @ [1, 1j]).astype(np.complex64)


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("chirps", [60, 45])
def test_maps(kept: bool, chirps: int):
    """Even and odd numbers of bins. Planted bugs in the kernel: the opposite bins not conjugated;
    the last row of a block left out."""
    rng, w = np.random.default_rng(2), Waveform(num_samples=64, num_chirps=chirps)
    schedule = conventional_schedule(3, chirps, 3)
    payload = random_payload(w, schedule, 8, rng)
    known = Known(w, schedule, payload.delay_symbols, payload.phases, ANTENNAS, 1)
    spectra = complex_noise(rng, 3, 4, 29, chirps)
    ends, places, factors = maps._operators(known)
    places = 2 * (places[0] * np.uint64(spectra[0].size) + places[1])
    room = aligned(4 * ROWS * len(factors) * PART)
    made = np.zeros((3 if kept else 0, 4, 29, chirps), np.complex64)
    args = spectra.reshape(-1).view(np.float32), spectra.shape, ends, places, factors
    kernel_made, twin_made = made.copy(), made.copy()
    power, twin_power = np.zeros((2, 29, chirps), np.float32)
    kernel, twin = TWINS["isac_rt.receive.maps.make_maps"]
    kernel(*args, room, kernel_made, np.empty((ROWS, chirps), np.complex64), power)
    twin(*args, room, twin_made, np.empty((ROWS, chirps), np.complex64), twin_power)
    np.testing.assert_allclose(power, twin_power, rtol=0, atol=SINGLE * twin_power.max())
    np.testing.assert_allclose(kernel_made, twin_made, rtol=0, atol=SINGLE * 60)


def test_background_of_cells():
    """Rows at both ends, where a side has few cells or none, and blocks in which hardly any cell is
    kept. Planted bugs in the kernel: bins that do not wrap; the smaller of both sides."""
    rng = np.random.default_rng(3)
    power, keep = rng.gamma(3.0, 0.4, (41, 33)).astype(np.float32), rng.random((41, 33)) < 0.7
    keep[10:22, 5:25] = False
    index = np.arange(41)
    sides = np.clip(np.stack([index - 2, 38 - index], axis=1), 0, 5)
    sides = np.where(sides >= 2, sides, 0)
    args = power, keep, sides, 2, 4, 0.25, np.zeros((41, 33))
    assert_twins_agree("isac_rt.receive.cfar.fill_background", *args, rtol=1e-12)


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    angle = rng.uniform(-np.pi, np.pi, shape)
    return np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32)


def test_bounds_of_a_line():
    """Planted bug in the kernel: every second direction left out."""
    rng = np.random.default_rng(4)
    channels = rng.permutation(20)[:14].reshape(2, 7)
    maps = complex_noise(rng, 20, 48).view(np.float32)
    args = maps, channels, complex_noise(rng, 6, 7), np.zeros(48, np.float32)
    assert_twins_agree("isac_rt.receive.directions.fill_line_bounds", *args, rtol=SINGLE)


@pytest.mark.parametrize("scales", [1, 9])
def test_search_over_directions(scales: int):
    """Planted bugs in the kernel: the looks added in amplitude; the turns of both axes exchanged;
    beyond the disc too."""
    rng, wide, high = np.random.default_rng(5), 22, 32
    lines = complex_noise(rng, 9, 3, 2, wide), complex_noise(rng, 9, 3, 3, high)
    scale = rng.uniform(0.5, 1.5, (scales, wide, high)).astype(np.float32)
    inside = (rng.uniform(size=wide * high) < 0.7).astype(np.float32)
    out = np.zeros(9, np.float32), np.zeros((9, 2), np.float32)
    args = *lines, unit(rng, 2, high), unit(rng, 3, wide), inside, scale, *out
    # the parabola's offset is a quotient of differences of logarithms
    assert_twins_agree("isac_rt.receive.directions.search_directions", *args, rtol=1e-4)


@pytest.mark.parametrize("one_way", [False, True])
def test_quadratic_forms(one_way: bool):
    """More directions along X than along Z. Planted bugs in the kernel: what couples both axes once
    and not twice; as many directions along both."""
    rng, make = np.random.default_rng(6), [directions.channel_search, directions.receiver_search]
    search = make[one_way](replace(ANTENNAS, rx_z=3), 1613.0)
    assert len(search.cosines[0]) > len(search.cosines[1]) or one_way
    size = len(search.channels)
    mixed = complex_noise(rng, 18, size, size)
    Q = (np.eye(size) + mixed @ mixed.conj().transpose(0, 2, 1)).astype(np.complex64)
    out = np.zeros((18, *search.inside.shape), np.float32)
    args = Q, *search.axes, out
    # sums of some 2000 numbers that cancel
    assert_twins_agree("isac_rt.receive.directions.quadratic_forms", *args, rtol=1e-5)


def test_covariances_of_clutter():
    """Cells at the ends of both axes too. Planted bugs in the kernel: the Doppler axis does not
    wrap; rows from `REACH` too low."""
    rng, bins, size, count = np.random.default_rng(7), 30, 5, 400
    bucket = np.sort(rng.integers(0, 40 * bins, count))
    power = rng.gamma(1.0, 3.0, count).astype(np.float32)
    order = np.lexsort((-power, bucket))
    start = np.searchsorted(bucket, np.arange(40 * bins + 1))
    offsets = rng.uniform(-0.5, 0.5, (2, count)).astype(np.float32)
    tables = tuple(
        np.exp(-np.arange((REACH + 1) * TABLE_STEPS + 2) / w).astype(np.float32) for w in (37, 23)
    )
    steer = np.exp(1j * rng.uniform(-np.pi, np.pi, (count, size))).astype(np.complex64)
    taper = rng.uniform(0.3, 0.9, (size, size))
    taper = np.tril(taper, -1) + np.tril(taper, -1).T + np.eye(size)
    cells = np.array([0, 3, 21, 39]), np.array([0, 29, 11, 17]), bins
    scatterers = start, *offsets, power[order], steer
    out = np.zeros((4, size, size), np.complex64)
    args = cells, scatterers, tables, taper.astype(np.float32), out
    assert_twins_agree(
        "isac_rt.extensions.city_receivers.covariance.fill_covariances", *args, rtol=SINGLE
    )


def local_rows(rng: np.random.Generator, rows: int) -> tuple[Chirps, WindowAxis]:
    """Work space for `rows` rows of 20 receivers and 3 x 24 chirps, and a template's axis."""
    size, blocks = 72, 2
    weight, time = np.zeros((2, size + -size % LANES))
    weight[:size], time[:size] = rng.uniform(0.2, 1, size), rng.uniform(-4e-3, 4e-3, size)
    data = aligned(size * rows * blocks * 2 * LANES)
    data[:] = rng.standard_normal(data.size)
    tx = rng.integers(0, 3, size)
    chirps = Chirps(data, rows, blocks, weight, time, tx, aligned(LANES * LANES))
    return chirps, WindowAxis(77.1e9, 1.7e13, 1.3e-5, 2.1e-5, 230.0, 0.91, 17.0)


@pytest.mark.parametrize("chirps", [24, 21])
def test_rows_about_a_peak(chirps: int):
    """Also a number of chirps that fills no vector. Planted bug in the kernel: the first row's turn
    for all."""
    rng = np.random.default_rng(9)
    room, axis = local_rows(rng, 6)
    room = room._replace(data=room.data[: 3 * chirps * 6 * 2 * 2 * LANES])
    spectra = complex_noise(rng, 3, 20, 40, chirps)
    by_kernel, by_twin = (room._replace(data=np.zeros_like(room.data)) for _ in range(2))
    kernel, twin = TWINS["isac_rt.receive.estimate.gather"]
    kernel(spectra, 17, axis.share, by_kernel)
    twin(spectra, 17, axis.share, by_twin)
    np.testing.assert_allclose(by_kernel.data, by_twin.data, rtol=0, atol=SINGLE)


@pytest.mark.parametrize("rows", [7, 4])
def test_matches_of_templates(rows: int):
    """Planted bugs in the kernel: the window's middle left out of the beat; conjugated."""
    rng = np.random.default_rng(10)
    chirps, axis = local_rows(rng, rows)
    delays = (17 + rng.uniform(1, 5, 4)) / (axis.slope * axis.duration)
    out, energy = np.zeros((4, 3 * 2 * 2 * LANES), np.float32), np.zeros((4, 3))
    args = chirps, axis, delays, rng.uniform(-3e-8, 3e-8, 4), out, energy
    kernel, twin = TWINS["isac_rt.receive.estimate.match"]
    kernel_out, kernel_energy, twin_out, twin_energy = (
        a.copy() for a in (out, energy, out, energy)
    )
    kernel(*args[:4], kernel_out, kernel_energy)
    twin(*args[:4], twin_out, twin_energy)
    most = np.abs(twin_out).max()
    # phases of 1e6 cycles are reduced in float64, in another order
    np.testing.assert_allclose(kernel_out, twin_out, rtol=0, atol=1e-5 * most)
    np.testing.assert_allclose(kernel_energy, twin_energy, rtol=1e-5)


def test_peaks_climbed():
    """A path in noise, from two starts beside it, one at the end of the rows. Planted bugs in the
    kernel: the coupling's sign, before or after; the cross alone in the first stencil."""
    rng = np.random.default_rng(14)
    room, axis = local_rows(rng, 7)
    spectra = complex_noise(rng, 3, 20, 26, 24)
    place = np.arange(26)[:, None] - 20.3 - rng.uniform(-0.1, 0.1)
    spectra += (40 * np.exp(-(place**2) / 2 + 2j * place)).astype(np.complex64)
    lows, counts = np.array([17, 20]), np.array([7, 6])
    delays = np.array([20.1, 21.2]) / (axis.slope * axis.duration)
    peaks = lows, counts, delays, np.array([3e-10, -4e-10])
    units = 1 / (axis.slope * axis.duration), 1.5e-9, 0.37
    to = (
        np.array([0.2, 0.08]),
        units,
        np.zeros((2, 3 * 2 * 2 * LANES), np.float32),
        np.zeros((2, 3)),
    )
    results = []
    for chosen in TWINS["isac_rt.receive.estimate.estimate"]:
        args = [a.copy() if isinstance(a, np.ndarray) else a for a in (*peaks, *to)]
        chosen(spectra, room, axis, *args)
        results.append(args)
    kernel, twin = results
    # float32 sums move the top of a paraboloid by 1e-5 of a stencil
    np.testing.assert_allclose(kernel[2], twin[2], rtol=0, atol=1e-4 * units[0])
    np.testing.assert_allclose(kernel[3], twin[3], rtol=0, atol=1e-4 * units[1])
    most = np.abs(twin[6]).max()
    np.testing.assert_allclose(kernel[6], twin[6], rtol=0, atol=1e-3 * most)
    np.testing.assert_allclose(kernel[7], twin[7], rtol=1e-4)


@pytest.mark.parametrize("size", [9, 5])
def test_a_newton_step(size: int):
    """Planted bug in the kernel: a limit of two stencils."""
    rng = np.random.default_rng(15)
    for powers in np.exp(rng.normal(size=(20, size))):
        assert_twins_agree("isac_rt.receive.estimate.newton", powers, 0.2, 0.31, rtol=1e-9)


def test_a_template_added():
    """Planted bugs in the kernel: the transmit antennas' delays left out; the turn from row to row
    conjugated."""
    rng, chirps = np.random.default_rng(11), 20
    args = (
        complex_noise(rng, 3, 4, 30, chirps),
        (5, 24),
        rng.standard_normal((3, 4, 2)) @ [1, 1j],
        rng.integers(0, 3, (3, chirps)),
        rng.uniform(12, 14, (3, chirps)),
        np.exp(1j * rng.uniform(-3, 3, (3, chirps))),
        rng.uniform(-0.1, 0.1, 3),
        rng.uniform(-0.1, 0.1, 4),
        (231.0, 256.0),
    )
    assert_twins_agree("isac_rt.receive.pursuit.add_template", *args, rtol=1e-6)


def test_atoms_of_a_pursuit():
    """Sparse random slots. Planted bugs in the kernel: the Gram matrix conjugated where atoms are
    taken out; the last amplitude not in the back substitution."""
    rng, slots = np.random.default_rng(12), 90
    chosen = np.sort(rng.choice(slots, 31, replace=False))
    analysis, gram = omp._dictionary(tuple(chosen.tolist()), slots)
    first = complex_noise(rng, 40, 31) @ analysis
    out = np.zeros((40, 4), np.int64), np.zeros((40, 4), complex)
    # amplitudes by the normal equations of float32 correlations
    assert_twins_agree("isac_rt.receive.omp.fill_atoms", first, *gram, *out, rtol=1e-5)


@pytest.mark.parametrize("turned", [False, True])
def test_cells_of_range_spectra(turned: bool):
    """19 chirps, of which the last three fill no vector. Planted bugs in the kernel: the window's
    taper of one neighbour alone; the turn conjugated."""
    rng, size, chirps = np.random.default_rng(13), 80, 19
    samples, factor = complex_noise(rng, 3, chirps, size), complex_noise(rng, chirps, size)
    cells, turn = np.array([-3, 0, 7, 41]), complex_noise(rng, 4, chirps) if turned else None
    results = []
    for chosen in TWINS["isac_rt.receive.spectrum.fill_cells"]:
        out = np.zeros((3, 4, chirps), np.complex64)
        power, tapered = np.zeros((2, chirps, size), np.float32)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(spectrum, "fill_cells", chosen)
            more = {"phasor": turn, "power": power, "tapered": tapered}
            spectrum.transform(samples, factor, cells, out, **more)
        results.append((out, power, tapered))
    for found, expected in zip(*results, strict=True):
        most = np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=0, atol=SINGLE * most)


def two_tones(rng: np.random.Generator, passes: int) -> tuple[Known, Tones]:
    w = Waveform(num_samples=64, num_chirps=24)
    schedule = conventional_schedule(3, 24, 3)
    payload = random_payload(w, schedule, 8, rng)
    known = Known(w, schedule, payload.delay_symbols, payload.phases, ANTENNAS, passes)
    paths = [
        JointPath(1.1e-7 * (1 + 0.07 * i), 3e-8 * (i - 0.4), u, np.ones(1), np.zeros(4))
        for i, u in enumerate(rng.uniform(-0.5, 0.5, (3, 2)))
    ]
    return known, Tones.of(known, paths)[0]


@pytest.mark.parametrize("passes", [1, 2])
def test_sums_of_tones_against_tones(passes: int):
    """Planted bugs in the kernel: the turn between receivers left out; n^2 from sample 0."""
    known, made = two_tones(np.random.default_rng(14), passes)
    weights = powers_of_time(known, 3)
    pairs = np.array([[1, 0], [2, 1], [0, 2], [1, 1]])  # the last of one frequency
    for powers in (1, 3):
        out = np.zeros((4, powers, 3, 3, ANTENNAS.num_rx), complex)
        kernel, twin = TWINS["isac_rt.receive.joint.tones.fill_cross_sums"]
        by_kernel, by_twin = out.copy(), out.copy()
        kernel(made, pairs, weights, by_kernel)
        twin(made, pairs, weights, by_twin)
        most = np.abs(by_twin).max(axis=(0, 3, 4), keepdims=True)  # n^q t^i: sizes of their own
        assert (np.abs(by_kernel - by_twin) <= 1e-6 * most).all()  # of the nodes


def test_sums_of_samples_against_tones():
    """Planted bugs in the kernel: n from sample N // 2; the taps of the first receiver for all."""
    rng = np.random.default_rng(15)
    known, made = two_tones(rng, 1)
    weights = powers_of_time(known, 2)
    shape = known.schedule.shape
    spectrum = complex_noise(rng, *shape, 96, 16).view(np.float32)
    out = np.zeros((3, 2, 2, 3, ANTENNAS.num_rx), complex)
    args = spectrum, made, weights, 0.5, moments._kernel(), out
    kernel, twin = TWINS["isac_rt.receive.joint.moments.fill_sums"]
    by_kernel, by_twin = out.copy(), out.copy()
    kernel(*args[:-1], by_kernel)
    twin(*args[:-1], by_twin)
    most = np.abs(by_twin).max(axis=(3, 4), keepdims=True)
    assert (np.abs(by_kernel - by_twin) <= 1e-5 * most).all()  # taps in float32


@pytest.mark.parametrize(("count", "size"), [(1, 1), (16, 5), (37, 15), (3, 45)])
def test_inverses(count: int, size: int):
    """Clutter 50 dB over noise of unit power, so that the inverse's elements are one at most.
    Planted bugs in the kernel: sums in float32 (3e-4); the last matrices, which fill no vector,
    left out; the upper half not conjugated."""
    rng = np.random.default_rng(5)
    waves = rng.standard_normal((count, size, 3, 2)) @ [1, 1j]
    R = (np.eye(size) + 1e5 * waves @ waves.conj().transpose(0, 2, 1)).astype(np.complex64)
    name = "isac_rt.receive.directions.fill_inverses"
    assert_twins_agree(name, R, np.zeros_like(R), rtol=0, atol=1e-6)
