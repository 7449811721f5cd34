"""What `losses` and the genie's bound rest on, against a matched filter that is written out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind
from isac_rt.scenario.file import load
from isac_rt.simulation.setup import prepare
from isac_rt.simulation.stations import Station, standard_terminal

SCENE = Path(__file__).parents[2] / "scenes" / "munich_swarm.yaml"
C, BOLTZMANN = 299_792_458.0, 1.380649e-23
FRAME = 40
EVERY = 16
"""Every sixteenth sample is summed: what is left of the phases in a chirp is under 1e-3 cycles."""
TOLERANCE_DB = 0.01
"""The number that is stated is energy over noise alone. The plane wave and the constant rates of
the filter below cost up to 0.0025 dB in 14 target-frames of 12 m and more: the wave's curvature
over the arrays, a^2/(2 lambda r) of a cycle, and the turn of the line of sight within a frame."""


def unit(vector):
    return vector / np.linalg.norm(vector)


def matched_snr(waveform, sent, here, body):
    """Energy of an echo of amplitude 1 behind a filter of its true delay, rate and directions.

    The echo s = exp(j 2 pi (f_c tau + alpha tau (u - tau/2))) of a body (6,) is the direct sum over
    groups, receivers, chirps and samples in float64, tau from the distances of the elements to the
    body where it is at that time. The filter knows the delay at the middle of the frame, its rate
    and the two directions, as plane waves.
    """
    w, tx, rx = waveform, sent.pose, here
    slope, n = w.slope, np.arange(0, w.num_samples, EVERY)
    u = w.window_start + n * w.sample_interval
    p = np.arange(w.num_chirps)
    at_tx = tx.position + sent.antennas.tx_positions @ tx.rotation.T
    at_rx = rx.position + sent.antennas.rx_positions @ rx.rotation.T
    to = [unit(body[:3] - pose.position) for pose in (tx, rx)]
    length = [np.linalg.norm(body[:3] - pose.position) for pose in (tx, rx)]
    rates = [e @ (body[3:] - pose.velocity) for e, pose in zip(to, (tx, rx), strict=True)]
    through, energy = 0j, 0
    for m in range(w.num_groups):
        t = (p - (w.num_chirps - 1) / 2) * w.slot_duration
        place = body[:3] + t[:, None] * body[3:]
        elements = at_tx[sent.schedule[m]] + t[:, None] * tx.velocity
        out = np.linalg.norm(place - elements, axis=1)
        for r in range(len(at_rx)):
            back = np.linalg.norm(place - at_rx[r] - t[:, None] * rx.velocity, axis=1)
            plane = sum(length) + t * sum(rates)
            plane = plane - (at_tx[sent.schedule[m]] - tx.position) @ to[0]
            plane = plane - (at_rx[r] - rx.position) @ to[1]
            tau, model = ((x / C)[:, None] for x in (out + back, plane))
            cycles = w.carrier_frequency * (tau - model)
            cycles = cycles + slope * (tau * (u - tau / 2) - model * (u - model / 2))
            through += np.exp(2j * np.pi * cycles).sum()
            energy += cycles.size
    return EVERY * float(abs(through) ** 2 / energy)


@pytest.mark.sionna
def test_the_matched_filter_of_losses_is_one():
    """Every UAV in view of the AT and of PT2 in a frame of Munich: the SNR that decides whether it
    is too weak is that of the filter written out, and the genie finds it as often as a steady
    amplitude in complex Gaussian noise crosses the threshold of one cell (non-central chi squared).
    Clutter is left out, for neither depends on it. Planted bugs: the number of receivers left out;
    the noise figure left out; the genie's threshold that of two looks."""
    scenario = load(SCENE, ["receiver_preset=plain", "clutter={model: none}"])
    setup, noise, compared = prepare(scenario), scenario.noise, 0
    watts = BOLTZMANN * 290.0 * 10 ** (noise.noise_figure_db / 10)
    watts *= setup.waveform.sampling_rate
    threshold = -2 * np.log(scenario.receivers.false_alarm_rate)
    frame, when = setup.frame(FRAME), setup.timetable.epoch(FRAME, "AT")
    flights = setup.swarm.trajectories
    for link in (Link("AT", "AT"), Link("AT", "PT2")):
        terminal = standard_terminal(setup, link, scenario)
        observer = Station(setup, link, terminal, scenario.receivers)
        record = observer.record(frame, observer.receive(frame, frame.received(link), False))
        paths = frame.paths[link]
        for i in np.flatnonzero(np.isfinite(record.uavs.target_snr)):
            name = list(setup.swarm.uavs)[i]
            if name == link.tx:
                continue  # its line of sight
            own = (paths.kind == PathKind.TARGET) & (paths.target == paths.target_names.index(name))
            pose = flights[name].pose(when)
            body, here = np.concatenate([pose.position, pose.velocity]), flights[link.rx].pose(when)
            amplitude = abs(paths.gain[own].item()) * frame.sent["AT"].amplitude
            snr = matched_snr(setup.waveform, frame.sent["AT"], here, body) * amplitude**2 / watts
            assert 10 * np.log10(record.uavs.target_snr[i] / snr) == pytest.approx(
                0, abs=TOLERANCE_DB
            )
            finds = stats.ncx2.sf(threshold, 2, 2 * record.uavs.target_snr[i])
            assert record.uavs.genie[i] == pytest.approx(finds, rel=1e-6)
            compared += 1
    assert compared == 8
