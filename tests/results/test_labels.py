"""Which path caused a detection, on path sets made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.types import Detections
from isac_rt.results.labels import (
    EXPLAINS,
    Aim,
    explain,
    hann_response,
    owners,
    reach,
)

WAVEFORM = Waveform()
RANGE, VELOCITY = WAVEFORM.range_cell(2), WAVEFORM.velocity_cell(2)
LOUD = 1e6
"""Power over the noise of a path of unit gain: everything stands out."""


def detections(rows) -> Detections:
    z = np.array(rows, float).reshape(-1, 4)
    return Detections(
        range=z[:, 0].copy(),
        velocity=z[:, 1].copy(),
        direction=z[:, 2:].copy(),
        snr=np.ones(len(z)),
        std=np.ones((len(z), 4)),
        is_reference=np.zeros(len(z), bool),
        starts=np.ones(len(z), bool),
    )


def paths(rows, link=("AT", "AT"), **more):
    """Of (range [m], velocity [m/s], gain, kind, target) each, echoes at the AT."""
    r, v, gain, kind, target = zip(*rows, strict=True)
    passes, count = 2 if link[0] == link[1] else 1, len(rows)
    return make_paths(
        gain=np.array(gain),
        delay=np.array(r) * passes / SPEED_OF_LIGHT,
        delay_rate=np.array(v) * passes / SPEED_OF_LIGHT,
        departure=np.tile([0.0, 1.0, 0.0], (count, 1)),
        arrival=np.tile([0.0, 1.0, 0.0], (count, 1)),
        kind=np.array(kind),
        target=np.array(target),
        epoch=0.1,
        tx=link[0],
        rx=link[1],
        target_names=("a", "b", "c"),
        **more,
    )


def test_the_strongest_path_within_a_cell_wins():
    """Not the nearest, velocity modulo the unambiguous span, -1 where none is near. The face is the
    first that the path meets, whether a UAV's point comes before it or not. Planted bugs: the
    nearest path; the first column of the faces."""
    span = 2 * WAVEFORM.max_velocity(2)
    found = paths(
        [
            (20.0, 1.0, 1.0, PathKind.TARGET, 0),
            (20.2, 1.1, 3.0j, PathKind.SPECULAR, -1),
            (33.0, span + 3.0, 0.2, PathKind.GHOST, 2),
            (47.0, 0.0, 5.0, PathKind.DIFFUSE, -1),
        ],
        bounces=np.array([0, 1, 2, 1]),
        faces=np.array([[-1, -1, -1], [41, -1, -1], [-1, 17, 5], [8, -1, -1]]),
        points=np.zeros((4, 3, 3)),
    )
    rows = [[20.05, 1.02, 0, 0], [33.1, 3.1, 0, 0], [47.0, 0.6, 0, 0], [19.8, 0.9, 0, 0]]
    kind, target, order, face, sidelobe = explain(detections(rows), found, WAVEFORM, 2, 100.0)
    assert kind.tolist() == [PathKind.SPECULAR, PathKind.GHOST, -1, PathKind.TARGET]
    assert target.tolist() == [-1, 2, -1, 0]
    assert order.tolist() == [1, 2, -1, 0]
    assert face.tolist() == [41, 17, -1, -1]
    assert not sidelobe.any()


def test_direction_tells_a_weak_path_from_a_strong_one():
    """In one cell a line 40 dB over a UAV's echo, 0.4 away in u_x, and clutter beside it: a
    detection at the echo's direction is the echo's, one between both the strong one's, as is one
    without a direction; of what comes from one direction the strongest decides, clutter together.
    An echo beside the detection's cell is no cause for its direction. Planted bugs: the echo's
    direction compared in u_z alone; clutter from all directions together."""
    rows = [
        (20.0, 1.0, 100.0, PathKind.SPECULAR, -1),
        (20.1, 1.0, 1.0, PathKind.TARGET, 1),
        *((20.0 + 0.02 * k, 1.0, 0.3, PathKind.DIFFUSE, -1) for k in range(13)),
        (20.0 + 1.4 * RANGE, 1.0, 3.0, PathKind.TARGET, 2),
    ]
    around = [(0.3, 0.1)] * 9 + [(0.5, -0.3)] * 4  # 0.81 of the echo's power in its beam
    towards = np.array([(-0.1, 0.1), (0.31, 0.12), *around, (0.7, 0.1)])
    aim = Aim(towards, np.array([0.07, 0.13]))
    found = [
        explain(detections([[20.05, 1.0, *u]]), paths(rows), WAVEFORM, 2, LOUD, aim)
        for u in (
            (0.29, 0.05),
            (0.1, 0.1),
            (np.nan, np.nan),
            (-0.12, 0.15),
            (0.5, -0.3),
            (0.7, 0.1),
        )
    ]
    strong, echo = (PathKind.SPECULAR, -1), (PathKind.TARGET, 1)
    assert [(f.kind[0], f.target[0]) for f in found] == [
        echo,
        strong,
        strong,
        strong,
        (PathKind.DIFFUSE, -1),
        strong,
    ]
    assert not any(f.sidelobe[0] for f in found)


@pytest.mark.parametrize(("scatterers", "kind"), [(3, PathKind.TARGET), (5, PathKind.DIFFUSE)])
def test_scatterers_of_a_cell_count_together(scatterers, kind):
    """Each a quarter of the UAV's power. Planted bug: each scatterer by itself."""
    echo = (20.0, 1.0, 1.0, PathKind.TARGET, 1)
    wall = [(20.0 + 0.03 * k, 1.0, 0.5, PathKind.DIFFUSE, -1) for k in range(scatterers)]
    beside = [(20.0 + 3 * RANGE, 1.0, 0.9, PathKind.DIFFUSE, -1)] * 9
    found = explain(
        detections([[20.0, 1.0, 0, 0]]), paths([echo, *wall, *beside]), WAVEFORM, 2, LOUD
    )
    assert found.kind.tolist() == [kind]


