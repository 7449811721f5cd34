"""The city as a Sionna RT scene of our own making: one shape per material, so that every hit maps
back to a face of the float64 mesh.

Import only after `isac_rt.runtime.activate()`: Sionna and Mitsuba start the JIT.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import sionna.rt as rt
from numpy.typing import NDArray

from isac_rt.world.city.materials import Material
from isac_rt.world.city.mesh import CityMesh

NO_FACE = -1


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


_latest: tuple[weakref.ref[CityMesh], float, SceneHandle] | None = None


def shared_scene(city: CityMesh, carrier_frequency: float) -> SceneHandle:
    """As `build_scene`, but the one built last is handed out again for the same city object, to
    tracers that place and clear away their own terminals: compilation is paid once in a worker that
    runs many points of a sweep."""
    global _latest
    if _latest is None or _latest[0]() is not city or _latest[1] != carrier_frequency:
        _latest = weakref.ref(city), carrier_frequency, build_scene(city, carrier_frequency)
    return _latest[2]


def build_scene(city: CityMesh, carrier_frequency: float) -> SceneHandle:
    """Sionna scene of a city, new.

    Materials carry their constants at the carrier, so that none can be undefined there; they are
    set before the frequency.
    """
    scene = rt.load_scene()
    shapes, faces = [], []
    for index, material in enumerate(city.materials):
        chosen = np.flatnonzero(city.face_material == index)
        if chosen.size:
            name = f"surface-{index}"
            shapes.append(
                rt.SceneObject(
                    mi_mesh=_shape(city, chosen, name),
                    name=name,
                    radio_material=_radio(material, name),
                )
            )
            faces.append(chosen)
    if shapes:
        scene.edit(add=shapes)
    scene.frequency = carrier_frequency
    numbers = [int(np.asarray(shape.object_id).ravel()[0]) for shape in shapes]
    return SceneHandle(scene, dict(zip(numbers, faces, strict=True)))


def _shape(city: CityMesh, chosen: NDArray[np.int64], name: str) -> mi.Mesh:
    used, faces = np.unique(city.faces[chosen], return_inverse=True)
    mesh = mi.Mesh(name, used.size, chosen.size)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = city.vertices[used].astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def _radio(material: Material, name: str) -> rt.RadioMaterial:
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
