"""Claims on complexity: how the processor time of the program's own steps grows with each number
that the paper's expressions contain."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy.stats import linregress

from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload, random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.randomness import generator
from isac_rt.receive.known import Known
from isac_rt.receive.omp import omp
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.symbols import decide, decide_transitions
from reproduce import onepath
from reproduce.outcome import Progress, Sentences, Verdict, table

SCALES = (1, 2, 4, 8)

say = Sentences("""
removal: Compensating the delays and removing the phases costs O(M N L_rx P) each
  processor time of both with the range DFT grows as {text}

delays: Deciding the delay symbols costs O(M K P)
  once the peaks are known; finding them searches the cells: time grows as {text}

phases: Deciding the phases costs O(M L_rx K P)
  time grows as {text} (here the line of sight alone is decided on)

omp: OMP costs O(M K P log P + M K^2 P/L_tx)
  that is one vector; it runs for every range row and antenna pair, N L times: time grows as {text}

load: OMP's load remains acceptable
  only at the rows with a detection: {each:.1f} us per vector of 40 chirps here, {all:.0f} ms for
  all {rows} of a frame of {frame:.2f} ms
""")


@dataclass(frozen=True)
class Growth:
    """How one step's time grows with one number.

    Attributes
    ----------
    step, number : names
    sizes, seconds : (n,) values of the number and least processor time of a call
    exponent, deviation : of the power law fitted, and its standard deviation
    """

    step: str
    number: str
    sizes: np.ndarray
    seconds: np.ndarray
    exponent: float
    deviation: float


def growth(
    step: str,
    number: str,
    sizes: Sequence[int],
    make: Callable[[int], Callable[[], object]],
    repeats: int,
) -> Growth:
    """Fit seconds = a size^b to the least of `repeats` processor times; `make` prepares a call for
    a size."""
    seconds = []
    for size in sizes:
        call = make(size)
        call()
        times = []
        for _ in range(repeats):
            start = time.process_time()
            call()
            times.append(time.process_time() - start)
        seconds.append(max(min(times), 1e-7))
    fit = linregress(np.log(np.asarray(sizes, float)), np.log(np.asarray(seconds)))
    measured = np.asarray(sizes), np.asarray(seconds)
    return Growth(step, number, *measured, float(fit.slope), float(fit.stderr))


def _cube(
    seed: int, *, samples: int = 512, chirps: int = 60, receivers: int = 4, groups: int = 1
) -> tuple[IFCube, Payload]:
    """Noise with a random payload: the steps do not look at what is in it."""
    w = Waveform(num_samples=samples, num_chirps=chirps, num_groups=groups)
    rng = generator(seed, "claims", "cost")
    schedule = pseudo_random_schedule(groups, chirps, w.num_tx, rng)
    payload = random_payload(w, schedule, 8, rng)
    data = rng.standard_normal((groups, receivers, chirps, samples, 2), np.float32).view(
        np.complex64
    )[..., 0]
    return IFCube(samples=data, waveform=w, schedule=schedule, start_time=0.0), payload


def data_removal(seed: int, repeats: int) -> list[Growth]:
    """Range spectra with both kinds of data taken out: compensation and removal in one pass."""

    def make(**change: int) -> Callable[[], object]:
        cube, payload = _cube(seed, **change)
        known = Known.of(cube, payload, onepath.antennas(cube.waveform, 1), 2)
        return lambda: clean_spectrum(cube, known)

    name = "range DFT and data removal"
    return [
        growth(name, "N", [512 * k for k in SCALES], lambda n: make(samples=n), repeats),
        growth(name, "P", [60 * k for k in SCALES], lambda n: make(chirps=n), repeats),
        growth(name, "L_rx", [4 * k for k in SCALES], lambda n: make(receivers=n), repeats),
        growth(name, "M", [1, 2, 3], lambda n: make(groups=n, chirps=240), repeats),
    ]


def matching_pursuit(seed: int, repeats: int) -> list[Growth]:
    """Batch-OMP on vectors of P/3 chirps."""

    def make(chirps: int = 120, atoms: int = 4, vectors: int = 512) -> Callable[[], object]:
        rng = generator(seed, "claims", "cost", "omp")
        chosen = np.flatnonzero(pseudo_random_schedule(1, chirps, 3, rng)[0] == 0)
        data = rng.standard_normal((vectors, chosen.size, 2)).view(np.complex128)[..., 0]
        return lambda: omp(data, chosen, chirps, atoms)

    return [
        growth("OMP", "K", [2, 4, 8, 16], lambda n: make(atoms=n), repeats),
        growth("OMP", "P", [120, 240, 480, 960], lambda n: make(chirps=n), repeats),
        growth("OMP", "vectors", [256 * k for k in SCALES], lambda n: make(vectors=n), repeats),
    ]


def decisions(seed: int, repeats: int) -> list[Growth]:
    """Delay symbols from the power over chirps and cells, DPSK symbols from the cells that were
    picked."""

    def delays(chirps: int = 240, paths: int = 4, samples: int = 512) -> Callable[[], object]:
        w = Waveform(num_samples=samples, num_chirps=chirps, num_groups=1)
        rng = generator(seed, "claims", "cost", "delays")
        power = rng.exponential(size=(chirps, samples)).astype(np.float32)
        others = [(0.5, rng.integers(0, 40, chirps)) for _ in range(paths - 1)]
        return lambda: decide(power, others, w)

    def phases(chirps: int = 960, receivers: int = 16) -> Callable[[], object]:
        rng = generator(seed, "claims", "cost", "phases")
        schedule = pseudo_random_schedule(1, chirps, 3, rng)
        picked = rng.standard_normal((1, receivers, chirps, 2)).view(np.complex128)[..., 0]
        return lambda: decide_transitions(picked, schedule, 3, 8)

    delay, phase = "delay decisions", "DPSK decisions"
    return [
        growth(delay, "K", [2, 4, 8, 16], lambda n: delays(paths=n), repeats),
        growth(delay, "P", [240 * k for k in SCALES], lambda n: delays(chirps=n), repeats),
        growth(delay, "N", [512 * k for k in SCALES], lambda n: delays(samples=n), repeats),
        growth(phase, "P", [960 * k for k in SCALES], lambda n: phases(chirps=n), repeats),
        growth(phase, "L_rx", [16 * k for k in SCALES], lambda n: phases(receivers=n), repeats),
    ]


def cost(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Measure all steps."""
    repeats, found = 3 if quick else 7, []
    parts = (data_removal, decisions, matching_pursuit)
    for i, part in enumerate(parts):
        found += part(seed, repeats)
        report(i + 1, len(parts))
    rows = [
        (g.step, g.number, size, seconds, g.exponent, g.deviation)
        for g in found
        for size, seconds in zip(g.sizes, g.seconds, strict=True)
    ]
    verdicts = _verdicts({(g.step, g.number): g for g in found})
    return table("step number size cpu_seconds exponent exponent_std", rows), verdicts


