"""Diffraction factors against integrals that share no code with them, and shadow edges of a traced
scene."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special
from scipy.integrate import quad

from isac_rt.propagation.segments.diffraction import (
    LIT_REACH,
    SHADOW_REACH,
    disc,
    edge_factor,
    knife_edge,
)
from isac_rt.propagation.segments.discs import UavDiscs

LAMBDA = 299_792_458.0 / 77e9


def test_knife_edge_is_the_complementary_error_function():
    """F(nu) = erfc(nu sqrt(j pi / 2)) / 2, another form of the same integral; rounding. One half at
    the edge; the power in the shadow falls as 1/(2 pi^2 nu^2) and its loss is P.526's
    approximation, 6.9 + 20 log(sqrt((nu - 0.1)^2 + 1) + nu - 0.1) dB (eq. 31, stated for nu >
    -0.78; it is good to 0.3 dB there). Planted bug: the conjugate, as under exp(+jkd)."""
    nu = np.linspace(-8.3, 9.1, 517)
    exact = special.erfc(nu * np.sqrt(0.5j * np.pi)) / 2
    assert np.abs(knife_edge(nu) - exact).max() < 1e-13
    assert knife_edge(np.array(0.0)) == pytest.approx(0.5, rel=1e-15, abs=0)
    deep = np.array([11.3, 17.9])
    assert np.abs(knife_edge(deep)) ** 2 * 2 * np.pi**2 * deep**2 == pytest.approx(
        1.0, rel=1e-3, abs=0
    )
    shadow = nu[nu > -0.7]
    loss = 6.9 + 20 * np.log10(np.sqrt((shadow - 0.1) ** 2 + 1) + shadow - 0.1)
    assert np.abs(-20 * np.log10(np.abs(knife_edge(shadow))) - loss).max() < 0.3


def chopped(nu: float, radius: float) -> complex:
    """The disc's factor by cutting it into strips across the path: 1 - j/2 of the integral of
    exp(-j pi r^2 / 2) over its area."""

    def strip(y: float) -> complex:
        half = np.sqrt(max(radius**2 - y**2, 0.0))
        s, c = special.fresnel(np.array([nu - half, nu + half]))
        return np.exp(-0.5j * np.pi * y**2) * ((c[1] - c[0]) - 1j * (s[1] - s[0]))

    parts = [
        quad(lambda y, f=f: f(strip(y)), -radius, radius, epsabs=1e-9, limit=400)[0]
        for f in (np.real, np.imag)
    ]
    return 1 - 0.5j * complex(*parts)


@pytest.mark.parametrize(
    ("nu", "radius"),
    [(0.0, 1.13), (0.71, 0.43), (1.37, 2.91), (2.91, 2.9), (5.3, 3.7), (0.2, 0.05)],
)
def test_disc_against_strips(nu, radius):
    """Within, across the rim and outside of the shadow; the quadrature's 1e-8. Planted bug: alpha
    nu cos(phi) left out of the weight."""
    assert abs(disc(np.array([nu]), np.array([radius]))[0] - chopped(nu, radius)) < 1e-7


def test_disc_has_poissons_spot_and_a_large_one_is_an_edge():
    """On the axis exp(-j pi alpha^2/2), exact. The rim of a disc of 60 units is straight over the
    few units that matter, up to the share sqrt(1 - d/alpha) (4 % at 5 units) by which its wave is
    focused."""
    radius = np.array([0.31, 1.7, 4.4])
    assert np.abs(disc(np.zeros(3), radius) - np.exp(-0.5j * np.pi * radius**2)).max() < 1e-12
    off = np.linspace(-4.7, 4.7, 41)
    assert np.abs(disc(60.0 + off, np.full(41, 60.0)) - knife_edge(-off)).max() < 0.05


def test_bodies_shade_every_straight_part_that_passes_them():
    """Chains of three parts among bodies of all sizes and distances: the product of the discs over
    bodies and parts, each found by plain vectors, the Fresnel unit from the whole path's lengths to
    both ends. Planted bugs: paths passed over that are in reach; lengths counted from the part's
    begin; a part's end for the path's."""
    rng = np.random.default_rng(9)
    names, places = tuple("abcdefgh"), rng.uniform(-14, 14, (8, 3))
    radii = rng.uniform(0.1, 0.9, 8)
    chains = rng.uniform(-20, 20, (300, 4, 3))
    chains[:, 1:3] = places[rng.integers(0, 8, (300, 2))] + rng.normal(0, 2.5, (300, 2, 3))
    discs = UavDiscs(names, places, radii)
    found = discs.factor(chains, LAMBDA, discs.spared([("c",)]))
    truth, shaded = np.ones(300, complex), 0
    for i, chain in enumerate(chains):
        parts = np.linalg.norm(np.diff(chain, axis=0), axis=1)
        for k, length in enumerate(parts):
            u = (chain[k + 1] - chain[k]) / length
            for name, place, radius in zip(names, places, radii, strict=True):
                along = (place - chain[k]) @ u
                if name == "c" or not 0 < along < length:
                    continue
                off = np.linalg.norm(place - chain[k] - along * u)
                before = max(parts[:k].sum() + along, radius)
                after = max(parts.sum() - parts[:k].sum() - along, radius)
                unit = np.sqrt(LAMBDA * before * after / (2 * (before + after)))
                if (off - radius) / unit < LIT_REACH:
                    x = np.clip(2 * (off - radius) / unit / LIT_REACH - 1, 0, 1)
                    truth[i] *= 1 + (
                        disc(np.array([off / unit]), np.array([radius / unit]))[0] - 1
                    ) * (1 - x * x * (3 - 2 * x))
                    shaded += 1
    assert shaded > 150 and (np.abs(truth) < 0.9).sum() > 30
    assert np.abs(found - truth).max() < 1e-6  # the discs' quadrature


def test_edge_factor_has_no_step():
    """From 1 on the lit side to nothing in the shadow; its slope is bounded by the closed form's,
    |dF/dnu| = 1/sqrt(2), and the tapers'. Planted bug: a taper in straight lines."""
    nu = np.linspace(-LIT_REACH - 1, SHADOW_REACH + 1, 20_001)
    f = edge_factor(nu)
    assert np.array_equal(f[nu < -LIT_REACH], np.ones((nu < -LIT_REACH).sum()))
    assert not f[nu > SHADOW_REACH].any()
    middle = (nu > -LIT_REACH / 2) & (nu < SHADOW_REACH * 0.75)
    assert np.abs(f - special.erfc(nu * np.sqrt(0.5j * np.pi)) / 2)[middle].max() < 1e-13
    slope = np.abs(np.diff(f)) / (nu[1] - nu[0])
    assert slope.max() < 1 / np.sqrt(2) + 0.05
    assert np.abs(np.diff(slope)).max() < 0.02
