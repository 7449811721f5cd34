"""Claims on compressed sensing: coherence and isometry of the sampled DFT, OMP's recovery against
sparsity, scenes that are not sparse."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from isac_rt.frame.schedule import conventional_schedule, pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.randomness import generator
from isac_rt.receive.known import Known
from isac_rt.receive.omp import omp, sparse_enough
from isac_rt.results.metrics import binomial_interval
from reproduce import onepath
from reproduce.outcome import Progress, Sentences, Verdict, proportion, table

CHIRPS, ANTENNAS = 120, 3
SPARSITIES = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20)
SCHEDULES = 20
"""Schedules over which the vectors of one sparsity are spread."""
LEVELS = {"equal": 0.0, "spread over 20 dB": 20.0}


say = Sentences("""
latin: In every cycle the antennas over blocks and slots form a Latin matrix
  cycles that do, L_tx = 1 to 8, M = 1 to L_tx: {share}; the stricter order costs a group nothing:
  its median coherence is {three:.3f} in Fig. 5(d) and {one:.3f} in (b), 200 schedules each

fallback: In scenes that are not sparse one switches to Fig. 5(c)
  the paper gives no rule; here the receiver of sparse samples asks whether as many atoms as it
  recovers dependably explain two thirds of what is above the noise. Frames called sparse by paths
  in a range cell: {text}. With all M = L_tx groups at hand no switch is needed (the union)

price: CS trades computation for an unambiguous velocity L_tx times as large
  the price is sparsity as well: six equal tones in a range cell, recovered from P/L_tx of {chirps}
  chirps: {text}

