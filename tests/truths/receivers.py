"""Receivers, detectors, trackers and scores against theory."""

from __future__ import annotations

import itertools

import numpy as np
from scipy import stats
from scipy.integrate import quad

from isac_rt.frame.cube import IFCube
from isac_rt.frame.level import link_budget
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.clutter.rayleigh import rayleigh_cells
from isac_rt.propagation.settings import Clutter
from isac_rt.receive.active import receive_active
from isac_rt.receive.cfar import CfarRule, greatest_of_factor
from isac_rt.receive.clutter_filter import remove_static
from isac_rt.receive.estimate import directions
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate, channel_maps, slow_window, union_operator
from isac_rt.receive.omp import omp
from isac_rt.receive.sense import Cfar
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.symbols import demodulate
from isac_rt.receive.types import Prediction
from truths import stage
from truths.case import Errors, case, slow
from truths.stage import FEW, FULL

C = 299_792_458.0
ONCE_IN_1E5 = "false alarm 7e-6"
SHORT = Waveform(num_samples=128)


# ---- data


def _prediction(length: float, rate: float) -> Prediction:
    one = np.ones(1)
    return Prediction(
        range=length * one,
        velocity=rate * one,
        direction=np.zeros((1, 2)),
        range_std=one,
        velocity_std=one,
        weight=one,
    )


def _symbols_in_noise(order: int, cell_snr: float, frames: int) -> tuple[int, int, int, int]:
    """Wrong and all delay symbols, wrong and all transitions, with three receivers at this SNR of a
    range cell each."""
    w, schedule, payload = stage.frame(order, 5, SHORT)
    length, rate = 21.37 * w.range_cell(1), 7.3
    clean = stage.cube_of(w, schedule, payload, [(length, rate, 1.0)])
    delay = dpsk = 0
    for seed in range(frames):
        found = demodulate(
            stage.noisy(clean, w.num_samples / cell_snr, seed), _prediction(length, rate), order
        )
        delay += int((found.raw != payload.delay_symbols).sum())
        dpsk += int((found.transitions != payload.transitions).sum())
    return delay, frames * payload.delay_symbols.size, dpsk, frames * payload.transitions.size


def _dpsk_theory(order: int, snr: float, branches: int) -> float:
    """Symbol error rate of D-DPSK with summed branches: twice the chance that a Hermitian form of
    Gaussians leaves the sector on one side, by inverting its characteristic function (Gil-Pelaez);
    both sides at once, opposite to the symbol, is left out (1e-9)."""
    eigenvalues, vectors = np.linalg.eigh(
        np.array([[0, -0.5j * np.exp(-1j * np.pi / order)], [0.5j * np.exp(1j * np.pi / order), 0]])
    )
    means = np.abs(vectors.conj().T @ np.full(2, np.sqrt(snr))) ** 2

    def density(t: float) -> float:
        root = 1 - 1j * t * eigenvalues
        return float(
            ((np.exp(1j * t * eigenvalues * means / root) / root).prod() ** branches).imag / t
        )

    return 2 * (0.5 + quad(density, 0, np.inf, limit=2000)[0] / np.pi)


@case(
    "characteristic function of the detector's Hermitian form, inverted",
    "4.5 sigma",
    ONCE_IN_1E5 + "; neighbouring symbols share a chirp, which at most doubles the variance",
)
def dpsk_symbol_errors() -> Errors:
    """Symbol error rates of DPSK in white noise with three receivers, D = 8 and 16, at rates of a
    few percent."""
    for order, snr in ((8, 8.0), (16, 26.0)):
        _, _, wrong, total = _symbols_in_noise(order, snr, 16)
        rate = _dpsk_theory(order, snr, 3)
        yield abs(wrong / total - rate) / np.sqrt(2 * rate * (1 - rate) / total)


