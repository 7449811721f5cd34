"""The evaluation of receivers over cities: its statistics by hand, and a flight from point to
table."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from unittest.mock import create_autospec

import numpy as np
import pytest
from scipy import stats

from isac_rt.cli.cli import main
from isac_rt.results.metrics import binomial_interval
from isac_rt.sweep.execute import run_job, run_points
from isac_rt.sweep.outcomes import Outcomes
from isac_rt.sweep.workers import SweepError
from reproduce import city, city_flights
from reproduce.city import Estimate, Goal, mean, rate, root
from reproduce.city_flights import (
    PLACES,
    FlightJob,
    Flights,
    fly,
    outcomes_of,
    repeated,
    seeds_wanted,
)


def test_rates_and_means_over_seeds():
    """One seed: the binomial law. Three: frames of unequal rates amount to fewer. Means: Student's
    t of 2 degrees of freedom, 4.303 s / sqrt(3). Planted bugs: the normal's quantile; a root of the
    mean instead of the mean of squares."""
    one = rate([30], [40])
    assert one == pytest.approx((0.75, *binomial_interval(30, 40)))
    spread, alike = rate([40, 20, 30], [40, 40, 40]), rate([30, 30, 30], [40, 40, 40])
    assert spread.value == alike.value == 0.75
    assert spread.high - spread.low > 1.5 * (alike.high - alike.low)
    found = mean([1.0, 2.0, 6.0])
    half = 4.302653 * np.sqrt(7.0) / np.sqrt(3)
    assert found == pytest.approx((3.0, 3.0 - half, 3.0 + half), rel=1e-6)
    assert np.isnan(mean([2.0]).low)
    assert root([3.0, 4.0]).value == pytest.approx(np.sqrt(12.5))
    assert np.isnan(rate([], []).value)


def test_intervals_of_means_hold_what_they_say():
    """Of 2,000 draws of five seeds 95 % hold the mean, within four deviations of that count."""
    rng = np.random.default_rng(4)
    draws = rng.normal(3.0, 0.7, (2000, 5))
    held = sum(low <= 3.0 <= high for _, low, high in map(mean, draws))
    assert abs(held - 1900) < 4 * stats.binom.std(2000, 0.95)


@pytest.mark.parametrize(
    ("found", "least", "verdict"),
    [
        (Estimate(0.96, 0.951, 0.97), True, "holds"),
        (Estimate(0.96, 0.94, 0.97), True, "holds under a condition"),
        (Estimate(0.96), True, "holds under a condition"),
        (Estimate(0.94, 0.9, 0.97), True, "does not hold"),
        (Estimate(0.94, 0.9, 0.949), False, "holds"),
        (Estimate(0.94, 0.9, 0.97), False, "holds under a condition"),
        (Estimate(np.nan), True, "does not hold"),
    ],
)
def test_a_goal_holds_with_its_whole_interval(found, least, verdict):
    assert Goal("x", found, 0.95, least).verdict(3).verdict == verdict


def test_data_in_the_shadow_by_hand():
    """Frames 3, 4 lost, 5 read with one wrong symbol, 12 a pilot, 36 read, 40 misread, in one seed;
    in the other all are read. Planted bugs: frames after the shadow among those read in it; pilots
    that count."""
    whole = [[f, 0, 0, 100, 0, 50, 1] for f in (3, 4, 5, 36, 40)]
    torn = [
        [3, 0, 100, 100, 50, 50, 0],
        [4, 0, 100, 100, 50, 50, 0],
        [5, 0, 1, 100, 2, 50, 1],
        [12, 1, 0, 0, 0, 0, 1],
        [36, 1, 0, 100, 0, 50, 1],
        [40, 1, 60, 100, 9, 50, 1],
    ]
    outcomes = [{"by_frame": {"AT->PT1": rows}} for rows in (torn, whole)]
    every, read, delay, phase, late = (g.found.value for g in city._goals_of_data(outcomes))
    assert every == pytest.approx((2 + 5) / 2)
    assert read == pytest.approx((1 + 3) / 2)
    assert delay == pytest.approx(1 / 400)
    assert phase == pytest.approx(2 / 200)
    assert late == pytest.approx(0.5)


def test_the_rate_that_suffers_most():
    """Of AT's hits 0.1 and 0.02 are lost in two seeds, of PT's delay symbols 0.03 and 0.05."""

    def outcome(hit, wrong):
        silent = {"ser_dpsk": None, "ser_delay": None}
        return {
            "terminals": {
                "AT": {"hit_rate": hit, **silent},
                "PT": {"hit_rate": 0.5, "ser_dpsk": 0.0, "ser_delay": wrong},
            }
        }

    before = [outcome(0.9, 0.01), outcome(0.8, 0.0)]
    after = [outcome(0.8, 0.04), outcome(0.78, 0.05)]
    assert city._worst_loss(before, after).value == pytest.approx(0.06)
    assert city._worst_loss(after, before).value == pytest.approx(0.0)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Two seeds of a short flight without a city, run as workers would."""
    folder = tmp_path_factory.mktemp("city")
    paper = PLACES[city_flights.PAPER]
    small = "radio={samples_per_chirp: 256, bandwidth_hz: 320e6, chirps_per_frame: 24}"
    paper = replace(paper, few=4, changes=(*paper.changes, small))
    flights = Flights({city_flights.PAPER: paper}, 2, 7, True)
    outcomes = Outcomes(folder)
    outcomes.begin({})
    for point in flights.points():
        job = FlightJob(
            point.key, point.tree, point.ground, str(flights.base.folder), str(folder), 1
        )
        assert run_job(job).status == "done", outcomes.read(point.key)
    return flights, folder


