"""The adaptive matched filter with the covariance that the mesh and the own velocity predict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from isac_rt.receive.arms import Channels
from isac_rt.receive.clutter.adaptive import Beams, Matched, Scan, white_scan
from isac_rt.receive.clutter.detectors import ClutterDetector, Judged
from isac_rt.receive.clutter.power import Taper, covariances
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate
from isac_rt.receive.types import ExpectedClutter

LEAST = 0.03
"""Cells whose expected clutter is less than this share of the noise are taken to hold noise
alone."""


class AngleDoppler(ClutterDetector):
    """The filter of every cell against the clutter that is expected there."""

    def judge(
        self, frames: Sequence[np.ndarray], known: Known, clutter: ExpectedClutter | None = None
    ) -> list[Judged]:
        powers = [accumulate(maps) for maps in frames]
        clutter, expected, noise = self.expectation(powers, known, clutter)
        wanted = np.fft.ifftshift(expected > LEAST * np.mean(noise), axes=1)
        scans = self.scans(known)
        by_scan = [
            predicted(frames, c, b, noise, wanted, clutter, known, self.taper) for c, b in scans
        ]
        by_frame = [
            [(scan, b) for scan, (_, b) in zip(one, scans, strict=True)]
            for one in zip(*by_scan, strict=True)
        ]
        return [
            self.directed(parts, n + expected, held_up=True)
            for parts, n in zip(by_frame, noise, strict=True)
        ]


def predicted(
    frames: Sequence[np.ndarray],
    channels: Channels,
    beams: Beams,
    noise: Sequence[float],
    wanted: np.ndarray,
    clutter: ExpectedClutter,
    known: Known,
    taper: Taper,
) -> list[Scan]:
    """Scans with the covariance that the expected clutter gives, of frames that share it.

    Parameters
    ----------
    frames : (L_tx, L_rx, rows, P) complex64 of `channel_maps` each
    noise : mean noise power of a cell of one channel, of each frame; the covariance is made for
        their mean
    wanted : (rows, P) bool, cells with clutter to speak of, Doppler in FFT order; the others are
        taken to hold noise alone
    """
    snapshots = [
        np.ascontiguousarray(np.moveaxis(maps[channels.tx, channels.rx], 0, -1)) for maps in frames
    ]  # rows, P, L
    scans = [white_scan(x, beams, n) for x, n in zip(snapshots, noise, strict=True)]
    level = float(np.mean(noise))
    eye, scale = np.eye(len(channels), dtype=np.complex64), np.float32(np.sqrt(level))
    for row, bins, R in covariances(clutter, known, channels, wanted, taper):
        matched = Matched.of(R / np.float32(level) + eye, beams)
        for scan, x in zip(scans, snapshots, strict=True):
            matched.fill(scan, row, bins, x[row, bins] / scale)
    return scans