@case(
    "M-ary orthogonal signals with three square-law branches: an integral over the "
    "noncentral chi-square law",
    "4.5 sigma",
    ONCE_IN_1E5,
)
def delay_symbol_errors() -> float:
    """Symbol error rate of the delay symbols in white noise with three receivers, 72 cells, at a
    rate of a few percent."""
    snr, branches, cells = 5.0, 3, SHORT.num_samples // 2 + 8
    wrong, total, _, _ = _symbols_in_noise(8, snr, 16)
    right = quad(
        lambda x: (
            stats.ncx2.pdf(x, 2 * branches, 2 * branches * snr)
            * stats.chi2.cdf(x, 2 * branches) ** (cells - 1)
        ),
        0,
        200,
        limit=500,
    )[0]
    rate = 1 - right
    return abs(wrong / total - rate) / np.sqrt(rate * (1 - rate) / total)


@case("the symbols and bits that were sent", "0 symbols", "exact without noise")
def data_at_the_ends_of_the_velocity() -> float:
    """Every symbol and bit of a noise-free frame, D = 2 to 16, at -29.4 and +17.3 m/s, a fraction
    of a cell off the prediction."""
    wrong = 0
    w = Waveform(num_samples=256)
    for order, rate in itertools.product((2, 4, 8, 16), (-29.4, 17.3)):
        _, schedule, payload = stage.frame(order, 3, w)
        signal = stage.cube_of(
            w, schedule, payload, [(71.39, rate, 1j)], FEW, (0.31, -0.22), (-0.17, 0.26)
        )
        found = demodulate(signal, _prediction(71.42, rate + 0.05), order)
        wrong += int(
            (found.raw != payload.delay_symbols).sum()
            + (found.transitions != payload.transitions).sum()
        )
        wrong += int((found.bits != payload.bits).sum())
    return float(wrong)


@case(
    "Fourier transform by a plain sum over uniform samples",
    "0 dB over -50 dB",
    "sidelobes that the resampling may leave (isac_rt.receive.maps)",
)
def union_of_the_groups() -> Errors:
    """One antenna's samples at their true, uneven times give the spectrum of even ones, for tones
    all over the band."""
    w, schedule, payload = stage.frame(8, 3, SHORT)
    slot = w.slot_duration
    times = np.zeros(w.num_chirps)
    for m, p in zip(*np.nonzero(schedule == 1), strict=True):
        times[p] = (
            p
            + (2 * m * w.max_delay + payload.delay_symbols[m, p] * w.max_delay / w.num_samples)
            / slot
        )
    p, bins = np.arange(w.num_chirps), np.fft.fftfreq(w.num_chirps, 1 / w.num_chirps)
    for tone in (-57.3, -31.6, 4.2, 22.5, 56.9):
        found = union_operator(w, times) @ np.exp(2j * np.pi * tone * times / w.num_chirps)
        even = np.exp(2j * np.pi * tone * (p + (times - p).mean()) / w.num_chirps)
        truth = np.exp(-2j * np.pi * np.outer(bins, p) / w.num_chirps) @ (slow_window(w) * even)
        yield 20 * np.log10(np.abs(found - truth).max() / np.abs(truth).max()) + 50


@case(
    "least squares on a support that grows atom by atom",
    "0.0001 relative",
    "single precision of the result",
)
def orthogonal_matching_pursuit() -> Errors:
    """Batch OMP in its Gram-matrix form finds what the plain algorithm finds."""
    rng = np.random.default_rng(6)
    chosen = np.sort(rng.choice(120, 40, replace=False))
    atoms = np.exp(2j * np.pi * np.outer(chosen, np.arange(120)) / 120)
    vectors = rng.normal(size=(12, 40, 2)) @ np.array([1, 1j]) + 3 * atoms[:, [17]].T
    found = omp(vectors, chosen, 120, 4)
    for vector, result in zip(vectors, found, strict=True):
        support: list[int] = []
        rest = vector
        for _ in range(4):
            support.append(int(np.argmax(np.abs(atoms.conj().T @ rest))))
            solution = np.linalg.lstsq(atoms[:, support], vector, rcond=None)[0]
            rest = vector - atoms[:, support] @ solution
        truth = np.zeros(120, complex)
        truth[support] = 40 * solution
        yield stage.relative(result, truth)


# ---- detection


