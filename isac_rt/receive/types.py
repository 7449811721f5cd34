"""Inputs of a receiver besides the samples, and its outputs. Nothing here comes from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted paths of one frame, in measurement space, at the middle of the frame.

    One row per expected path; row 0 of a PT is its line of sight.

    Attributes
    ----------
    range : (K,) [m]; one way for an echo at the AT, whole path length at a PT
    velocity : (K,) [m/s] rate of `range`, positive is receding
    direction : (K, 2) direction cosines (u_x, u_z) in the receiver's body frame
    range_std, velocity_std : (K,) standard deviations of the predictions
    weight : (K,) expected power relative to the strongest, in (0, 1]

    Examples
    --------
    >>> one = np.ones(1)
    >>> expected = Prediction(
    ...     range=30.2 * one, velocity=-3.1 * one, direction=np.array([[0.1, 0.0]]),
    ...     range_std=0.02 * one, velocity_std=0.1 * one, weight=one,
    ... )
    >>> expected.range.round(1)
    array([30.2])
    """

    range: np.ndarray
    velocity: np.ndarray
    direction: np.ndarray
    range_std: np.ndarray
    velocity_std: np.ndarray
    weight: np.ndarray

    @property
    def reference(self) -> Prediction:
        """Return row 0 alone."""
        return Prediction(**{name: value[:1] for name, value in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class Detections:
    """Points that a receiver found in one frame, at the middle of the frame. Read-only arrays of Q
    rows.

    Attributes
    ----------
    range : (Q,) [m]; one way at the AT, whole path length at a PT
    velocity : (Q,) [m/s], rate of `range`, positive is receding
    direction : (Q, 2) direction cosines (u_x, u_z) of arrival in the receiver's body frame; NaN
        where it was not found
    snr : (Q,) linear, of the range-Doppler cell after accumulation over antennas
    std : (Q, 4) standard deviations of range, velocity, u_x, u_z; infinite on an axis that the
        array does not observe
    is_reference : (Q,) bool, the line of sight at a PT
    starts : (Q,) bool, whether it may start a track; the others only carry on one

    Examples
    --------
    >>> d = no_detections()
    >>> len(d), d.select(d.snr > 25), len(Detections.joined([d, d]))
    (0, <0 detections>, 0)
    """

    range: np.ndarray
    velocity: np.ndarray
    direction: np.ndarray
    snr: np.ndarray
    std: np.ndarray
    is_reference: np.ndarray
    starts: np.ndarray

    def __post_init__(self) -> None:
        for a in vars(self).values():
            a.setflags(write=False)

    def __len__(self) -> int:
        return self.range.shape[0]

    @property
    def measured(self) -> np.ndarray:
        """(Q, 4) range, velocity, u_x, u_z."""
        return np.column_stack([self.range, self.velocity, self.direction])

    def select(self, which: np.ndarray) -> Detections:
        """The detections that a mask or an index array chooses."""
        return Detections(**{name: value[which] for name, value in vars(self).items()})

    def widened(self, spread: np.ndarray) -> Detections:
        """With independent errors of standard deviation `spread` (4,) or (Q, 4) besides."""
        return replace(self, std=np.hypot(self.std, spread))

    @staticmethod
    def joined(parts: Sequence[Detections]) -> Detections:
        """All detections of some sets, in their order."""
        names = [f.name for f in fields(Detections)]
        return Detections(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})

    def __repr__(self) -> str:
        rows = ["  range [m]  velocity [m/s]     u_x     u_z  SNR [dB]"]
        for i in range(min(len(self), 20)):
            mark = "  line of sight" if self.is_reference[i] else ""
            u_x, u_z = self.direction[i]
            level = 10 * np.log10(max(self.snr[i], 1e-30))
            rows.append(
                f"{self.range[i]:11.3f}{self.velocity[i]:16.3f}{u_x:8.3f}{u_z:8.3f}{level:10.1f}{mark}"
            )
        more = [f"  and {len(self) - 20} more"] if len(self) > 20 else []
        return "\n".join([f"<{len(self)} detections", *(rows if len(self) else []), *more]) + ">"


def no_detections() -> Detections:
    """Nothing found."""
    return Detections(
        range=np.zeros(0),
        velocity=np.zeros(0),
        direction=np.zeros((0, 2)),
        snr=np.zeros(0),
        std=np.zeros((0, 4)),
        is_reference=np.zeros(0, bool),
        starts=np.ones(0, bool),
    )


@dataclass(frozen=True, kw_only=True)
class Maps:
    """Pictures of one reception, made only when asked for.

    Attributes
    ----------
    range_doppler : (rows, P) power, accumulated over antennas; rows from range 0, Doppler centred
        (velocity ascending)
    range_axis [m], velocity_axis [m/s] : of the rows and columns
    equivalent_range : (N, P) rms magnitude over the receivers of the first group before data
        removal, over range cell and chirp
    equivalent_detections : (N, P) bool, what the one-dimensional CFAR finds in it, chirp by chirp
    """

    range_doppler: np.ndarray
    range_axis: np.ndarray
    velocity_axis: np.ndarray
    equivalent_range: np.ndarray
    equivalent_detections: np.ndarray


@dataclass(frozen=True)
class PathChannels:
    """Channels as one strong path shows them.

    Attributes
    ----------
    delay, delay_rate : of the path at mid-frame [s, 1]
    modes : (`isac_rt.receive.modes.MODES`, L_tx, L_rx) complex, amplitude of every virtual channel
        by polynomials over the chirp [sqrt(W)]; the first is the mean
    snr : of the cell after accumulation over antennas
    """

    delay: float
    delay_rate: float
    modes: np.ndarray
    snr: float


@dataclass(frozen=True, kw_only=True)
class Reception:
    """Output of one terminal's receiver for one frame.

    Attributes
    ----------
    detections : Detections
    decoded : whether data symbols were decided (a PT in a data frame with its line of sight)
    intact : whether the check sums among the decided bits hold
    delay_symbols : (M, P) int, -1 where nothing was decided
    transitions : (M, L_tx, P/L_tx - 1) int, -1 where nothing was decided
    bits : (bits_per_frame,) uint8, of the groups that are read, check sums included, in the order
        of `Payload.bits_of`; empty when not decoded
    delay_confidence : (M, P), transition_confidence : as `transitions`; larger is surer
    raw_delay_symbols : (groups read, P) int, decisions of a search that runs a few cells past the
        alphabet on both sides (so -3 and N/2 + 2 can occur), for slip detection; empty when not
        decoded
    line_of_sight : whether the receiver sees its reference path in this frame (PT; always False at
        the AT)
    reference_power : mean power of the reference path per sample and receive antenna [W], NaN where
        there is none
    maps : Maps or None
    confidence_looks : receivers whose noise is independent in a delay confidence, a mean of so many
        exponentials; 0 when not decoded
    sparse : where the velocities came from sparse sampling with OMP or from a conventional
        schedule, whether the scene is sparse enough for OMP (`isac_rt.receive.omp.sparse_enough`);
        False advises the transmitter to fall back from a pseudo-random schedule to a conventional
        one (`isac_rt.simulation.fall_back`). None elsewhere
    correction : what the frame's clutter says of the own velocity and of the level that the
        terminal expects; None where a detector does not ask
    placed : whether what it shows can be placed: not where data were read over a path that nothing
        explains
    path_channels : what strong paths show of the channels, at a PT its reference alone; empty where
        `receivers.self_calibration` is none
    """

    detections: Detections
    decoded: bool
    delay_symbols: np.ndarray
    transitions: np.ndarray
    bits: np.ndarray
    delay_confidence: np.ndarray
    transition_confidence: np.ndarray
    raw_delay_symbols: np.ndarray
    line_of_sight: bool
    reference_power: float
    maps: Maps | None = None
    confidence_looks: int = 0
    sparse: bool | None = None
    correction: Correction | None = None
    path_channels: tuple[PathChannels, ...] = ()
    placed: bool = True
    intact: bool = True

    @property
    def is_read(self) -> bool:
        """True if data were decided and their check sums hold; else they are erased."""
        return self.decoded and self.intact

    @classmethod
    def undecoded(
        cls,
        waveform: Waveform,
        detections: Detections,
        maps: Maps | None = None,
        sparse: bool | None = None,
        correction: Correction | None = None,
    ) -> Reception:
        """A reception whose data, if it carried any, were not read.

        Examples
        --------
        >>> Reception.undecoded(Waveform(), no_detections())
        <Reception 0 detections, no data decoded>
        """
        w = waveform
        shape = w.num_groups, w.num_chirps
        transitions = w.num_groups, w.num_tx, w.num_chirps // w.num_tx - 1
        return cls(
            detections=detections,
            decoded=False,
            delay_symbols=np.full(shape, -1),
            transitions=np.full(transitions, -1),
            bits=np.zeros(0, np.uint8),
            delay_confidence=np.zeros(shape),
            transition_confidence=np.zeros(transitions),
            raw_delay_symbols=np.zeros((0, w.num_chirps), int),
            line_of_sight=False,
            reference_power=float("nan"),
            maps=maps,
            sparse=sparse,
            correction=correction,
        )

    def without_reference(self) -> Reception:
        """The same frame with its reference taken for something else: what was read by it is
        erased."""
        d = self.detections
        return replace(
            self,
            detections=replace(d, is_reference=np.zeros(len(d), bool)),
            decoded=False,
            delay_symbols=np.full_like(self.delay_symbols, -1),
            transitions=np.full_like(self.transitions, -1),
            bits=np.zeros(0, np.uint8),
            raw_delay_symbols=np.zeros((0, self.raw_delay_symbols.shape[1]), int),
            line_of_sight=False,
        )

    def without_sight(self, named: bool) -> Reception:
        """The same frame read over another path than the line of sight; unless that is `named`,
        what it shows has no place."""
        d = self.detections
        remaining = replace(d, is_reference=np.zeros(len(d), bool)) if named else no_detections()
        return replace(self, detections=remaining, line_of_sight=False, placed=named)

    def __repr__(self) -> str:
        data = f"{self.bits.size} bits decoded" if self.decoded else "no data decoded"
        los = "line of sight, " if self.line_of_sight else ""
        return f"<Reception {len(self.detections)} detections, {los}{data}>"


@dataclass(frozen=True)
class ExpectedClutter:
    """K independent scatterers of known mean power, as one receiver expects them at the middle of a
    frame.

    Attributes
    ----------
    delay, delay_rate : (K,) [s, 1]
    power : (K,) mean received power per sample and antenna pair [W], elements included
    departure, arrival : (K, 3) unit vectors in the body frame of the transmitter and of the
        receiver
    """

    delay: np.ndarray
    delay_rate: np.ndarray
    power: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray

    def __len__(self) -> int:
        return self.delay.size

    def select(self, which: np.ndarray) -> ExpectedClutter:
        """The scatterers that a mask or an index array chooses."""
        return ExpectedClutter(*(a[which] for a in vars(self).values()))

    @staticmethod
    def joined(parts: Sequence[ExpectedClutter]) -> ExpectedClutter:
        """Several kinds of clutter as one."""
        names = [f.name for f in fields(ExpectedClutter)]
        return ExpectedClutter(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


@dataclass(frozen=True)
class Correction:
    """Estimate of the terminal's own errors from a frame.

    Attributes
    ----------
    level : natural logarithm of the factor on all expected powers
    velocity : (3,) to be added to the terminal's velocity, body axes [m/s]
    """

    level: float
    velocity: np.ndarray

    def then(self, further: Correction) -> Correction:
        """Both together, `further` found after this one was applied."""
        return Correction(self.level + further.level, self.velocity + further.velocity)

    def apply(self, clutter: ExpectedClutter) -> ExpectedClutter:
        """The clutter as it is expected after the correction."""
        closing = (clutter.departure + clutter.arrival) @ self.velocity
        return replace(
            clutter,
            delay_rate=clutter.delay_rate - closing / SPEED_OF_LIGHT,
            power=clutter.power * np.exp(self.level),
        )


@dataclass(frozen=True)
class Hints:
    """Knowledge of a terminal about a frame before it processes the samples.

    Attributes
    ----------
    clutter : what its city returns; None: unknown
    """

    clutter: ExpectedClutter | None = None


NO_HINTS = Hints()