rip: The sampled DFT satisfies the RIP with very high probability, so that OMP converges
  of {count} random schedules the coherence is {median:.3f} (95 % within {low:.3f} to {high:.3f};
  Welch's bound {bound:.3f}, round robin {plain:.0f}): recovery is certain for {certain} tones at
  most; isometry constants below 1/3 up to sparsity {small}. For supports at random OMP is
  dependable (95 %) up to {limits} tones in a range cell

dense: Where the scene is not sparse reconstruction fails
  of 40 chirps, tones of equal strength: 4 tones {few}, 20 tones {many}

union: The conventional scheme of Fig. 5(c) needs no sparsity
  by the union of its groups, whose plain DFT has 60 tones to {rest:.1g} RMS; but so has the union
  of the pseudo-random groups of Fig. 5(d). Group by group (c) takes any number of tones, and is
  ambiguous beyond 1/3 of the velocity (Fig. 5)
""")


def slots(random: bool, rng: np.random.Generator, num_tx: int = ANTENNAS) -> np.ndarray:
    """Slots (P/L_tx,) of antenna 0 in one group."""
    shape = (1, CHIRPS, num_tx)
    chosen = pseudo_random_schedule(*shape, rng) if random else conventional_schedule(*shape)
    return np.flatnonzero(chosen[0] == 0)


def coherence(chosen: np.ndarray, num_chirps: int = CHIRPS) -> float:
    """Largest correlation between two different columns of the row-sampled DFT matrix, all of unit
    norm."""
    mask = np.zeros(num_chirps)
    mask[chosen] = 1
    return float(np.abs(np.fft.fft(mask))[1:].max() / chosen.size)


def isometry(chosen: np.ndarray, sparsity: int, supports: int, rng: np.random.Generator) -> float:
    """A lower bound of the restricted isometry constant: the worst of some random supports."""
    atoms = np.exp(2j * np.pi * np.outer(chosen, np.arange(CHIRPS)) / CHIRPS) / np.sqrt(chosen.size)
    gram = atoms.conj().T @ atoms
    worst = 0.0
    for _ in range(supports):
        which = rng.choice(CHIRPS, sparsity, replace=False)
        values = np.linalg.eigvalsh(gram[np.ix_(which, which)])
        worst = max(worst, values[-1] - 1, 1 - values[0])
    return worst


def vectors(
    chosen: np.ndarray,
    sparsity: int,
    count: int,
    spread_db: float,
    off_grid: bool,
    rng: np.random.Generator,
):
    """Slow-time vectors (count, S) of `sparsity` Doppler tones without noise, their bins (count,
    sparsity) and amplitudes.

    Bins are distinct; off the grid each tone is moved by up to half a bin. Amplitudes have random
    phases and levels uniform over `spread_db`.
    """
    bins = np.argsort(rng.random((count, CHIRPS)), axis=1)[:, :sparsity]
    level = 10 ** (-spread_db * rng.random((count, sparsity)) / 20)
    amplitude = level * np.exp(2j * np.pi * rng.random((count, sparsity)))
    moved = bins + (rng.uniform(-0.5, 0.5, bins.shape) if off_grid else 0.0)
    tones = np.exp(2j * np.pi * moved[..., None] * chosen / CHIRPS)
    return np.einsum("vk,vks->vs", amplitude, tones), bins, amplitude


def recovered(
    sparsity: int, trials: int, spread_db: float, off_grid: bool, seed: int, num_tx: int = ANTENNAS
) -> int:
    """Vectors whose support OMP, told the sparsity, finds: exactly on the grid; off it each tone
    within a bin."""
    rng = generator(seed, "claims", "omp", sparsity, int(spread_db), int(off_grid), num_tx)
    good = 0
    for part in np.array_split(np.arange(trials), SCHEDULES):
        chosen = slots(True, rng, num_tx)
        data, bins, _ = vectors(chosen, sparsity, part.size, spread_db, off_grid, rng)
        found = omp(data, chosen, CHIRPS, sparsity) != 0
        if off_grid:
            found = found | np.roll(found, 1, axis=1) | np.roll(found, -1, axis=1)
        good += int(np.take_along_axis(found, bins, axis=1).all(axis=1).sum())
    return good


def latin(quick: bool, seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Whether schedules keep the Latin constraint for any L_tx and M, and whether it costs
    randomness."""
    draws, rows = 20 if quick else 100, []
    for num_tx in range(1, 9):
        rng = generator(seed, "claims", "latin", num_tx)
        for groups in range(1, num_tx + 1):
            many = [
                pseudo_random_schedule(groups, 12 * num_tx, num_tx, rng).reshape(groups, 12, num_tx)
                for _ in range(draws)
            ]
            cycles = np.concatenate([s.transpose(1, 0, 2) for s in many])
            in_group = (np.sort(cycles, axis=2) == np.arange(num_tx)).all(axis=(1, 2))
            in_slot = (np.diff(np.sort(cycles, axis=1), axis=1) > 0).all(axis=(1, 2))
            latin_cycles = int((in_group & in_slot).sum())
            rows.append((num_tx, groups, len(cycles), latin_cycles))
    found = table("L_tx M cycles latin", rows)
    good, total = int(found.latin.sum()), int(found.cycles.sum())
    rng = generator(seed, "claims", "latin", "coherence")

    def last(groups: int) -> np.ndarray:
        schedule = pseudo_random_schedule(groups, CHIRPS, ANTENNAS, rng)
        return np.flatnonzero(schedule[groups - 1] == 0)

    one, three = (np.median([coherence(last(m)) for _ in range(200)]) for m in (1, 3))
    share = proportion(good, total)
    return found, (say("latin", good == total, share=share, one=one, three=three),)


def judged_sparse(tones: int, frames: int, seed: int) -> int:
    """Frames that the receiver's rule calls sparse when each of 8 occupied range rows holds so many
    equal paths off the Doppler grid.

    One group, 4 receive antennas, each path 20 dB over the noise of a chirp, directions at random.
    """
    w, rng, count = Waveform(num_groups=1), generator(seed, "claims", "fallback", tones), 0
    rows, receivers, noise, slot = 8, 4, 0.01, np.arange(CHIRPS)
    for _ in range(frames):
        schedule = pseudo_random_schedule(1, CHIRPS, ANTENNAS, rng)
        known = Known.unmodulated(w, schedule, onepath.antennas(w, receivers), 2)
        tone = np.exp(2j * np.pi * rng.uniform(0, CHIRPS, (rows, tones, 1)) * slot / CHIRPS)
        sent = np.exp(2j * np.pi * rng.random((rows, tones, ANTENNAS)))[..., schedule[0]]
        heard = np.exp(2j * np.pi * rng.random((receivers, rows, tones)))
        spectra = np.einsum("lrk,rkp->lrp", heard, tone * sent)
        spectra += (
            np.sqrt(noise / 2)
            * rng.standard_normal((*spectra.shape, 2)).view(np.complex128)[..., 0]
        )
        count += int(sparse_enough(spectra[None], np.arange(rows), noise, known))
    return count


FALLBACK_TONES = (1, 2, 3, 4, 6, 8, 12, 16)


def fallback(quick: bool, seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """How the receiver's rule for falling back to the conventional schedule decides."""
    frames = 25 if quick else 100
    rows = [(k, judged_sparse(k, frames, seed), frames) for k in FALLBACK_TONES]
    ends = rows[0][1] == frames and rows[-1][1] == 0
    text = ", ".join(f"{k}: {proportion(found, of)}" for k, found, of in rows)
    verdict = say("fallback", False, ends, text=text)
    return table("tones called_sparse frames", rows), (verdict,)


def united_error(sparsity: int, trials: int, seed: int) -> float:
    """RMS amplitude error, relative, of the plain DFT over the three groups' union, scheme (c) or
    (d): every slot is sampled."""
    rng = generator(seed, "claims", "union", sparsity)
    data, bins, amplitude = vectors(np.arange(CHIRPS), sparsity, trials, 0.0, False, rng)
    found = np.take_along_axis(np.fft.fft(data, axis=1) / CHIRPS, bins, axis=1)
    return float(np.sqrt(np.mean(np.abs(found - amplitude) ** 2)))


def recovery(
    quick: bool, seed: int, report: Progress
) -> tuple[dict[str, pd.DataFrame], tuple[Verdict, ...]]:
    """Coherence, isometry and recovery."""
    schedules, trials = (200, 400) if quick else (1000, 2000)
    rng = generator(seed, "claims", "coherence")
    samples = [slots(True, rng) for _ in range(schedules)]
    mu = np.array([coherence(s) for s in samples])
    plain = coherence(slots(False, rng))
    supports, few = 100 if quick else 300, [k for k in SPARSITIES if k <= 12]
    worst = [(k, max(isometry(s, k, supports, rng) for s in samples[:10])) for k in few]
    delta = table("sparsity isometry_at_least", worst)
    cases = [(name, db, False) for name, db in LEVELS.items()]
    cases += [("equal, off the grid", 0.0, True)]
    rows = []
    for name, spread, off in cases:
        for k in SPARSITIES:
            good = recovered(k, trials, spread, off, seed)
            rows.append((name, k, good, trials, good / trials, *binomial_interval(good, trials)))
            report(len(rows), len(cases) * len(SPARSITIES))
    found = table("levels sparsity recovered trials share low high", rows)
    tables = {
        "recovery": found,
        "coherence": pd.DataFrame({"schedule": np.arange(schedules), "coherence": mu}),
        "isometry": delta,
    }
    return tables, _verdicts(mu, plain, delta, found, seed)


def against_coherence(quick: bool, seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Recovery of six equal tones as ever fewer chirps are an antenna's own: coherence rises with
    L_tx."""
    schedules, trials = (50, 400) if quick else (200, 2000)
    rows = []
    for num_tx in (2, 3, 4, 5, 6):
        rng = generator(seed, "claims", "coherence", num_tx)
        mu = [coherence(slots(True, rng, num_tx)) for _ in range(schedules)]
        good = recovered(6, trials, 0.0, False, seed, num_tx)
        rows.append((num_tx, CHIRPS // num_tx, np.median(mu), good, trials))
    found = table("L_tx chirps coherence recovered trials", rows)
    rises = bool((found.coherence.diff().dropna() > 0).all())
    falls = rises and rows[-1][3] < rows[0][3]
    text = "; ".join(
        f"L_tx = {n}: coherence {mu:.2f}, {proportion(good, of)}" for n, _, mu, good, of in rows
    )
    return found, (say("price", not falls, True, chirps=CHIRPS, text=text),)


def dependable(found: pd.DataFrame, levels: str, share: float = 0.95) -> int:
    """Largest sparsity up to which the lower end of every interval is at least `share`; 0 if there
    is none."""
    part = found[found.levels == levels].sort_values("sparsity")
    good = np.append(part.low >= share, False)
    return 0 if not good[0] else int(part.sparsity.iloc[int(np.argmin(good)) - 1])


def _verdicts(
    mu: np.ndarray, plain: float, delta: pd.DataFrame, found: pd.DataFrame, seed: int
) -> tuple[Verdict, ...]:
    few = delta[delta.isometry_at_least < 1 / 3].sparsity
    equal = found[found.levels == "equal"].set_index("sparsity")
    texts = [proportion(int(equal.recovered[k]), int(equal.trials[k])) for k in (4, 20)]
    limits = (f"{dependable(found, name)} ({name})" for name in found.levels.unique())
    return (
        say(
            "rip",
            False,
            True,
            count=mu.size,
            median=np.median(mu),
            low=np.quantile(mu, 0.025),
            high=np.quantile(mu, 0.975),
            bound=np.sqrt((CHIRPS - CHIRPS / ANTENNAS) / (CHIRPS / ANTENNAS * (CHIRPS - 1))),
            plain=plain,
            certain=int((1 / np.median(mu) + 1) / 2),
            small=few.max() if few.size else 0,
            limits=", ".join(limits),
        ),
        say("dense", equal.high[20] < 0.05, few=texts[0], many=texts[1]),
        say("union", False, True, rest=united_error(60, 200, seed)),
    )


def draw(ax: Axes, found: pd.DataFrame) -> None:
    """Share of recovered vectors against sparsity."""
    for mark, (name, part) in zip("osD", found.groupby("levels", sort=False), strict=True):
        error = np.abs(part[["low", "high"]].to_numpy().T - part.share.to_numpy())
        ax.errorbar(part.sparsity, part.share, yerr=error, fmt="-" + mark, capsize=2, label=name)
    ax.set(
        xlabel="Doppler tones in a range cell",
        ylabel="supports recovered",
        title="OMP from 40 of 120 chirps",
        ylim=(-0.03, 1.03),
    )
    ax.legend(title="tones", loc="lower left")
