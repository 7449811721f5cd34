"""Plain FMCW: a data sheet's timing, codes of antennas that send at once, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from isac_rt.document import ScenarioError
from isac_rt.frame.schedule import codes_of, images, schedule_of, unambiguous_share
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Sweep, Waveform, waveform_of
from isac_rt.scenario.file import load, to_yaml

CHIRP = {"slope_mhz_per_us": 21.0, "idle_us": 4, "adc_start_us": 3.5, "ramp_end_us": 31}
SCENE = {
    "frames": 3,
    "radio": {
        "mode": "fmcw",
        "samples_per_chirp": 250,
        "sampling_rate_hz": 10e6,
        "chirps_per_frame": 48,
        "chirp": CHIRP,
    },
    "swarm": {
        "R": {"role": "active", "position_m": [0, 0, 10]},
        "T": {"role": "target", "position_m": [1, 30, 12]},
    },
}


def scenario(tmp_path, *overrides):
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(SCENE))
    return load(path, overrides)


def waveform(scheme, num_tx, bands, chirps=48):
    sweep = Sweep(21e12, 31e-6, 3.5e-6, 35e-6)
    return Waveform(
        bandwidth=651e6,
        sampling_rate=10e6,
        num_samples=250,
        num_chirps=chirps,
        num_groups=1,
        num_tx=num_tx,
        sweep=sweep,
        carries_data=False,
        scheme=scheme,
        bands=bands,
    )


def test_timing_of_a_data_sheet_by_hand(tmp_path):
    """Range cell c/(2 S T), longest range c f_s/(2 S), velocities lambda/(4 L T_c); bug: the
    paper's slope B / (T + 2 T_d)."""
    s = scenario(tmp_path)
    w = waveform_of(s.radio, s.array)
    assert s.radio.bandwidth_hz == pytest.approx(21e12 * 31e-6)
    assert w.slot_duration == pytest.approx(35e-6) and w.frame_duration == pytest.approx(48 * 35e-6)
    assert w.range_cell(2) == pytest.approx(SPEED_OF_LIGHT / (2 * 21e12 * 25e-6))
    reach = w.num_range_cells * w.range_cell(2)
    assert reach == pytest.approx(SPEED_OF_LIGHT * 10e6 / (2 * 21e12))
    middle = 77e9 + 21e12 * (3.5e-6 + 12.5e-6)
    assert w.effective_carrier == pytest.approx(middle)
    assert w.max_velocity(2) == pytest.approx(SPEED_OF_LIGHT / middle / (4 * 35e-6))
    assert unambiguous_share(w) == pytest.approx(1 / 3)
    assert s.frame_duration_s == pytest.approx(w.frame_duration)
    assert w.bits_per_frame(8) == 0


def test_a_plain_radar_round_trips(tmp_path):
    """Keys that follow are written too and fit; bug: groups written as 3."""
    s = scenario(tmp_path, "radio.scheme=ddm")
    again = tmp_path / "again.yaml"
    again.write_text(to_yaml(s))
    assert load(again) == s and s.radio.groups == 1
    text = to_yaml(load("scenes/street_canyon.yaml"))
    assert "mode" not in yaml.safe_load(text)["radio"]


@pytest.mark.parametrize("scheme", ["ddm", "bpm"])
@pytest.mark.parametrize(("num_tx", "bands"), [(2, 4), (3, 4), (4, 8), (12, 16)])
def test_codes_are_orthogonal_over_every_period(scheme, num_tx, bands):
    """Exactly, by integers for Hadamard; bug: a code that advances by a/L_tx in place of a/B."""
    codes = codes_of(waveform(scheme, num_tx, bands))
    one = codes[:, bands : 2 * bands]
    assert one @ one.conj().T == pytest.approx(bands * np.eye(num_tx), abs=1e-12)
    assert np.abs(codes) == pytest.approx(np.ones(codes.shape))


def test_images_by_counting():
    """DDM: of L antennas in B bands L - k pairs stand k bands apart, and L - (B - k) on the other
    side round. Three of four Hadamard rows: the products of two are each other row twice, and over
    the rows a line has a power of one."""
    w = waveform("ddm", 4, 6)
    pairs = [sum((b - a) % 6 == k for a in range(4) for b in range(4)) for k in range(6)]
    assert images(w) == pytest.approx(np.array(pairs, float), abs=1e-12)
    assert images(waveform("bpm", 3, 4)) == pytest.approx(np.array([3, 2, 2, 2.0]), abs=1e-12)
    assert images(waveform("bpm", 4, 4)) == pytest.approx(np.full(4, 4.0), abs=1e-12)
    shares = [unambiguous_share(waveform("bpm", n, b)) for n, b in ((4, 4), (4, 8), (2, 4), (3, 4))]
    assert shares == [0.25, 1, 1, 1]
    assert unambiguous_share(waveform("ddm", 4, 4)) == 0.25


def test_all_antennas_send_in_every_slot():
    """No schedule where all send at once; in order where they take turns."""
    rng = np.random.default_rng(1)
    assert (schedule_of("conventional", waveform("bpm", 3, 4), rng) == 0).all()
    turns = schedule_of("conventional", waveform("tdm", 3, 1), rng)
    assert turns[0, :7].tolist() == [0, 1, 2, 0, 1, 2, 0]


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("radio.chirp.adc_start_us=7", "last sample is taken 32 us"),
        ("radio.chirp.adc_start_us=0.4", "comes back 0.4762 us"),
        ("radio.bandwidth_hz=700e6", "6.51e+08 follows from radio.chirp"),
        ("radio.chirp.slope_mhz_per_us=-3", "greater than 0"),
        ("radio.chirp=3", "must be a mapping"),
        ("radio.groups=3", "carry data"),
        ("radio.sub_bands=4", "no meaning with scheme tdm"),
        ("radio.scheme=simo", "simo sends from one antenna, and there are 3"),
        ("radio.mode=isac", "no meaning with mode isac"),
        ("swarm.T.role=passive", "no passive terminals"),
        ("access.establish=true", "no links between terminals"),
        ("receivers.velocity_method=pursuit", "not made for mode fmcw with scheme tdm"),
        ("radio.chirps_per_frame=50", "not a multiple"),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path, override, said):
    """One message each, with the key that was set."""
    with pytest.raises(ScenarioError, match=said.replace("+", r"\+")):
        scenario(tmp_path, override)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["radio.scheme=bpm", "radio.sub_bands=6"], "power of two"),
        (["radio.scheme=ddm", "radio.sub_bands=2"], "do not hold the 3"),
        (["radio.scheme=ddm", "radio.sub_bands=5"], "not a multiple of the 5 sub_bands"),
        (["radio.scheme=ddm", "receivers.refinement=joint"], "not made for mode fmcw"),
    ],
)
def test_codes_that_do_not_fit_are_refused(tmp_path, overrides, said):
    """Bug: the bands checked against no array."""
    with pytest.raises(ScenarioError, match=said):
        scenario(tmp_path, *overrides)