def _greatest_of(factor: float, looks: int, cells: int, snr: float = 0.0) -> float:
    """Chance that a cell (mean of `looks` powers of amplitude-squared `snr` over the noise) exceeds
    factor times the greater mean."""

    def density(z: float) -> float:
        side = stats.gamma(looks * cells, scale=1 / (looks * cells))
        above = (
            stats.ncx2.sf(2 * looks * factor * z, 2 * looks, 2 * looks * snr)
            if snr
            else stats.gamma.sf(factor * z, looks, scale=1 / looks)
        )
        return float(2 * side.pdf(z) * side.cdf(z) * above)

    return quad(density, 0, 6, points=[0.7, 1.0, 1.4], limit=400)[0]


@case(
    "F distribution of a cell over one training mean; an integral for the greater of two",
    "0.001 of the rate",
    "trapezoid over 4001 points",
)
def false_alarm_factor() -> Errors:
    """The threshold's factor gives the false-alarm rate that was asked for, from 1e-2 to 1e-6,
    one-sided and greatest-of."""
    for rate, looks, cells in ((1e-2, 3, 8), (1e-4, 15, 8), (1e-6, 45, 20)):
        one = greatest_of_factor(rate, float(looks), float(cells), 0.0)
        yield abs(stats.f.sf(one, 2 * looks, 2 * looks * cells) / rate - 1)
        yield (
            abs(
                _greatest_of(greatest_of_factor(rate, float(looks), cells, cells), looks, cells)
                / rate
                - 1
            )
        )


@case("binomial law at the designed rate", "4.5 sigma", ONCE_IN_1E5)
def false_alarms_along_range() -> float:
    """False alarms of the one-dimensional CFAR in noise of 15 receivers, 200,000 cells at 1e-3,
    ends included."""
    power = np.random.default_rng(21).gamma(15, 1 / 15, (1000, 200))
    return abs(CfarRule(1e-3, (3, 0), (8, 0), 15).detect_chirps(power).sum() - 200) / np.sqrt(200)


@case(
    "integral of the noncentral chi-square law over the greater training mean",
    "4.5 sigma",
    ONCE_IN_1E5 + "; factor by the program, whose rate has a case of its own",
)
def detection_probability() -> float:
    """Share of detections of a steady target of 0 dB per receiver, 15 receivers, false-alarm rate
    1e-4."""
    looks, snr, rng = 15, 1.0, np.random.default_rng(9)
    power = rng.gamma(looks, 1 / looks, (100, 4000))
    power[50] = rng.noncentral_chisquare(2 * looks, 2 * looks * snr, 4000) / (2 * looks)
    rate = _greatest_of(greatest_of_factor(1e-4, float(looks), 8, 8), looks, 8, snr)
    return abs(
        CfarRule(1e-4, (3, 0), (8, 0), looks).detect_chirps(power)[50].mean() - rate
    ) / np.sqrt(rate * (1 - rate) / 4000)


def _noise_cube(w: Waveform, seed: int) -> IFCube:
    empty = np.zeros((w.num_groups, 3, w.num_chirps, w.num_samples), np.complex64)
    _, schedule, _ = stage.frame(8, seed, w)
    return stage.noisy(
        IFCube(samples=empty, waveform=w, schedule=schedule, start_time=0.0), 1.0, seed
    )


@slow(
    "the designed rate",
    "0.25 relative",
    "windowed neighbours count as fractions of independent cells, an approximation good to a "
    "fifth; 1,200 alarms in clusters scatter by 0.06",
)
def false_alarms_of_the_whole_chain() -> float:
    """Cells above the threshold in noise through data removal, Doppler and accumulation, designed
    for 5e-3."""
    w, alarms, cells = Waveform(num_samples=256), 0, 0
    rule = CfarRule.of(Receivers(false_alarm_rate=5e-3), 9)
    for seed in range(16):
        cube = _noise_cube(w, seed)
        known = Known.unmodulated(w, cube.schedule, FEW, 1)
        power = accumulate(channel_maps(clean_spectrum(cube, known), known))
        above, _ = rule.detect(power)
        alarms, cells = alarms + int(above.sum()), cells + above.size
    return abs(alarms / cells / 5e-3 - 1)


# ---- estimates


