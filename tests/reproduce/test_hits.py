"""Hit rates of figure 14: what counts as one, the same decisions as the receivers', and
verdicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube

from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.randomness import generator
from isac_rt.receive.active import receive_active
from isac_rt.receive.estimate import Estimate
from isac_rt.receive.omp import omp
from reproduce import fig14, hits
from reproduce.baselines import resolution
from reproduce.hits import (
    Setting,
    Target,
    count_hits,
    draw_target,
    make_cube,
    make_noise,
    one_atom_power,
    strongest,
)
from reproduce.montecarlo import Curve

LOUD = 20.0


@pytest.mark.parametrize(
    "case",
    [
        Setting(name="F", kind="FMCW", snr_db=(LOUD,), speed=0.3),
        Setting(name="L", kind="LoRadar", snr_db=(LOUD,), speed=0.3),
        Setting(name="A", kind="AT", snr_db=(LOUD,)),
        Setting(name="P", kind="PT", snr_db=(LOUD,), orders=(4,), samples=512),
        Setting(
            name="G", kind="PT", snr_db=(LOUD,), samples=512, fixed=True, speed=0.0, gated=True
        ),
    ],
    ids=lambda case: case.name,
)
def test_without_noise_every_frame_hits(case):
    """Planted bugs: the PT's range halved; the sign of the drawn velocity."""
    for index in range(2):
        for name, (events, total) in count_hits(case, 7, index).items():
            assert events[0] == (0 if "errors" in name else total), (name, index)


def test_a_hit_is_within_one_resolution_in_all_four():
    """The estimate stays and the truth moves by 0.9 and 1.1 resolutions (fractions of a cell on
    both sides of the limit).

    Planted bug: any of the four instead of all."""
    case = Setting(name="A", kind="AT", snr_db=(0.0,))
    w = case.waveform
    truth = np.array([37.3, 4.1, 0.31, -0.22])
    u = np.array([truth[2], 0.0, truth[3]])
    scale = 2 * np.pi * w.effective_carrier / SPEED_OF_LIGHT
    turn = np.exp(-1j * scale * ((ANTENNAS.tx_positions @ u)[:, None] + ANTENNAS.rx_positions @ u))
    estimate = Estimate(2 * truth[0] / SPEED_OF_LIGHT, 2 * truth[1] / SPEED_OF_LIGHT, turn)
    bound = resolution(w, ANTENNAS)
    for i in range(4):
        for share, expected in ((0.9, True), (-0.9, True), (1.1, False), (-1.1, False)):
            moved = truth + share * bound * (np.arange(4) == i)
            assert (
                hits.hit(
                    case, Target(moved, u[::2], 1.0, np.zeros(0), np.zeros(0)), estimate, ANTENNAS
                )
                == expected
            ), (i, share)


def test_echoes_are_those_of_the_equation():
    """The cube of a drawn target against the signal's equation; plane waves there, spherical ones
    here (0.03 rad at 23 m), and mixing conjugates a path's gain.

    Planted bug: one pass instead of two."""
    case = Setting(name="A", kind="AT", snr_db=(0.0,), samples=512)
    w, rng = case.waveform, np.random.default_rng(2)
    schedule = pseudo_random_schedule(1, 120, 3, rng)
    payload = random_payload(w, schedule, 8, rng)
    target = draw_target(case, rng)
    target.truth[0] = 23.41  # with any data within the IF filter's passband
    r, v, *u = target.truth
    ours = make_cube(case, target, schedule, payload).samples
    theirs = cube(
        w, schedule, payload, [Path(2 * r, 2 * v, np.conj(target.phase), tuple(u), tuple(u))]
    ).samples
    assert np.abs(ours - theirs).max() < 0.1 and np.sqrt((np.abs(ours - theirs) ** 2).mean()) < 0.03


def test_one_atom_is_omp_with_sparsity_one():
    """Planted bug: no shift of the Doppler axis."""
    case = Setting(name="A", kind="AT", snr_db=(0.0,), groups=2)
    w, rng = case.waveform, np.random.default_rng(6)
    schedule = pseudo_random_schedule(2, 120, 3, rng)
    spectra = (rng.standard_normal((2, 4, 5, 120, 2)) @ [1, 1j]).astype(np.complex64)
    power = np.zeros((5, 120))
    for group, sent_by in zip(spectra, schedule, strict=True):
        for antenna in range(3):
            chosen = np.flatnonzero(sent_by == antenna)
            found = omp(group[:, :, chosen].reshape(-1, chosen.size), chosen, 120, 1)
            power += (np.abs(found) ** 2).reshape(4, 5, 120).sum(axis=0)
    ours = one_atom_power(spectra, w, schedule)
    assert ours / (2 * 3 * 4) == pytest.approx(
        np.fft.fftshift(power, axes=-1) / (2 * 3 * 4), rel=1e-4, abs=1e-3
    )


def test_maps_at_a_level_are_those_of_the_mixed_samples():
    """One map from signal and noise apart, and of both together. Planted bugs: the cross term
    halved; the level squared for the noise."""
    case = Setting(name="A", kind="AT", snr_db=(-30.0,), samples=512)
    w, rng, level = case.waveform, np.random.default_rng(5), 0.7
    schedule = pseudo_random_schedule(1, 120, 3, rng)
    signal, white = (
        (rng.standard_normal((1, 4, 6, 120, 2)) @ [1, 1j]).astype(np.complex64) for _ in range(2)
    )
    mixed = signal + np.float32(level) * white
    sums = hits._Sums(*(hits.correlations(s, w, schedule) for s in (signal, white)))
    assert sums.power(level) == pytest.approx(
        one_atom_power(mixed, w, schedule), rel=1e-4, abs=1e-3
    )  # float32, 40 terms
    maps = [
        (rng.standard_normal((3, 4, 6, 120, 2)) @ [1, 1j]).astype(np.complex64) for _ in range(2)
    ]
    expected = np.fft.fftshift((np.abs(maps[0] + level * maps[1]) ** 2).mean(axis=(0, 1)), axes=-1)
    assert hits._Parts(*maps).power(level) == pytest.approx(expected, rel=1e-4, abs=1e-3)