_ALLOWED = 0.5
"""By which a fitted exponent may exceed 1 and still count as linear: a log N, caches, other
programs."""


def _verdicts(by: dict[tuple[str, str], Growth]) -> tuple[Verdict, ...]:
    def linear(step: str, numbers: str) -> bool:
        return all(by[step, n].exponent < 1 + _ALLOWED for n in numbers.split())

    def text(step: str, numbers: str) -> str:
        return ", ".join(
            f"{n}^({by[step, n].exponent:.2f} +- {by[step, n].deviation:.2f})"
            for n in numbers.split()
        )

    removal = "range DFT and data removal"
    vectors = by["OMP", "vectors"]
    each = float(vectors.seconds[-1] / vectors.sizes[-1])
    w = Waveform()
    rows = w.num_delay_symbols * 45 * w.num_groups
    load = {"each": each * 1e6, "all": rows * each * 1e3, "frame": w.frame_duration * 1e3}
    delays, phases = linear("delay decisions", "K P"), linear("DPSK decisions", "P L_rx")
    return (
        say("removal", linear(removal, "N P L_rx M"), text=text(removal, "N P L_rx M")),
        say("delays", False, delays, text=text("delay decisions", "K P N")),
        say("phases", phases, text=text("DPSK decisions", "P L_rx")),
        say("omp", False, text=text("OMP", "vectors K P")),
        say("load", False, True, rows=rows, **load),
    )


def draw(ax: Axes, found: pd.DataFrame) -> None:
    """Time over the smallest size's, against size over the smallest."""
    for i, ((step, number), part) in enumerate(found.groupby(["step", "number"], sort=False)):
        first, look = part.iloc[0], "osD^v*<>"[i % 8] + "-"
        x, y = part["size"] / first["size"], part.cpu_seconds / first.cpu_seconds
        label = f"{step}: {number} ({first.exponent:.2f})"
        ax.plot(x, y, look, ms=4, lw=0.9, color=f"C{i % 10}", label=label)
    ax.plot([1, 8], [1, 8], "k--", lw=1, label="linear")
    ax.set(xscale="log", xlabel="size over the smallest", title="Complexity (exponent)")
    ax.set(yscale="log", ylabel="time over the smallest's")
    ax.set_xticks(SCALES, [str(k) for k in SCALES])
    ax.minorticks_off()
    ax.legend(fontsize=5.8, loc="upper left")