@pytest.mark.parametrize(("over_noise", "kind"), [(0.3, PathKind.DIFFUSE), (0.2, -1)])
def test_what_lies_under_the_noise_explains_nothing(over_noise, kind):
    """Planted bug: any path in the cell explains a false alarm."""
    wall = paths([(20.0, 1.0, 1.0, PathKind.DIFFUSE, -1)])
    found = explain(detections([[20.0, 1.0, 0, 0]]), wall, WAVEFORM, 2, over_noise)
    assert found.kind.tolist() == [kind]


def test_skirts_of_strong_paths_are_theirs():
    """A path 60 dB over the noise of a cell reaches 3.4 cells out on one axis, and not on both: the
    sidelobe of a Hann window there is 41 dB under its peak. Planted bug: no sidelobes."""
    strong = paths([(20.0, 1.0, 1.0, PathKind.LEAKAGE, -1)])
    off = 3.4
    rows = [
        [20.0 + off * RANGE, 1.0, 0, 0],
        [20.0, 1.0 - off * VELOCITY, 0, 0],
        [20.0 + off * RANGE, 1.0 + off * VELOCITY, 0, 0],
        [20.0 + 0.9 * RANGE, 1.0, 0, 0],
    ]
    found = explain(detections(rows), strong, WAVEFORM, 2, 1e6)
    assert found.kind.tolist() == [PathKind.LEAKAGE, PathKind.LEAKAGE, -1, PathKind.LEAKAGE]
    assert found.sidelobe.tolist() == [True, True, False, False]


