"""Knowledge of a receiver about a frame besides its samples."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import overload

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload, unmodulated
from isac_rt.frame.schedule import (
    Schedule,
    codes_of,
    decoded_schedule,
    is_latin,
    leaks,
    unambiguous_share,
)
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform


@dataclass(frozen=True, eq=False)
class Known:
    """Chirps of a frame, sent or decided, and the arrays at both ends.

    Attributes
    ----------
    waveform : Waveform
    schedule : (M, P) transmit antenna of each chirp
    delay_symbols : (M, P) int
    phases : (M, P) complex, beta of the DPSK
    antennas : of both ends
    passes : 2 for echoes at the active terminal, 1 at a passive one (`Link.passes`)
    unambiguous_share : of the velocities of a chirp in every slot, that the codes of antennas that
        send at once leave unambiguous
    code_leaks : of `schedule.leaks`, of antennas that sent at once; else None
    """

    waveform: Waveform
    schedule: Schedule
    delay_symbols: np.ndarray
    phases: np.ndarray
    antennas: Antennas
    passes: int
    unambiguous_share: float = 1.0
    code_leaks: np.ndarray | None = None

    @classmethod
    def of(cls, cube: IFCube, payload: Payload, antennas: Antennas, passes: int) -> Known:
        """Build the knowledge of a receiver with the payload of a frame."""
        sent = payload.delay_symbols, payload.phases
        return cls(cube.waveform, cube.schedule, *sent, antennas, passes)

    @classmethod
    def unmodulated(
        cls, waveform: Waveform, schedule: Schedule, antennas: Antennas, passes: int
    ) -> Known:
        """Build the knowledge of a frame without data."""
        pilot = unmodulated(waveform)
        return cls(waveform, schedule, pilot.delay_symbols, pilot.phases, antennas, passes)

    def decoded(self, spectra: np.ndarray) -> tuple[np.ndarray, Known]:
        """Return spectra (1, L_rx, rows, P) decoded by each antenna's code, one group per antenna,
        with their knowledge; unchanged where antennas send in turn."""
        codes, w = codes_of(self.waveform), self.waveform
        if codes is None:
            return spectra, self
        known = Known.unmodulated(w.decoded, decoded_schedule(w), self.antennas, self.passes)
        known = replace(known, unambiguous_share=unambiguous_share(w), code_leaks=leaks(w))
        return spectra * codes.conj().astype(np.complex64)[:, None, None], known

    def alike(self, other: Known) -> bool:
        """Test for the same knowledge of one frame."""
        same = self.antennas == other.antennas and self.passes == other.passes
        same = same and np.array_equal(self.delay_symbols, other.delay_symbols)
        return same and np.array_equal(self.phases, other.phases)

    @cached_property
    def _maps(self) -> list[tuple[weakref.ref[np.ndarray], np.ndarray]]:
        return []

    def mapped(self, spectra: np.ndarray, make: Callable[[], np.ndarray]) -> np.ndarray:
        """Return the power map of spectra, cached for receivers with the same spectra, which must
        not change them."""
        for of, power in self._maps:
            if of() is spectra:
                return power
        self._maps.append((weakref.ref(spectra), make()))
        return self._maps[-1][1]

    @cached_property
    def channels(self) -> int:
        """Virtual channels: pairs of a transmit and a receive antenna."""
        return self.antennas.num_tx * self.antennas.num_rx

    @cached_property
    def full(self) -> bool:
        """True if the groups together sample every antenna in every slot."""
        num_tx = self.waveform.num_tx
        return len(self.schedule) == num_tx and is_latin(self.schedule, num_tx)

    @cached_property
    def leaks(self) -> np.ndarray:
        """(K, L_tx, L_tx) amplitude by which an antenna's channel shows each one's echo, k K-ths of
        the Doppler span above its own, over that of chirps in every slot. Antennas that take turns
        in order see their own echoes K = L_tx times, turned by the slot in which they begin; other
        sparse schedules spread them over all velocities, which is left out."""
        num_tx = self.waveform.num_tx
        if self.code_leaks is not None:
            return self.code_leaks
        if self.full:
            return np.eye(num_tx)[None]
        first = self.schedule[:, :num_tx]
        if (self.schedule != np.tile(first, self.schedule.shape[1] // num_tx)).any():
            return np.eye(num_tx)[None] * len(first) / num_tx
        slot = np.argsort(first, axis=1)  # (M, L_tx) of each antenna
        phasor = np.exp(-2j * np.pi * np.arange(num_tx)[:, None, None] * slot / num_tx)
        return phasor.sum(axis=1)[:, None] * np.eye(num_tx) / num_tx

    @cached_property
    def times(self) -> np.ndarray:
        """Middles (M, P) of the chirps' windows [s] from mid-frame, tau_D later with data."""
        return self.waveform.middle_time + self.delay_symbols * self.waveform.delay_step

    @cached_property
    def slots(self) -> np.ndarray:
        """Times (M, P) of the cleaned chirps in slots: group m is 2 m T_d later, a chirp with data
        tau_D later."""
        w = self.waveform
        return (w.chirp_time + self.delay_symbols * w.delay_step) / w.slot_duration

    @cached_property
    def sampled_times(self) -> np.ndarray:
        """Middles (M, P) of the chirps' samples [s] from mid-frame."""
        w = self.waveform
        half = (w.num_samples - 1) / 2 * w.sample_interval
        return w.chirp_time + w.window_start + half - w.frame_duration / 2

    @cached_property
    def sent_by(self) -> list[np.ndarray]:
        """Chirps of each transmit antenna, (M, P) bool."""
        return [self.schedule == tx for tx in range(self.waveform.num_tx)]

    @cached_property
    def wavenumber(self) -> float:
        """2 pi f / c [rad/m], f the frequency at the middle of the window."""
        return 2 * np.pi * float(self.waveform.carrier()) / SPEED_OF_LIGHT

    @property
    def metres(self) -> float:
        """Reported range per delay, and velocity per delay rate [m/s]."""
        return SPEED_OF_LIGHT / self.passes

    @property
    def range_cell(self) -> float:
        """Reported range of one cell [m]."""
        return self.waveform.range_cell(self.passes)

    @overload
    def radius(self, delay: float) -> float: ...
    @overload
    def radius(self, delay: np.ndarray) -> np.ndarray: ...
    def radius(self, delay: float | np.ndarray) -> float | np.ndarray:
        """Return the radius of the wavefront of a path [m], at least one cell."""
        return np.maximum(delay * SPEED_OF_LIGHT / self.passes, self.range_cell)
