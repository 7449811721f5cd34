"""Triangles into a depth buffer."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit


@jit
def rasterise(corners, depth, face):
    """Depth buffer of triangles (F, 3, 3) in pixels and metres of depth; a pixel belongs to a
    triangle if its middle does."""
    height, width = depth.shape
    for f in range(corners.shape[0]):
        ax, ay, az = corners[f, 0]
        bx, by, bz = corners[f, 1]
        cx, cy, cz = corners[f, 2]
        # twice the signed area, and the pixels of the bounding box
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0:
            continue
        left, right = (
            max(int(np.ceil(min(ax, bx, cx) - 0.5)), 0),
            min(int(np.floor(max(ax, bx, cx) - 0.5)), width - 1),
        )
        low, high = (
            max(int(np.ceil(min(ay, by, cy) - 0.5)), 0),
            min(int(np.floor(max(ay, by, cy) - 0.5)), height - 1),
        )
        for row in range(low, high + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                # barycentric coordinates of the pixel's middle, then its depth
                x = column + 0.5
                b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
                c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
                if b < 0.0 or c < 0.0 or b + c > 1.0:
                    continue
                z = az + b * (bz - az) + c * (cz - az)
                if z < depth[row, column]:
                    depth[row, column] = z
                    face[row, column] = f
