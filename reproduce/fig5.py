"""Fig. 5: the four antenna schedules, and what each does to the velocity spectrum of one target, on
the exact signal.

Each schedule is processed as the paper does, one group at a time (the mean of the groups' maps),
and with all groups united, which for three groups under the Latin constraint samples every antenna
in every slot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from isac_rt.frame.payload import unmodulated
from isac_rt.frame.schedule import Schedule, conventional_schedule, pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.randomness import generator
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate, channel_maps, doppler_bins
from isac_rt.receive.spectrum import clean_spectrum
from reproduce import onepath
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, blank, style, table

NAMES = {
    "a": "conventional TDM-MIMO",
    "b": "pseudo-random TDM-MIMO",
    "c": "conventional, 3 groups",
    "d": "pseudo-random, 3 groups",
}
RANGE, VELOCITY_SHARE = 23.7, 0.23
"""The target's range [m], and its radial velocity as a share of the unambiguous one."""
_EQUAL_DB = 1.0
"""A second peak this close to the first is a second answer."""
_SLOTS = 9
_COLOURS = ("#0072B2", "#E69F00", "#009E73")


@dataclass(frozen=True)
class Spectrum:
    """Velocity spectrum of one target.

    Attributes
    ----------
    scheme, united : the schedule's letter; whether the groups were united
    velocity, power_db : (P,) axis [m/s] and accumulated power over its peak
    unambiguous : largest |velocity| without a second answer [m/s]
    sidelobe_db : of the highest peak elsewhere
    """

    scheme: str
    united: bool
    velocity: np.ndarray
    power_db: np.ndarray
    unambiguous: float
    sidelobe_db: float


def schedules(seed: int) -> dict[str, Schedule]:
    """The four schedules of 120 slots and 3 antennas."""
    w = Waveform()
    shape = (w.num_chirps, w.num_tx)
    return {
        "a": conventional_schedule(1, *shape),
        "b": pseudo_random_schedule(1, *shape, generator(seed, "fig5", "b")),
        "c": conventional_schedule(3, *shape),
        "d": pseudo_random_schedule(3, *shape, generator(seed, "fig5", "d")),
    }


def spectra(scheme: str, schedule: Schedule) -> list[Spectrum]:
    """Spectra group by group and, for several groups, united."""
    w = replace(Waveform(), num_groups=len(schedule))
    velocity, arrays, pilot = (
        VELOCITY_SHARE * w.max_velocity(2),
        onepath.antennas(w, 2),
        unmodulated(w),
    )
    cube = onepath.frame(
        w,
        schedule,
        pilot,
        arrays,
        delay=2 * RANGE / SPEED_OF_LIGHT,
        rate=2 * velocity / SPEED_OF_LIGHT,
    )
    known = Known.of(cube, pilot, arrays, 2)
    clean = clean_spectrum(cube, known)
    single = replace(w, num_groups=1)
    rows = []
    for m in range(w.num_groups):
        alone = Known.unmodulated(single, schedule[m : m + 1], arrays, 2)
        power = accumulate(channel_maps(clean[m : m + 1], alone))
        rows.append(power[power.max(axis=1).argmax()])
    out = [judge(scheme, False, np.mean(rows, axis=0), w)]
    if w.num_groups > 1:
        power = accumulate(channel_maps(clean, known))
        out.append(judge(scheme, True, power[power.max(axis=1).argmax()], w))
    return out