def test_an_echo_in_its_place_is_not_the_skirt_of_a_line_from_elsewhere():
    """A line 60 dB over the noise 3.4 cells away, within a beam of a detection that lies in the
    cell of an echo: the cause is whose direction fits better. Planted bugs: the skirt first, as
    before; the echo whatever the direction."""
    rows = [
        (20.0, 1.0, 1.0, PathKind.LEAKAGE, -1),
        (20.0 + 3.4 * RANGE, 1.0, 1e-3, PathKind.TARGET, 1),
    ]
    aim = Aim(np.array([(0.23, 0.05), (0.06, 0.26)]), np.array([0.25, 0.25]))
    found = [
        explain(detections([[20.0 + 3.5 * RANGE, 1.0, *u]]), paths(rows), WAVEFORM, 2, 1e6, aim)
        for u in ((0.08, 0.24), (0.22, 0.08))
    ]
    assert [f.kind[0] for f in found] == [PathKind.TARGET, PathKind.LEAKAGE]
    assert [f.sidelobe[0] for f in found] == [False, True]


def test_the_resampling_of_the_groups_leaves_a_floor():
    """1e-5 of a path's power in every Doppler bin of its row: 80 dB over the noise it explains what
    lies 30 bins away, 40 dB over it does not. Planted bug: no floor."""
    row = [[20.0, 1.0 + 30 * VELOCITY, 0, 0]]
    strong = paths([(20.0, 1.0, 1.0, PathKind.LEAKAGE, -1)])
    found = [explain(detections(row), strong, WAVEFORM, 2, gain).kind[0] for gain in (1e8, 1e4)]
    assert found == [PathKind.LEAKAGE, -1]


def test_response_is_that_of_the_window():
    """Against the sum over 4096 samples of a Hann-windowed tone (discretisation: 1e-6 of the peak);
    `reach` lies above it everywhere, and on it at 1.5 cells and at the peaks of the sidelobes."""
    size = 4096
    n = np.arange(size) + 0.5
    window = np.sin(np.pi * n / size) ** 2
    d = np.concatenate([np.linspace(0, 9, 181), [0.31, 1.0, 1.5]])
    truth = np.array([abs(window @ np.exp(2j * np.pi * x * n / size)) ** 2 for x in d])
    truth /= window.sum() ** 2
    responses, reached = hann_response(d), reach(d)
    assert responses == pytest.approx(truth, abs=1e-6)
    assert (reached >= truth - 1e-6).all()
    assert reach(0.7) == reach(1.0) == 1.0
    assert reach(1.5) == pytest.approx(truth[-1], abs=1e-6)
    for lobe in (3, 4, 7):
        inside = (d > lobe) & (d < lobe + 1)
        # the amplitude falls within a lobe, so that its peak lies under the bound of its middle
        assert reach(lobe + 0.5) == pytest.approx(truth[inside].max(), rel=0.1)


def test_whose_path_it_is():
    """A UAV's straight echo and the transmitter's line of sight; no ghost, no wall. Planted bugs:
    ghosts count; the line of sight is nobody's."""
    names = ["PT1", "c", "AT", "b", "a"]
    rows = [
        (20.0, 1.0, 1.0, PathKind.LINE_OF_SIGHT, -1),
        (30.0, 1.0, 1.0, PathKind.TARGET, 0),
        (40.0, 1.0, 1.0, PathKind.GHOST, 1),
        (50.0, 1.0, 1.0, PathKind.SPECULAR, -1),
        (60.0, 1.0, 1.0, PathKind.TARGET, 2),
    ]
    at_pt, at_at = paths(rows, ("AT", "PT1")), paths(rows[1:])
    assert owners(at_pt.kind, at_pt.target, at_pt, names).tolist() == [2, 4, -1, -1, 1]
    assert owners(at_at.kind, at_at.target, at_at, names).tolist() == [4, -1, -1, 1]


def strongest(power: np.ndarray, clutter: np.ndarray) -> int:
    """The path of most power, -1 if none explains anything; all clutter counts as its
    strongest."""
    power = power.copy()
    if clutter.any():
        power[np.argmax(clutter)] = clutter.sum()
    return int(np.argmax(power)) if power.size and power.max() >= EXPLAINS else -1
