"""Elements with errors, found in flight: angles by the number of looks, and a flight over Munich.

Every element is off by 1 dB and 30 degrees. The bound is that of the calibrated array: Fisher's
information of its channels for two direction cosines, with an unknown amplitude at the active
terminal and one by transmit antenna at a passive one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.extensions.hardware.self_calibration import KnownDirection, SelfCalibration
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.randomness import generator
from isac_rt.receive.modes import MODES
from isac_rt.receive.types import PathChannels
from isac_rt.scenario.file import load
from isac_rt.simulation import simulate
from reproduce import SCENES
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, blank, style, table
from reproduce.symbols import link_waveform, paper_antennas

GAIN_DB, PHASE_DEG = 1.0, 30.0
SNR = 50.0
"""Of a channel, of looks and of what is measured with the array after them."""
LOOKS = 10
FAR_M = 1e6
ONE_DECIBEL = 10 ** (1 / 20)
ERRORS = f"{{gain_std_db: {GAIN_DB:g}, phase_std_deg: {PHASE_DEG:g}}}"
FRONT_END = f"radio.front_end={{transmit: {ERRORS}, receive: {ERRORS}}}"
SETS = ("tracks", "positions")
COMPARED = ", ".join(f"{one}: {{receivers: {{self_calibration: {one}}}}}" for one in SETS)

say = Sentences("""
bound: Ten frames bring angles from 1 dB and 30 degrees of error back to within 1 dB of the
Cramer-Rao bound of the calibrated array
  errors over the bound before and after ten looks of 17 dB a channel: active terminal {at}, passive
  terminal {pt} (1.122 is 1 dB; {arrays} arrays)

munich: In Munich hit rates and angles come back too
  {rows}
""")


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Angles by the number of looks, and Munich with ideal elements, with errors, and with errors
    that are found in flight."""
    arrays, frames = (400, 12) if quick else (2000, 78)
    looks = []
    for step, (name, passes) in enumerate((("active", 2), ("passive", 1))):
        rms = ratios(passes, arrays, seed)
        looks += [(name, number, float(value)) for number, value in enumerate(rms)]
        progress(step + 1, 4)
    flights = _flights(frames, seed, progress)
    tables = {"looks": table("terminal looks error_over_bound", looks), "munich": flights}
    settings = {"quick": quick, "seed": seed, "arrays": arrays, "flight_frames": frames}
    verdicts = _bound_verdict(tables["looks"], arrays), _munich_verdict(flights)
    title = "Self-calibration in flight"
    return Outcome("self_calibration", title, tables, _figure(tables), verdicts, settings)


def ratios(passes: int, arrays: int, seed: int) -> np.ndarray:
    """(`LOOKS` + 1,) root mean square error of a direction cosine over its bound, by the number of
    looks at somebody whose place is known."""
    w = link_waveform(1024)
    antennas, rng = paper_antennas(w), generator(seed, "self-calibration", passes)
    total = np.zeros(LOOKS + 1)
    for _ in range(arrays):
        sent, received = _errors(rng, antennas.num_tx), _errors(rng, antennas.num_rx)
        gain = (sent[:, None] * received).ravel()
        one = SelfCalibration(w, antennas, passes)
        for number in range(LOOKS + 1):
            total[number] += _square(one, gain, w, antennas, passes, rng)
            u = rng.uniform(-0.5, 0.5, 2)
            y = gain * _wave(u, w, antennas, passes) + _noise(rng, gain.size)
            modes = np.zeros((MODES, antennas.num_tx, antennas.num_rx), complex)
            modes[0] = y.reshape(modes.shape[1:])
            one.learn(PathChannels(0.0, 0.0, modes, SNR), KnownDirection(u, FAR_M, 1e-4))
    return np.sqrt(total / arrays)


def _errors(rng: np.random.Generator, size: int) -> np.ndarray:
    level, phase = rng.normal(size=(2, size))
    return 10 ** (GAIN_DB * level / 20) * np.exp(1j * np.radians(PHASE_DEG) * phase)


def _noise(rng: np.random.Generator, size: int) -> np.ndarray:
    return rng.normal(size=(size, 2)) @ np.array([1, 1j]) / np.sqrt(2 * SNR)


def _places(antennas: Antennas, passes: int) -> np.ndarray:
    """(C, 2) of the channels by which a direction is told."""
    if passes == 2:
        return antennas.virtual_positions[:, [0, 2]]
    return np.tile(antennas.rx_positions[:, [0, 2]], (antennas.num_tx, 1))


def _wave(u: np.ndarray, w: Waveform, antennas: Antennas, passes: int) -> np.ndarray:
    """(C,) plane wave of power 1 in every channel."""
    turn = -2j * np.pi * w.effective_carrier / SPEED_OF_LIGHT
    return np.exp(turn * (_places(antennas, passes) @ u))