@case(
    "range, velocity and direction that the cube was made with",
    "0.002 of a resolution",
    "element delays of opposite sign do not cancel in the summed power, 2e-4 m; plane waves in "
    "the cube against spheres in the receiver",
)
def bias_of_an_echo() -> Errors:
    """Estimates of a noise-free echo off the grid, data on the chirps, at 31 and 58 m and up to
    14.6 m/s; nothing else is seen."""
    w, schedule, payload = stage.frame(w=Waveform(num_samples=512))
    for distance, speed, x, z in ((31.3217, 13.277, -0.52, 0.17), (57.618, -14.62, 0.05, 0.61)):
        signal = stage.cube_of(
            w, schedule, payload, [(2 * distance, 2 * speed, 1.0)], FULL, (x, z), (x, z)
        )
        d = receive_active(signal, payload, FULL, Receivers()).detections
        if len(d) != 1:
            yield np.inf
            return
        off = np.array([d.range[0] - distance, d.velocity[0] - speed, *(d.direction[0] - [x, z])])
        yield np.abs(off / [0.24983, 0.25014, 0.108, 0.108]).max()


def _loss(window: np.ndarray) -> tuple[float, float]:
    """Variance of the peak's place [cycles per sample]^2 at unit SNR of a sample, with this window
    and without (the Cramer-Rao bound)."""
    x = np.arange(window.size) - (window.size - 1) / 2
    bound = 6 / (4 * np.pi**2 * window.size * (window.size**2 - 1))
    return float((window**2 * x**2).sum() / (window * x**2).sum() ** 2 / 2 / (4 * np.pi**2)), bound


@case(
    "Cramer-Rao bound of a tone over channels of unknown phase, with the Hann windows' loss by "
    "first-order perturbation",
    "4.5 sigma",
    ONCE_IN_1E5 + "; the variance of 100 frames is known to 14 %",
)
def scatter_of_range_and_velocity() -> float:
    """Estimates of range and velocity in noise scatter as the bound says, 15 dB below the noise of
    a sample."""
    w, schedule, _ = stage.frame(w=Waveform(num_samples=256, num_chirps=60))
    pilot, length, rate, noise, count = unmodulated(w), 41.3, -4.6, 10**1.5, 100
    clean = stage.cube_of(w, schedule, pilot, [(length, rate, 1.0)])
    known, errors = Known.unmodulated(w, schedule, FEW, 1), []
    for seed in range(count):
        cube = stage.noisy(clean, noise, seed)
        d = Cfar(Receivers()).sense(clean_spectrum(cube, known), known).detections
        best = int(np.argmax(d.snr))
        errors.append([d.range[best] - length, d.velocity[best] - rate])
    fast = (
        np.sin(np.pi * np.arange(252) / 251.73) ** 4
    )  # Hann in the data and in the template; short by the largest data delay
    slow = np.sin(np.pi * (np.arange(60) + 0.5) / 60) ** 2
    channels = 3 * 3
    in_slow = (slow**2).sum() / slow.sum() ** 2 * 60
    in_fast = (fast**2).sum() / fast.sum() ** 2
    sigma_range = (
        np.sqrt(_loss(fast)[0] * noise * in_slow / 60 / channels) * w.num_samples * w.range_cell(1)
    )
    sigma_speed = np.sqrt(_loss(slow)[0] * noise * in_fast / channels) * 60 * w.velocity_cell(1)
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / [sigma_range, sigma_speed]
    return float(np.abs(ratio**2 - 1).max() / np.sqrt(2 / count))


