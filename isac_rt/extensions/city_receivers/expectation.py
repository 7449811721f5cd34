"""The clutter that a terminal predicts from its own copy of the mesh.

Its surfaces are cut as finely as the scenario's field, its points are its own. What an active
terminal expects of its own link is cut finer near by (`NEAR`) and merged where noise covers it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from isac_rt import runtime
from isac_rt.extensions.two_bounces.two_bounces import TwoBounces
from isac_rt.frame.antennas import Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.clutter.cells import Density
from isac_rt.propagation.clutter.field import ClutterField, Visible
from isac_rt.propagation.clutter.merging import NoiseFloor
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.propagation.settings import Clutter
from isac_rt.randomness import seed_sequence
from isac_rt.receive.types import ExpectedClutter
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose, Swarm

NEAR = 40.0
"""Distance [m] from an active terminal's flight within which what it expects of its own link is cut
finer. Its scatterers are a draw of a wall's directions, the true ones are another: what is 10 to 25
dB over the noise is whitened only where the draw is dense."""


class MeshExpectation:
    """Expected clutter along the flights of one run, by the receivers' copy of the mesh; starts the
    JIT back end.

    Parameters
    ----------
    floor : of the active terminals' own links; None: nothing is merged
    level_db : error of the expected level
    """

    def __init__(
        self,
        clutter: Clutter,
        swarm: Swarm,
        city: CityMesh,
        waveform: Waveform,
        arrays: Arrays,
        seed: int,
        floor: NoiseFloor | None = None,
        level_db: float = 0.0,
    ) -> None:
        runtime.activate()
        from isac_rt.world.city.scene import shared_scenes

        scene = shared_scenes(city, waveform.carrier_frequency).faces
        own = int(seed_sequence(seed, "expected clutter").generate_state(1)[0])
        about = city, scene, waveform.wavelength, own
        density = Density.of(clutter)
        self._field = ClutterField.plan(density, swarm, *about)
        senders = {name: swarm.uavs[name] for name in swarm.transmitters}
        alone = replace(swarm, uavs=senders)
        self._own = ClutterField.plan(replace(density, near=NEAR), alone, *about, floor)
        self._two_bounces = (
            TwoBounces.plan(self._field, city, waveform.wavelength, own, clutter.mirrors)
            if clutter.mirrors
            else None
        )
        self._city, self._arrays = city, arrays
        self._level = 10 ** (level_db / 20)  # factor of all amplitudes

    def clutter(self, name: str, pose: Pose, time: float, amplitude: float) -> ExpectedClutter:
        """Return the clutter of the terminal's own link at a time, from where it believes to be.

        Parameters
        ----------
        name : of the terminal
        pose : in world coordinates
        amplitude : sqrt(transmit power of one antenna) [sqrt(W)]
        """
        local = self._local(pose)
        amplitude *= self._level
        state = LinkState(Link(name, name), time, local, local)
        mirrored = [] if self._two_bounces is None else self._two_bounces.seen(state)
        parts = [self._own.seen(state), *(part.seen for part in mirrored)]
        return ExpectedClutter.joined(
            [_expected(s, amplitude * state.elements(self._arrays, s), local) for s in parts]
        )

    def _local(self, pose: Pose) -> Pose:
        """A pose in the axes of the city's mesh."""
        return replace(pose, position=pose.position - self._city.origin)

    def between(
        self, link: Link, amplitude: float, sender: np.ndarray, own: Pose
    ) -> ExpectedClutter:
        """Return the mesh's clutter at a passive terminal, by one bounce and by way of mirrors.

        Parameters
        ----------
        link : of the terminal
        amplitude : sqrt(transmit power of one antenna) [sqrt(W)]
        sender : (6,) position and velocity of the transmitter in world coordinates, as the terminal
            has them. Its attitude it does not know: each element sends as on boresight
        own : pose of the terminal in world coordinates

        Returns
        -------
        clutter : departures in the axes of the terminal's own body
        """
        end = self._local(own)
        place, velocity = sender[:3] - self._city.origin, sender[3:]
        start = replace(end, position=place, velocity=velocity, acceleration=np.zeros(3))
        state = LinkState(link, 0.0, start, end)
        mirrored = [] if self._two_bounces is None else self._two_bounces.from_places(state)
        parts = []
        for seen in [self._field.from_places(state), *(part.seen for part in mirrored)]:
            tx, rx = (self._arrays.of(name) for name in link)
            received = rx.element_gain(end.to_body(seen.arrival))
            gain = self._level * np.sqrt(tx.gain * received)
            parts.append(_expected(seen, amplitude * gain, end))
        return ExpectedClutter.joined(parts)


def _expected(seen: Visible, amplitude: np.ndarray, axes: Pose) -> ExpectedClutter:
    """Clutter of scatterers (K,) with amplitudes (K,) where antennas were isotropic, directions in
    the body's axes of a pose."""
    power = (amplitude * seen.magnitude) ** 2
    some = power > 0
    return ExpectedClutter(
        seen.length[some] / SPEED_OF_LIGHT,
        seen.rate[some] / SPEED_OF_LIGHT,
        power[some],
        axes.to_body(seen.departure)[some],
        axes.to_body(seen.arrival)[some],
    )
