r"""mmWave-LoRadar as the paper sketches it: LoRa's initial-frequency modulation on the radar's
chirp, compressed sampling, own echoes.

The paper says: SF = 15, H = 2^15 initial frequencies, 2^16 sampling points compressed to 1024
(1/64), P SF = 1800 bits in a frame, "the same parameter settings", phase discontinuities from
frequency hopping, and a phase compensation of the initial frequencies for sensing. Assumed here,
where it is silent:

- A symbol h sweeps the band once in T = 51.2 us, from h B/H up, wrapping to 0 at t_w = T (1 - h/H):
  B T = H, so the symbols' tones after dechirping are 1/T apart. One symbol per slot, conventional
  TDM over L_tx antennas, slots of the ISAC waveform.
- 65536 points are the rate 2 B; compression keeps 1024 of these instants, drawn at random and known
  to the receiver.
- SNR is per kept sample and receive antenna, before any processing: |beta|^2/sigma^2, the same
  definition and number of samples as for the other schemes. (A converter open to 2 B instead of f_s
  would collect 18 dB more noise; that is not charged.)
- Communication: perfect timing, the path's delay and Doppler known and removed, one path. After
  dechirping h is a tone at bin h before the wrap and at bin h + H of 2 H after it. As the hop
  breaks the phase, the detector "energy" adds the powers of both bins over the receive antennas.
  "coherent", for comparison, keeps instants at multiples of 1/B, where both tones are one, and
  needs an unbroken phase.
- Sensing (monostatic): the echo is dechirped with the transmitter's own chirp and sampled at N/T =
  20 MHz. An echo in the symbol's first tau, and
  for tau after the wrap, beats outside the IF band and is lost: the time discontinuity. The
  reference and the echo share the oscillator, so a random phase at the wrap cancels. What remains
  is tau times the swept frequency, whose start differs by symbol: a phase f_h tau.
- `compensation` of that phase: "none"; "phase": every range cell k is turned by -2 pi h k/H, chirps
  as they were sampled, so that the tone jumps by the cell's fraction at the wrap; "ordered":
  samples are put in the order of swept frequency, where chirps of all symbols are alike, and the
  slow time counts from when mid-band was swept. Then Doppler, CFAR and angles as for FMCW.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import scipy.fft
from scipy import stats

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform, hann
from isac_rt.receive.cfar import first_row
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections
from reproduce.baselines.tdm import sense_tdm

Detector = Literal["energy", "coherent"]
Compensation = Literal["none", "phase", "ordered"]
BATCH = 4  # symbols at once: 4 x 15 spectra of 65536 points are 32 MB


@dataclass(frozen=True)
class LoRadar:
    """LoRadar's numbers at the parameters of an ISAC waveform.

    Raises
    ------
    ValueError  If B T is not a power of two: then no spreading factor makes the tones orthogonal.
    """

    waveform: Waveform

    def __post_init__(self) -> None:
        product = self.waveform.bandwidth * self.waveform.sampled_duration
        if abs(product - 2**self.spreading_factor) > 1e-6 * product:
            raise ValueError(
                f"LoRadar needs bandwidth x sampled duration = 2^SF; {product:g} is not a power of "
                "two"
            )

    @property
    def spreading_factor(self) -> int:
        """SF = log2(B T), bits per symbol."""
        return round(np.log2(self.waveform.bandwidth * self.waveform.sampled_duration))

    @property
    def num_symbols(self) -> int:
        """H."""
        return 2**self.spreading_factor

    @property
    def compression(self) -> float:
        """Kept samples over Nyquist points at the rate 2 B."""
        return self.waveform.num_samples / (2 * self.num_symbols)

    @property
    def bits_per_frame(self) -> int:
        """P SF."""
        return self.waveform.num_chirps * self.spreading_factor

    @property
    def range_cell(self) -> float:
        """c / (2 B) [m]: the whole band is swept within the sampled time."""
        return SPEED_OF_LIGHT / (2 * self.waveform.bandwidth)


def symbol_tones(
    system: LoRadar, symbols: np.ndarray, instants: np.ndarray, wrap_phase: np.ndarray | float = 0.0
) -> np.ndarray:
    """Dechirped symbols (S, K) at Nyquist instants (K,) (numbers of 1/(2B)): h n/(2H) cycles, less
    n/2 from n_w = 2 (H - h) on."""
    h, n = np.asarray(symbols, np.int64)[:, None], np.asarray(instants, np.int64)[None, :]
    wrapped = n >= 2 * (system.num_symbols - h)
    cycles = (h * n % (2 * system.num_symbols)) / (2 * system.num_symbols) - wrapped * (n % 2) / 2
    return np.exp(2j * np.pi * cycles + 1j * wrapped * np.reshape(wrap_phase, (-1, 1)))


def detect_symbols(
    system: LoRadar, samples: np.ndarray, instants: np.ndarray, detector: Detector = "energy"
) -> np.ndarray:
    """Symbols (S,) from dechirped samples (S, L_rx, K) at the known instants."""
    count = system.num_symbols
    length = 2 * count if detector == "energy" else count
    sparse = np.zeros((*samples.shape[:2], length), np.complex64)
    sparse[..., instants if detector == "energy" else instants // 2] = samples
    spectra = scipy.fft.fft(sparse, axis=-1, workers=1, overwrite_x=True)
    power = (spectra.real**2 + spectra.imag**2).sum(axis=1)
    if detector == "energy":
        power = power[:, :count] + power[:, count:]
    return power.argmax(axis=1)


def loradar_symbol_errors(
    snr_db: float,
    num_symbols: int,
    rng: np.random.Generator,
    system: LoRadar,
    num_rx: int = 15,
    detector: Detector = "energy",
    broken_phase: bool = True,
) -> np.ndarray:
    """Monte-Carlo of the communication receiver.

    Parameters
    ----------
    snr_db : per kept sample and receive antenna
    num_symbols : trials, each with its own sampling instants and phases at the antennas
    broken_phase : whether the hop at the wrap draws a new phase

    Returns
    -------
    wrong : (num_symbols,) bool
    """
    wrong = np.empty(num_symbols, bool)
    step = 1 if detector == "energy" else 2
    amplitude = 10 ** (snr_db / 20)
    for first in range(0, num_symbols, BATCH):
        count = min(BATCH, num_symbols - first)
        sent = rng.integers(0, system.num_symbols, count)
        instants = step * np.sort(
            rng.choice(2 * system.num_symbols // step, system.waveform.num_samples, replace=False)
        )
        jump = 2 * np.pi * rng.random(count) if broken_phase else 0.0
        channel = amplitude * np.exp(2j * np.pi * rng.random((count, num_rx, 1)))
        noise = rng.standard_normal((count, num_rx, instants.size, 2)).view(np.complex128)[
            ..., 0
        ] / np.sqrt(2)
        samples = channel * symbol_tones(system, sent, instants, jump)[:, None, :] + noise
        wrong[first : first + count] = detect_symbols(system, samples, instants, detector) != sent
    return wrong


def loradar_error_rate(
    snr_db: float, system: LoRadar, num_rx: int = 15, detector: Detector = "energy"
) -> float:
    """Symbol error rate of noncoherent detection of H orthogonal symbols with square-law combining.

    P = 1 - E[F(z)^(H-1)], z the sent symbol's power, F the law of a wrong one's. "coherent": L_rx
    branches, exact but for the correlation of the random atoms. "energy": 2 L_rx branches that
    share the energy as x^2 + (1 - x)^2, x the wrap's place, averaged over x; the width of the
    shortened tones, which makes neighbours alike, is left out.
    """
    snr, size = 10 ** (snr_db / 10), system.waveform.num_samples
    branches = num_rx if detector == "coherent" else 2 * num_rx
    shares = (
        [1.0]
        if detector == "coherent"
        else [x**2 + (1 - x) ** 2 for x in (np.arange(25) + 0.5) / 50]
    )
    rates = []
    for share in shares:
        z = stats.ncx2(2 * branches, 2 * num_rx * size * snr * share)
        grid = np.linspace(z.ppf(1e-9), z.isf(1e-9), 1501)
        wrong = stats.gamma(branches, scale=1 + snr).logcdf(
            grid / 2
        )  # the sent symbol leaks snr into every other bin
        rates.append(1 - np.trapezoid(z.pdf(grid) * np.exp((system.num_symbols - 1) * wrong), grid))
    return float(np.mean(rates))


@dataclass(frozen=True)
class Echoes:
    """K point targets at mid-frame: range [m], velocity [m/s, receding], direction (K, 2) in u_x
    and u_z, complex amplitude."""

    range: np.ndarray
    velocity: np.ndarray
    direction: np.ndarray
    amplitude: np.ndarray


@dataclass(frozen=True)
class LoRadarFrame:
    """IF samples (L_rx, P, N) of the own echoes, the symbols (P,) that were sent, and the antenna
    (P,) of each chirp."""

    samples: np.ndarray
    symbols: np.ndarray
    schedule: np.ndarray


def loradar_frame(
    system: LoRadar,
    echoes: Echoes,
    antennas: Antennas,
    noise_power: float,
    rng: np.random.Generator,
    unmodulated: bool = False,
) -> LoRadarFrame:
    """A frame with random symbols (all 0 where `unmodulated`): f_c tau + (f_h - B [wrapped]) tau +
    alpha tau (t - tau/2) cycles."""
    w = system.waveform
    slope, time = w.bandwidth / w.sampled_duration, np.arange(w.num_samples) / w.sampling_rate
    symbols = (
        np.zeros(w.num_chirps, int)
        if unmodulated
        else rng.integers(0, system.num_symbols, w.num_chirps)
    )
    schedule = np.arange(w.num_chirps) % w.num_tx
    start = symbols / system.num_symbols * w.bandwidth
    wrap = w.sampled_duration - start / slope
    late = np.arange(w.num_chirps)[:, None] * w.slot_duration + time - w.frame_duration / 2
    out = np.zeros((antennas.num_rx, w.num_chirps, w.num_samples), np.complex128)
    for r, v, (u_x, u_z), a in zip(
        echoes.range, echoes.velocity, echoes.direction, echoes.amplitude, strict=True
    ):
        u = np.array([u_x, 0.0, u_z])
        for rx in range(antennas.num_rx):
            elements = antennas.tx_positions[schedule] @ u + antennas.rx_positions[rx] @ u
            tau = (2 * (r + v * late) - elements[:, None]) / SPEED_OF_LIGHT
            both, lost = (
                time >= wrap[:, None] + tau,
                (time < tau) | ((time >= wrap[:, None]) & (time < wrap[:, None] + tau)),
            )
            swept = start[:, None] - w.bandwidth * both + slope * (time - tau / 2)
            cycles = (w.carrier_frequency * tau) % 1.0 + (swept * tau) % 1.0
            out[rx] += np.where(lost, 0.0, a * np.exp(2j * np.pi * cycles))
    if noise_power:
        out += (
            np.sqrt(noise_power / 2)
            * rng.standard_normal((*out.shape, 2)).view(np.complex128)[..., 0]
        )
    return LoRadarFrame(out.astype(np.complex64), symbols, schedule)


def receive_loradar(
    frame: LoRadarFrame,
    system: LoRadar,
    antennas: Antennas,
    settings: Receivers,
    compensation: Compensation = "ordered",
) -> Detections:
    """Range (one way), velocity and direction of the echoes of a terminal's own symbols."""
    w = system.waveform
    spectra, times = loradar_spectra(frame, system, compensation)
    first = first_row(settings, system.range_cell)
    return sense_tdm(
        spectra, frame.schedule, times, partial(loradar_delay, system), w, antennas, settings, first
    )


