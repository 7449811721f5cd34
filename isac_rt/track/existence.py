r"""Existence of a track's target.

A track follows a target, which is found in a frame with the probability :math:`p_D`, or an
artefact: an echo over walls that nothing explains, a spot of a surface that the mesh lacks, noise.
An artefact is found again in a share :math:`p_A` of the frames. By Bayes the logarithm of the odds
grows by

.. math:: \ln\frac{p_D}{p_A} \text{ if the frame shows it}, \qquad
    \ln\frac{1 - p_D}{1 - p_A} \text{ if not},

and by :math:`\ln(p_D p_C)` where the frame shows what a known artefact must show, as a target's
echo over a wall, and a target is there by chance with the probability :math:`p_C`. This is the
recursion of Musicki, Evans and Stankovic [1]_ with artefacts in place of uniform clutter. The
track's own record of n detections in N frames says :math:`p_D = (n + 1) / (N + 2)` (Laplace's rule
of succession).

References
----------
.. [1] D. Musicki, R. Evans and S. Stankovic, "Integrated probabilistic data association", IEEE
   Trans. Automatic Control 39(6), 1994, doi:10.1109/9.293185
"""

from __future__ import annotations

from math import log

BIRTH = log(1 / 6)
"""Log-odds of a first detection: of ten that no rule refuses, one or two are of a new target."""
RECURS = 0.1
"""p_A: share of the frames in which an artefact is found where its track expects it."""
EXPLAINED = log(RECURS * 0.2)
"""What a detection says less if a known artefact explains it: p_A p_C, with one frame in five in
which a target is there by chance."""
SURE = log(200)
"""Most that a record says: a target may leave or hide."""


def updated(
    odds: float, hit: bool, hits: int, frames: int, most: float = 1.0, recurs: float = RECURS
) -> float:
    """Return log-odds after a frame, by `hits` in the `frames` before it: p_D is at `most` so much,
    and p_A `recurs`."""
    found = most * (hits + 1) / (frames + 2)
    said = log(found / recurs) if hit else log((1 - found) / (1 - recurs))
    return min(odds + said, SURE)
