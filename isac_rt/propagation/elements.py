"""Element patterns of both ends, applied along every path's own directions: the one place where
antennas touch a gain."""

from __future__ import annotations

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.world.swarm import Pose


def element_amplitude(
    antennas: Antennas, tx: Pose, rx: Pose, departure: np.ndarray, arrival: np.ndarray
) -> np.ndarray:
    """(K,) sqrt(G_tx G_rx) towards world directions (K, 3)."""
    return np.sqrt(
        antennas.element_gain(tx.to_body(departure)) * antennas.element_gain(rx.to_body(arrival))
    )
