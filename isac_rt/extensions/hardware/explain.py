"""Share of a measured cube that the simulated one of the same scene explains, with and without each
part of the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from isac_rt.extensions.hardware.calibrate import PARTS, Calibration, board, near_spectra
from isac_rt.extensions.hardware.types import Capture, CaptureError
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference, Transmission
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Exact
from isac_rt.world.swarm import Pose, attitude


def simulated(cube: IFCube, antennas: Antennas, distance: float) -> IFCube:
    """The cube of an ideal board with one point on its boresight, by the program's own synthesis
    (`Exact`): element by element, with spherical waves.

    Parameters
    ----------
    cube : whose waveform and schedule it has
    distance : of the point [m]
    """
    w, still = cube.waveform, np.zeros(3)
    pose = Pose(still, still, still, attitude(np.array([0.0, 1.0, 0.0])))
    sender = Transmission(
        name="board",
        pose=pose,
        antennas=antennas,
        schedule=cube.schedule,
        payload=unmodulated(w),
    )
    forward = np.array([[0.0, 1.0, 0.0]])
    point = make_paths(
        gain=np.ones(1),
        delay=np.array([2 * distance / SPEED_OF_LIGHT]),
        departure=forward,
        arrival=forward,
        tx_radius=np.array([distance]),
        rx_radius=np.array([distance]),
        kind=PathKind.TARGET,
        epoch=w.frame_duration / 2,
        tx="board",
        rx="board",
    )
    receiver = ReceiveArray(pose, antennas)
    return if_signal(w, [(sender, point)], receiver, Reference(0.0), Exact())


def unexplained_by(
    capture: Capture, calibration: Calibration, parts: Sequence[Sequence[str]]
) -> list[float]:
    """Power of the reflector's cells that the simulated cube leaves, over the power there [dB], for
    each set of `PARTS` of the board; one complex level is fitted for all channels.

    Raises
    ------
    CaptureError  If the positions of the elements are unknown.
    """
    if capture.antennas is None:
        raise CaptureError(
            "the positions of the elements are unknown, so the scene cannot be simulated; state "
            "elements in the description"
        )
    cube = capture.cube
    ideal = simulated(cube, capture.antennas, calibration.range_m)
    cell = calibration.range_m / cube.waveform.range_cell(2)
    truth = near_spectra(capture, cell)
    out = []
    for chosen in parts:
        samples = ideal.samples * board(calibration, cube, chosen)
        ours = near_spectra(replace(capture, cube=replace(cube, samples=samples)), cell)
        level = np.vdot(ours, truth) / np.vdot(ours, ours)
        left = truth - level * ours
        out.append(10 * float(np.log10((np.vdot(left, left) / np.vdot(truth, truth)).real)))
    return out


STEPS: dict[str, tuple[str, ...]] = {
    "ideal": (),
    "gains": PARTS[:1],
    "gains and delays": PARTS[:2],
    "gains, delays and response": PARTS[:3],
    "all": PARTS,
    **{f"all but {part}": tuple(p for p in PARTS[:3] if p != part) for part in PARTS[:3]},
}
"""Sets of parts that a table shows; the pairs stay out of those that leave a part out."""
