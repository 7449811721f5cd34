"""The Monte-Carlo of the figures: theory against simulation, intervals, sample sizes, kept frames,
and the receiver's own decisions."""

from __future__ import annotations

from dataclasses import replace
from math import comb, exp, factorial

import numpy as np
import pandas as pd
import pytest

from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import MODULATION_ORDERS, running_phases
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.receive.clutter_filter import chirp_runs
from isac_rt.receive.symbols import demodulate
from isac_rt.receive.types import Prediction
from isac_rt.results.metrics import binomial_interval
from reproduce import fig8, fig11, fig12, montecarlo
from reproduce.montecarlo import (
    Curve,
    Precision,
    Steps,
    crossing,
    delay_error_rate,
    dpsk_error_rate,
    interval,
    kept_in,
    sample,
)
from reproduce.symbols import (
    Setting,
    cell_noise,
    count_errors,
    draw_frame,
    link_waveform,
    make_cells,
)


def silent(done, total):
    assert 0 <= done <= total


def decibel(x):
    return 10 * np.log10(x)


def test_delay_errors_of_one_branch_are_the_alternating_sum():
    """Noncoherent orthogonal signalling: sum_k (-1)^(k+1) C(M-1, k) exp(-k g/(k+1)) / (k+1).

    Planted bug: non-centrality N snr instead of 2 N snr."""
    for g in (0.7, 3.1, 9.3):
        by_hand = sum(
            (-1) ** (k + 1) * comb(6, k) / (k + 1) * exp(-k * g / (k + 1)) for k in range(1, 7)
        )
        assert delay_error_rate([decibel(g / 23)], 23, 7, 1)[0] == pytest.approx(
            by_hand, rel=1e-5, abs=0
        )


