"""Where the time of a run goes."""

from __future__ import annotations

import threading
import time

import pytest

from isac_rt.results.recorder import STAGES
from isac_rt.simulation.stopwatch import Seconds, Stopwatch


def busy(seconds: float) -> None:
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_stages_are_processor_time_and_add_up():
    """Work of 0.2 and 0.1 s in two threads and sleep of 0.1 s, which the wall alone counts.

    The tolerance holds thread switches. Planted bug: `perf_counter` in `of_thread` (the sleep
    counts as synthesis).
    """
    watch = Stopwatch()
    watch.set_up(Seconds(3.25, 1.75))

    def work():
        with watch.stage("receive"):
            busy(0.2)

    other = threading.Thread(target=work)
    other.start()
    with watch.stage("synthesis"):
        busy(0.1)
        time.sleep(0.1)
    other.join()
    found = watch.so_far()
    assert found["receive"] == pytest.approx(0.2, abs=0.03)
    assert found["synthesis"] == pytest.approx(0.1, abs=0.03)
    assert found["setup"] == 3.25 and found["wall"]["setup"] == 1.75
    assert found["wall"]["synthesis"] >= 0.2 and found["wall"]["total"] >= 1.95
    stages = sum(found[name] for name in (*STAGES, "other"))
    assert found["total"] == pytest.approx(stages) and found["other"] < 0.1


def test_an_earlier_call_counts():
    """All numbers of the first call are in those of the second. Planted bug: `before` without the
    earlier total."""
    first, second = Stopwatch(), Stopwatch()
    first.set_up(Seconds(2.5, 1.5))
    with first.stage("track"):
        busy(0.05)
    earlier = first.so_far()
    second.restore(earlier)
    found = second.so_far()
    for name in (*STAGES, "total"):
        assert found[name] >= earlier[name] and found["wall"][name] >= earlier["wall"][name]
    assert found["setup"] == 2.5 and found["other"] >= 0
