"""What is looked at before a run begins: whether it fits into memory, and whether its bodies keep
apart."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Iterator

import numpy as np

from isac_rt.frame.antennas import Antennas, antennas_of
from isac_rt.frame.link import Link
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import Waveform
from isac_rt.runtime import available_memory
from isac_rt.scenario.file import ScenarioError, ScenarioWarning
from isac_rt.scenario.tree import NEAREST_M, Scenario
from isac_rt.world.swarm import Pose, Swarm

SAMPLE_BYTES = 8
RECORD_BYTES = 40
"""Of a recorded symbol: decisions and confidences of both alphabets."""
PROGRAM_BYTES = 4e8
"""Interpreter, libraries and a small city, measured: 0.35 GB after the first frame of
scenes/paper_swarm.yaml."""
MOST_EPOCHS = 4_000
ALIAS_EPOCHS = 50


def memory_needed(
    waveform: Waveform, antennas: Antennas, frames: int, links: int, at_once: int
) -> float:
    """Estimate of a run's memory [bytes], the city's mesh and its clutter left out.

    Each receiver at work holds its cube, a copy that it turns, the range spectra and the Doppler
    maps; each frame of a link leaves its symbols behind.
    """
    w = waveform
    chirps = w.num_groups * w.num_chirps
    cube = chirps * antennas.num_rx * w.num_samples
    maps = antennas.num_tx * antennas.num_rx * w.num_chirps * w.num_samples / 2
    kept = frames * links * (chirps * RECORD_BYTES + w.bits_per_frame(16))
    return PROGRAM_BYTES + SAMPLE_BYTES * min(links, at_once) * (2.5 * cube + maps) + kept


def check_memory(
    waveform: Waveform, antennas: Antennas, scenario: Scenario, timetable: Timetable
) -> None:
    """Refuse a run that does not fit.

    Raises
    ------
    ScenarioError  With the estimate and what is free.
    """
    free, links = available_memory(), len(timetable.all_links)
    needed = memory_needed(waveform, antennas, scenario.frames, links, os.cpu_count() or 1)
    if free is not None and needed > free:
        raise ScenarioError(
            f"{scenario.name}: the run would need about {needed / 1e9:.3g} GB of memory, "
            f"{free / 1e9:.3g} GB are free; lower "
            "radio.samples_per_chirp, radio.chirps_per_frame, array.rx_x, array.rx_z or frames"
        )


def check_flights(scenario: Scenario, swarm: Swarm, timetable: Timetable) -> None:
    """Refuse flights on which two bodies meet, or on which the numbers run out of float64's range:
    at such a frame there are no directions between them. Of very long runs every so manyth frame is
    looked at. Warns of velocities that alias.

    Raises
    ------
    ScenarioError
    """
    step = max(1, scenario.frames // MOST_EPOCHS)
    epochs = np.array([timetable.epoch(frame) for frame in range(0, scenario.frames, step)])
    with np.errstate(over="ignore", invalid="ignore"):
        places = {
            name: np.array([flight.pose(t).position for t in epochs])
            for name, flight in swarm.trajectories.items()
        }
    for name, way in places.items():
        if not np.isfinite(way).all() or np.abs(way).max() > 1e12:
            raise ScenarioError(
                f"swarm.{name}: flies beyond all bounds; lower its velocity, or the time between "
                "its waypoints"
            )
    for (a, first), (b, second) in itertools.combinations(places.items(), 2):
        apart = np.linalg.norm(first - second, axis=1)
        nearest = int(np.argmin(apart))
        if apart[nearest] < NEAREST_M:
            raise ScenarioError(
                f"swarm.{b}: is {apart[nearest]:.2g} m from {a} at {epochs[nearest]:.4g} s (frame "
                f"{nearest * step}), at least "
                f"{NEAREST_M} m are needed; change one of their flights"
            )
    for said in aliases(scenario, swarm, timetable):
        warnings.warn(said, ScenarioWarning, stacklevel=3)


def aliases(scenario: Scenario, swarm: Swarm, timetable: Timetable) -> Iterator[str]:
    """What is in view and moves faster than the frame can tell: it is reported a whole period
    slower, and what the groups' offsets make of it as weak further detections.

    Looks at an active terminal's echoes and at lines of sight, in `ALIAS_EPOCHS` frames over the
    run.
    """
    w = timetable.waveform
    antennas = antennas_of(scenario, w)
    frames = np.unique(np.linspace(0, scenario.frames - 1, ALIAS_EPOCHS).round().astype(int))
    poses = [swarm.poses(timetable.epoch(int(frame))) for frame in frames]
    for tx, rx in timetable.all_links:
        passes = 2 if tx == rx else 1
        limit = _fastest(scenario, w, timetable, Link(tx, rx))
        for name in [n for n in swarm.uavs if n != tx] if tx == rx else [rx]:
            rates = np.array([_closing(at[tx], at[name], antennas, passes) for at in poses])
            worst = int(np.abs(rates).argmax())
            if abs(rates[worst]) > limit:
                shown = (rates[worst] + limit) % (2 * limit) - limit
                what = f"the echo of {name} at {tx}" if tx == rx else f"{name} from {tx}"
                yield (
                    f"{scenario.name}: {what} moves at {rates[worst]:.4g} m/s (receding is "
                    f"positive) in frame {frames[worst]}, beyond "
                    f"the unambiguous {limit:.4g} m/s: it is reported at about {shown:.3g} m/s, "
                    "beside weaker false detections"
                )


def _fastest(scenario: Scenario, waveform: Waveform, timetable: Timetable, link: Link) -> float:
    """Unambiguous speed of a link [m/s]: a conventional schedule of few groups has a share of
    it."""
    r, limit = scenario.receivers, waveform.max_velocity(2 if link[0] == link[1] else 1)
    whole = (
        len(timetable.groups(link) or range(waveform.num_groups)) == waveform.num_tx
        and r.velocity_method != "conventional"
    )
    return limit if whole or scenario.array.schedule == "pseudo_random" else limit / waveform.num_tx


def _closing(own: Pose, other: Pose, antennas: Antennas, passes: int) -> float:
    """Range rate of another body [m/s], 0 where it is out of view (of either end, for a line of
    sight)."""
    line = other.position - own.position
    line = line / np.linalg.norm(line)
    seen = antennas.in_view(own.to_body(line)) and (
        passes == 2 or antennas.in_view(other.to_body(-line))
    )
    return float((other.velocity - own.velocity) @ line) if seen else 0.0


def check_reference(scenario: Scenario, timetable: Timetable) -> None:
    """Refuse a scenario whose noise or clutter refers to an echo that there is not.

    Raises
    ------
    ScenarioError
    """
    if scenario.noise.model != "snr" and scenario.clutter.model != "rayleigh":
        return
    for name in dict.fromkeys(tx for tx, rx in timetable.all_links if tx == rx):
        if not any(
            other != name and uav.rcs.model != "relative" for other, uav in scenario.swarm.items()
        ):
            key = (
                "noise.model = snr" if scenario.noise.model == "snr" else "clutter.model = rayleigh"
            )
            raise ScenarioError(
                f"{scenario.name}: {key} refers to the strongest echo at {name}, and there is no "
                "UAV with a cross-section of its own; "
                "add one, or use another model"
            )
