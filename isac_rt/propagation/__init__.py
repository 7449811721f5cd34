"""Propagation: poses in, path sets out."""

from isac_rt.propagation.build import make_propagation
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.model import Census, Propagation, Traced
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths, merge

__all__ = [
    "Census",
    "FreeSpace",
    "PathKind",
    "PathSet",
    "Propagation",
    "Traced",
    "make_paths",
    "make_propagation",
    "merge",
]
