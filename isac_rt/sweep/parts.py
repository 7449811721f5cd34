"""Arrays and labels that a data set keeps of a frame on a link: transforms of its IF samples by the
symbols that were sent, and the truth of its cells. No receiver's decision is in them."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np

from isac_rt.frame.antennas import SAME_POSITION_M, Antennas, resolutions
from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.known import Known
from isac_rt.receive.maps import channel_maps, doppler_bins
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.results.labels import hann_response, owners
from isac_rt.results.losses import Sensitivity
from isac_rt.simulation.setup import Frame, Setup

BOXES = ("uav", "row", "column", "height", "width", "u_x", "snr")
NOISE, CITY, FIRST_UAV = 0, 1, 2
"""Values of a mask; UAV k, in the order of the truth, is `FIRST_UAV` + k."""
STEPS_PER_BEAM = 2
"""Directions of a spectrum in a beam: power that is sampled so has all that the array resolves."""
TRANSFORMED = ("range_doppler", "range_azimuth", "cube")


def npy(values: np.ndarray) -> bytes:
    """Write an array as the bytes of an ``.npy`` file."""
    out = io.BytesIO()
    np.save(out, np.ascontiguousarray(values), allow_pickle=False)
    return out.getvalue()


class FrameParts:
    """Collector of a scene's parts: `simulate.run` hands it every frame with its samples.

    Attributes
    ----------
    files : names and contents by frame and link
    seconds : processor time of each
    """

    def __init__(self, setup: Setup, keep: Sequence[str]) -> None:
        self._setup, self._keep = setup, frozenset(keep)
        self.files: dict[tuple[int, Link], list[tuple[str, bytes]]] = {}
        self.seconds: list[float] = []

    def __call__(self, frame: Frame, link: Link, cube: IFCube) -> None:
        begun = time.thread_time()
        self.files[frame.number, link] = [
            (f"{name}.npy", npy(values)) for name, values in self._arrays(frame, link, cube)
        ]
        self.seconds.append(time.thread_time() - begun)

    def _arrays(self, frame: Frame, link: Link, cube: IFCube) -> Iterator[tuple[str, np.ndarray]]:
        keep, payload = self._keep, frame.sent[link.tx].payload
        if "bits" in keep:
            yield "bits", payload.bits
        if "samples" in keep:
            yield "samples", cube.samples
        if not keep & {*TRANSFORMED, "boxes", "mask"}:
            return
        known = Known.of(cube, payload, self._setup.arrays.at(link), link.passes)
        if keep & {*TRANSFORMED}:
            spectra, decoded = known.decoded(clean_spectrum(cube, known))
            yield from _transformed(channel_maps(spectra, decoded), decoded, keep)
        w = cube.waveform
        yield "map_range", np.arange(w.num_range_cells) * w.range_cell(link.passes)
        yield "map_velocity", doppler_bins(w) * w.velocity_cell(link.passes)
        if keep & {"boxes", "mask"}:
            boxes, mask = labels(self._setup.of(link.tx), frame, link)
            yield from ((n, v) for n, v in (("boxes", boxes), ("mask", mask)) if n in keep)


def _transformed(
    maps: np.ndarray, known: Known, keep: frozenset[str]
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the parts that are made of channel maps (L_tx, L_rx, rows, P), Doppler in FFT order."""
    maps = np.fft.fftshift(maps, axes=-1)
    if "range_doppler" in keep:
        yield "range_doppler", maps
    if keep & {"range_azimuth", "cube"}:
        u, lines = horizontal_lines(known.antennas, known.waveform, known.passes)
        cube = azimuth_power(maps, u, lines, known.wavenumber)
        yield "u_x", u
        if "cube" in keep:
            yield "cube", cube
        if "range_azimuth" in keep:
            yield "range_azimuth", cube.mean(axis=1)


Lines = tuple[tuple[np.ndarray, np.ndarray], ...]
"""Channels along X at one height: their numbers and places x [m]."""


