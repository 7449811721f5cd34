"""The kernel of the views against its numpy twin, on generic numbers."""

from __future__ import annotations

import numpy as np
from twins import assert_twins_agree

from isac_rt.views import render


def test_triangles_in_a_depth_buffer():
    """Triangles that overlap, lie across the edges and beside the picture, and one without area.
    Planted bugs: the farther one drawn; a pixel more at the right edge of the box. Same arithmetic
    but for fused products: 1e-12."""
    rng = np.random.default_rng(7)
    corners = rng.uniform(-9.3, 41.7, (60, 1, 3)) + rng.normal(0, 7.1, (60, 3, 3))
    corners[..., 2] = rng.uniform(2.1, 90.7, (60, 3))
    corners[5, 2] = corners[5, 1]
    depth, face = np.full((29, 37), 80.3), np.full((29, 37), -1, np.int32)
    assert_twins_agree(f"{render.__name__}.rasterise", corners, depth, face, rtol=1e-12)
