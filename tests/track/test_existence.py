"""Log-odds of tracks against the closed form over all orders of hits, and what a tracker makes of
them."""

from itertools import permutations

import numpy as np
import pytest
from scipy.special import betaln

from isac_rt.receive.types import Detections
from isac_rt.track import existence
from isac_rt.track.filter import Ambiguity
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Tracker
from isac_rt.world.swarm import Pose

OWN = Pose.at_rest(np.array([3.1, -7.3, 21.9]), (0.5, 1.2, -0.15))
DT = 0.02


def seen(*off):
    """Detections at one place, each with its deviation from it in range [m]."""
    z = np.array([[33.1 + o, 0.0, 0.11, 0.07] for o in off]).reshape(-1, 4)
    return Detections(
        range=z[:, 0],
        velocity=z[:, 1],
        direction=z[:, 2:],
        snr=100.0 + np.arange(len(z)),
        std=np.tile([0.03, 0.08, 0.004, 0.006], (len(z), 1)),
        is_reference=np.zeros(len(z), bool),
        starts=np.ones(len(z), bool),
    )


def in_a_city():
    return Tracker(Tracking(initiation="unexplained", drop_misses=50), Ambiguity())


@pytest.mark.parametrize("misses", [0, 1, 3])
def test_odds_are_those_of_a_probability_of_which_nothing_is_known(misses):
    """A first detection, then 3 more and some misses in any order: the odds are the integral of
    p^4 (1-p)^m over that of p, over the same of artefacts that recur with p_A. Planted bugs: n + 2
    in place of n + 1; the frame itself counted before it is judged."""
    p_A, n = existence.RECURS, 4
    exact = existence.BIRTH + betaln(n + 1, misses + 1) - betaln(2, 1)
    exact -= (n - 1) * np.log(p_A) + misses * np.log(1 - p_A)
    for order in set(permutations([True] * (n - 1) + [False] * misses)):
        odds, hits, frames = existence.BIRTH, 1, 1
        for hit in order:
            odds = existence.updated(odds, hit, hits, frames)
            hits, frames = hits + hit, frames + 1
        assert odds == pytest.approx(exact, abs=1e-12)


def test_an_artefact_says_by_the_odds_against_it_what_it_may():
    """Log-odds of p_A p_C, of p_C no less than one in five; from p_C of 10 on a track is left
    alone, as without a detection. Planted bugs: no least; tracks gain by it; a jump at p_C of 1."""
    least = np.log(0.02)
    for ratio, said in ((1.3, np.log(0.13)), (0.01, least), (0.0, least), (12.0, 0), (np.inf, 0)):
        tracker = in_a_city()
        tracker.update(seen(0.0), OWN)
        (track,) = tracker.tracks
        tracker.doubt({track.id: ratio})
        assert track.odds - existence.BIRTH == pytest.approx(said)
        track.detection = -1
        before = track.odds
        tracker.doubt({track.id: ratio})
        assert track.odds == before


def test_a_track_is_reported_while_it_is_a_target_more_probably_than_not():
    """Two detections confirm a track; a miss makes it an artefact more probably, the next detection
    a target again. Without a city only confirmation counts. Planted bugs: confirmation alone is
    reported; odds that do not fall; a record with the frame itself."""
    for settings, reported in (
        (Tracking(initiation="unexplained"), [False, True, False, True, True]),
        (Tracking(confirm_hits=2), [False, True, True, True, True]),
    ):
        tracker, said = Tracker(settings, Ambiguity()), []
        for k, d in enumerate([seen(0), seen(0), seen(), seen(0), seen(0)]):
            tracker.predict(DT * k)
            tracker.update(d, OWN)
            said.append(bool(tracker.snapshot(OWN).confirmed[0]))
        assert said == reported
        odds = existence.BIRTH + betaln(5, 2) - betaln(2, 1)
        odds -= 3 * np.log(existence.RECURS) + np.log(1 - existence.RECURS)
        alone = tracker.tracks[0].odds
        assert alone == pytest.approx(odds) if tracker.by_odds else alone == np.inf


@pytest.mark.parametrize(("apart", "left"), [(0.3, 1), (0.7, 2)])
def test_confirmed_tracks_in_one_place_become_one(apart, left):
    """A second track grows beside a first one, 0.3 m or 0.7 m away; the older number is left, with
    the state of the detection, and reported. Planted bugs: the younger number left; any two tracks
    joined; the younger one's few hits in the older one's many frames."""
    tracker = in_a_city()
    frames = [*[seen(0)] * 60, seen(0, apart), seen(0, apart), *[seen(apart)] * 4]
    for k, d in enumerate(frames):
        tracker.predict(DT * k)
        tracker.update(d, OWN)
    confirmed = [t for t in tracker.tracks if t.confirmed]
    assert len(confirmed) == left and confirmed[0].id == 0
    if left == 1:
        assert confirmed[0].credible
        assert np.linalg.norm(confirmed[0].state.mean[:3] - OWN.position) > 33.1 + apart / 2
