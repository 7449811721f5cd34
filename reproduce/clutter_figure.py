"""The picture of `isac-rt reproduce clutter`: curves above, what the clutter is like below."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.free_space import radar_amplitude
from reproduce.clutter_scenes import SMALL_UAV_M2, Scenes
from reproduce.clutter_statistics import cell_powers, strongest_run
from reproduce.outcome import blank, style

COLOURS = dict(
    zip(
        ("gaussian", "rayleigh", "square", "street", "roofs"),
        ("#000000", "#E69F00", "#0072B2", "#009E73", "#CC79A7"),
        strict=True,
    )
)
LINES = {"strongest cell": "-", "none": "-", "profile": "--", "notch": "--", "old profile": ":"}
WORDS = {
    "strongest cell": "by the strongest cell",
    "profile": "by the range profile, one frame old",
    "old profile": "twelve frames old",
    "none": "CFAR",
    "notch": "CFAR after a zero-Doppler notch",
}
COLUMNS = (
    ("paper", 0.0, "clutter at +10 dB, hovering"),
    ("paper", 10.0, "clutter at +10 dB, 10 m/s"),
    ("physical", 10.0, "physical level, 10 m/s"),
)


def draw(tables: dict[str, pd.DataFrame], scenes: Scenes) -> Figure:
    """Three columns of curves by level and motion; profile, Doppler and distribution of the places'
    clutter."""
    with style():
        figure, axes = blank(5, 3, (11.5, 15.5))
        delay, dpsk = (
            tables["symbols"][tables["symbols"].symbol == name] for name in ("delay", "dpsk")
        )
        least = 0.5 / delay.trials.max()
        rows = (
            (delay, "rate", "delay symbols in error, PT"),
            (dpsk, "rate", "DPSK symbols in error, PT"),
            (tables["hits"], "rate", "targets hit, AT"),
            (tables["hits"], "false_alarm_rate", "false alarms per cell, AT"),
        )
        for column, (level, speed, title) in enumerate(COLUMNS):
            axes[0, column].set_title(title)
            for ax, (table, value, words) in zip(axes[:4, column], rows, strict=True):
                _curves(ax, table, value, level, speed, least)
                ax.set(
                    ylabel=words,
                    xlabel=f"SNR of the {'target' if table is tables['hits'] else 'line of sight'} "
                    "[dB]",
                )
            for ax in axes[:2, column]:
                ax.axhspan(0.7 * least, 1.3 * least, color="#EEEEEE", zorder=0)
                ax.set(yscale="log", ylim=(0.6 * least, 1.4))
            axes[2, column].set(ylim=(-0.03, 1.05))
            axes[3, column].set(yscale="log", ylim=(4e-5, 0.1))
        for name, colour in COLOURS.items():
            label = name if name in ("gaussian", "rayleigh") else f"mesh, {name}"
            axes[2, 0].plot([], [], color=colour, label=label)
        axes[2, 0].legend(loc="lower right")
        note = {"transform": axes[0, 0].transAxes, "fontsize": 8, "color": "#555555"}
        axes[0, 0].text(0.98, 0.1, "in the grey: no error", ha="right", **note)
        for ax, names in (
            (axes[0, 2], ("strongest cell", "profile", "old profile")),
            (axes[2, 1], ("none", "notch")),
        ):
            for name in names:
                ax.plot([], [], LINES[name], color="#555555", label=WORDS[name])
            ax.legend(loc="upper right" if ax is axes[0, 2] else "lower right")
        titles = "level of the mesh's clutter", "its Doppler in flight", "its amplitudes"
        for ax, words in zip(axes[4], titles, strict=True):
            ax.set_title(words)
        _below(axes[4], scenes)
    return figure


def _curves(ax, table: pd.DataFrame, value: str, level: str, speed: float, least: float) -> None:
    """One panel; Gaussian and Rayleigh clutter know no motion, and Rayleigh's level is the paper's.
    What happened not once in all trials is drawn at `least`."""
    for (clutter, decision), part in table.groupby(["clutter", "decision"], sort=False):
        here = part[(part.level == level) & (part.speed_mps == speed)]
        if clutter == "gaussian" or (clutter == "rayleigh" and level == "paper"):
            here = part[part.level == "paper"]
        shown = np.maximum(here[value], least if "symbol" in table else 1e-9)
        ax.plot(here.snr_db, shown, LINES[decision], color=COLOURS[clutter], marker="o", ms=2.5)


def _below(axes, scenes: Scenes) -> None:
    """Level over a small UAV against range, Doppler within the strongest run, and amplitudes there
    against Rayleigh's law."""
    w, gain = scenes.setup.waveform, scenes.setup.antennas.gain
    level, doppler, law = axes
    at = np.arange(40, w.num_delay_symbols - 40)
    ranges = at * w.range_cell(2)
    uav = np.asarray(radar_amplitude(w.wavelength, SMALL_UAV_M2, ranges, ranges))
    uav = (scenes.amplitude * gain * uav) ** 2
    rng = np.random.default_rng(1)
    for place in [name for name in COLOURS if name in scenes.setup.swarm.uavs]:
        clutter = scenes.expected(place, scenes.pose(place, 10.0))
        cell, power = cell_powers(clutter, w)
        look = {"color": COLOURS[place], "lw": 1}
        over = 10 * np.log10(np.maximum(power[at], 1e-30) / uav)
        level.plot(ranges, over, color=COLOURS[place], lw=0.8)
        run = strongest_run(power)
        inside = (cell >= run.start) & (cell < run.stop)
        velocity = clutter.delay_rate[inside] * SPEED_OF_LIGHT / 2
        edges = np.arange(-12, 4, w.velocity_cell(2))
        spectrum, _ = np.histogram(velocity, edges, weights=clutter.power[inside])
        shown = 10 * np.log10(np.maximum(spectrum / spectrum.max(), 1e-6))
        doppler.plot(edges[:-1], shown, **look)
        drawn = rng.exponential(size=400 * (run.stop - run.start))
        amplitude = np.sqrt(np.repeat(power[run], 400) * drawn / power[run].mean())
        share = 1 - np.arange(amplitude.size) / amplitude.size
        law.plot(np.sort(amplitude), share, **look)
    level.fill_between([20, 31], 8, 12, color=COLOURS["rayleigh"], alpha=0.5, lw=0)
    level.set(xlabel="range [m]", ylabel="clutter in a cell over a small UAV [dB]", ylim=(-30, 30))
    level.text(32, 9, "the Rayleigh model", fontsize=7, color="#9A6B00")
    doppler.axvline(0, color=COLOURS["rayleigh"], lw=2)
    doppler.set(xlabel="radial velocity in the strongest 45 cells, 10 m/s [m/s]")
    doppler.set(ylabel="power [dB]", ylim=(-40, 3))
    x = np.linspace(0, 5, 100)
    law.plot(x, np.exp(-(x**2)), color=COLOURS["rayleigh"], lw=2)
    law.set(xlabel="amplitude over rms in the strongest 45 cells", xlim=(0, 5))
    law.set(ylabel="exceeded with probability", yscale="log", ylim=(1e-3, 1.2))
