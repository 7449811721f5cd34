"""The figures of a run by methods, for notebooks: one line opens a run and draws it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from isac_rt.results.files import ResultsError, open_results
from isac_rt.results.recorder import Results
from isac_rt.views import figures, maps
from isac_rt.world.city.mesh import CityMesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Measure = Literal["range", "velocity", "azimuth", "elevation"]
Against = Literal["delay", "doppler"]


class Plots:
    """Draws a run, each method into `ax` or into a new figure, and returns the axes.

    Parameters
    ----------
    run : Results, or the folder that `isac-rt run` wrote

    Raises
    ------
    ResultsError  If it is the folder of no run; of a method, if the run has no such terminal or
        nothing to draw, or there is no such measure.

    Examples
    --------
    >>> import isac_rt as irt
    >>> results = irt.run(irt.load("scenes/paper_swarm_consistent.yaml", frames=4))
    >>> irt.Plots(results).tracks("PT1", "velocity").get_ylabel()
    'velocity [m/s]'
    """

    def __init__(self, run: Results | str | Path) -> None:
        self.results = run if isinstance(run, Results) else open_results(run)

    def scene(self, city: CityMesh | None = None, ax: Axes | None = None) -> Axes:
        """The swarm from above, over a city if one is given (`irt.city_of(results.scenario)`)."""
        return figures.scene_map(_axes(ax), self.results.dataset, city)

    def range_doppler(
        self, observer: str | None = None, snapshot: int = -1, ax: Axes | None = None
    ) -> Axes:
        """Map of a link (by default the first) in one of the snapshots (the last)."""
        number = self._snapshot(snapshot)
        return maps.range_doppler(_axes(ax), self.results.dataset, number, self._number(observer))

    def tracks(
        self, observer: str | None = None, measure: Measure = "range", ax: Axes | None = None
    ) -> Axes:
        """Truth, detections and tracks of every UAV over time."""
        _check(measure, Measure)
        number = self._number(observer)
        return figures.over_time(_axes(ax), self.results.dataset, number, measure)

    def errors(
        self, measure: Measure = "range", ax: Axes | None = None, terminals: bool = False
    ) -> Axes:
        """Distribution of the absolute errors of targets, or of terminals, on every link."""
        _check(measure, Measure)
        return figures.error_cdf(_axes(ax), self.results.dataset, measure, terminals)

    def paths(
        self,
        observer: str | None = None,
        against: Against = "delay",
        ax: Axes | None = None,
    ) -> Axes:
        """Power of every path of the snapshots."""
        _check(against, Against)
        self._snapshot(-1)
        number = self._number(observer)
        return figures.path_power(_axes(ax), self.results.dataset, number, against)

    def decoding(self, observer: str | None = None, ax: Axes | None = None) -> Axes:
        """Errors among the data symbols of every frame."""
        return figures.decoding(_axes(ax), self.results.dataset, self._number(observer))

    def reference_snr(self, ax: Axes | None = None) -> Axes:
        """SNR of every terminal's reference path over time."""
        return figures.reference_snr(_axes(ax), self.results.dataset)

    def _number(self, observer: str | None) -> int:
        names = [str(name) for name in self.results.dataset.observer.values]
        if observer is not None and observer not in names:
            raise ResultsError(f"{observer}: no such observer; choose from {', '.join(names)}")
        return 0 if observer is None else names.index(observer)

    def _snapshot(self, snapshot: int) -> int:
        count = self.results.dataset.sizes["snapshot"]
        if not -count <= snapshot < count:
            raise ResultsError(
                f"snapshot {snapshot}: the run kept {count} frames; give --snapshots to the run"
            )
        return int(np.arange(count)[snapshot])


def _check(name: str, choices: Any) -> None:
    if name not in get_args(choices):
        raise ResultsError(f"{name}: choose from {', '.join(get_args(choices))}")


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(7, 4), layout="constrained")[1]
