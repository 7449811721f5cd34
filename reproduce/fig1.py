"""Fig. 1: the chirp with delay and phase symbols, what arrives, and the intermediate frequency,
from the paper's equation of the chirp.

The chirps are written here as the paper writes them, x(t) = conj(beta) exp(j s(t - tau_D)) with
s(t) = 2 pi (f_c t + alpha t^2/2), and mixed by multiplying; the program's own signal has to be the
same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.frame.payload import Payload, random_payload, unmodulated
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.randomness import generator
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate, channel_maps
from isac_rt.receive.spectrum import clean_spectrum
from reproduce import onepath
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, blank, style

RANGE, VELOCITY = 61.7, 4.3
"""The target as the AT sees it [m, m/s]."""
ORDER = 8
SHOWN = range(3, 6)
"""Slots drawn: the second chirp of each antenna, the first with a phase."""
_START_US, _IF_US = 2.6, 3.0
_GREY, _BLUE, _ORANGE = "#7F7F7F", "#0072B2", "#D55E00"


@dataclass(frozen=True)
class Chirps:
    """Signals of one slot by the paper's equation, without the carrier.

    Attributes
    ----------
    time : (T,) since the start of the slot [s]
    plain, sent, received : (T,) complex; transmitted without and with data, and the echo of the
        latter
    """

    time: np.ndarray
    plain: np.ndarray
    sent: np.ndarray
    received: np.ndarray


def chirp(w: Waveform, since: np.ndarray) -> np.ndarray:
    """exp(j s(t)) of a chirp that began `since` ago, times exp(-j 2 pi f_c t) of the clock; zero
    before and after it [s]."""
    on = (since >= 0) & (since < w.chirp_duration)
    return on * np.exp(2j * np.pi * ((w.slope * since * since / 2) % 1.0))


def slot(w: Waveform, payload: Payload, p: int, delay: float, time: np.ndarray) -> Chirps:
    """Chirp p of group 0 at times (T,) since its start; `delay` of the echo at that chirp [s]."""
    data, beta = payload.delay_symbols[0, p] * w.delay_step, payload.phases[0, p]
    carrier = [
        np.exp(-2j * np.pi * ((w.carrier_frequency * tau) % 1.0)) for tau in (data, data + delay)
    ]
    return Chirps(
        time=time,
        plain=chirp(w, time),
        sent=beta.conj() * carrier[0] * chirp(w, time - data),
        received=beta.conj() * carrier[1] * chirp(w, time - data - delay),
    )


def echo_delay(w: Waveform, time: np.ndarray) -> np.ndarray:
    """Delay of the echo [s] at times since the start of the frame."""
    return 2 * (RANGE + VELOCITY * (time - w.frame_duration / 2)) / SPEED_OF_LIGHT


def mixed(w: Waveform, payload: Payload, p: int, u: np.ndarray) -> np.ndarray:
    """IF of chirp p at times `u` since its start: the plain chirp times the conjugate of what
    arrives, whose delay is that of each time."""
    delay = echo_delay(w, u + p * w.slot_duration)
    data, beta = payload.delay_symbols[0, p] * w.delay_step, payload.phases[0, p]
    carrier = np.exp(2j * np.pi * ((w.carrier_frequency * (data + delay)) % 1.0))
    return beta * carrier * chirp(w, u) * chirp(w, u - data - delay).conj()


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Without noise; the seed chooses the data and `quick` changes nothing."""
    w = Waveform(num_groups=1)
    schedule = conventional_schedule(1, w.num_chirps, w.num_tx)
    payload = random_payload(w, schedule, ORDER, generator(seed, "fig1"))
    arrays = onepath.antennas(w, 1)
    middle = 2 * RANGE / SPEED_OF_LIGHT
    cube = onepath.frame(
        w, schedule, payload, arrays, delay=middle, rate=2 * VELOCITY / SPEED_OF_LIGHT
    )
    progress(1, 2)
    figure, table = _draw(w, payload)
    verdicts = _verdicts(w, payload, schedule, cube)
    progress(2, 2)
    settings = {
        "quick": quick,
        "seed": seed,
        "range_m": RANGE,
        "velocity_mps": VELOCITY,
        "D": ORDER,
        "noise": "none",
        "delay_symbols": payload.delay_symbols[0, list(SHOWN)].tolist(),
    }
    tables = {"fig1": table}
    return Outcome(
        "fig1", "The chirp with delay and phase symbols", tables, figure, verdicts, settings
    )