def test_delay_errors_with_many_branches_are_those_of_drawn_powers():
    """15 branches, 520 cells: exponentials added up, without chi-squares. Planted bug: one degree
    of freedom a branch instead of two."""
    rng, count, branches, g = np.random.default_rng(8), 3000, 15, 1024 * 10**-3.0
    wrong = 0
    for _ in range(count // 100):
        noise = rng.gamma(branches, 1.0, (100, 519)).max(axis=1)
        sent = np.sqrt(g) + (rng.standard_normal((100, branches, 2)) @ [1, 1j]) / np.sqrt(2)
        wrong += int((noise > (np.abs(sent) ** 2).sum(axis=1)).sum())
    p = delay_error_rate([-30.0], 1024, 520, branches)[0]
    assert abs(wrong / count - p) < 4 * np.sqrt(p * (1 - p) / count)  # 4 sigma


def test_binary_dpsk_is_proakis():
    """1/2 exp(-g) for one branch; with L of them 2^(1-2L) e^(-Lg) sum_k (Lg)^k/k! sum_n C(2L-1, n).

    Planted bug: the integral up to pi/4 alone."""
    for branches in (1, 5):
        for g in (0.3, 1.1):
            by_hand = (
                2.0 ** (1 - 2 * branches)
                * exp(-branches * g)
                * sum(
                    (branches * g) ** k
                    / factorial(k)
                    * sum(comb(2 * branches - 1, n) for n in range(branches - k))
                    for k in range(branches)
                )
            )
            assert dpsk_error_rate([decibel(g / 7)], 7, 2, branches)[0] == pytest.approx(
                by_hand, rel=1e-8, abs=0
            )


@pytest.mark.parametrize(
    ("order", "branches", "g"), [(4, 3, 0.7), (8, 15, 2.6), (16, 15, 4.0), (16, 2, 0.05)]
)
def test_dpsk_of_all_orders_is_that_of_drawn_samples(order, branches, g):
    """Planted bug: sin(n pi/D) without n."""
    rng, count = np.random.default_rng(order), 40_000
    x, before = np.sqrt(g) + (rng.standard_normal((2, count, branches, 2)) @ [1, 1j]) / np.sqrt(2)
    wrong = (np.abs(np.angle((x * before.conj()).sum(axis=1))) > np.pi / order).mean()
    p = dpsk_error_rate([decibel(g / 1024)], 1024, order, branches)[0]
    assert abs(wrong - p) < 4 * np.sqrt(p * (1 - p) / count)  # 4 sigma


def test_interval_of_like_frames_is_binomial_and_of_unlike_ones_wider():
    """Frames whose rates are drawn from a beta law: 95 % intervals must hold the mean about 19
    times in 20; those of the plain law hold it far less often. Planted bug: the variance of one
    frame instead of their mean's."""
    alike = np.full(20, 6)
    assert interval(alike, 12) == binomial_interval(120, 240)
    assert interval(np.zeros(9, int), 12) == binomial_interval(0, 108)
    rng, held, plain, repeats = np.random.default_rng(4), 0, 0, 400
    for _ in range(repeats):
        events = rng.binomial(117, rng.beta(2.0, 3.0, 25))
        held += interval(events, 117)[0] <= 0.4 <= interval(events, 117)[1]
        low, high = binomial_interval(int(events.sum()), 25 * 117)
        plain += low <= 0.4 <= high
    assert held / repeats > 0.95 - 4 * np.sqrt(0.05 * 0.95 / repeats) and plain / repeats < 0.6
    assert held < repeats - 3


def test_crossing_is_linear_in_the_logit():
    snr = np.array([-3.0, -1.0, 1.0])

    def logit(p):
        return np.log(p / (1 - p))

    p = 1 / (1 + np.exp(0.7 * snr + 0.2))
    assert crossing(snr, p * 1e9, 10**9, 0.31) == pytest.approx(
        (-logit(0.31) - 0.2) / 0.7, rel=1e-9
    )
    assert np.isnan(crossing(snr, np.array([9, 9, 9]), 10, 0.5))


SNR = np.array([-3.0, 0.0, 2.0])


class Trials:
    """Counts by number and how often each was asked for."""

    def __init__(self):
        self.asked = []

    def __call__(self, number):
        self.asked.append(number)
        return {
            "a": (np.random.default_rng(number).binomial(50, [0.5, 0.1, 0.0]), 50),
            "b": (np.array([1, 2, 3]), 7),
        }


def test_samples_grow_until_the_intervals_are_small():
    """Planted bug: only the first curve is looked at."""
    trial = Trials()
    loose = sample(trial, SNR, Precision(400, absolute=0.08), silent, key="k", prefix="p: ")
    tight = sample(Trials(), SNR, Precision(400, absolute=0.04), silent, key="k")
    frames = len(loose["a"].events)
    assert montecarlo.FEWEST <= frames < len(tight["a"].events) < 400 and sorted(
        trial.asked
    ) == list(range(frames))
    t = loose["a"].table()
    assert (
        ((t.high - t.low) / 2 <= np.maximum(0.1 * t.rate, 0.08)).all()
        and (t.frames == frames).all()
        and t.curve[0] == "p: a"
    )
    assert len(sample(Trials(), SNR, Precision(6), silent, key="k")["b"].events) == 6
    assert np.array_equal(tight["a"].events[:frames], loose["a"].events)
    assert loose["a"].text(2.1).endswith(f"(0 of {50 * frames})")


def test_kept_frames_are_not_run_again(tmp_path):
    """What was interrupted goes on, with the same result as in one go. Planted bug: `now` ignored
    at the end."""
    whole = sample(Trials(), SNR, Precision(12, absolute=0), silent, key="k")
    with kept_in(tmp_path / "x"):
        sample(Trials(), SNR, Precision(5, absolute=0), silent, key="k")
        again = Trials()
        found = sample(again, SNR, Precision(12, absolute=0), silent, key="k")
        assert sorted(again.asked) == list(range(5, 12))
        assert {n: c.events.tolist() for n, c in found.items()} == {
            n: c.events.tolist() for n, c in whole.items()
        }
        other = Trials()
        sample(other, SNR, Precision(5, absolute=0), silent, key="another seed")
        assert sorted(other.asked) == list(range(5))
    assert [f.suffix for f in (tmp_path / "x").iterdir()] == [".frames"] * 2


def test_steps_of_a_run_that_stops_early_are_filled_up():
    seen = []
    steps = Steps(lambda done, total: seen.append((done, total)), 9)
    steps.part(5)(2, 5)
    steps.part(4)(1, 4)
    assert seen == [(0, 9), (2, 9), (5, 9), (6, 9)]


@pytest.mark.parametrize(
    "link",
    [
        Setting(name="plain", waveform=link_waveform(512), orders=(4,)),
        Setting(
            name="filtered", waveform=link_waveform(512), orders=(4,), clutter=True, run_cells=15
        ),
        Setting(
            name="profile", waveform=link_waveform(512), orders=(4,), clutter=True, profile=True
        ),
    ],
    ids=lambda link: link.name,
)
def test_errors_are_those_of_the_receiver(link):
    """The same samples, noise and all, through `demodulate`. Planted bug: the noise's cross term
    without its factor 2."""
    w, snr = (
        link.waveform,
        np.array([-27.0, -24.5, -21.0]) - (20 if link.profile else 0),
    )  # 45 cells of 10 dB each add up
    counted = count_errors(link, snr, 5, 2)
    frame, noise = draw_frame(link, 5, 2), cell_noise(link, 5, 2)
    beats = w.beat_cells(frame.lengths[0] / SPEED_OF_LIGHT, frame.rate / SPEED_OF_LIGHT)[0]
    turn = np.exp(2j * np.pi * beats[:, None] * np.arange(w.num_samples) / w.num_samples)
    still = np.zeros(frame.lengths.size)
    expected = Prediction(
        range=frame.lengths,
        velocity=still + frame.rate,
        direction=np.zeros((still.size, 2)),
        range_std=still,
        velocity_std=still,
        weight=frame.weights,
    )
    for i, level in enumerate(10 ** (-snr / 20)):
        samples = frame.samples + level * np.fft.ifft(noise, axis=-1) * turn
        sent = samples * running_phases(frame.transitions[4], frame.schedule, 4)[0][:, None]
        cube = IFCube(
            samples=sent[None].astype(np.complex64),
            waveform=w,
            schedule=frame.schedule,
            start_time=0.0,
        )
        found = demodulate(cube, expected, 4, link.run_cells)
        # float32 here and there: one of 120 may be decided the other way
        assert abs((found.delay != frame.delay_symbols).sum() - counted["delay"][0][i]) <= 1
        assert abs((found.transitions != frame.transitions[4]).sum() - counted["dpsk 4"][0][i]) <= 2
    assert (
        counted["delay"][0][0] > 20 and counted["delay"][1] == 120 and counted["dpsk 4"][1] == 117
    )


def test_the_filter_finds_the_receivers_runs():
    """Cells left out, against `chirp_runs` on the samples. Planted bug: half of Hann's
    neighbours."""
    link = Setting(name="filtered", waveform=link_waveform(512), clutter=True, run_cells=15)
    size, frame, noise, level = 512, draw_frame(link, 5, 2), cell_noise(link, 5, 2), 10 ** (24 / 20)
    beats = np.full(120, 20.3)
    turn = np.exp(-2j * np.pi * beats[:, None] * np.arange(size) / size)
    samples = (frame.samples + level * np.fft.ifft(noise, axis=-1) * turn.conj()).astype(
        np.complex64
    )
    inside = chirp_runs(samples, turn.astype(np.complex64), 15)
    left_out = make_cells(frame.samples, beats, noise, window=True).power(level, 15) == 0
    # float32 may move a cell over the threshold at a run's end
    assert (inside != left_out).mean() < 1e-3 < 0.03 < inside.mean()


def test_errors_without_a_prediction_error_are_the_theorys():
    """Ten frames at four SNRs: 4 sigma. Planted bug: noise of variance N/2 in a cell."""
    link = Setting(name="theory", waveform=link_waveform(1024), orders=(4,), exact_prediction=True)
    snr = np.array([-34.0, -31.0, -29.0, -27.0])
    found = [count_errors(link, snr, 3, i) for i in range(10)]
    for name, p in (
        ("delay", delay_error_rate(snr, 1024, 520, 15)),
        ("dpsk 4 known delay", dpsk_error_rate(snr, 1024, 4, 15)),
    ):
        total = 10 * found[0][name][1]
        rate = sum(f[name][0] for f in found) / total
        # neighbouring transitions share a chirp: up to twice the variance
        assert np.all(np.abs(rate - p) < 4 * np.sqrt(2 * p * (1 - p) / total) + 1 / total), (
            name,
            rate,
            p,
        )


def curve(name, rates, trials=4000, frames=10):
    snr = np.linspace(-36, -18, len(rates))
    return Curve(
        name,
        snr,
        np.round(np.outer(np.ones(frames), rates) * trials / frames).astype(int),
        trials // frames,
    )


def falling(at, floor=0.0):
    """A rate that passes 0.5 at `at` dB."""
    snr = np.linspace(-36, -18, 19)
    return floor + (1 - floor) / (1 + np.exp(2 * (snr - at)))


def test_fig12_verdicts_from_made_up_curves():
    """Planted bug: later taken as short minus long the other way round."""
    curves = {f"D = {d}": curve(f"D = {d}", falling(-30)) for d in MODULATION_ORDERS}
    curves |= {"T = 25.6 us": curve("s", falling(-27)), "clutter": curve("c", falling(-30, 0.99))}
    curves |= {"random fraction": curve("r", falling(-30))}
    curves |= {
        "clutter, filtered": curve("f", falling(-30, 0.4)),
        "clutter, profile known": curve("k", falling(-34)),
    }
    curves["random fraction, floor"] = curve("l", falling(-30, 0.5))
    judged = fig12._verdicts(curves)
    assert [v.verdict for v in judged] == [
        "holds",
        "holds",
        "holds under a condition",
        "does not hold",
    ]
    assert "3.00 dB" in judged[1].finding
    curves["D = 16"] = curve("D = 16", falling(-29.5))
    curves["T = 25.6 us"] = curves["D = 8"]
    assert [v.verdict for v in fig12._verdicts(curves)][:2] == ["does not hold", "does not hold"]


def test_fig11_verdicts_from_made_up_curves():
    curves = {
        f"T = 51.2 us: {d}": curve(str(d), falling(at))
        for d, at in zip(MODULATION_ORDERS, (-29, -28, -27, -22), strict=True)
    }
    curves |= {
        "T = 25.6 us: 8": curve("s", falling(-24)),
        "mmWave-LoRadar": curve("l", falling(-24)),
    }
    curves |= {
        f"clutter{kind}: 8": curve("c", falling(-26))
        for kind in ("", ", filtered", ", profile known")
    }
    curves["letter: 8 literal"] = curve("x", falling(0))
    judged = [v.verdict for v in fig11._verdicts(curves)]
    assert judged == [
        "holds",
        "holds",
        "holds",
        "holds",
        "holds under a condition",
        "holds",
        "does not hold",
    ]


def test_fig8_counts_are_of_velocities_within_a_bin():
    """With no noise to speak of both find every velocity in the FFT's range; over the whole range
    the FFT finds the third that does not fold. Planted bug: no folding (bins taken modulo 40)."""
    near, wide = (replace(fig8.CASES[i]) for i in (0, 2))
    found = fig8.hits(near, 1, 0)
    assert found["OMP"][0][-1] == found["FFT"][0][-1] == found["OMP"][1] == fig8.VECTORS
    shares = [fig8.hits(wide, 1, i)["FFT"][0][-1] for i in range(8)]
    assert abs(np.mean(shares) / fig8.VECTORS - 1 / 3) < 4 * np.sqrt(2 / 9 / (8 * fig8.VECTORS))


@pytest.mark.slow
def test_fig8_at_quick_size():
    made = fig8.run(True, 2, silent)
    assert [v.verdict for v in made.verdicts] == ["does not hold", "holds"]
    table = made.tables["fig8"]
    assert (
        set(table.columns) >= {"curve", "snr_db", "rate", "low", "high", "events", "trials"}
        and made.figure is not None
    )
    assert (table.low <= table.rate).all() and (table.rate <= table.high).all()


@pytest.mark.slow
@pytest.mark.parametrize("module", [fig11, fig12])
def test_quick_size(module):
    made = module.run(True, 2, silent)
    judged = [v.verdict for v in made.verdicts]
    assert judged.count("holds") >= 2 and judged[-1] == "does not hold"
    assert isinstance(next(iter(made.tables.values())), pd.DataFrame)
