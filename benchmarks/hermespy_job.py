"""The job that HermesPy is measured on, run by an interpreter that has it: `python hermespy_job.py
JSON`, the answer on stdout.

It knows nothing of isac_rt, whose dependencies that interpreter need not have. HermesPy's radar
channel takes the samples of one transmit antenna at the sampling rate B and adds for every path a
delayed copy at each receive antenna; how far its delays are from those asked for is told by the
same sum with the chirps delayed in continuous time.

Argument: {"bandwidth_hz", "carrier_hz", "num_samples", "num_chirps", "num_rx", "sizes": [K, ...],
"error_paths": K, "seed"}. Answer: {"seconds": {K: CPU s}, "error", "versions"}.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version

import numpy as np
from hermespy.channel.channel import LinkState
from hermespy.channel.radar.radar import RadarChannelSample, RadarTargetPath
from hermespy.core import Signal
from hermespy.simulation import SimulatedDevice, SimulatedIdealAntenna, SimulatedUniformArray

LIGHT = 299792458.0
LONGEST = 0.2
"""Longest delay over the chirp's duration."""


def chirps(times: np.ndarray, job: dict) -> np.ndarray:
    """FMCW of unit amplitude from -B/2 to B/2, chirp after chirp, at any times [s]; nothing before
    0."""
    bandwidth, duration = job["bandwidth_hz"], job["num_samples"] / job["bandwidth_hz"]
    within = times % duration
    wave = np.exp(1j * np.pi * (bandwidth / duration * within - bandwidth) * within)
    return np.where((times >= 0) & (times < job["num_chirps"] * duration), wave, 0)


def channel(job: dict, count: int) -> RadarChannelSample:
    """`count` static targets in front of a transmitter with one antenna and a receiver with a line
    of them, at the same place."""
    f_c, bandwidth, rng = job["carrier_hz"], job["bandwidth_hz"], np.random.default_rng(job["seed"])
    farthest = LIGHT * LONGEST * job["num_samples"] / bandwidth / 2
    states = []
    for antennas in (1, job["num_rx"]):
        array = SimulatedUniformArray(SimulatedIdealAntenna, LIGHT / f_c / 2, (antennas, 1, 1))
        states.append(
            SimulatedDevice(carrier_frequency=f_c, bandwidth=bandwidth, antennas=array).state()
        )
    direction = rng.normal(size=(count, 3)) * [1, 1, 0.3] + [0, 0, 1]
    place = (
        direction
        / np.linalg.norm(direction, axis=1, keepdims=True)
        * rng.uniform(0.01, 0.99, (count, 1))
        * farthest
    )
    phase = rng.uniform(0, 2 * np.pi, count)
    paths = [
        RadarTargetPath(p, np.zeros(3), 1.0, a, attenuate=False, static=True)
        for p, a in zip(place, phase, strict=True)
    ]
    return RadarChannelSample(paths, 1.0, LinkState(*states, f_c, bandwidth, 0.0))


def propagated(job: dict, sample: RadarChannelSample) -> np.ndarray:
    """What HermesPy makes of the frame: (num_rx, chirps x samples)."""
    times = np.arange(job["num_chirps"] * job["num_samples"]) / job["bandwidth_hz"]
    signal = Signal.Create(chirps(times, job)[None], job["bandwidth_hz"], job["carrier_hz"])
    return sample.propagate(signal).view(np.ndarray)[:, : times.size]


def error(job: dict) -> float:
    """Relative RMS deviation from chirps delayed in continuous time, over the part of each chirp
    that all paths have reached."""
    few = job | {"num_chirps": 3}
    sample = channel(few, job["error_paths"])
    times = np.arange(few["num_chirps"] * few["num_samples"]) / few["bandwidth_hz"]
    truth = np.zeros((few["num_rx"], times.size), complex)
    tx, rx = sample.transmitter_state, sample.receiver_state
    for path in sample.paths:
        delayed = chirps(times - path.propagation_delay(tx, rx), few)
        truth += path.propagation_response(tx, rx, few["carrier_hz"]) @ delayed[None]
    reached = np.arange(times.size) % few["num_samples"] >= LONGEST * few["num_samples"]
    found = propagated(few, sample)
    return float(np.linalg.norm((found - truth)[:, reached]) / np.linalg.norm(truth[:, reached]))


def main(job: dict) -> dict:
    """Run the job; its seconds, its errors and the versions."""
    seconds = {}
    propagated(job, channel(job, 2))
    for count in job["sizes"]:
        sample = channel(job, count)
        begin = time.process_time()
        propagated(job, sample)
        seconds[count] = time.process_time() - begin
    versions = {name: version(name) for name in ("hermespy", "numpy", "scipy")} | {
        "python": sys.version.split()[0]
    }
    return {"seconds": seconds, "error": error(job), "versions": versions}


if __name__ == "__main__":
    print(json.dumps(main(json.loads(sys.argv[1]))))