def _square(
    one: SelfCalibration,
    gain: np.ndarray,
    w: Waveform,
    antennas: Antennas,
    passes: int,
    rng: np.random.Generator,
) -> float:
    """Mean squared error of the cosines of a wave over their bounds, corrected by what is known."""
    u = rng.uniform(-0.5, 0.5, 2)
    wave = _wave(u, w, antennas, passes)
    each = np.exp(one.state.gains.value[0] + 1j * one.state.gains.value[1])
    known = (each[: antennas.num_tx, None] * each[antennas.num_tx :]).ravel()
    if passes == 1:
        known = np.tile(each, antennas.num_tx)
    y = (gain * wave + _noise(rng, gain.size)) / known
    # one amplitude for all, or one by transmit antenna
    owner = np.zeros(gain.size, int) if passes == 2 else np.arange(gain.size) // antennas.num_rx
    count = np.bincount(owner)
    ratio = y * wave.conj()
    mean = (np.bincount(owner, ratio.real) + 1j * np.bincount(owner, ratio.imag)) / count
    phase = (ratio / mean[owner]).imag
    slope = -2 * np.pi * w.effective_carrier / SPEED_OF_LIGHT * _places(antennas, passes)
    middle = np.stack([np.bincount(owner, column) / count for column in slope.T], axis=1)
    J = slope - middle[owner]
    error = np.linalg.lstsq(J, phase, rcond=None)[0]
    bound = np.diag(np.linalg.inv(2 * SNR * J.T @ J))
    return float(np.mean(error**2 / bound))


def _flights(frames: int, seed: int, progress: Progress) -> pd.DataFrame:
    """A row for each kind of hardware and terminal of a shortened flight."""
    rows: list[dict[str, Any]] = []
    scene, changes = SCENES / "munich_swarm.yaml", [f"frames={frames}"]
    ideal = simulate.summarise(load(scene, changes, seed=seed))
    rows += _rows("ideal", ideal["terminals"])
    progress(3, 4)
    changes += [FRONT_END, f"compare={{{COMPARED}}}"]
    found = simulate.summarise(load(scene, changes, seed=seed))
    rows += _rows("none", found["terminals"])
    for name in SETS:
        rows += _rows(name, found["compared"][name]["terminals"])
    progress(4, 4)
    return pd.DataFrame(rows)


def _rows(name: str, terminals: dict[str, Any]) -> list[dict[str, Any]]:
    out = []
    for terminal, one in terminals.items():
        row = {"calibration": name, "terminal": terminal, "hit_rate": one["hit_rate"]}
        row |= {"false_tracks": one["false_tracks_per_frame"], "ser_dpsk": one["ser_dpsk"]}
        for key in ("azimuth_deg", "elevation_deg"):
            row[key] = (one["rmse"] or {}).get(key)
            row[f"tracked_{key}"] = (one["rmse_tracked"] or {}).get(key)
        out.append(row)
    return out


def _bound_verdict(looks: pd.DataFrame, arrays: int) -> Verdict:
    by = {name: part.error_over_bound.to_numpy() for name, part in looks.groupby("terminal")}
    text = {name: f"{rms[0]:.1f} and {rms[-1]:.3f}" for name, rms in by.items()}
    within = all(rms[-1] < ONE_DECIBEL for rms in by.values())
    return say("bound", within, at=text["active"], pt=text["passive"], arrays=arrays)


def _munich_verdict(flights: pd.DataFrame) -> Verdict:
    """Whether at every terminal that finds targets at all the angles' errors are under half of
    those without, and the hit rate is no more than 0.05 under that of ideal elements."""
    by = flights.set_index(["terminal", "calibration"])
    kept, rows = [], []
    for terminal in dict.fromkeys(flights.terminal):
        one = by.loc[terminal]
        told = ", ".join(
            f"{name} {_number(r.hit_rate)} and {_number(r.tracked_azimuth_deg)} deg"
            for name, r in one.iterrows()
        )
        rows.append(f"{terminal} (hit rate, tracked azimuth): {told}")
        if not one.hit_rate["ideal"]:
            continue
        angle = one.tracked_azimuth_deg.astype(float)
        better = angle["positions"] < 0.5 * angle["none"]
        kept.append(bool(better and one.hit_rate["positions"] >= one.hit_rate["ideal"] - 0.05))
    return say("munich", all(kept), any(kept), rows=". ".join(rows))


def _number(value: Any) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.3g}"


def _figure(tables: dict[str, pd.DataFrame]) -> Figure:
    with style():
        figure, axes = blank(1, 2, size=(10.0, 4.0))
        left, right = axes[0]
        for name, part in tables["looks"].groupby("terminal"):
            left.semilogy(part.looks, part.error_over_bound, "o-", label=name)
        left.axhline(ONE_DECIBEL, color="0.4", lw=0.8, label="1 dB")
        left.set(xlabel="looks", ylabel="error over the calibrated array's bound")
        left.legend()
        flights = tables["munich"]
        names = list(dict.fromkeys(flights.calibration))
        terminals = list(dict.fromkeys(flights.terminal))
        for i, name in enumerate(names):
            values = flights[flights.calibration == name].tracked_azimuth_deg.astype(float)
            at = np.arange(len(terminals)) + 0.2 * (i - 1.5)
            right.bar(at, values.to_numpy(), 0.2, label=name)
        right.set(ylabel="azimuth error of tracks [deg]", title="Munich")
        right.set_xticks(np.arange(len(terminals)), terminals)
        right.legend(title="self_calibration")
    return figure