def test_tables_hold_what_flights_brought(flown):
    """All sets at all terminals, causes that add up, data frame by frame: of four frames one is
    data, PT1 reads them and PT2 does not see who sends."""
    flights, folder = flown
    found = outcomes_of(flights, folder)
    (outcomes,) = found.values()
    assert [len(o["by_frame"]["AT->PT1"]) for o in outcomes] == [4, 4]
    terminals = list(city._terminals(found))
    assert {(r["receivers"], r["terminal"]) for r in terminals} == {
        (s, t) for s in city_flights.SETS for t in ("AT", "PT1", "PT2")
    }
    for row, losses in zip(terminals, city._losses(found), strict=True):
        assert sum(losses[c] for c in city.LOSSES) == losses["in_view"]
        if losses["in_view"]:
            assert row["hit_rate"] == pytest.approx(losses["found"] / losses["in_view"])
    data = {r["link"]: r for r in city._data(found)}
    assert data["AT->PT1"]["data_frames"] == 2 == data["AT->PT2"]["lost_out_of_sight"]
    assert data["AT->PT1"]["lost_in_sight"] == data["AT->PT1"]["lost_out_of_sight"] == 0
    assert data["AT->PT1"]["seconds_per_frame"] > 0
    assert {r["picture"] for r in city._pictures(found)} == {"all together", "AT", "PT1", "PT2"}
    goals = list(city._goals_of_paper(outcomes))
    assert [g.found.value for g in goals[:2]] == [0.0, pytest.approx(0.0, abs=0.01)]


def test_what_is_done_is_not_flown_again(flown, monkeypatch):
    """No cluster is asked for. Planted bug: a key that depends on what is not in the scenario."""
    flights, folder = flown
    monkeypatch.setattr(city_flights, "connected", None)
    told = []
    fly(flights, folder, lambda done, total: told.append((done, total)))
    assert told == [(2, 2)]
    assert len({p.tree["seed"] for p in flights.points()}) == 2


def test_only_what_is_missing_goes_to_the_workers(flown, monkeypatch):
    """A third seed: its one flight, as a job with its own scenario; `run_points` is called as it
    is defined. The bug that was there: the count of what is done in the place of the points."""
    flights, folder = flown
    given = []

    def serve(plan, outcomes, client, job, missing, done, retry_failed, progress):
        given.extend(missing)
        assert (done, retry_failed) == (2, True)
        (fields,) = [
            {"key": p.key, "tree": p.tree, "ground": p.ground, "scenario_folder": ""} for p in given
        ]
        assert isinstance(job(given[0], **fields, folder="", threads=1), FlightJob)
        progress(3, 0, 3)

    served = create_autospec(run_points, side_effect=serve)
    monkeypatch.setattr(city_flights, "run_points", served)
    monkeypatch.setattr(city_flights, "connected", lambda *_: nullcontext())
    told = []
    fly(replace(flights, seeds=3), folder, lambda done, total: told.append((done, total)))
    assert [p.index for p in given] == [(2, 0)]
    assert told == [(2, 3), (3, 3)]


def test_a_flight_that_fails_is_one_message(flown, tmp_path):
    flights, _ = flown
    outcomes = Outcomes(tmp_path)
    outcomes.begin({})
    for point in flights.points():
        outcomes.write(point.key, {"status": "failed", "error": "no room"})
    with pytest.raises(SweepError, match="paper's swarm failed: no room"):
        outcomes_of(flights, tmp_path)


def test_every_place_can_be_flown():
    """Three of them were not used while the receivers were built."""
    assert sum(p.unseen for p in PLACES.values()) == 3
    every = Flights(PLACES, 1, 7, False)
    assert every.num_points == len(PLACES)
    for name, scenario in every.scenarios.items():
        assert scenario.cooperation == "tracks"
        assert set(scenario.compare) == set(PLACES[name].compared)


def test_seeds_are_asked_for_city_alone(capsys):
    assert main(["reproduce", "fig13", "--seeds", "3"]) == 2
    assert "--seeds" in capsys.readouterr().err
    assert (seeds_wanted(True), seeds_wanted(False)) == (1, 10)
    with repeated(4):
        assert (seeds_wanted(True), seeds_wanted(False)) == (4, 4)
