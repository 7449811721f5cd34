"""The city as scenes of our own making, one shape per material: of faces alone for rays that ask
what stands in their way, and with materials for Sionna RT, where every hit maps back to a face of
the float64 mesh.

Sionna RT takes longer to import than a frame to make, and runs that find their chains of walls in
the store solve nothing: it is loaded by whoever asks for its scene.

Import only after `isac_rt.runtime.activate()`: Sionna and Mitsuba start the JIT.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from isac_rt.world.city.materials import Material
from isac_rt.world.city.mesh import CityMesh

if TYPE_CHECKING:
    import sionna.rt as rt

NO_FACE = -1


def with_room(values: NDArray) -> NDArray:
    """Return values (N,) with room behind them: Embree, and Dr.Jit on CPUs, read arrays where they
    lie, up to 16 numbers at once, and reading past the end of memory ends the program."""
    return np.pad(values, (0, 16))[: len(values)]


@dataclass(frozen=True)
class SceneHandle:
    """A scene and the way back from its hits.

    Attributes
    ----------
    scene : sionna.rt.Scene at the carrier
    faces_of_object : for each object id the faces of the mesh that it holds, in the order of its
        primitives
    """

    scene: rt.Scene
    faces_of_object: dict[int, NDArray[np.int64]]

    def face_index(self, objects: NDArray, primitives: NDArray) -> NDArray[np.int64]:
        """Faces of the mesh for Sionna's object and primitive numbers (any shape); -1 where there
        was no hit.

        Of surfaces only: at a SENSING interaction Sionna stores a target's index in place of an
        object number.
        """
        out = np.full(objects.shape, NO_FACE, np.int64)
        for number, faces in self.faces_of_object.items():
            here = objects == number
            out[here] = faces[primitives[here]]
        return out


@dataclass(frozen=True)
class CityScenes:
    """The scenes of a city, each made when it is first asked for."""

    city: CityMesh
    carrier_frequency: float

    @cached_property
    def faces(self) -> mi.Scene:
        """The faces without materials, for shadow rays."""
        chosen = _by_material(self.city)
        shapes = {f"surface-{i}": _shape(self.city, f, f"surface-{i}") for i, f in chosen.items()}
        return mi.load_dict({"type": "scene", **shapes})

    @cached_property
    def solved(self) -> SceneHandle:
        """Sionna's, in which rays find chains of walls."""
        return build_scene(self.city, self.carrier_frequency)


_latest: CityScenes | None = None


def shared_scenes(city: CityMesh, carrier_frequency: float) -> CityScenes:
    """The scenes of a city; those made last are handed out again for the same city object, to
    tracers that place and clear away their own terminals: compilation is paid once in a worker that
    runs many points of a sweep."""
    global _latest
    found = _latest
    if found is None or found.city is not city or found.carrier_frequency != carrier_frequency:
        found = _latest = CityScenes(city, carrier_frequency)
    return found


def build_scene(city: CityMesh, carrier_frequency: float) -> SceneHandle:
    """Sionna scene of a city, new.

    Materials carry their constants at the carrier, so that none can be undefined there; they are
    set before the frequency.
    """
    import sionna.rt as rt

    scene = rt.load_scene()
    shapes, faces = [], []
    for index, chosen in _by_material(city).items():
        name = f"surface-{index}"
        mesh, radio = _shape(city, chosen, name), _radio(city.materials[index], name)
        shapes.append(rt.SceneObject(mi_mesh=mesh, name=name, radio_material=radio))
        faces.append(chosen)
    if shapes:
        scene.edit(add=shapes)
    scene.frequency = carrier_frequency
    numbers = [int(np.asarray(shape.object_id).ravel()[0]) for shape in shapes]
    return SceneHandle(scene, dict(zip(numbers, faces, strict=True)))


def _by_material(city: CityMesh) -> dict[int, NDArray[np.int64]]:
    """The faces of every material that has any."""
    found = {i: np.flatnonzero(city.face_material == i) for i in range(len(city.materials))}
    return {index: chosen for index, chosen in found.items() if chosen.size}


def _shape(city: CityMesh, chosen: NDArray[np.int64], name: str) -> mi.Mesh:
    used, faces = np.unique(city.faces[chosen], return_inverse=True)
    mesh = mi.Mesh(name, used.size, chosen.size)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = with_room(city.vertices[used].astype(np.float32).ravel())
    parameters["faces"] = with_room(faces.astype(np.uint32).ravel())
    parameters.update()
    return mesh


def _radio(material: Material, name: str) -> rt.RadioMaterial:
    import sionna.rt as rt

    pattern: dict[str, float] = {}
    if material.scattering_pattern != "lambertian":
        pattern["alpha_r"] = material.pattern_exponent
    if material.scattering_pattern == "backscattering":
        pattern |= {"alpha_i": material.pattern_exponent, "lambda_": 0.5}
    return rt.RadioMaterial(
        f"{name}-{material.name}",
        thickness=material.thickness,
        relative_permittivity=material.relative_permittivity,
        conductivity=material.conductivity,
        scattering_coefficient=material.scattering_coefficient,
        scattering_pattern=material.scattering_pattern,
        **pattern,
    )
