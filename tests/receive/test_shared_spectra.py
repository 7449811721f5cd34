"""What several sets of receivers make of one cube, made once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from receiver_cubes import ANTENNAS, Path, cube, frame

from isac_rt.receive import spectrum
from isac_rt.receive.active import receive_active
from isac_rt.receive.settings import Receivers


def test_receivers_of_one_cube_share_what_they_clean_and_hear_what_they_hear_alone(monkeypatch):
    """Planted bugs: the filter works on the shared spectra (the second receiver hears what the
    first one left); spectra are kept whatever data were read."""
    w, schedule, payload = frame()
    heard = cube(w, schedule, payload, [Path(60.0, 0.0), Path(82.0, 14.0)]).shared()
    filtering = Receivers(clutter_filter="zero_doppler")
    made = []

    def count(*arguments, clean=spectrum.clean_spectrum):
        made.append(clean(*arguments))
        return made[-1]

    monkeypatch.setattr(spectrum, "clean_spectrum", count)

    def ranges(of, settings, sent=payload):
        return receive_active(of, sent, ANTENNAS, settings).detections.range

    first, second = ranges(heard, filtering), ranges(heard, Receivers())
    assert len(made) == 1
    assert np.array_equal(second, ranges(replace(heard), Receivers()))
    assert len(second) == 2
    assert len(first) != len(second)
    other = replace(payload, delay_symbols=payload.delay_symbols[:, ::-1])
    assert len(made) == 2
    ranges(heard, Receivers(), other)
    assert len(made) == 3


def test_samples_that_change_are_received_as_they_are():
    """Planted bug: every cube keeps what was made of it, so that noise added later is not heard."""
    w, schedule, payload = frame()
    heard = cube(w, schedule, payload, [Path(60.0, 0.0)])
    before = receive_active(heard, payload, ANTENNAS, Receivers()).detections
    heard.samples[:] *= 0
    after = receive_active(heard, payload, ANTENNAS, Receivers()).detections
    assert len(before) == 1
    assert len(after) == 0
