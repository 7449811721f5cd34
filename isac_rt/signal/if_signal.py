"""PathSet, waveform and payload to IF samples: one interface to the exact model, the fast ones, and
noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, RangeProfiles, Transmission
from isac_rt.frame.payload import Payload
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.vector import cube_memory
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.signal.choice import SHIPPED, CostModel, choose, read, speed_of
from isac_rt.signal.direct import Tones, add_direct, exact
from isac_rt.signal.gridded import (
    ACCURATE,
    DEFAULT,
    GRIDDED_ERROR,
    PROFILES,
    Setting,
    add_gridded,
    range_cells,
)
from isac_rt.signal.noise import add_white_noise
from isac_rt.signal.separable import separable
from isac_rt.world.swarm import Pose

Method = Literal["auto", "exact", "direct", "gridded", "paper"]
"""exact: float64 per sample. direct: error 1e-6 (float32 sums), cost ~ paths. gridded: error of its
setting, for many paths. auto: all direct, or a grid and some paths direct, whichever a cost model
says is cheapest within an error (`isac_rt.signal.choice.choose`). Direct go lines of sight, paths
too fast for the grid's error, and those whose error, integrated coherently over the whole cube,
could exceed the noise of a cell (amplitude^2 |gain|^2 error^2 size > noise_power), the `max_direct`
strongest at the most. paper: the paper's separable model, for comparison
(`isac_rt.signal.separable`)."""

_CHUNK = 1024  # paths whose element delays stay in the second-level cache


def if_signal(
    waveform: Waveform,
    links: Sequence[tuple[Transmission, PathSet]],
    rx_pose: Pose,
    rx_antennas: Antennas,
    *,
    start_time: float,
    schedule: Schedule | None = None,
    first_block: int | None = None,
    method: Method = "auto",
    noise_power: float = 0.0,
    max_direct: int = 16,
    setting: Setting = DEFAULT,
    max_error: float = GRIDDED_ERROR,
    costs: CostModel | None = None,
    decide_for: int | None = None,
) -> IFCube:
    r"""Dechirped IF samples of one receiver in one frame, without noise.

    .. math::

        s[m,l,p,n] = \sum A \beta_{m'p}\, \bar g\, h(\alpha\tau)\, e^{j2\pi(f_c\tau +
        \alpha\tau(u-\tau/2))}

    over paths and transmit groups m', with tau = data delay + path delay + clock + 2 (b' + m' - b -
    m) T_d + element delays (notes, section 2), b' and b the first resource blocks of the
    transmitter and of the receiver's reference; h is the IF filter. A farther target has a higher
    fast-time frequency, a receding one a positive slow-time frequency; a wave from body direction u
    turns element r by exp(-j 2 pi f r.u/c).

    Parameters
    ----------
    links : transmissions and the paths from each to this receiver; amplitudes in sqrt(W), gains
        without unit
    rx_pose, rx_antennas : of the receiver, at the middle of the frame
    start_time : of the frame's first reference chirp [s], block `first_block` of its slot
    schedule : of the cube; by default that of the first transmission
    first_block : resource block of the first reference chirp; by default that of the first
        transmission
    method : see `Method`
    noise_power : per complex sample [W], for "auto"; with 0 the `max_direct` strongest go direct
    setting : of "gridded": its grid, and whether the delays of the receive elements apply to the
        whole chirp
    max_error : for "auto": relative RMS error of the samples that the choice keeps
    costs : for "auto": what the methods cost; by default the costs that ship with the program
    decide_for : for "auto": number of paths whose cost decides, where the links hold some of them

    Raises
    ------
    ValueError  If a path set belongs to another slot than the one in the middle of the frame, there
    is no link and no schedule, or
        the waveform is a receiver's view of some groups.

    Notes
    -----
    Not modelled: motion during the flight of light; the turning of directions within a frame
    (element phases err by 2 pi v r t / (R lambda), 0.03 rad at an outer element for 10 m/s across
    at 30 m). Spherical wavefronts enter at both ends by their radii, jointly for lines of sight;
    for folded paths the joint term r_tx.r_rx/L of the perpendicular offsets is left out (5e-6 m,
    0.01 rad at 30 m), as it is for lines of sight in "gridded".
    """
    schedule, first_block, middle = _frame(waveform, links, start_time, schedule, first_block)
    tones, sight, power = _tones(waveform, links, rx_pose, rx_antennas, middle, first_block)
    shape = (waveform.num_groups, rx_antennas.num_rx, waveform.num_chirps, waveform.num_samples)
    if method in ("exact", "paper"):
        samples = {"exact": exact, "paper": separable}[method](waveform, tones).astype(np.complex64)
    else:
        samples = cube_memory(shape)
        alone = np.full(len(tones), method == "direct")
        if method == "auto":
            speed = speed_of(tones.rate, tones.accel, waveform.frame_duration)
            setting, alone = choose(
                costs or read(SHIPPED),
                shape,
                power,
                speed,
                sight,
                noise_power=noise_power,
                max_error=max_error,
                max_direct=max_direct,
                num_paths=decide_for,
            )
        if not alone.all():
            add_gridded(samples, waveform, tones.select(~alone), setting, fresh=True)
        add_direct(samples, waveform, tones.select(alone), fresh=bool(alone.all()))
    return IFCube(samples=samples, waveform=waveform, schedule=schedule, start_time=start_time)


def range_profiles(
    waveform: Waveform,
    links: Sequence[tuple[Transmission, PathSet]],
    rx_pose: Pose,
    rx_antennas: Antennas,
    payload: Payload,
    *,
    start_time: float,
    num_cells: int | None = None,
    schedule: Schedule | None = None,
    first_block: int | None = None,
    noise_power: float = 0.0,
    seed_words: np.ndarray | None = None,
    setting: Setting | None = None,
) -> RangeProfiles:
    """Range profiles of a receiver that knows the data and never looks at its samples: Hann's
    window and noise included.

    The same as `if_signal`, `add_noise` and `isac_rt.receive.spectrum.clean_spectrum` but for the
    draw of the noise, whose covariance over cells, chirps and receivers is that of windowed and
    transformed white noise. The joint curvature of lines of sight is left out.

    Parameters
    ----------
    payload : whose delay and DPSK symbols are taken out, as they were sent
    num_cells : range cells, from cell 0; by default those of the delay symbols; at most 3/4 of N
    noise_power : per complex IF sample [W]; it is added if there are `seed_words`, (2,) uint32 as
        of `add_noise`
    setting : by default `PROFILES`, or `ACCURATE` where the error of the strongest path could show
        above the noise of a cell, as it does where there is none
    others : as of `if_signal`
    """
    schedule, first_block, middle = _frame(waveform, links, start_time, schedule, first_block)
    tones, _, power = _tones(waveform, links, rx_pose, rx_antennas, middle, first_block)
    cells = waveform.num_delay_symbols if num_cells is None else num_cells
    if setting is None:
        size = waveform.num_samples * rx_antennas.num_rx * schedule.size
        setting = (
            ACCURATE if power.max(initial=0.0) * GRIDDED_ERROR**2 * size > noise_power else PROFILES
        )
    spectra = range_cells(
        waveform,
        tones,
        payload.delay_symbols,
        payload.phases,
        cells,
        setting,
        noise_power,
        seed_words,
    )
    return RangeProfiles(
        spectra=spectra, waveform=waveform, schedule=schedule, start_time=start_time
    )


def add_noise(cube: IFCube, power: float, seed_words: np.ndarray) -> IFCube:
    """Add thermal noise to the cube's samples, in place, and return the cube.

    Parameters
    ----------
    power : E|n|^2 per complex sample [W]
    seed_words : (2,) uint32, ``seed_sequence(...).generate_state(2)``; one pair per receiver and
        frame
    """
    add_white_noise(cube.samples, power, seed_words)
    return cube


def _frame(
    waveform: Waveform,
    links: Sequence[tuple[Transmission, PathSet]],
    start_time: float,
    schedule: Schedule | None,
    first_block: int | None,
) -> tuple[Schedule, int, float]:
    """Schedule, first block and middle of a frame, checked."""
    if schedule is None:
        if not links:
            raise ValueError(
                "a frame with neither a link nor a schedule; pass the schedule of the cube"
            )
        schedule = links[0][0].schedule
    if waveform.blocks is not None:
        raise ValueError(
            "if_signal makes all groups of a frame; take those that a receiver reads with "
            "IFCube.of_groups"
        )
    if first_block is None:
        first_block = links[0][0].first_block if links else 0
    middle = start_time + waveform.frame_duration / 2
    _check_epochs(links, middle, waveform.slot_duration)
    return schedule, first_block, middle


def _check_epochs(
    links: Sequence[tuple[Transmission, PathSet]], middle: float, slot: float
) -> None:
    for transmission, paths in links:
        if abs(paths.epoch - middle) >= slot:
            raise ValueError(
                f"paths {transmission.name}->{paths.rx} have epoch {paths.epoch!r} s, the middle "
                f"of the frame is {middle!r} s; "
                f"compute the paths within a slot ({slot:g} s) of start_time + frame_duration/2"
            )


def _tones(
    waveform: Waveform,
    links: Sequence[tuple[Transmission, PathSet]],
    rx_pose: Pose,
    rx_antennas: Antennas,
    middle: float,
    first_block: int,
) -> tuple[Tones, np.ndarray, np.ndarray]:
    """All links' paths as flat arrays, whether each is a line of sight, and its received power
    [W]."""
    w = waveform
    rx = rx_pose.to_world(rx_antennas.rx_positions)
    num_tx = max((t.antennas.num_tx for t, _ in links), default=1)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in Tones.__dataclass_fields__}
    parts["cross"].append(np.zeros((1, num_tx, len(rx))))
    rows = 1
    sights, powers = [np.zeros(0, bool)], [np.zeros(0)]
    for q, (t, s) in enumerate(links):
        tx = np.zeros((num_tx, 3))
        tx[: t.antennas.num_tx] = t.pose.to_world(t.antennas.tx_positions)
        sight = s.kind == PathKind.LINE_OF_SIGHT
        near = np.flatnonzero(sight & np.isfinite(s.rx_radius))
        row = np.zeros(len(s), np.int64)
        row[near] = rows + np.arange(near.size)
        rows += near.size
        tx_delay, rx_delay = (
            _element_delay(tx, s.departure, s.tx_radius),
            _element_delay(rx, s.arrival, s.rx_radius),
        )
        joint = _straight_delay(tx, rx, s.departure[near], s.rx_radius[near])
        later = (
            middle - s.epoch
        )  # blocks start at different times of a slot, the paths' epoch is one for all
        moved = s.delay + (s.delay_rate + s.delay_accel * later / 2) * later
        values = {
            "link": np.full(len(s), q, np.int64),
            "factor": s.gain.conj(),
            "delay": moved + t.clock_offset + (t.first_block - first_block) * w.group_spacing,
            "rate": s.delay_rate + s.delay_accel * later + t.clock_drift,
            "accel": s.delay_accel.copy(),
            "begin": s.begin - later,
            "end": s.end - later,
            "tx_delay": tx_delay,
            "rx_delay": rx_delay,
            "cross_row": row,
            "cross": joint - tx_delay[near, :, None] - rx_delay[near, None, :],
            "symbol_delay": t.payload.delay_symbols[None] * w.delay_step,
            "send": t.amplitude * t.payload.phases[None] * (1.0 if t.active is None else t.active),
            "antenna": np.array(t.schedule[None], np.int64),
        }
        for name, value in values.items():
            parts[name].append(value)
        sights.append(sight)
        powers.append(t.amplitude**2 * s.power)
    shapes = {"tx_delay": (0, num_tx), "rx_delay": (0, len(rx)), "send": (0, *_grid_shape(w))}
    joined = {
        name: np.concatenate(value) if value else np.zeros(shapes.get(name, (0,)))
        for name, value in parts.items()
    }
    return Tones(**joined), np.concatenate(sights), np.concatenate(powers)


def _grid_shape(waveform: Waveform) -> tuple[int, int]:
    return waveform.num_groups, waveform.num_chirps


def _element_delay(elements: np.ndarray, direction: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """(|R u - r| - R)/c, and -r.u/c where R is infinite: (K, L) [s], free of cancellation."""
    along = direction @ elements.T
    out = along * (-1 / SPEED_OF_LIGHT)
    square = (elements**2).sum(1)
    near = np.flatnonzero(np.isfinite(radius))
    for some in np.split(near, range(_CHUNK, near.size, _CHUNK)):
        far = radius[some, None]
        change = square - 2 * far * along[some]
        distance = far**2 + change
        np.sqrt(distance, out=distance)
        distance += far
        change /= distance
        change /= SPEED_OF_LIGHT
        out[some] = change
    return out


def _straight_delay(
    tx: np.ndarray, rx: np.ndarray, direction: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """(|L d + r_rx - r_tx| - L)/c of straight paths: (K, L_tx, L_rx) [s], free of cancellation."""
    offset = rx[None, :] - tx[:, None]
    along = np.einsum("trx,kx->ktr", offset, direction)
    change = 2 * length[:, None, None] * along + (offset**2).sum(2)
    distance = np.sqrt(length[:, None, None] ** 2 + change)
    return change / (distance + length[:, None, None]) / SPEED_OF_LIGHT
