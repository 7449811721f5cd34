r"""Existence of a track's target.

A track follows a target, which is found in a frame with the probability :math:`p_D`, or an
artefact: an echo over walls that nothing explains, a spot of a surface that the mesh lacks, noise.
An artefact is found again in a share :math:`p_A` of the frames. By Bayes the logarithm of the odds
grows by

.. math:: \ln\frac{p_D}{p_A} \text{ if the frame shows it}, \qquad
    \ln\frac{1 - p_D}{1 - p_A} \text{ if not},

and by :math:`\ln(p_A p_C)` more, where that is less than 0 and the frame shows what a known
artefact must show, as a target's echo over a wall: :math:`p_C` is the density of targets there over
that of the artefact's measures. This is the recursion of Musicki, Evans and Stankovic [1]_ with
artefacts in place of uniform clutter. The track's own record of n detections in N frames says
:math:`p_D = (n + 1) / (N + 2)` (Laplace's rule of succession).

References
----------
.. [1] D. Musicki, R. Evans and S. Stankovic, "Integrated probabilistic data association", IEEE
   Trans. Automatic Control 39(6), 1994, doi:10.1109/9.293185
"""

from __future__ import annotations

from math import log

BIRTH = log(1 / 6)
"""Log-odds of a first detection: of those that no rule refuses at an active terminal one of seven
is of a new target. At a passive one fewer are, but waiting loses more targets than it saves."""
RECURS = 0.1
"""p_A: share of the frames in which an artefact is found where its track expects it."""
SURE = log(200)
"""Most that a record says: a target may leave or hide."""
LEAST_RATIO = 0.2
"""p_C at the least: a mesh, or a track that is taken for a source, may be wrong."""


def updated(
    odds: float, hit: bool, hits: int, frames: int, most: float = 1.0, recurs: float = RECURS
) -> float:
    """Return log-odds after a frame, by `hits` in the `frames` before it: p_D is at `most` so much,
    and p_A `recurs`."""
    found = most * (hits + 1) / (frames + 2)
    said = log(found / recurs) if hit else log((1 - found) / (1 - recurs))
    return min(odds + said, SURE)


def explained(ratio: float) -> float:
    """Return what a detection says less if a known artefact explains it, with the `ratio` p_C."""
    return log(RECURS * max(ratio, LEAST_RATIO))
