"""Fig. 13: bit rate against the number of transmit antennas, exactly, without noise."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from isac_rt.frame.payload import MODULATION_ORDERS
from isac_rt.frame.waveform import Waveform
from reproduce.outcome import Outcome, Progress, Verdict, blank, style

ANTENNAS = range(1, 7)
CHIRPS = 120
"""Divisible by every number of antennas drawn."""
READINGS = ("51.2 us", "25.6 us, all times halved", "25.6 us, T_d kept")
_CLAIMED = (500.0, 700.0)
_MARKS = dict(zip(MODULATION_ORDERS, "osD^", strict=True))
_DASHES = dict(zip(READINGS, ("-", "--", ":"), strict=True))


def slot_duration(waveform: Waveform, reading: str) -> float:
    """Slot [s] of a chirp sampled for 25.6 us or 51.2 us.

    "All times halved" keeps the sweep and so makes the slope steeper and T_d shorter. "T_d kept"
    halves T alone: the chirp lasts T + 2 T_d and the guard interval 2 L_tx T_d with the T_d of 51.2
    us.
    """
    if reading == "25.6 us, T_d kept":
        t_d = replace(waveform, num_samples=2 * waveform.num_samples).max_delay
        return waveform.sampled_duration + 2 * t_d + 2 * waveform.num_tx * t_d
    return waveform.slot_duration


def rate(num_tx: int, order: int, reading: str) -> float:
    """Bit rate [kbit/s] of M = L_tx groups over a frame without pilots."""
    samples = 1024 if reading == READINGS[0] else 512
    w = Waveform(num_samples=samples, num_chirps=CHIRPS, num_groups=num_tx, num_tx=num_tx)
    return w.bits_per_frame(order) / (CHIRPS * slot_duration(w, reading)) / 1e3


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Rates by formula; nothing is random and `quick` changes nothing."""
    rows = [
        {"T": reading, "D": order, "L_tx": n, "rate_kbps": rate(n, order, reading)}
        for reading in READINGS
        for order in MODULATION_ORDERS
        for n in ANTENNAS
    ]
    table = pd.DataFrame(rows)
    progress(1, 1)
    settings = {"quick": quick, "seed": seed, "chirps_per_frame": CHIRPS, "groups": "L_tx"}
    return Outcome(
        "fig13",
        "Bit rate against transmit antennas",
        {"fig13": table},
        _figure(table),
        _verdicts(table),
        settings,
    )


def _figure(table: pd.DataFrame):
    with style():
        figure, axes = blank()
        ax = axes[0, 0]
        ax.axhspan(
            *_CLAIMED,
            color="#009E73",
            alpha=0.12,
            lw=0,
            label="500 to 700 kbit/s, claimed at $L_{tx}=3$",
        )
        for i, order in enumerate(MODULATION_ORDERS):
            for reading in READINGS:
                part = table[(table.D == order) & (table["T"] == reading)]
                ax.plot(
                    part.L_tx,
                    part.rate_kbps,
                    _DASHES[reading] + _MARKS[order],
                    color=f"C{i}",
                    label=f"D = {order}, T = {reading}",
                )
        ax.set(
            xlabel="number of transmit antennas $L_{tx}$ (groups $M = L_{tx}$)",
            ylabel="bit rate [kbit/s]",
            xlim=(1, 6),
            ylim=(0, 2450),
        )
        ax.legend(fontsize=6.2, ncols=2, loc="upper left")
    return figure


def _verdicts(table: pd.DataFrame) -> tuple[Verdict, ...]:
    three = table[table.L_tx == 3].groupby("T").rate_kbps.agg(["min", "max"])
    text = "; ".join(
        f"T = {t}: {low:.1f} to {high:.1f} kbit/s"
        for t, (low, high) in zip(three.index, three.to_numpy(), strict=True)
    )
    inside = bool((three["min"] >= _CLAIMED[0]).all() and (three["max"] <= _CLAIMED[1]).all())
    growth = table[table["T"] == READINGS[0]].pivot(index="L_tx", columns="D", values="rate_kbps")
    per_antenna = growth.div(growth.index.to_numpy(), axis=0)
    rising, slower = (
        bool((growth.diff().dropna() > 0).all().all()),
        bool((per_antenna.diff().dropna() < 0).all().all()),
    )
    eight = ", ".join(f"{v:.1f}" for v in growth[8])
    return (
        Verdict(
            "With 3 transmit antennas and the settings of D and T the rate is 500 to 700 kbit/s",
            "holds" if inside else "does not hold",
            f"D = 2 to 16 at 3 antennas; {text}",
        ),
        Verdict(
            "The rate grows with the number of transmit antennas, but not in proportion",
            "holds" if rising and slower else "does not hold",
            f"D = 8, T = 51.2 us, 1 to 6 antennas: {eight} kbit/s",
        ),
    )
