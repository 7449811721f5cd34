"""Data without a line of sight: paths found in data frames alone, and frames read late by them.

A passive terminal that cannot read a data frame keeps what is strongest in every chirp. Once a
batch of such frames, or a pilot among them, shows a path (`blind`), all of
the batch are read, and the frames that follow are read over that path as they come, as long as it
lasts. Any path carries the data. Whether it is the line of sight shows the frame itself, once its
data are out.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from isac_rt.extensions.city_receivers.blind import DataPath, Peaks, acquire, find_peaks, read_peaks
from isac_rt.extensions.city_receivers.ghosts import Leeway
from isac_rt.extensions.city_receivers.images import WELL_INSIDE, Ways
from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import folded
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.passive import PassiveReceiver
from isac_rt.receive.types import Detections, Hints, Prediction, Reception
from isac_rt.track.filter import measure
from isac_rt.track.parts import Late, OtherPaths, Ownship, delayed
from isac_rt.track.reference import COAST_CELLS, Reference, end_symbols, slip_cells
from isac_rt.track.tracker import in_plane

BATCH = 8
"""Frames kept at most."""
SPAN = 0.5
"""Age at which a frame is let go [s]: longer flights bend more than the comb tries."""
GATE_CELLS, GATE_STDS = 0.4, 3.0
"""Cells, or deviations of what is predicted, within which the path is found again in a frame that
was read over it, and in its direction to a resolution. A frame in which it is not was read over
another path, and all its symbols by the same number of cells too low or too high."""
STD_CELLS = 0.02
"""Floor of its range and velocity deviations in cells."""
NAMED_CELLS = 1.5
"""Cells of length and of its rate within which a path is one that the city explains."""
FIRST_ACCELERATION_STD = 3.0
"""Deviation of the acceleration of a path that is seen for the first time [m/s^2]."""


@dataclass
class Waiting:
    """Frames that wait for a path, and the path over which frames are read now; None: none is
    known."""

    batch: list[Peaks] = field(default_factory=list)
    path: DataPath | None = None


class OutOfSequence(OtherPaths):
    """Frames that a passive terminal could not read, and the path over which it reads now.

    Parameters
    ----------
    receiver : of the terminal
    walls : the mesh, by which a path over walls is recognised; None: no path is

    Attributes
    ----------
    late : earlier frames that the last one made readable
    """

    def __init__(self, receiver: PassiveReceiver, waveform: Waveform, walls: Walls | None) -> None:
        self._receiver, self._waveform, self._walls = receiver, waveform, walls
        self._leeway = Leeway.of(waveform, receiver.antennas, 1)
        self._cells, self._beam = np.split(self._leeway.resolution, 2)
        self.state = Waiting()
        self.late: tuple[Late, ...] = ()

    @property
    def is_reading(self) -> bool:
        return self.state.path is not None

    def read_frame(
        self,
        cube: IFCube,
        reception: Reception,
        own: Ownship,
        reference: Reference,
        *,
        refused: bool,
        anchored: bool,
        maps: bool,
    ) -> tuple[Reception, bool]:
        self.late = ()
        if anchored and self.state.batch:  # it tells the whole cells of those that wait
            self.state.path = self._learn(cube, own.time, False) or self.state.path
        if anchored and refused:
            self.start(delayed(reception.detections, own.clock), own.time)
        if reception.line_of_sight:
            self.forget()
        if anchored or reception.decoded:
            return reception, anchored
        out = self.read(cube, own.time, Hints(own.clutter), maps=maps)
        if out is None:
            return reception, False
        out = replace(out, detections=delayed(out.detections, own.clock, -1))
        strong = out.line_of_sight and reference.is_plausible(out, own.straight)
        # near the edge of the view it may have come from the opposite one: a track would fly there
        seen = np.abs(in_plane(out.detections).direction[out.detections.is_reference])
        if strong and (seen < WELL_INSIDE * self._receiver.antennas.view_limit).all():
            self.forget()
            return out, True
        return out.without_sight(self._is_named(own)), False

    def _is_named(self, own: Ownship) -> bool:
        """Return whether the path that is read over is as long, and changes as fast, as one from
        the transmitter over the city's walls, or straight, as it almost is about an edge."""
        path = self.state.path
        if self._walls is None or path is None or not own.over_other_path or own.sender is None:
            return False
        there = own.sender.state.mean
        length = path.mean[:2] - SPEED_OF_LIGHT * own.clock
        straight = measure(there, own.pose)[None, :2]
        over_walls = Ways.of_sender(there[:6], own.pose, self._walls, float(length[0]) + 1).seen
        difference = np.abs(np.concatenate([straight, over_walls[:, :2]]) - length)
        return bool((difference < NAMED_CELLS * self._cells).all(axis=1).any())

    def read(self, cube: IFCube, time: float, hints: Hints, *, maps: bool) -> Reception | None:
        """A data frame that the line of sight does not read, over the path that is known or that it
        makes known; None where there is none yet."""
        out = self._over(cube, time, hints, maps=maps)
        if out is None:
            self.state.path = self._learn(cube, time, True)
            out = self._over(cube, time, hints, maps=maps)
        return out

    def take_over(self, reference: Prediction, own: Ownship) -> None:
        p = delayed(reference, own.clock)
        mean = np.array([p.range[0], p.velocity[0], 0.0])
        spread = np.square([p.range_std[0], p.velocity_std[0], FIRST_ACCELERATION_STD])
        self.state.path = DataPath(own.time, mean, np.diag(spread), p.direction[0])

    def start(self, detections: Detections, time: float) -> None:
        """Go on over the known path where a frame without data and without a reference shows it,
        else over the strongest one."""
        if self.state.path is not None:
            self.state.path = self.state.path.at(time)
            if self._follow(detections):
                return
        d = in_plane(detections)
        d = d.select(np.isfinite(d.direction).all(axis=1))
        if len(d):
            i = int(d.snr.argmax())
            mean = np.array([d.range[i], d.velocity[i], 0.0])
            spread = np.append(self._deviations(d, i), FIRST_ACCELERATION_STD) ** 2
            self.state.path = DataPath(time, mean, np.diag(spread), d.direction[i])

    def forget(self) -> None:
        """The line of sight reads again."""
        self.state = Waiting()

    def _learn(self, cube: IFCube, time: float, modulated: bool) -> DataPath | None:
        """Keep a frame, and read those that wait where it makes a path known."""
        young = [one for one in self.state.batch if time - one.time <= SPAN]
        groups = self._receiver.groups
        mine = cube if groups is None else cube.of_groups(groups)
        self.state.batch = [*young[1 - BATCH :], find_peaks(mine, time, modulated)]
        order = self._receiver.reader.order
        path = acquire(self.state.batch, self._receiver.antennas, order)
        if path is None:
            return None
        waiting, self.state.batch = self.state.batch, []
        for one in waiting:
            if one.modulated and one.time < time:
                there = path.at(one.time).prediction
                symbols = read_peaks(one, there, self._receiver.antennas, order)
                if symbols is None:
                    continue
                reception = self._receiver.of_symbols(symbols, one.waveform, self._waveform)
                if reception is not None:
                    self.late += (Late(one.time, reception),)
        return path

    def _over(self, cube: IFCube, time: float, hints: Hints, *, maps: bool) -> Reception | None:
        """A frame read over the path, which it makes known better; None where it cannot be."""
        if self.state.path is None:
            return None
        self.state.path = self.state.path.at(time)
        expected = self.state.path.prediction
        if expected.range_std[0] > COAST_CELLS * self._cells[0]:
            return None
        out = self._receiver.receive_over(cube, expected, hints, maps=maps)
        if not out.decoded or not self._follow(out.detections):
            return None
        ends = end_symbols(out, self._receiver.groups, self._waveform)
        return None if slip_cells(ends, self._waveform.num_delay_symbols) else out

    def _follow(self, d: Detections) -> bool:
        """Update the path by the detection that is it; return whether there is one."""
        path = self.state.path
        assert path is not None
        off = np.abs(np.stack([d.range, d.velocity]).T - path.mean[:2])
        std = np.sqrt(np.diag(path.covariance)[:2])
        gate = np.maximum(GATE_CELLS * self._cells, GATE_STDS * std)
        # zero on an axis that is not seen
        aside = folded(np.nan_to_num(d.direction - path.direction), self._leeway.cosine_period)
        near = (off < gate).all(axis=1) & (np.abs(aside) < self._beam).all(axis=1)
        if not near.any():
            return False
        i = int(np.where(near, d.snr, -1.0).argmax())
        measured = np.array([d.range[i], d.velocity[i]])
        direction = np.where(np.isfinite(d.direction[i]), d.direction[i], path.direction)
        self.state.path = path.seen(measured, self._deviations(d, i), direction)
        return True

    def _deviations(self, detections: Detections, i: int) -> np.ndarray:
        """Return the standard deviations of range and velocity of a detection (2,)."""
        return np.maximum(detections.std[i, :2], STD_CELLS * self._cells)
