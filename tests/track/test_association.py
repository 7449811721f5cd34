"""Which detection belongs to which track: all hypotheses enumerated in long double from the
likelihood's equation, and the life of a track by its rule over all patterns of hits."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest
from oracles import slopes, what_is_measured
from scipy.optimize import brentq
from scipy.stats import chi2

from isac_rt.receive.types import Detections
from isac_rt.track.filter import STD_FLOOR, UNAMBIGUOUS, Ambiguity, Gaussian, costs
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Track, Tracker, assign
from isac_rt.world.swarm import Pose, attitude

OWN = Pose(
    np.array([3.1, -2.7, 31.3]), np.array([4.3, 7.9, -0.6]), np.zeros(3), attitude((1, 2, 0))
)
SENDER = np.array([140.3, 33.7, 80.9, 8.3, -2.1, 0.4])
FAR = np.array([231.7, 331.9, 57.1, -3.7, 6.1, 1.3])
"""About 400 m away: measurements are affine over the metres by which states are in doubt, to a
thousandth of a deviation."""
PERIOD = 41.3
GATE = 0.98


def cholesky(S):
    """Lower triangle in long double, by its definition."""
    L = np.zeros_like(S)
    for i, j in product(range(len(S)), range(len(S))):
        if j <= i:
            rest = S[i, j] - L[i, :j] @ L[j, :j]
            L[i, j] = np.sqrt(rest) if i == j else rest / L[j, j]
    return L


def distance_and_log_det(y, S):
    """y^T S^-1 y and ln det S in long double."""
    L = cholesky(np.asarray(S).astype(np.longdouble))
    w = np.zeros(len(y), np.longdouble)
    for i in range(len(y)):
        w[i] = (y[i] - L[i, :i] @ w[:i]) / L[i, i]
    return w @ w, 2 * np.log(np.diag(L)).sum()


def gate(freedom):
    """Quantile of the chi-square law of 2 or 4 degrees of freedom, from its closed form."""
    tail = {2: lambda x: np.exp(-x / 2), 4: lambda x: np.exp(-x / 2) * (1 + x / 2)}[freedom]
    return brentq(lambda x: 1 - tail(x) - GATE, 0, 100)


def test_the_distance_is_that_of_what_was_measured():
    """Every pattern of missing components against the density of the others alone, of three
    detections and two tracks, one of them nowhere near. Planted bugs: the determinant left out;
    covariances with missing components kept; the deviation of another detection; the gate of four
    components for all."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(4, 4)) * [[0.3], [2.0], [0.01], [0.02]]
    S, std = root @ root.T, np.abs(root[:3]) + STD_FLOOR
    mean = np.array([[30.0, 4.0, 0.2, 0.1], [3000.0, 4.0, 0.2, 0.1]])
    y = (2 * rng.normal(size=(3, 4))) @ root.T
    inside = 0
    for there in product([True, False], repeat=4):
        some = np.flatnonzero(there)
        z = np.where(there, mean[0] + y, np.nan)
        found = costs(z, std, mean, np.array([S, S]), UNAMBIGUOUS, GATE)
        for q in range(3):
            R = np.diag(std[q] ** 2)
            d2, log_det = distance_and_log_det(y[q, some], (S + R)[np.ix_(some, some)])
            if some.size and d2 <= chi2.ppf(GATE, some.size):
                assert found[0, q] == pytest.approx(float(d2 + log_det), rel=1e-9)
                inside += 1
            else:
                assert found[0, q] == np.inf
        assert np.isinf(found[1]).all() or not there[0]
    assert 5 < inside < 43


def test_a_small_deviation_is_not_believed():
    """Planted bug: the floor left out."""
    z, nothing = np.array([[2e-3, 0.0, 0.0, 0.0]]), np.zeros((1, 4, 4))
    found = costs(z, np.full((1, 4), 1e-9), np.zeros((1, 4)), nothing, UNAMBIGUOUS, GATE)
    assert found[0, 0] == pytest.approx(4 + 2 * np.log(STD_FLOOR).sum())


def clutter_of(rng, states, sender, std):
    """Detections about three bodies, nearer each other than some of the tracks know: one of each,
    and one that belongs to none."""
    at = [what_is_measured(x, OWN, sender) for x in states]
    at.append(np.mean(at, axis=0))
    return np.array(at, float) + std * rng.normal(size=(4, 4))