def test_spectra_without_a_window_hold_all_samples():
    """A tone on a cell, with data: N in its cell and nothing beside it. Planted bug: the turn of
    the cross term left out."""
    case = Setting(name="A", kind="AT", snr_db=(0.0,), samples=512)
    w, rng = case.waveform, np.random.default_rng(9)
    schedule = pseudo_random_schedule(1, 120, 3, rng)
    payload = random_payload(w, schedule, 8, rng)
    path = cube(
        w, schedule, payload, [Path(31 * w.range_cell(1), 0.0, 1.0, (0.0, 0.0), (0.0, 0.0))]
    )
    found = hits.plain_spectrum(path, payload)[0, 0]
    away = np.abs(np.arange(len(found)) - 31) > 1
    # the data's own time shift detunes the tone by up to 17 samples of a cell's turn: what is left
    # beside it is under 5 %
    assert np.abs(np.abs(found[31]) - 512).max() < 1 and np.abs(found[away]).max() < 0.05 * 512
    turns = np.angle(found[31] * found[31, 0].conj())
    assert np.abs(turns).max() < 0.02


def test_strongest_cell_and_its_gate():
    power = np.zeros((20, 12))
    power[[1, 9, 11], [3, 11, 5]] = [9.0, 7.0, 8.0]
    assert strongest(power, 2) == (11, 5) and strongest(power, 0) == (1, 3)
    assert strongest(power, 2, near=(10, 0)) == (9, 11)  # the Doppler axis wraps


def test_detected_hits_are_the_receivers():
    """The same samples through `receive_active`: where a united hit is detected here there is a
    detection within one resolution, and nowhere else. Planted bug: the CFAR's threshold for one
    channel."""
    case = Setting(name="A", kind="AT", snr_db=(-47.0, -40.0), groups=3)
    w, antennas = case.waveform, hits.paper_antennas(case.waveform)
    for index in (0, 1):
        counted = count_hits(case, 4, index)["hits, united, detected"][0]
        rng = generator(4, "hits", case.name, index)
        target = draw_target(case, rng)
        schedule = pseudo_random_schedule(3, 120, 3, rng)
        payload = random_payload(w, schedule, 8, rng)
        clean, white = make_cube(case, target, schedule, payload), make_noise(case, 4, index)
        for k, level in enumerate(hits.levels(case)):
            got = replace(clean, samples=clean.samples + np.float32(level) * white)
            d = receive_active(got, payload, antennas, hits.SETTINGS).detections
            errors = np.abs(np.column_stack([d.range, d.velocity, d.direction]) - target.truth)
            assert bool((errors < resolution(w, antennas)).all(axis=1).any()) == bool(counted[k])


def made_up(at, rising=True):
    """A hit rate that passes 0.5 at `at` dB, in 40 frames."""
    snr = np.arange(-56.0, -17.0)
    rate = 1 / (1 + np.exp(-1.5 * (snr - at) * (1 if rising else -1)))
    return Curve("x", snr, (np.arange(40)[:, None] < np.round(40 * rate)).astype(int), 1)


def test_fig14_verdicts_from_made_up_curves():
    """Planted bugs: the difference to FMCW the wrong way round; LoRadar judged by the better of its
    two ways."""
    curves = {f"PT: D = {d}": made_up(-29) for d in (2, 4, 8, 16)}
    curves |= {
        "PT: D = 8, delay errors": made_up(-30, False),
        "PT, known: data known": made_up(-41),
        "FMCW: hits": made_up(-44),
    }
    curves["AT, M = 1: hits, no window"] = made_up(-43)
    curves |= {
        "AT, M = 1: hits": made_up(-42),
        "AT, M = 3: hits, united": made_up(-46),
        "PT, T = 25.6 us: D = 8": made_up(-26),
    }
    curves |= {
        "LoRadar: ordered": made_up(-44),
        "LoRadar: phase": made_up(-40),
        "FMCW, full velocity range: hits": made_up(-30),
    }
    curves |= {f"AT, M = 1, clutter, {how}: hits": made_up(-34) for how in ("moving", "at rest")}
    curves |= {
        f"PT, {how}: D = 8": made_up(-30)
        for how in ("at rest", "clutter, filtered", "clutter, profile known")
    }
    judged = [v.verdict for v in fig14._verdicts(curves)]
    assert judged == [
        "holds",
        "holds",
        "holds",
        "holds",
        "holds under a condition",
        "holds under a condition",
        "holds",
    ]
    curves |= {
        "AT, M = 3: hits, united": made_up(-41),
        "LoRadar: ordered": made_up(-38),
        "PT: D = 16": made_up(-26),
    }
    curves["PT, clutter, filtered: D = 8"] = made_up(0)
    judged = [v.verdict for v in fig14._verdicts(curves)]
    assert judged == [
        "holds",
        "does not hold",
        "holds",
        "holds under a condition",
        "holds",
        "holds",
        "holds",
    ]


@pytest.mark.slow
def test_quick_size():
    made = fig14.run(True, 2, lambda done, total: None)
    assert [v.verdict for v in made.verdicts][-1] == "holds" and made.figure is not None
    assert made.tables["fig14"].rate.between(0, 1).all()