def slope_error(w: Waveform, payload: Payload) -> tuple[float, float]:
    """Largest departure of the sent chirps' frequency from a line of slope alpha [Hz], and of their
    modulus from 1, over all chirps."""
    step = 1 / (4 * w.bandwidth)
    worst, modulus = 0.0, 0.0
    for p in range(w.num_chirps):
        start = payload.delay_symbols[0, p] * w.delay_step
        t = start + np.linspace(0.01, 0.98, 400) * w.chirp_duration
        x, y = (slot(w, payload, p, 0.0, t + k * step).sent for k in (0, 1))
        frequency = np.angle(y * x.conj()) / (2 * np.pi * step)
        line = w.slope * (t + step / 2 - start)
        alias = (frequency - line + 2 * w.bandwidth) % (4 * w.bandwidth) - 2 * w.bandwidth
        worst, modulus = (
            max(worst, float(np.abs(alias).max())),
            max(modulus, float(np.abs(np.abs(x) - 1).max())),
        )
    return worst, modulus


def beat_error(w: Waveform, payload: Payload, samples: np.ndarray) -> float:
    """Largest distance [cells] of a chirp's strongest beat from data symbol plus path plus Doppler,
    over all chirps."""
    cell = np.arange(16 * w.num_samples) / 16
    peak = cell[np.abs(np.fft.fft(samples, 16 * w.num_samples, axis=-1)).argmax(axis=-1)]
    middle = np.arange(w.num_chirps) * w.slot_duration + w.window_start + w.sampled_duration / 2
    doppler = 2 * VELOCITY / SPEED_OF_LIGHT * w.effective_carrier * w.sampled_duration
    return float(
        np.abs(
            peak - payload.delay_symbols[0] - echo_delay(w, middle) / w.delay_step - doppler
        ).max()
    )


def coherent_share(
    w: Waveform, payload: Payload, schedule: np.ndarray, cube, *, removed: bool
) -> float:
    """Share of the power of an unmodulated chirp frame's strongest range-Doppler cell that is left
    with data on the chirps."""
    pilot = unmodulated(w)
    reference = onepath.frame(
        w,
        schedule,
        pilot,
        onepath.antennas(w, 1),
        delay=2 * RANGE / SPEED_OF_LIGHT,
        rate=2 * VELOCITY / SPEED_OF_LIGHT,
    )
    peaks = []
    for one, sent in ((cube, payload if removed else pilot), (reference, pilot)):
        known = Known.of(one, sent, onepath.antennas(w, 1), 2)
        spectra = clean_spectrum(one, known, w.num_samples)
        peaks.append(float(accumulate(channel_maps(spectra, known)).max()))
    return peaks[0] / peaks[1]


say = Sentences("""
linear: After modulation the chirp is still a linear frequency modulation of constant modulus
  over {chirps} chirps the frequency departs from a line of slope alpha by {slope:.2g} Hz at most,
  of {band:.0f} MHz, the modulus by {modulus:.1g}

IF: The IF is that of FMCW with the data delay added to the path's
  the mixed chirps and the program's signal differ by {difference:.1g} RMS; beats lie within
  {beat:.2f} cells of symbol plus path and Doppler (searched in steps of 1/16)

compatible: It is compatible with the existing estimation algorithms for FMCW
  only once all data phases are removed: the strongest cell of the range-Doppler map then has
  {kept:.3f} of its power without data, else {lost:.2g}
""")


def _verdicts(w: Waveform, payload: Payload, schedule: np.ndarray, cube) -> tuple[Verdict, ...]:
    samples = cube.samples[0, 0].astype(np.complex128)
    model = np.stack([mixed(w, payload, p, w.fast_time) for p in range(w.num_chirps)])
    difference = float(np.sqrt(np.mean(np.abs(samples - model) ** 2)))
    slope, modulus = slope_error(w, payload)
    beat = beat_error(w, payload, samples)
    kept, lost = (coherent_share(w, payload, schedule, cube, removed=r) for r in (True, False))
    far = {"chirps": w.num_chirps, "slope": slope, "modulus": modulus, "band": w.bandwidth / 1e6}
    alike = difference < 1e-3 and beat < 0.1
    return (
        say("linear", slope < 1e3 and modulus < 1e-12, **far),
        say("IF", alike, difference=difference, beat=beat),
        say("compatible", lost > 0.9, kept > 0.9 > 10 * lost, kept=kept, lost=lost),
    )