def affine(x, sender):
    """What is measured of a state, its slopes and the covariance by the sender's doubt."""
    at = None if sender is None else sender.mean
    H = slopes(lambda s: what_is_measured(s, OWN, at), x)
    if sender is None:
        return what_is_measured(x, OWN), H, np.zeros((4, 4))
    J = slopes(lambda s: what_is_measured(x, OWN, s), at)
    return what_is_measured(x, OWN, at), H, J @ sender.covariance @ J.T


def innovation(z, mean):
    """What was measured beyond what was expected, its velocity folded, and which of it there is."""
    y = z - mean
    y[1] -= PERIOD * np.round(y[1] / PERIOD)
    return y, np.flatnonzero(np.isfinite(z))


def hypothesis_costs(states, z, std, sender):
    """(tracks, detections) -2 ln of the likelihood of a pair but for a constant, inf outside the
    gate; the same without the determinant; and how near a pair is to the gate's edge."""
    costs, edge = np.full((2, len(states), len(z)), np.inf), np.inf
    for k, (x, P) in enumerate(states):
        mean, H, others = affine(x, sender)
        for q in range(len(z)):
            y, some = innovation(z[q], mean)
            S = H @ P @ H.T + others + np.diag(std[q] ** 2)
            d2, log_det = distance_and_log_det(y[some], S[np.ix_(some, some)])
            edge = min(edge, abs(d2 - gate(some.size)))
            if d2 <= gate(some.size):
                costs[:, k, q] = d2 + log_det, d2
    return *costs, edge


def conditioned(state, z, std, sender):
    """State and covariance after a detection, by the gain."""
    mean, H, others = affine(state.mean, sender)
    y, some = innovation(z, mean)
    H, y = H[some].astype(float), y[some].astype(float)
    S = H @ state.covariance @ H.T + (others + np.diag(std**2)).astype(float)[np.ix_(some, some)]
    K = state.covariance @ H.T @ np.linalg.inv(S)
    return state.mean + K @ y, state.covariance - K @ S @ K.T


def best(cost, rows, free):
    """The pairs of these tracks and detections by trying all, and by how much the second best of as
    many pairs is worse. A track that takes none has a place of its own among the columns."""
    found = []
    empty = [("none", k) for k in rows]
    for chosen in permutations([*free, *empty], len(rows)):
        pairs = {k: q for k, q in zip(rows, chosen, strict=True) if not isinstance(q, tuple)}
        total = sum(cost[k, q] for k, q in pairs.items())
        if np.isfinite(total) and all(
            q[1] == k for k, q in zip(rows, chosen, strict=True) if isinstance(q, tuple)
        ):
            found.append((-len(pairs), float(total), tuple(sorted(pairs.items()))))
    found = sorted(set(found))
    apart = found[1][1] - found[0][1] if len(found) > 1 and found[1][0] == found[0][0] else np.inf
    return dict(found[0][2]), apart


def in_turn(cost, confirmed):
    """Hypotheses of the confirmed tracks first, then of the others with what is left."""
    free, hit, apart = list(range(cost.shape[1])), {}, np.inf
    for now in (True, False):
        pairs, margin = best(cost, [k for k, c in enumerate(confirmed) if c is now], free)
        free, hit, apart = (
            [q for q in free if q not in pairs.values()],
            hit | pairs,
            min(apart, margin),
        )
    return hit, apart