def loradar_spectra(
    frame: LoRadarFrame, system: LoRadar, compensation: Compensation
) -> tuple[np.ndarray, np.ndarray]:
    """Hann-windowed range spectra (L_rx, N, P) of a terminal's own symbols, and the times (P,) that
    their phases belong to [s]."""
    w, size = system.waveform, system.waveform.num_samples
    begin = (
        frame.symbols / system.num_symbols * size
    )  # where in the band each chirp starts, in samples
    whole = (
        np.floor(begin).astype(int) if compensation == "ordered" else np.zeros(w.num_chirps, int)
    )
    window = hann(np.arange(size) + 0.5, size)
    turn = np.zeros(w.num_chirps) if compensation == "none" else begin - whole
    cells = np.exp(-2j * np.pi * np.outer(np.arange(size), turn) / size).astype(np.complex64)
    order = (np.arange(size) - whole[:, None]) % size
    spectra = np.empty((len(frame.samples), size, w.num_chirps), np.complex64)
    for rx, one in enumerate(frame.samples):
        sorted_ = np.take_along_axis(one, order, axis=1) * window.astype(np.float32)
        spectra[rx] = scipy.fft.fft(sorted_, axis=1, workers=1).T * cells
    middle = (0.5 - begin / size) % 1.0 if compensation == "ordered" else np.full(w.num_chirps, 0.5)
    return spectra, np.arange(w.num_chirps) * w.slot_duration + middle * w.sampled_duration


def loradar_delay(system: LoRadar, cell: float, doppler_bin: float) -> tuple[float, float]:
    """Delay [s] and delay rate of a range cell and a Doppler bin."""
    w = system.waveform
    carrier = w.carrier_frequency + w.bandwidth / 2
    rate = doppler_bin / (w.frame_duration * carrier)
    return (cell - rate * carrier * w.sampled_duration) / w.bandwidth, rate
