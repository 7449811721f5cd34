"""The picture of `isac-rt reproduce clutter`: curves above, what the clutter is like below."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.experiments.clutter_scenes import SMALL_UAV_M2, Scenes
from isac_rt.experiments.clutter_statistics import cell_powers, strongest_run
from isac_rt.experiments.outcome import blank, style
from isac_rt.propagation.free_space import radar_amplitude
from isac_rt.waveform import SPEED_OF_LIGHT

COLOURS = {"gaussian": "#000000", "rayleigh": "#E69F00", "square": "#0072B2", "street": "#009E73", "roofs": "#CC79A7"}
LINES = {"strongest cell": "-", "none": "-", "profile": "--", "notch": "--"}
COLUMNS = (
    ("paper", 0.0, "clutter at +10 dB, hovering"),
    ("paper", 10.0, "clutter at +10 dB, 10 m/s"),
    ("physical", 10.0, "physical level, 10 m/s"),
)


def draw(tables: dict[str, pd.DataFrame], scenes: Scenes) -> Figure:
    """Three columns of curves by level and motion; profile, Doppler and distribution of the places' clutter."""
    with style():
        figure, axes = blank(4, 3, (11.5, 12.0))
        delay, dpsk = (tables["symbols"][tables["symbols"].symbol == name] for name in ("delay", "dpsk"))
        for column, (level, speed, title) in enumerate(COLUMNS):
            for ax, table in zip(axes[:3, column], (delay, dpsk, tables["hits"]), strict=True):
                _curves(ax, table, level, speed)
            axes[1, column].set(ylabel="DPSK symbol error rate, PT", xlabel="SNR of the line of sight [dB]")
            axes[1, column].set(yscale="log", ylim=(1.5e-3, 1.3))
            axes[0, column].set(title=title, ylabel="delay symbol error rate, PT", xlabel="SNR of the line of sight [dB]")
            axes[0, column].set(yscale="log", ylim=(1.5e-3, 1.3))
            axes[2, column].set(ylabel="hit rate, AT", xlabel="SNR of the target [dB]", ylim=(-0.03, 1.05))
        for name, colour in COLOURS.items():
            axes[0, 0].plot([], [], color=colour, label=name if name in ("gaussian", "rayleigh") else f"mesh, {name}")
        axes[0, 0].legend(fontsize=7, loc="lower left")
        for ax, words in ((axes[0, 1], ("strongest cell", "range profile")), (axes[2, 1], ("CFAR", "after a zero-Doppler notch"))):
            for line, word in zip(("-", "--"), words, strict=True):
                ax.plot([], [], line, color="#777777", label=word)
            ax.legend(fontsize=7, loc="lower left")
        _below(axes[3], scenes)
    return figure


def _curves(ax, table: pd.DataFrame, level: str, speed: float) -> None:
    for (clutter, decision), part in table.groupby(["clutter", "decision"], sort=False):
        here = part[(part.level == level) & (part.speed_mps == speed)]
        if clutter in ("gaussian", "rayleigh"):
            here = part[part.level == "paper"]
        shown = np.maximum(here.rate, 0.5 / here.trials) if decision in ("strongest cell", "profile") else here.rate
        ax.plot(here.snr_db, shown, LINES[decision], color=COLOURS[clutter], marker="o", ms=2.5)


def _below(axes, scenes: Scenes) -> None:
    """Level over a small UAV against range, Doppler within the strongest run, and amplitudes there against Rayleigh's law."""
    w, gain = scenes.setup.waveform, scenes.setup.antennas.gain
    level, doppler, law = axes
    at = np.arange(40, w.num_delay_symbols - 40)
    ranges = at * w.range_cell(2)
    uav = (scenes.amplitude * gain * np.asarray(radar_amplitude(w.wavelength, SMALL_UAV_M2, ranges, ranges))) ** 2
    rng = np.random.default_rng(1)
    for place in [name for name in COLOURS if name in scenes.setup.swarm.uavs]:
        clutter = scenes.expectation.clutter(place, scenes.pose(place, 10.0), scenes.epoch, scenes.amplitude)
        cell, power = cell_powers(clutter, w)
        level.plot(ranges, 10 * np.log10(np.maximum(power[at], 1e-30) / uav), color=COLOURS[place], lw=0.8)
        run = strongest_run(power)
        inside = (cell >= run.start) & (cell < run.stop)
        velocity = clutter.delay_rate[inside] * SPEED_OF_LIGHT / 2
        spectrum, edges = np.histogram(velocity, np.arange(-12, 4, w.velocity_cell(2)), weights=clutter.power[inside])
        doppler.plot(edges[:-1], 10 * np.log10(np.maximum(spectrum / spectrum.max(), 1e-6)), color=COLOURS[place], lw=1)
        amplitude = np.sqrt(np.repeat(power[run], 400) * rng.exponential(size=400 * (run.stop - run.start)) / power[run].mean())
        law.plot(np.sort(amplitude), 1 - np.arange(amplitude.size) / amplitude.size, color=COLOURS[place], lw=1)
    level.fill_between([20, 31], 8, 12, color=COLOURS["rayleigh"], alpha=0.5, lw=0)
    level.set(xlabel="range [m]", ylabel="clutter in a cell over a small UAV [dB]", ylim=(-30, 30))
    doppler.axvline(0, color=COLOURS["rayleigh"], lw=2)
    doppler.set(xlabel="radial velocity in the strongest 45 cells, 10 m/s [m/s]", ylabel="power [dB]", ylim=(-40, 3))
    x = np.linspace(0, 5, 100)
    law.plot(x, np.exp(-(x**2)), color=COLOURS["rayleigh"], lw=2)
    law.set(xlabel="amplitude over rms in the strongest 45 cells", ylabel="exceeded with probability", yscale="log")
    law.set(ylim=(1e-3, 1.2), xlim=(0, 5))