@pytest.mark.parametrize("bistatic", [False, True])
def test_the_association_is_the_likeliest_of_all(bistatic):
    """Three tracks that know their body by factors of up to 20 differently, four detections of
    different deviations, one without a direction, one folded in velocity: among the hypotheses with
    most pairs the one of greatest likelihood, confirmed tracks first; then each state by its gain.
    40 draws, without those whose runner-up or gate is within 0.1 (linearisation moves costs by half
    of that). In at least four draws the answer differs without the determinant. Planted bugs: the
    determinant left out, halved or negative; the deviations of another detection; the sender's
    covariance left out; tentative tracks first; the velocity's difference unfolded; updates with
    another detection's deviations."""
    rng, reports, mattered = np.random.default_rng(12 + bistatic), 0, 0
    for _ in range(40):
        cloud = np.linalg.cholesky(np.diag([9, 9, 9, 4, 4, 4.0]) + 0.5)
        states = FAR + rng.normal(size=(3, 6)) @ cloud.T
        spread = 10 ** rng.uniform(-1, 0.3, 3)
        tracks = []
        for k in range(3):
            root = (
                np.diag([1, 1, 1, 2, 2, 2, 0.3, 0.3, 0.3])
                @ np.linalg.qr(rng.normal(size=(9, 9)))[0]
            )
            P = spread[k] ** 2 * (root * rng.uniform(0.5, 2, 9)) @ root.T
            mean = np.append(states[k], np.zeros(3)) + np.linalg.cholesky(P) @ rng.normal(size=9)
            tracks.append(
                Track(k, Gaussian(mean, (P + P.T) / 2), 1.0, confirmed=bool(rng.random() < 0.6))
            )
        sender = None
        if bistatic:
            doubt = np.diag(np.array([0.9, 1.3, 0.7, 1.1, 0.9, 1.7, 0.1, 0.1, 0.1]) ** 2)
            sender = Gaussian(np.append(SENDER, np.zeros(3)), doubt)
        std = np.array([0.3, 0.4, 0.004, 0.005]) * 10 ** rng.uniform(-0.3, 0.5, (4, 4))
        z = clutter_of(rng, states, None if sender is None else sender.mean, std)
        z[1, 2:] = np.nan
        z[2, 1] -= PERIOD
        cost, without, edge = hypothesis_costs([t.state for t in tracks], z, std, sender)
        confirmed = [t.confirmed for t in tracks]
        expected, apart = in_turn(cost, confirmed)
        if min(apart, edge) < 0.1:
            continue
        reports += 1
        mattered += in_turn(without, confirmed)[0] != expected
        tracker, before = (
            Tracker(Tracking(gate_probability=GATE), Ambiguity(PERIOD)),
            [t.state for t in tracks],
        )
        tracker.state.tracks = list(tracks)
        tracker.update(marked(z, std), OWN, sender)
        hit = {t.id: int(t.snr) - 100 for t in tracks if t.missed == 0}
        assert hit == expected
        for k, q in hit.items():
            mean, P = conditioned(before[k], z[q], std[q], sender)
            scale = np.sqrt(np.diag(P))
            assert (tracks[k].state.mean - mean) / scale == pytest.approx(np.zeros(9), abs=0.05)
            assert np.diag(tracks[k].state.covariance) / scale**2 == pytest.approx(
                np.ones(9), abs=0.05
            )
    assert reports >= 25
    assert mattered >= 4


@pytest.mark.parametrize("freedom", [2, 4])
def test_the_gate_is_the_quantile_of_what_was_measured(freedom):
    """A detection off in range alone, at 0.99 and 1.01 of the distance that 98 % keep, with and
    without a direction. Planted bugs: the gate of four components for two; the determinant in
    it."""
    P, std = np.diag([0.5] * 3 + [1.0] * 3 + [0.1] * 3), np.array([0.3, 0.4, 0.004, 0.005])
    mean, H, _ = affine(np.append(FAR, np.zeros(3)), None)
    some = slice(freedom)
    S = (H @ P @ H.T + np.diag(std**2)).astype(float)[some, some]
    one = 1 / np.sqrt(np.linalg.inv(S)[0, 0])
    for share, taken in ((0.99, True), (1.01, False)):
        tracker = Tracker(Tracking(gate_probability=GATE), Ambiguity(PERIOD))
        tracker.state.tracks = [Track(0, Gaussian(np.append(FAR, np.zeros(3)), P), 1.0)]
        z = np.array(mean, float)
        z[0] += share * np.sqrt(gate(freedom)) * one
        z[freedom:] = np.nan
        tracker.update(marked(z[None], std[None]), OWN)
        assert (tracker.tracks[0].missed == 0) is taken


def marked(z, std):
    """Detections whose SNR is 100 and their number, so that a track says which it took."""
    return Detections(
        range=z[:, 0].copy(),
        velocity=z[:, 1].copy(),
        direction=z[:, 2:].copy(),
        snr=100.0 + np.arange(len(z)),
        std=std,
        is_reference=np.zeros(len(z), bool),
        starts=np.ones(len(z), bool),
    )


BODY = np.array([14.7, 28.9, 27.1, 0.0, 0.0, 0.0])
"""At rest as a new track takes it to be, so that the same track is hit whenever it is seen."""
STD = np.array([0.031, 0.083, 0.0047, 0.0061])


def one_detection(frames=1, reference=False):
    still = Pose.at_rest(OWN.position, (0.5, 1.2, -0.15))
    z = np.tile(np.asarray(what_is_measured(BODY, still), float), (frames, 1))
    d = marked(z, np.tile(STD, (frames, 1)))
    object.__setattr__(d, "is_reference", np.full(frames, reference))
    return d, still


