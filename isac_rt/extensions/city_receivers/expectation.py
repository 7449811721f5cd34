"""The clutter that a terminal predicts from its own copy of the mesh. Import only after
`isac_rt.runtime.activate()`.

Its surfaces are cut as finely as the scenario's field, its points are its own. What an active
terminal expects of its own link is cut finer near by (`NEAR`) and merged where noise covers it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from isac_rt.extensions.two_bounces.two_bounces import SeenByMirror, TwoBounces
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.clutter.cells import Density
from isac_rt.propagation.clutter.field import ClutterField, Seen
from isac_rt.propagation.clutter.merging import NoiseFloor
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.propagation.settings import Clutter
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive.types import ExpectedClutter
from isac_rt.track.expectation import ClutterExpectation, Mistakes
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import mirror_image
from isac_rt.world.swarm import Pose, Swarm

NEAR = 40.0
"""Distance [m] from an active terminal's flight within which what it expects of its own link is cut
finer. Its scatterers are a draw of a wall's directions, the true ones are another: what is 10 to 25
dB over the noise is whitened only where the draw is dense."""


class MeshExpectation:
    """Expected clutter along the flights of one run."""

    def __init__(
        self,
        clutter: Clutter,
        swarm: Swarm,
        city: CityMesh,
        scene: mi.Scene,
        antennas: Antennas,
        wavelength: float,
        seed: int,
        floor: NoiseFloor | None = None,
    ) -> None:
        own = int(seed_sequence(seed, "expected clutter").generate_state(1)[0])
        about = city, scene, wavelength, own
        density = Density.of(clutter)
        self._field = ClutterField.plan(density, swarm, *about)
        senders = {name: swarm.uavs[name] for name in swarm.transmitters}
        alone = replace(swarm, uavs=senders)
        self._own = ClutterField.plan(replace(density, near=NEAR), alone, *about, floor)
        self._two_bounces = (
            TwoBounces.plan(self._field, city, wavelength, own, clutter.mirrors)
            if clutter.mirrors
            else None
        )
        self._city, self._antennas = city, antennas

    def __len__(self) -> int:
        return len(self._field.cells)

    def clutter(
        self, name: str, pose: Pose, time: float, amplitude: float, mistakes: Mistakes | None = None
    ) -> ExpectedClutter:
        """Return the clutter of the terminal's own link at a time, from where it believes to be.

        Parameters
        ----------
        name : of the terminal
        pose : in world coordinates
        amplitude : sqrt(transmit power of one antenna) [sqrt(W)]
        """
        wrong = mistakes or Mistakes()
        local = self._believed(pose, wrong)
        amplitude = amplitude * 10 ** (wrong.level_db / 20)
        error = self._errors(wrong)
        state = LinkState(Link(name, name), time, local, local)
        mirrored = [] if self._two_bounces is None else self._two_bounces.seen(state)
        own = self._own.of(state.link).cells
        return ExpectedClutter.joined(
            [
                self._expected(
                    part, error, amplitude * state.elements(self._antennas, part.seen), local
                )
                for part in self._paths(self._own.seen(state), own.face, mirrored, error)
            ]
        )

    def _believed(self, pose: Pose, wrong: Mistakes) -> Pose:
        """A pose in the axes of the city's mesh, with the velocity that the terminal believes."""
        return replace(
            pose,
            position=pose.position - self._city.origin,
            velocity=pose.velocity + np.array(wrong.velocity),
        )

    def _errors(self, wrong: Mistakes) -> np.ndarray | None:
        """Return the error of each face along its normal [m]; None where the mesh is right."""
        if not wrong.mesh_std:
            return None
        drawn = generator(wrong.seed, "mesh error").standard_normal(self._city.num_faces)
        return wrong.mesh_std * drawn

    def between(
        self,
        link: Link,
        amplitude: float,
        sender: np.ndarray,
        own: Pose,
        mistakes: Mistakes | None = None,
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
        wrong = mistakes or Mistakes()
        end = self._believed(own, wrong)
        amplitude = amplitude * 10 ** (wrong.level_db / 20)
        place, velocity = sender[:3] - self._city.origin, sender[3:]
        start = replace(end, position=place, velocity=velocity, acceleration=np.zeros(3))
        state, error = LinkState(link, 0.0, start, end), self._errors(wrong)
        mirrored = [] if self._two_bounces is None else self._two_bounces.from_places(state)
        parts = []
        once, every = self._field.from_places(state), self._field.cells
        for part in self._paths(once, every.face, mirrored, error):
            received = self._antennas.element_gain(end.to_body(part.seen.arrival))
            gain = np.sqrt(self._antennas.gain * received)
            parts.append(self._expected(part, error, amplitude * gain, end))
        return ExpectedClutter.joined(parts)

    def _paths(
        self,
        once: Seen,
        face: np.ndarray,
        mirrored: Sequence[SeenByMirror],
        error: np.ndarray | None,
    ) -> Iterator[_Path]:
        """Ways of one bounce by cells on faces (N,), and by way of mirrors, whose faces are in
        error along their normals."""
        yield _Path(once, face[once.index], once.departure, once.arrival)
        for part in mirrored:
            n, s = part.mirror.normal, part.seen
            met = s.departure if part.before else s.arrival
            turned = mirror_image(met, n)  # the way from the mirror to the scatterer
            there, back = (turned, s.arrival) if part.before else (s.departure, turned)
            moved = 0.0 if error is None else 2 * error[part.mirror.faces[0]] * (met @ n)
            yield _Path(s, self._field.cells.face[s.index], there, back, moved)

    def _expected(
        self, part: _Path, error: np.ndarray | None, amplitude: np.ndarray, axes: Pose
    ) -> ExpectedClutter:
        """Clutter of amplitudes (K,) where antennas were isotropic, on faces that are each in
        error; directions in the body's axes of a pose."""
        seen = part.seen
        length = seen.length + part.moved
        if error is not None:
            slopes = (self._city.normals[part.face] * (part.there + part.back)).sum(axis=1)
            length += error[part.face] * slopes
        power = (amplitude * seen.magnitude) ** 2
        some = power > 0
        return ExpectedClutter(
            length[some] / SPEED_OF_LIGHT,
            seen.rate[some] / SPEED_OF_LIGHT,
            power[some],
            axes.to_body(seen.departure)[some],
            axes.to_body(seen.arrival)[some],
        )


class _Path(NamedTuple):
    """Paths over K scatterers on faces (K,): unit vectors (K, 3) at which both segments meet them,
    and the error of their length where a mirror is in error [m]."""

    seen: Seen
    face: np.ndarray
    there: np.ndarray
    back: np.ndarray
    moved: np.ndarray | float = 0.0


def make_expectation(
    clutter: Clutter,
    swarm: Swarm,
    city: CityMesh,
    waveform: Waveform,
    antennas: Antennas,
    seed: int,
    floor: NoiseFloor | None = None,
) -> ClutterExpectation:
    """The receivers' copy of the mesh; starts the JIT back end. `floor`: of the active terminals'
    own links; None: nothing is merged."""
    from isac_rt import runtime

    runtime.activate()
    from isac_rt.world.city.scene import shared_scenes

    scene = shared_scenes(city, waveform.carrier_frequency).faces
    return MeshExpectation(clutter, swarm, city, scene, antennas, waveform.wavelength, seed, floor)
