"""False alarms of a passive terminal over cities without a UAV in the air but the two terminals:
against design, in cells in which clutter is expected and in the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind
from isac_rt.receive.clutter import bistatic
from isac_rt.scenario.file import load
from isac_rt.simulation.setup import prepare
from isac_rt.simulation.simulate import _Observer, standard_terminal

SCENES = Path(__file__).parents[2] / "scenes"
ROWS, BINS = 3, 1
"""About a path that is no clutter, what is found is its own or what its removal left."""
QUIET, CLUTTER = 0, 1


class Counter:
    """Cells, alarms and those that may start a track, in quiet cells and in clutter (2, 3)."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.counts, self.false = np.zeros((2, 3), int), 0
        judge = bistatic.BeamSearch._judge

        def noting(search, maps, noise, expected, known, clutter, left_over):
            self.seen = known.waveform, expected / noise, left_over.power > 0, clutter is not None
            return judge(search, maps, noise, expected, known, clutter, left_over)

        monkeypatch.setattr(bistatic.BeamSearch, "_judge", noting)

    def look(self, observer: _Observer, frame) -> None:
        """Count a frame."""
        self.seen = None
        heard = observer.hear(frame, frame.heard(observer.link), False)
        tracks = observer.record(frame, heard).tracks
        self.false += int((tracks.confirmed & (tracks.uav < 0)).sum())
        if self.seen is None or not self.seen[3]:
            return
        w, held, beside, _ = self.seen
        paths = frame.paths[observer.link]
        alone = paths.kind != PathKind.DIFFUSE
        for i, j in zip(*self._cells(paths.delay[alone], paths.delay_rate[alone], w), strict=True):
            rows = np.arange(max(i - ROWS, 0), min(i + ROWS + 1, len(held)))
            beside[np.ix_(rows, (np.arange(-BINS, BINS + 1) + j) % w.num_chirps)] = True
        kind = np.where(held > bistatic.LEAST, CLUTTER, QUIET)
        kind[beside] = -1
        kind[:2] = -1
        d = heard.reception.detections.select(~heard.reception.detections.is_reference)
        i, j = self._cells(d.range / 299792458, d.velocity / 299792458, w)
        where = kind[np.clip(i, 0, len(held) - 1), j]
        for k in (QUIET, CLUTTER):
            mine = where == k
            self.counts[k] += (kind == k).sum(), mine.sum(), (mine & d.starts).sum()

    @staticmethod
    def _cells(delay, rate, w):
        bins = np.round(rate * w.frame_duration * w.effective_carrier).astype(int)
        rows = np.round(w.beat_cells(delay, rate, 0.0)).astype(int)
        return rows, (bins + w.num_chirps // 2) % w.num_chirps


@pytest.mark.slow
@pytest.mark.sionna
@pytest.mark.parametrize(
    ("scene", "changes"),
    [
        ("street_canyon", ["clutter={model: field}"]),
        ("blocks_swarm", []),
        ("florence_square", ["clutter={model: field}", "cooperation=tracks"]),
    ],
)
def test_a_passive_terminal_alarms_no_more_often_than_designed(scene, changes, monkeypatch):
    """Two seeds of noise, clutter and data, eight frames each: alarms at 1e-4 a cell and starts at
    1e-6 within the 0.999 of chance, no track confirmed but the transmitter's. In Florence its track
    is 1 m/s off across the line of sight for more than a dozen frames, so that its word must count.
    Planted bugs: no whitening; the word not used."""
    counter = Counter(monkeypatch)
    for seed in (1, 2):
        whole = load(SCENES / f"{scene}.yaml", [f"seed={seed}", "receiver_preset=city", *changes])
        alone = {name: whole.swarm[name] for name in ("AT", "PT1")}
        setup, link = prepare(whole.model_copy(update={"swarm": alone})), Link("AT", "PT1")
        receivers = setup.scenario.receivers
        observer = _Observer(setup, link, standard_terminal(setup, link), receivers)
        for number in range(8):
            counter.look(observer, setup.frame(number))
    print(scene, counter.counts.tolist())
    assert counter.false == 0
    rates = receivers.update_false_alarm_rate, receivers.false_alarm_rate
    for cells, *found in counter.counts:
        assert cells > 5_000
        for count, rate in zip(found, rates, strict=True):
            assert count <= stats.binom.ppf(0.999, cells, rate)
