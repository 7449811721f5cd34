"""Processor and wall seconds of each stage of a run."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from isac_rt.results.recorder import STAGES


class Seconds(NamedTuple):
    """Duration of one piece of work.

    Attributes
    ----------
    processor : user and system time
    wall : from its beginning to its end
    """

    processor: float = 0.0
    wall: float = 0.0

    def __add__(self, more: Any) -> Seconds:
        return Seconds(self[0] + more[0], self[1] + more[1])

    def __sub__(self, earlier: Any) -> Seconds:
        return Seconds(self[0] - earlier[0], self[1] - earlier[1])

    @classmethod
    def of_process(cls) -> Seconds:
        """Return the time of all threads of the process so far; wall time has an arbitrary zero."""
        return cls(time.process_time(), time.perf_counter())

    @classmethod
    def of_thread(cls) -> Seconds:
        """Return the time of the calling thread so far; wall time has an arbitrary zero."""
        return cls(time.thread_time(), time.perf_counter())


NONE = Seconds()


@dataclass
class Stopwatch:
    """Seconds of each stage of a run, summed over the threads that work in it.

    Stages of several threads overlap, so their wall seconds may add up to more than the total's.
    Processor seconds add up: what no stage counts (threads of the ray tracer, waiting, progress)
    is `other`.
    """

    spent: dict[str, Seconds] = field(default_factory=lambda: dict.fromkeys(STAGES, NONE))
    before: Seconds = NONE
    """Set-up, and earlier calls of a run that goes on."""
    begun: Seconds = field(default_factory=Seconds.of_process)
    _adding: threading.Lock = field(default_factory=threading.Lock)

    def set_up(self, seconds: Seconds) -> None:
        """Add the set-up, which precedes the start of the stopwatch."""
        self.spent["setup"] += seconds
        self.before += seconds

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the time of this thread in a stage."""
        start = Seconds.of_thread()
        yield
        seconds = Seconds.of_thread() - start
        with self._adding:
            self.spent[name] += seconds

    def so_far(self) -> dict[str, Any]:
        """Return processor seconds of each stage, ``other`` and ``total``; under ``wall`` the wall
        seconds, without ``other``."""
        total = self.before + (Seconds.of_process() - self.begun)
        processor = {name: spent.processor for name, spent in self.spent.items()}
        return {
            **processor,
            "other": max(total.processor - sum(processor.values()), 0.0),
            "total": total.processor,
            "wall": {**{name: s.wall for name, s in self.spent.items()}, "total": total.wall},
        }

    def restore(self, earlier: Mapping[str, Any]) -> None:
        """Add the seconds of an earlier call of the same run (`so_far`)."""
        for name in STAGES:
            self.spent[name] += Seconds(earlier[name], earlier["wall"][name])
        self.before += Seconds(earlier["total"], earlier["wall"]["total"])