@pytest.mark.parametrize(("hits", "window", "misses"), [(2, 3, 2), (3, 4, 3), (1, 1, 2)])
def test_the_life_of_a_track_over_all_patterns(hits, window, misses):
    """All patterns of hits and misses over 6 frames after initiation: whether the first track lives
    and is confirmed, by the rule word for word. Planted bugs: one miss too many; the window one
    frame too long; a track that needs one hit not confirmed at once; age counted in hits."""
    settings = Tracking(confirm_hits=hits, confirm_window=window, drop_misses=misses)
    seen, still = one_detection()
    for pattern in product([True, False], repeat=6):
        tracker, held = Tracker(settings, Ambiguity(PERIOD)), [True]
        tracker.predict(0.0)
        tracker.update(seen, still)
        for k, hit in enumerate(pattern, 1):
            held.append(hit)
            tracker.predict(0.02 * k)
            tracker.update(seen if hit else seen.select(np.zeros(1, bool)), still)
            reached = [
                n for n in range(1, len(held) + 1) if sum(held[max(0, n - window) : n]) >= hits
            ]
            first = [t for t in tracker.tracks if t.id == 0]
            if reached:
                dead = any(
                    not any(held[n - misses : n])
                    for n in range(max(misses, reached[0]), len(held) + 1)
                )
            else:  # the hits so far and a hit in every frame left of its first window are too few
                dead = sum(held[:window]) + max(window - len(held), 0) < hits
            assert bool(first) is not dead, (held,)
            if dead:
                break
            assert first[0].confirmed is bool(reached), (held,)
            assert first[0].age == k
            assert first[0].recent == held[-window:]
            assert first[0].missed == held[::-1].index(True)


def test_numbers_snr_and_references():
    """A track's SNR is that of its own last detection, a new track's of its first, a reference
    starts none, and a number is used once. Planted bugs: the SNR of another detection or of the
    first one for ever; references tracked as reflectors."""
    seen, still = one_detection()
    tracker = Tracker(Tracking(), Ambiguity())
    z = np.column_stack([seen.range, seen.velocity, seen.direction])
    others = np.concatenate([z + np.array([7.0, 0, 0, 0]), z, z - np.array([9.0, 0, 0, 0])])
    for k in range(3):
        tracker.predict(0.02 * k)
        tracker.update(marked(np.roll(others, k, axis=0), np.tile(STD, (3, 1))), still)
        assert [t.snr for t in tracker.tracks] == [100 + (i + k) % 3 for i in range(3)]
    tracker.clear()
    tracker.update(seen, still)
    assert [t.id for t in tracker.tracks] == [3] and tracker.new_id() == 4
    tracker.update(one_detection(2, reference=True)[0], still)
    assert len(tracker.tracks) == 1


def stone_soups_pairs(cost):
    """Pairs (row, column) of Stone Soup's `GlobalNearestNeighbour` over hypotheses with these
    distances, a missed detection farther than all others together."""
    from stonesoup.dataassociator.neighbour import GlobalNearestNeighbour
    from stonesoup.hypothesiser import Hypothesiser
    from stonesoup.types.detection import Detection, MissedDetection
    from stonesoup.types.hypothesis import SingleDistanceHypothesis
    from stonesoup.types.multihypothesis import MultipleHypothesis
    from stonesoup.types.prediction import StatePrediction
    from stonesoup.types.track import Track as Followed

    missed = 1 + cost[np.isfinite(cost)].sum()

    class Stated(Hypothesiser):
        def hypothesise(self, track, detections, timestamp):
            i = rows.index(track)
            mine = [
                SingleDistanceHypothesis(states[i], columns[j], cost[i, j])
                for j in np.flatnonzero(np.isfinite(cost[i]))
            ]
            none = SingleDistanceHypothesis(states[i], MissedDetection(timestamp=None), missed)
            return MultipleHypothesis([*mine, none])

    states = [StatePrediction([[float(i)]]) for i in range(len(cost))]
    rows = [Followed([state]) for state in states]
    columns = [Detection(np.array([[float(j)]])) for j in range(cost.shape[1])]
    found = GlobalNearestNeighbour(Stated()).associate(set(rows), set(columns), None)
    return sorted((rows.index(t), columns.index(h.measurement)) for t, h in found.items() if h)


def test_pairs_are_those_of_stone_soup():
    """Forty tables of up to four tracks and four detections with a third of the pairs outside the
    gate: as many pairs as can be, of the least total. Planted bug: the nearest pair first, however
    much the others lose by that."""
    pytest.importorskip("stonesoup")
    rng = np.random.default_rng(12)
    for _ in range(40):
        cost = rng.exponential(5.0, rng.integers(1, 5, 2))
        cost[rng.random(cost.shape) < 1 / 3] = np.inf
        assert sorted(assign(cost)) == stone_soups_pairs(cost)