@case(
    "Cramer-Rao bound of direction cosines on the elements",
    "4.5 sigma",
    ONCE_IN_1E5 + "; 400 draws",
)
def scatter_of_directions() -> Errors:
    """Direction cosines along both axes, one-way and two-way, scatter as the bound says, without
    bias."""
    w, rng, count, noise = Waveform(), np.random.default_rng(14), 400, 0.02
    schedule = conventional_schedule(w.num_groups, w.num_chirps, w.num_tx)
    scale = (
        2
        * np.pi
        * (77e9 + w.slope * (w.chirp_duration - w.sampled_duration / 2 * (1 + 17 / 1024)))
        / C
    )
    u, sent = np.array([0.271, -0.37]), np.array([0.4, 0.1])
    for virtual in (True, False):
        tx, rx = FULL.tx_positions[:, [0, 2]], FULL.rx_positions[:, [0, 2]]
        paths = (tx @ (u if virtual else sent))[:, None] + rx @ u
        known = Known.unmodulated(w, schedule, FULL, 2 if virtual else 1)
        # an unknown phase of all channels, or of those of each transmit antenna
        place = (tx[:, None] + rx).reshape(-1, 2) if virtual else rx
        off = place - place.mean(axis=0)
        fisher = 2 * scale**2 / noise * (off.T @ off) * (1 if virtual else len(tx))
        drawn = rng.normal(size=(count, *paths.shape, 2)) @ np.array([1, 1j])
        channels = np.exp(-1j * scale * paths) + np.sqrt(noise / 2) * drawn
        errors = directions(channels, np.full(count, 1.0), known) - u
        sigma = np.sqrt(np.diag(np.linalg.inv(fisher)))
        ratio = np.mean(np.square(errors), axis=0) / sigma**2
        yield float(np.abs(ratio - 1).max() / np.sqrt(2 / count))
        yield float((np.abs(errors.mean(axis=0)) / sigma).max() * np.sqrt(count))


@case(
    "signal and noise of the accumulated map, measured",
    "0.6 dB",
    "scalloping of a path off the grid, up to 1.4 dB per axis at worst, here 0.2 and 0.1; the "
    "window is 1.7 % short",
)
def processing_gain() -> float:
    """The link budget's gain from a sample to a cell of the map, against a path and noise sent
    through the receiver."""
    w, schedule, _ = stage.frame(w=Waveform(num_samples=256))
    pilot, known = unmodulated(w), Known.unmodulated(w, schedule, FEW, 1)
    clean = stage.cube_of(w, schedule, pilot, [(40.1 * w.range_cell(1), 0.07, 1.0)])

    def level(cube: IFCube) -> np.ndarray:
        return accumulate(channel_maps(clean_spectrum(cube, known), known))

    measured = 10 * np.log10(level(clean).max() / level(_noise_cube(w, 3)).mean())
    claimed = link_budget(
        ("A", "P"), "", 1.0, (1.0, 1.0), w, FEW
    ).processing_gain_db - 5 * np.log10(9)
    return abs(float(measured - claimed))


# ---- clutter


@case("what stands still is a constant over each antenna's chirps", "1e-5 relative", "complex64")
def standing_clutter_is_removed() -> float:
    """The notch takes a standing path away and leaves a moving one, but for its own mean."""
    schedule = conventional_schedule(3, 60, 3)
    rng = np.random.default_rng(2)
    p = np.arange(60)
    still = np.stack(
        [rng.normal(size=(3, 3, 2)) @ np.array([1, 1j]) for _ in range(3)]
    )  # group, rx, tx
    moving = np.exp(2j * np.pi * 7.0 * p / 20)[
        None, None, None
    ]  # whole turns over an antenna's chirps: no mean
    chosen = np.take_along_axis(still, np.broadcast_to(schedule[:, None], (3, 3, 60)), axis=2)
    spectra = np.repeat((100 * chosen)[:, :, None] + moving, 4, axis=2).astype(np.complex64)
    remove_static(spectra, schedule, None)
    return float(np.abs(spectra - moving).max() / 100)


@case("mean power, and Rayleigh's law by Kolmogorov and Smirnov", "4.5 sigma", ONCE_IN_1E5)
def rayleigh_clutter() -> float:
    """Amplitudes of the paper's clutter are Rayleigh, on average 10 dB over the reference; 40 to 50
    cells about 20 to 30 m."""
    rng, clutter = np.random.default_rng(5), Clutter(model="rayleigh")
    draws = [rayleigh_cells(clutter, 0.25, rng) for _ in range(300)]
    power = np.abs(np.concatenate([a for _, a in draws])) ** 2 / 10
    counts = {len(r) for r, _ in draws}
    ranges = np.array([r.mean() for r, _ in draws])
    if min(counts) < 40 or max(counts) > 50 or ranges.min() < 19.8 or ranges.max() > 30.2:
        return np.inf
    law = stats.kstest(power, stats.expon.cdf).pvalue
    return float(
        max(abs(power.mean() - 1) * np.sqrt(power.size), stats.norm.isf(max(law, 1e-300) / 2))
    )
