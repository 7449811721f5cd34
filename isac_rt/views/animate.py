"""A run as an animation: the map view and a link's range-Doppler map in step."""

from __future__ import annotations

import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.animation import FuncAnimation, writers
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from isac_rt.results.dataset import fused_positions, tracked_states
from isac_rt.results.files import ResultsError
from isac_rt.results.recorder import Results
from isac_rt.results.swarm import SWARM
from isac_rt.storage import write_whole
from isac_rt.views.figures import footprint, outline, scene_map
from isac_rt.views.maps import map_limits, range_doppler
from isac_rt.views.scene import boxes_in
from isac_rt.views.style import STYLE, colour_of
from isac_rt.world.city.mesh import CityMesh

WRITERS = {".gif": "pillow", ".mp4": "ffmpeg"}

_LEFT, _RIGHT = (0.06, 0.1, 0.38, 0.72), (0.52, 0.1, 0.42, 0.72)
"""Places of the axes, below the room for titles and legends."""


def tracked_positions(dataset: xr.Dataset, frame: int, observer: int) -> np.ndarray:
    """(K, 3) where a terminal's confirmed tracks lie in the world [m], as it sees them."""
    mine = (
        (dataset.track_frame.values == frame)
        & (dataset.track_observer.values == observer)
        & dataset.track_confirmed.values
    )
    return tracked_states(dataset)[mine, :3]


def animate(
    results: Results, observer: int = 0, city: CityMesh | None = None
) -> tuple[Figure, FuncAnimation]:
    """A picture per frame whose maps were kept (`run(snapshots=)`): left the swarm so far with the
    terminal's tracks, right its map.

    Raises
    ------
    ResultsError  If fewer than two frames have maps of this observer.
    """
    d = results.dataset
    shown = [
        k for k in range(d.sizes["snapshot"]) if np.isfinite(d.map_power.values[k, observer]).any()
    ]
    if len(shown) < 2:
        raise ResultsError(
            f"{len(shown)} frame(s) have maps of {d.observer.values[observer]}; run again with "
            "--snapshots 20 or more"
        )
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 5.2), dpi=100)
        left, right = figure.add_axes(_LEFT), figure.add_axes(_RIGHT)
        scene_map(left, d, city)
        for drawn in (*left.lines, *left.patches):
            drawn.set_alpha(0.25)
        moving = _Moving(left, d, observer)
        limits = np.array([map_limits(d, k, observer) for k in shown])
        low, high = limits[..., 0].min(axis=0), limits[..., 1].max(axis=0)

        def draw(k: int) -> list:
            frame = int(d.snapshot_frame.values[k])
            moving.show(frame)
            for ax in figure.axes[2:]:
                ax.remove()  # the last map's colour bar
            right.clear()
            right.set_position(_RIGHT)
            with matplotlib.rc_context(STYLE):
                range_doppler(right, d, k, observer)
            right.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            return []

        return figure, FuncAnimation(figure, draw, frames=shown, blit=False, cache_frame_data=False)


class _Moving:
    """Moving parts of the map view."""

    def __init__(self, ax: Axes, dataset: xr.Dataset, observer: int) -> None:
        self._d, self._ax, self._observer = dataset, ax, observer
        count = dataset.sizes["uav"]
        self._paths = [ax.plot([], [], color=colour_of(u))[0] for u in range(count)]
        self._here = [
            ax.plot([], [], "o", color=colour_of(u), mec="white")[0] for u in range(count)
        ]
        self._boxes = [
            (corners, footprint(corners[0], colour_of(u)))
            for u, corners in boxes_in(dataset).items()
        ]
        for _, patch in self._boxes:
            ax.add_patch(patch)
        (self._tracks,) = ax.plot(
            [],
            [],
            "x",
            color="black",
            ms=9,
            mew=1.6,
            label=f"tracks of {dataset.observer.values[observer]}",
        )
        fused = {
            str(dataset.receiver.values[observer]): ("s", 10, "fused tracks"),
            SWARM: ("D", 14, "fused tracks, swarm"),
        }
        alone = "" if "owner" in dataset.variables else "_"
        self._fused = {
            name: ax.plot([], [], mark, color="black", ms=size, mfc="none", label=alone + words)[0]
            for name, (mark, size, words) in fused.items()
        }
        ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, alignment="left")

    def show(self, frame: int) -> None:
        position = self._d.uav_position.values
        for u, (path, here) in enumerate(zip(self._paths, self._here, strict=True)):
            path.set_data(position[: frame + 1, u, 0], position[: frame + 1, u, 1])
            here.set_data(position[frame : frame + 1, u, 0], position[frame : frame + 1, u, 1])
        for corners, patch in self._boxes:
            patch.set_xy(outline(corners[frame]))
        positions = tracked_positions(self._d, frame, self._observer)
        self._tracks.set_data(positions[:, 0], positions[:, 1])
        for name, marks in self._fused.items():
            fused = fused_positions(self._d, frame, name)
            marks.set_data(fused[:, 0], fused[:, 1])
        legend = self._ax.get_legend()
        assert legend is not None
        legend.set_title(f"t = {float(self._d.time.values[frame]):.2f} s")


def write_animation(
    results: Results,
    file: str | Path,
    observer: int = 0,
    city: CityMesh | None = None,
    rate: float = 5.0,
) -> None:
    """Write the animation as GIF or, where there is ffmpeg, MP4; it appears whole or not at
    all.

    Parameters
    ----------
    rate : pictures per second

    Raises
    ------
    ResultsError  If the suffix is another, ffmpeg is missing or too few frames have maps.
    isac_rt.storage.StorageError  If the file cannot be written.
    """
    file = Path(file)
    writer = WRITERS.get(file.suffix)
    if writer is None:
        raise ResultsError(f"{file}: an animation ends in {' or '.join(WRITERS)}; name it so")
    if not writers.is_available(writer):
        raise ResultsError(
            f"{file}: {file.suffix} needs {writer}, which is not on this machine; install it or "
            "write a .gif"
        )
    _, moving = animate(results, observer, city)
    with tempfile.TemporaryDirectory() as folder:  # writers need a name that ends in the suffix
        made = Path(folder) / f"moving{file.suffix}"
        moving.save(made, writer=writers[writer](fps=rate))  # type: ignore[arg-type]  # a rate need not be whole
        write_whole(file, made.read_bytes())