def judge(scheme: str, united: bool, power: np.ndarray, w: Waveform) -> Spectrum:
    """Peaks of a spectrum (P,): the nearest second answer halves the distance to an ambiguity."""
    level = 10 * np.log10(np.maximum(power / power.max(), 1e-12))
    peak, count = int(power.argmax()), power.size
    apart = np.abs((np.arange(count) - peak + count // 2) % count - count // 2)
    elsewhere = apart > 3  # the Hann main lobe ends at two bins
    second = apart[elsewhere & (level > -_EQUAL_DB)]
    velocity = doppler_bins(w) * w.velocity_cell(2)
    bins = int(second.min()) if second.size else count
    return Spectrum(
        scheme,
        united,
        velocity,
        level,
        bins / 2 * w.velocity_cell(2),
        float(level[elsewhere].max()),
    )


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Without noise; `quick` changes nothing, the seed chooses the pseudo-random schedules."""
    chosen, found = schedules(seed), []
    for i, (scheme, schedule) in enumerate(chosen.items()):
        found += spectra(scheme, schedule)
        progress(i + 1, len(chosen))
    rows = [(s.scheme, s.united, s.unambiguous, s.sidelobe_db) for s in found]
    summary = table("scheme groups_united unambiguous_velocity_mps highest_sidelobe_db", rows)
    columns = "scheme groups_united velocity_mps power_db"
    curves = pd.concat(
        [
            table(
                columns,
                ((s.scheme, s.united, *p) for p in zip(s.velocity, s.power_db, strict=True)),
            )
            for s in found
        ]
    )
    chirps = [
        (scheme, m, p, int(schedule[m, p]))
        for scheme, schedule in chosen.items()
        for m, p in np.ndindex(*schedule.shape)
    ]
    slots = table("scheme group slot antenna", chirps)
    true_velocity = VELOCITY_SHARE * Waveform().max_velocity(2)
    settings = {
        "quick": quick,
        "seed": seed,
        "range_m": RANGE,
        "velocity_mps": true_velocity,
        "noise": "none",
        "window": "Hann",
    }
    tables = {"summary": summary, "spectra": curves, "schedules": slots}
    figure, verdicts = _figure(chosen, found), _verdicts(found)
    return Outcome("fig5", "Antenna schedules", tables, figure, verdicts, settings)


say = Sentences("""
reduces: Conventional TDM-MIMO reduces the unambiguous velocity
  {a}

larger: Pseudo-random TDM-MIMO makes it L_tx times larger
  {a}; {b}; {d}

needed: With 3 groups the pseudo-random order is needed for it
  only when each group is processed alone: {c}; {united_c}; {united_d}; by the Latin property the
  groups together sample every antenna in every slot, whatever the order
""")


def _verdicts(found: list[Spectrum]) -> tuple[Verdict, ...]:
    by = {(s.scheme, s.united): s for s in found}
    a, b, c, d = (by[scheme, False] for scheme in "abcd")
    united_c, united_d = by["c", True], by["d", True]

    def text(s: Spectrum) -> str:
        level = round(s.sidelobe_db, 1) + 0.0  # no "-0.0"
        return (
            f"({s.scheme}){' united' if s.united else ''} {s.unambiguous:.2f} m/s, highest "
            f"other peak {level:.1f} dB"
        )

    # the spacing of the ambiguities is a whole number of bins, so that the ratio is exact
    gain = all(abs(s.unambiguous / a.unambiguous - 3) < 1e-9 for s in (b, d))
    reduced = a.sidelobe_db > -_EQUAL_DB and a.unambiguous < b.unambiguous
    union = united_c.sidelobe_db < -20 and c.sidelobe_db > -_EQUAL_DB
    texts = {"c": text(c), "united_c": text(united_c), "united_d": text(united_d)}
    return (
        say("reduces", reduced, a=text(a)),
        say("larger", gain, a=text(a), b=text(b), d=text(d)),
        say("needed", not union, True, **texts),
    )


def _figure(chosen: dict[str, Schedule], found: list[Spectrum]) -> Figure:
    with style():
        figure, axes = blank(4, 2, size=(9.6, 9.2), width_ratios=(1, 1.5))
        for (scheme, schedule), (left, right) in zip(chosen.items(), axes, strict=True):
            _slots(left, scheme, schedule)
            for s in (x for x in found if x.scheme == scheme):
                how, colour = (
                    ("groups united", "#D55E00") if s.united else ("each group alone", "#0072B2")
                )
                right.plot(
                    s.velocity,
                    s.power_db,
                    "-" if s.united or len(schedule) == 1 else "--",
                    color=colour,
                    label=f"{how}: unambiguous to {s.unambiguous:.2f} m/s",
                )
            right.axvline(
                VELOCITY_SHARE * Waveform().max_velocity(2),
                color="#303030",
                lw=0.8,
                ls=":",
                label="true velocity",
            )
            right.set(
                ylim=(-60, 30), xlim=(-15, 15), ylabel="power [dB]", xlabel="radial velocity [m/s]"
            )
            right.legend(loc="upper right", ncols=2, fontsize=6.5)
    return figure


def _slots(ax: Axes, scheme: str, schedule: Schedule) -> None:
    """The first slots as chirps in time, one row per group, coloured by antenna."""
    for m, row in enumerate(schedule):
        for p in range(_SLOTS):
            start = p + 0.12 * m
            ax.plot([start, start + 0.7], [m, m + 0.8], color=_COLOURS[row[p]], lw=2.2)
            ax.text(start + 0.22, m + 0.55, str(row[p]), fontsize=7, ha="right")
    ax.set(xlim=(-0.2, _SLOTS + 0.3), ylim=(-0.2, 3.1), title=f"({scheme}) {NAMES[scheme]}")
    ax.set_xlabel("slot (number and colour: transmit antenna)")
    ax.set_yticks([m + 0.4 for m in range(3)], [f"group {m}" for m in range(3)])
    ax.grid(False)
    for edge in range(0, _SLOTS + 1, 3):
        ax.axvline(edge - 0.06, color="#B0B0B0", lw=0.8, ls="--")