@lru_cache(maxsize=8)
def horizontal_lines(
    antennas: Antennas, waveform: Waveform, passes: int
) -> tuple[np.ndarray, Lines]:
    """Return the direction cosines u_x of a spectrum (D,), and the lines of channels that it adds.

    Channels at one height have one phase for an elevation, so that it does not blur a line's
    spectrum. Lines under half of the longest resolve too little. Of one pass the departure is
    unknown: each transmit antenna has lines of its own.
    """
    places = antennas.virtual_positions if passes == 2 else antennas.rx_positions
    height = np.round(places[:, 2] / SAME_POSITION_M)
    repeated = 1 if passes == 2 else antennas.num_tx
    lines = [
        (np.flatnonzero(height == z) + k * len(places), places[height == z, 0])
        for k in range(repeated)
        for z in np.unique(height)
    ]
    longest = max(np.ptp(x) for _, x in lines)
    long = [line for line in lines if np.ptp(line[1]) >= 0.49 * longest]
    beam, limit = resolutions(waveform, antennas, passes)[2], antennas.view_limit
    half = int(np.ceil(STEPS_PER_BEAM * limit / beam)) if longest > SAME_POSITION_M else 0
    return np.linspace(-limit, limit, 2 * half + 1) if half else np.zeros(1), tuple(long)


def azimuth_power(maps: np.ndarray, u: np.ndarray, lines: Lines, wavenumber: float) -> np.ndarray:
    """Return the power (rows, P, D) float32 of channel maps (L_tx, L_rx, rows, P) by direction.

    Lines are steered by exp(j k x u) and their powers added, over the number of channels: noise has
    the level that it has in one channel's map.
    """
    rows, columns = maps.shape[2:]
    flat = maps.reshape(-1, rows * columns)
    power = np.zeros((rows * columns, len(u)), np.float32)
    for channels, x in lines:
        steered = flat[channels].T @ np.exp(1j * wavenumber * np.outer(x, u)).astype(np.complex64)
        power += steered.real**2 + steered.imag**2
    return power.reshape(rows, columns, -1) / sum(len(channels) for channels, _ in lines)


def labels(setup: Setup, frame: Frame, link: Link) -> tuple[np.ndarray, np.ndarray]:
    """Return the truth of a range-Doppler map.

    Returns
    -------
    boxes : (K, 7) float64, a row for each UAV with a path of its own in the frame, columns `BOXES`:
        its number in the truth, middle and size of the box in cells (an echo's main lobe down to
        a quarter of its power; columns modulo P), direction cosine, SNR in a channel's cell
    mask : (rows, P) uint8, what has the most power in each cell: `NOISE`, `CITY` (clutter, mirror
        images, leakage), or a UAV
    """
    paths, sent, w = frame.paths[link], frame.sent[link.tx], setup.waveform
    clock = setup.connections.clock_difference(link.tx, link, paths.epoch)
    rate = paths.delay_rate + clock.drift
    rows, columns = w.num_range_cells, w.num_chirps
    row = w.beat_cells(paths.delay + clock.offset, rate, 0.0)
    cell = w.velocity_cell(link.passes) * link.passes / SPEED_OF_LIGHT
    column = np.mod(rate / cell + columns // 2, columns)
    noise, groups = frame.noise_power(link), w.num_groups
    receivers = setup.scenario.receivers
    gain = Sensitivity.of(w, setup.arrays.at(link), receivers, sent, noise, groups, link.own).cell
    names = list(frame.poses)
    owner, power = owners(paths.kind, paths.target, paths, names), paths.power * gain
    direction = frame.poses[link.rx].to_body(paths.arrival)[:, 0]

    def off(about: float | np.ndarray, at: np.ndarray) -> np.ndarray:
        return (at - about + columns / 2) % columns - columns / 2

    along = hann_response(np.arange(rows) - row[:, None])
    across = hann_response(off(column[:, None], np.arange(columns)))
    seen = np.unique(owner[owner >= 0])
    levels = [np.ones((rows, columns))]
    boxes = []
    for k in (-1, *seen):
        mine = owner == k
        levels.append((along[mine].T * power[mine]) @ across[mine])
        if k < 0:
            continue
        best = column[mine][power[mine].argmax()]
        low, high = row[mine].min(), row[mine].max()
        left, right = off(best, column[mine]).min(), off(best, column[mine]).max()
        u_x, snr = np.average(direction[mine], weights=power[mine]), power[mine].sum()
        middle = (low + high) / 2, (best + (left + right) / 2) % columns
        boxes.append((k, *middle, high - low + 2, right - left + 2, u_x, snr))
    values = np.array([NOISE, CITY, *(FIRST_UAV + seen)], np.uint8)
    return np.array(boxes, float).reshape(-1, len(BOXES)), values[np.argmax(levels, axis=0)]
