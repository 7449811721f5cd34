"""The city: where its mesh comes from, what it is made of, and its ray-traced twin
(`isac_rt.world.city.scene`, which needs Sionna)."""

from isac_rt.world.city.materials import CityError, Material
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.city.sources import city_files, load_city

__all__ = ["CityError", "CityMesh", "Material", "city_files", "load_city"]
