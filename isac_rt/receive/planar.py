"""Directions from arrays whose elements stand anywhere in the plane: a scan of beams over the field
of view, and Newton's steps from the strongest.

The power of the beam towards u is |sum_l v_l exp(j k r_l.u)|^2, in phase over all virtual channels
for an echo; for one pass in phase over the receivers and added over the transmitters, whose
direction of departure is another. Its maximum is the maximum-likelihood estimate of one wave in
white noise, with the Cramer-Rao bound of `direction_bound`. An axis along which the channels
do not stand apart is not observed: its direction cosine is NaN.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.receive.known import Known

BEAMS = 3.0
"""Looks for a beam's width between its nulls and its peak, on each axis: the loss between two looks
is 0.4 dB at the most."""
MOST_KEPT = 20_000_000
"""Looks times channels that are kept from one detection to the next."""
CHUNK = 2_000_000
STEPS = 6
"""Newton's steps; the third is already far below any bound."""


class Channels(NamedTuple):
    """Places (L, axes) of the channels along the observed axes [m], and which those are: 0 for u_x,
    1 for u_z."""

    places: np.ndarray
    axes: tuple[int, ...]


@lru_cache(maxsize=16)
def channels_of(antennas: Antennas, passes: int) -> Channels:
    """The channels that directions are told by."""
    places = antennas.virtual_positions if passes == 2 else antennas.rx_positions
    axes = tuple(i for i, seen in enumerate(antennas.observes(passes)) if seen)
    return Channels(places[:, [0, 2]][:, list(axes)], axes)


@lru_cache(maxsize=16)
def steering_directions(antennas: Antennas, passes: int, wavenumber: float) -> np.ndarray:
    """(K, axes) direction cosines that the scan looks at, all within the field of view."""
    places, axes = channels_of(antennas, passes)
    limit = antennas.view_limit
    lines = []
    for i in range(len(axes)):
        step = 2 * np.pi / (wavenumber * np.ptp(places[:, i]) * BEAMS)
        count = 2 * int(np.ceil(limit / step)) + 1
        lines.append(np.linspace(-limit, limit, count))
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(axes))
    return grid[(grid**2).sum(axis=1) <= 1]


def _steering(looks: np.ndarray, places: np.ndarray, wavenumber: float) -> np.ndarray:
    return np.exp(1j * wavenumber * (looks @ places.T)).astype(np.complex64)


@lru_cache(maxsize=2)
def _kept(antennas: Antennas, passes: int, wavenumber: float) -> np.ndarray:
    """Steering (K, L) of all looks."""
    places = channels_of(antennas, passes).places
    return _steering(steering_directions(antennas, passes, wavenumber), places, wavenumber)


def scan(values: np.ndarray, known: Known) -> np.ndarray:
    """(axes,) direction cosines of the strongest look at channels (L, sums)."""
    key = known.antennas, known.passes, known.wavenumber
    looks, values = steering_directions(*key), values.astype(np.complex64)
    if looks.shape[0] * values.shape[0] <= MOST_KEPT:
        beams = _kept(*key) @ values
        return looks[int((np.abs(beams) ** 2).sum(axis=1).argmax())]
    places = channels_of(*key[:2]).places
    size = max(CHUNK // values.shape[0], 1)
    power = [
        (np.abs(_steering(looks[i : i + size], places, key[2]) @ values) ** 2).sum(axis=1)
        for i in range(0, len(looks), size)
    ]
    return looks[int(np.concatenate(power).argmax())]


def climb(u: np.ndarray, values: np.ndarray, places: np.ndarray, wavenumber: float) -> np.ndarray:
    """The maximum of the beam's power about u (axes,), by Newton's steps of at most a third of a
    beam."""
    most = 2 * np.pi / (wavenumber * np.ptp(places, axis=0) * BEAMS)
    k = 1j * wavenumber * places
    for _ in range(STEPS):
        turned = np.exp(k @ u)[:, None] * values
        s = turned.sum(axis=0)
        first = k.T @ turned
        second = np.einsum("la,lb,ls->abs", k, k, turned)
        gradient = 2 * (first @ s.conj()).real
        hessian = 2 * (first @ first.conj().T + second @ s.conj()).real
        if np.linalg.eigvalsh(hessian).max() >= 0:  # beside the peak: uphill
            move = most * np.sign(gradient) / 4
        else:
            move = -np.linalg.solve(hessian, gradient)
        u = u + np.clip(move, -most, most)
    return u


def cosines(channels: np.ndarray, known: Known, *, on_grid: bool = False) -> list[float]:
    """u_x and u_z of channel responses (L_tx, L_rx); NaN on an axis that is not observed, and where
    no direction is.

    `on_grid`: the strongest look.
    """
    places, axes = channels_of(known.antennas, known.passes)
    out = [float("nan")] * 2
    if not axes:
        return out
    values = channels.reshape(-1, 1) if known.passes == 2 else channels.T
    u = scan(values, known)
    if not on_grid:
        u = climb(u, values, places, known.wavenumber)
    if (u**2).sum() <= 1:
        for axis, value in zip(axes, u, strict=True):
            out[axis] = float(value)
    return out


def direction_bound(antennas: Antennas, passes: int, wavenumber: float) -> np.ndarray:
    r"""(2, 2) Cramer-Rao bound of u_x and u_z of one wave at unit SNR of all channels together,
    infinite where an axis is not observed.

    The inverse of :math:`2 k^2 C`, with C the covariance of the channels' places.
    """
    places, axes = channels_of(antennas, passes)
    out = np.diag([np.inf, np.inf])
    if axes:
        fisher = 2 * wavenumber**2 * np.cov(places.T, bias=True)
        out[np.ix_(axes, axes)] = np.linalg.inv(np.atleast_2d(fisher))
    return out


def direction_covariance(total: float, known: Known) -> np.ndarray:
    """`direction_bound` at the SNR `total` of all channels together."""
    return direction_bound(known.antennas, known.passes, known.wavenumber) / total
