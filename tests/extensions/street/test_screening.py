"""Opaque blades before the arrays of their own terminal, against Kirchhoff's integral as a sum over
the blades' surface in float64; `isac-rt validate` has what they take in one place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from street_scene import OWN, samples_of, scene
from truths.moving import OPAQUE, kirchhoff, surface

import isac_rt as irt
from isac_rt.extensions.street.centres import body_axes
from isac_rt.extensions.street.motion import pieces
from isac_rt.extensions.street.rotors import blades_of
from isac_rt.extensions.street.screening import squares_of
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.pathset import PathKind, merge
from isac_rt.scenario.tree import Scenario
from isac_rt.world.settings import Rotors


def test_a_blade_ends_where_the_way_over_it_is_shortest():
    """Straight up through a hub, where u is 0. Planted bug: `outer` without `np.where`."""
    rotors = Rotors(number=1, chord_m=0.015, height_m=0.1, incidence_deg=0.0, phase_deg=(20.0,))
    body = blades_of(rotors, irt.Waveform(num_chirps=6), 1, "U")
    found = squares_of(body, np.array([0, 0, 3.0]), np.zeros(1))[0].sum()
    weight, longer = kirchhoff(
        surface(rotors, 0.0), np.zeros(3), np.array([0, 0, 3.0]), 2 * np.pi / body.wave_number
    )
    truth = 1j * (weight * np.exp(-1j * body.wave_number * longer)).sum()
    assert abs(truth) > 0.7
    assert abs(found - truth) < 2e-3


def prepared(target, **rotors):
    """A radar under rotors that looks up at a target, prepared."""
    rotors = OPAQUE.model_dump() | rotors
    flight = {"rcs": {"model": "constant"}} | target
    return irt.prepare(scene(flight, 12, rotors=rotors, boresight=[0.1, 1, 0.6]))


UP = {"position_m": [-3.0, 2.0, 3.2], "velocity_mps": [1.0, 2.0, 0.0]}


def test_samples_are_those_of_the_surface_at_every_sample_and_element():
    """To 1 % of the echo, which blades change by 31 %: the sum over the surface for each antenna,
    with the elements' pattern, at every 64th sample. Planted bugs: the phase of `columns` with the
    other sign; `rate` left out; squares at the time since the epoch; `left` without what the first
    end took; without `pattern`; the far end's distance as the radius; `left.std()` without the
    mean."""
    setup = prepared(UP)
    frame = setup.frame(1)
    echo, pose, w = frame.paths[OWN], frame.poses["radar"], setup.waveform
    (row,) = np.flatnonzero(echo.kind == PathKind.TARGET)
    echo = echo.select(np.array([row]))
    waves = list(setup.moving_centres._over_blades(echo, frame.poses, 0.0, 0.0))
    found = samples_of(setup, frame, merge([echo, *waves])) / samples_of(setup, frame, echo)
    axes, antennas = body_axes(setup.swarm, "radar", echo.epoch), setup.arrays.of("radar")
    tx, rx = (
        pose.position + pose.to_world(r) for r in (antennas.tx_positions, antennas.rx_positions)
    )
    gain, sent, q = antennas.element_gain, frame.sent["radar"], frame.poses["T"]
    picked = np.arange(0, w.num_samples, 64)
    truth = np.ones((len(rx), w.num_chirps, picked.size), complex)
    for p, (i, sample) in ((p, x) for p in range(w.num_chirps) for x in enumerate(picked)):
        u = w.fast_time[sample]
        t = setup.timetable.start_time(1) + p * w.slot_duration + u
        uav = q.position + (t - echo.epoch) * q.velocity
        spot, normal, area = surface(setup.swarm.uavs["radar"].rotors, t)
        away = pose.to_body(spot @ axes.T / np.linalg.norm(spot, axis=1)[:, None])
        pattern = np.sqrt(gain(away) / gain(pose.to_body(echo.departure)))
        blades = pose.position + spot @ axes.T, normal @ axes.T, area * pattern

        def left(element, tau, u=u, uav=uav, blades=blades):
            length = SPEED_OF_LIGHT / (w.carrier_frequency + w.slope * u)
            weight, longer = kirchhoff(blades, element, uav, length)
            phase = w.phase(tau + longer / SPEED_OF_LIGHT, u) - w.phase(tau, u)
            return 1 + 1j * (weight * np.exp(2j * np.pi * phase)).sum()

        antenna = tx[sent.schedule[0, p]]
        for r, element in enumerate(rx):
            tau = sum(np.linalg.norm(uav - end) for end in (antenna, element)) / SPEED_OF_LIGHT
            truth[r, p, i] = left(antenna, tau) * left(element, tau)
    error = np.sqrt((np.abs(found[0][..., picked] - truth) ** 2).mean())
    assert np.sqrt((np.abs(truth - 1) ** 2).mean()) > 0.3
    assert error < 0.01
    rows = setup.moving_centres.report({OWN: echo}, frame.poses, {OWN: 1.0})
    (row,) = [row for row in rows if row["what"] == "opaque blades before the arrays"]
    assert row["estimate"] / 10 < error < row["estimate"]
    lines = 20 * np.log10(truth[0].mean(axis=1).std() / np.abs(truth[0].mean()))
    assert row["modelled"] == f"lines of {lines:.0f} dB on the strongest path"


def test_wires_hide_nothing_and_blades_no_leakage():
    """Without a chord no path changes; with one the leakage stays. Planted bugs: wires among the
    screens; leakage behind the blades."""
    for chord, kinds in ((None, set()), (0.015, {PathKind.TARGET})):
        setup = prepared(UP, chord_m=chord)
        frame = setup.frame(0)
        paths = frame.paths[OWN]
        found = setup.moving_centres.with_centres(paths, frame.poses, paths.epoch)
        for name, column in paths.arrays().items():
            kept = getattr(found, name)[: len(paths)]
            assert np.array_equal(kept[:, : column.shape[1]] if column.ndim > 1 else kept, column)
        leak = replace(
            paths.select(paths.kind == PathKind.TARGET), kind=np.array([PathKind.LEAKAGE])
        )
        waves = setup.moving_centres._over_blades(merge([paths, leak]), frame.poses, 0.0, 0.0)
        assert {PathKind(k) for part in waves for k in part.kind} == kinds


def test_centres_of_a_target_pass_the_blades_of_the_radar():
    """A vehicle's centres have the factor of its own path, slot by slot. Planted bug: `passed`
    left out of `faded`."""
    vehicle = {"extent": {"kind": "vehicle"}, "rcs": {"model": "constant"}}
    still = {"position_m": UP["position_m"], "velocity_mps": [0.0, 0.1, 0.0]}
    sets = []
    for chord in (None, 0.015):
        setup = prepared(vehicle | still, chord_m=chord)
        frame = setup.frame(0)
        paths = frame.paths[OWN].select(frame.paths[OWN].kind == PathKind.TARGET)
        found = setup.moving_centres.with_centres(paths, frame.poses, paths.epoch)
        sets.append(found.select(found.target == 1))
    _, time = pieces(setup.waveform, 1, 0.0)
    left = setup.moving_centres.passed(paths, time)
    whole, behind = sets
    assert len(whole) == 5
    assert np.ptp(np.abs(left)) > 0.1
    ratio = behind.gain.reshape(time.size, 5) / whole.gain
    assert ratio == pytest.approx(np.repeat(left[:, None], 5, axis=1), rel=1e-3)


def test_blades_of_a_passive_terminal_hide_the_others_from_it():
    """What it receives changes at its end alone, by the blades' share. Planted bug: the direction
    of departure at both ends."""
    at, flight = np.array([0.0, 0.0, 9.0]), {"position_m": (8.0, 3.0, 4.0)}
    four = {"number": 4, "rev_per_min": (1e-6, -1e-6) * 2, "phase_deg": (20.0, 75.0) * 2}
    blades = OPAQUE.model_copy(update=four)
    swarm = {
        "AT": {"role": "active", "position_m": tuple(at), "boresight": [1, 0.3, -0.3]},
        "PT": {"role": "passive", "boresight": [-0.9, 0.4, 0.5], "rotors": blades.model_dump()}
        | flight,
    }
    setup = irt.prepare(Scenario.model_validate({"frames": 5, "swarm": swarm}))
    frame = setup.frame(0)
    paths = frame.paths["AT", "PT"]
    sight = paths.select(paths.kind == PathKind.LINE_OF_SIGHT)
    (waves,) = setup.moving_centres._over_blades(sight, frame.poses, 0.0, 0.0)
    axes = body_axes(setup.swarm, "PT", sight.epoch)
    spot, normal, area = surface(blades, 0.0)
    k, there = dict(setup.moving_centres.models)["PT"].wave_number, at - flight["position_m"]
    placed = spot @ axes.T, normal @ axes.T, area
    weight, longer = kirchhoff(placed, np.zeros(3), there, 2 * np.pi / k)
    truth = 1j * (weight * np.exp(-1j * k * longer)).sum()
    first = waves.select(waves.begin == waves.begin.min())
    excess = (first.delay - sight.delay) * SPEED_OF_LIGHT
    share = -(first.gain / sight.gain * np.exp(-1j * k * excess)).sum()
    assert abs(truth) > 0.1
    assert abs(share - truth) < 0.02 * abs(truth)  # by the elements' pattern
    assert (waves.departure == sight.departure).all()
    assert (waves.tx_radius == sight.tx_radius).all()
    assert waves.rx_radius.max() < 0.4