def _draw(w: Waveform, payload: Payload) -> tuple[Figure, pd.DataFrame]:
    """Time-frequency lines above, real parts below; the columns are the slots."""
    frames = []
    with style():
        figure, axes = blank(
            4, len(SHOWN), size=(10.5, 8.4), sharey="row", height_ratios=(1.5, 1, 1, 1)
        )
        for column, p in zip(axes.T, SHOWN, strict=True):
            data = payload.delay_symbols[0, p] * w.delay_step
            delay = float(echo_delay(w, np.array(p * w.slot_duration + w.chirp_duration / 2)))
            _lines(column[0], column[1], w, data, delay)
            phase = np.angle(payload.phases[0, p]) / np.pi % 2
            column[0].set_title(
                f"chirp {p}: delay symbol {payload.delay_symbols[0, p]}, phase {phase:.2f} $\\pi$"
            )
            t = np.linspace(0, _START_US * 1e-6, 1200)
            x = slot(w, payload, p, delay, t)
            for k, (name, y, colour) in enumerate(
                (
                    ("conventional, sent", x.plain, _GREY),
                    ("ISAC, sent", x.sent, _BLUE),
                    ("ISAC, received", x.received, _ORANGE),
                )
            ):
                column[2].plot(t * 1e6, y.real - 2.4 * k, color=colour, lw=0.9, label=name)
            fine = w.window_start + np.linspace(0, _IF_US * 1e-6, 900)
            plain, sent = mixed(w, unmodulated(w), p, fine), mixed(w, payload, p, fine)
            u = fine * 1e6
            column[3].plot(u, plain.real, color=_GREY, lw=0.9, label="conventional, IF")
            column[3].plot(u, sent.real - 2.4, color=_ORANGE, lw=0.9, label="ISAC, IF")
            values = {
                "chirp": p,
                "delay_symbol": payload.delay_symbols[0, p],
                "phase_rad": np.angle(payload.phases[0, p]),
                "time_us": u,
            }
            frames.append(
                pd.DataFrame(
                    values | {"if_conventional_real": plain.real, "if_isac_real": sent.real}
                )
            )
            for ax in column:
                ax.set_xlabel("time since the slot began [us]")
        labels = (
            "frequency - $f_c$ [MHz]",
            "IF [MHz]",
            "real part,\ncarrier removed",
            "real part of IF",
        )
        for ax, label in zip(axes[:, 0], labels, strict=True):
            ax.set_ylabel(label)
        handles, names = axes[0, 0].get_legend_handles_labels()
        figure.legend(
            handles, names, loc="outside upper center", ncols=4, title="green: the sampled window"
        )
        for ax in axes[2:].ravel():
            ax.set_yticks([])
    return figure, pd.concat(frames, ignore_index=True)


def _lines(ax, beat, w: Waveform, data: float, delay: float) -> None:
    """Instantaneous frequencies of one slot, and of its IF over the sampled window."""
    end, us, mhz = w.chirp_duration, 1e6, 1e-6
    for later, name, colour, dash in (
        (0.0, "conventional, sent", _GREY, "--"),
        (delay, "conventional, received", _GREY, ":"),
        (data, "ISAC, sent", _BLUE, "-"),
        (data + delay, "ISAC, received", _ORANGE, "-"),
    ):
        ax.plot(
            np.array([later, later + end]) * us,
            [0, w.bandwidth * mhz],
            dash,
            color=colour,
            lw=1.1,
            label=name,
        )
    ax.set(xlim=(0, 6), ylim=(0, 75))
    window = np.array([w.window_start, end]) * us
    ax.axvspan(window[0], 6, color="#009E73", alpha=0.12, lw=0)
    for tau, colour, dash in ((delay, _GREY, "--"), (data + delay, _ORANGE, "-")):
        beat.plot(window, [w.slope * tau * mhz] * 2, dash, color=colour)
    beat.set(xlim=(0, end * us), ylim=(0, w.sampling_rate * mhz))
