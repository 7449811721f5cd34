"""Configurations of boards: a command line's and mmWave Studio's of one board say the same."""

from __future__ import annotations

import json

import numpy as np
import pytest

from isac_rt.document import ScenarioError
from isac_rt.extensions.hardware.description import load_description
from isac_rt.extensions.hardware.readers import import_file, import_frames
from isac_rt.extensions.hardware.types import CaptureError
from isac_rt.frame.boards import BoardFileError, read_board
from isac_rt.scenario.file import load
from isac_rt.simulation.setup import prepare

CFG = """% three transmitters, of which the first and the third send
sensorStop
channelCfg 15 5 0
adcCfg 2 1
adcbufCfg -1 0 1 1 1
profileCfg 0 77 267 7 57.14 0 0 70 1 256 5209 0 0 30
chirpCfg 0 0 0 0 0 0 0 1
chirpCfg 1 1 0 0 0 0 0 4
frameCfg 0 1 16 40 100 1 0
sensorStart
"""
STUDIO = {
    "mmWaveDevices": [
        {
            "rfConfig": {
                "rlChanCfg_t": {"rxChannelEn": "0xF", "txChannelEn": "0x5"},
                "rlAdcOutCfg_t": {"fmt": {"b2AdcBits": 2, "b2AdcOutFmt": 1}},
                "rlProfiles": [
                    {
                        "rlProfileCfg_t": {
                            "profileId": 0,
                            "startFreqConst_GHz": 77.0,
                            "idleTimeConst_usec": 267.0,
                            "adcStartTimeConst_usec": 7.0,
                            "rampEndTime_usec": 57.14,
                            "freqSlopeConst_MHz_usec": 70.0,
                            "numAdcSamples": 256,
                            "digOutSampleRate": 5209.0,
                        }
                    }
                ],
                "rlChirps": [
                    {
                        "rlChirpCfg_t": {
                            "chirpStartIdx": k,
                            "chirpEndIdx": k,
                            "profileId": 0,
                            "txEnable": hex(mask),
                        }
                    }
                    for k, mask in enumerate((1, 4))
                ],
                "rlFrameCfg_t": {
                    "chirpStartIdx": 0,
                    "chirpEndIdx": 1,
                    "numLoops": 16,
                    "numFrames": 40,
                    "framePeriodicity_msec": 100.0,
                },
            },
            "rawDataCaptureConfig": {"rlDevDataFmtCfg_t": {"chInterleave": 1, "iqSwapSel": 1}},
        }
    ]
}
SWARM = """frames: 4
sensor: {}
swarm:
  R: {{role: active, position_m: [0, 0, 9]}}
  U: {{role: target, position_m: [1, 7, 9.2]}}
"""


@pytest.fixture
def files(tmp_path):
    (tmp_path / "b.cfg").write_text(CFG)
    (tmp_path / "b.mmwave.json").write_text(json.dumps(STUDIO))
    return tmp_path


def test_both_files_say_what_the_board_does(files):
    """Numbers by hand: 70 MHz/us over 57.14 us, 256 samples at 5.209 Msps from 7 us on,
    transmitters 0 and 2 in turn, 16 loops in 100 ms. Planted bugs: masks taken for numbers; slope
    and idle time exchanged; the period in seconds."""
    board = read_board(files / "b.cfg")
    assert board == read_board(files / "b.mmwave.json")
    assert (board.start_hz, board.slope, board.rate) == (77e9, pytest.approx(70e12), 5.209e6)
    assert (board.chirps, board.loops, board.frames, board.receivers) == ((0, 2), 16, 40, 4)
    times = board.idle, board.adc_start, board.ramp_end, board.period
    assert times == pytest.approx((267e-6, 7e-6, 57.14e-6, 0.1))
    assert board.interleaved is False and board.q_first


def test_a_description_and_a_scenario_have_its_chirp(files):
    """A capture's waveform and a simulated one are the same; the transmitters stand two wavelengths
    apart, those of the board's numbers 0 and 2. Stated keys override. Planted bug: places of
    transmitters 0 and 1."""
    from isac_rt.extensions.hardware.readers import waveform_described

    said = load_description(files / "b.cfg")
    assert said.chirps == (0, 1) and said.frame_interval_ms == pytest.approx(100)
    (files / "s.yaml").write_text(SWARM.format("b.mmwave.json"))
    scenario = load(files / "s.yaml", ["radio.chirps_per_frame=64"])
    assert scenario.frame_interval_s == pytest.approx(0.1) and scenario.sensor is None
    setup, captured = prepare(scenario), waveform_described(said)
    assert setup.waveform.num_chirps == 64 and captured.num_chirps == 32
    for name in ("slope", "sampling_rate", "num_samples", "slot_duration", "carrier_frequency"):
        assert getattr(setup.waveform, name) == pytest.approx(getattr(captured, name))
    tx = setup.antennas.tx_positions
    assert abs(tx[1, 0] - tx[0, 0]) == pytest.approx(2 * 299792458 / 77e9)
    places = said.antennas()
    assert places is not None
    assert places.virtual_positions == pytest.approx(setup.antennas.virtual_positions)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("70 1 256", "fast 1 256", ":6: freqSlopeConst is 'fast', no number"),
        ("profileCfg 0 77", "profileCfg 0 7700", ":6: startFreq is 7700, it must be 1 to 500"),
        ("70 1 256 5209 0 0 30", "70", ":6: profileCfg has 8 numbers, it needs 14"),
        ("0 0 0 0 0 0 0 1", "0 0 0 0 0 0 0 3", ": chirp 0 switches 2 transmitters on"),
        ("chirpCfg 1 1", "chirpCfg 2 2", ": chirp 1 of the frame is configured 0 times"),
        ("1 1 0 0 0 0 0 4", "1 1 1 0 0 0 0 4", ": chirp 1 has another profile"),
        ("frameCfg", "%", ": has no frameCfg"),
        ("adcCfg 2 1", "adcCfg 2 3", ":4: the output format is 3, it must be 0 to 2"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(files, old, new, said):
    (files / "b.cfg").write_text(CFG.replace(old, new))
    with pytest.raises(BoardFileError, match=said):
        read_board(files / "b.cfg")
    with pytest.raises(CaptureError, match=said):
        load_description(files / "b.cfg")
    (files / "s.yaml").write_text(SWARM.format("b.cfg"))
    with pytest.raises(ScenarioError, match=r"s\.yaml:2: sensor: .*" + said):
        load(files / "s.yaml")


@pytest.mark.parametrize(("swap", "cell"), [(1, 20), (0, 236)])
def test_the_order_of_i_and_q_and_the_frames_of_an_endless_board(files, swap, cell):
    """A tone of 20 cells, written Q first (Q Q I I), comes back as two frames; read as I first its
    beat is mirrored. A frame cut off and one beyond the last are refused. Planted bugs: SampleSwap
    taken from the place before it; frames: 1 where frameCfg says 0."""
    tone = np.exp(2j * np.pi * 20 / 256 * np.arange(256))
    counts = np.rint(1000 * np.stack([tone.imag, tone.real])).astype("<i2")
    words = counts.reshape(2, 128, 2).swapaxes(0, 1).tobytes()  # Q Q I I
    frame = words * (32 * 4)
    (files / "a.bin").write_bytes(frame * 2)
    text = CFG.replace("1 1 1\nprofile", f"{swap} 1 1\nprofile").replace(" 16 40 100", " 16 0 100")
    (files / "b.cfg").write_text(text)
    found = import_frames(files / "a.bin", load_description(files / "b.cfg"))
    assert len(found) == 2
    for capture in (found[0], found[1]):
        assert capture.cube.samples.shape == (1, 4, 32, 256)
        spectra = np.abs(np.fft.fft(capture.cube.samples, axis=-1))
        assert (spectra.argmax(axis=-1) == cell).all()
    (files / "a.bin").write_bytes(frame * 2 + words)
    with pytest.raises(CaptureError, match=f"or cut the file off at {2 * len(frame)} bytes"):
        import_frames(files / "a.bin", load_description(files / "b.cfg"))
    (files / "a.bin").write_bytes(frame * 2)
    late = load_description(files / "b.cfg").model_copy(update={"frame": 2})
    with pytest.raises(CaptureError, match="has frames 0 to 1; frame: 2 is none"):
        import_file(files / "a.bin", late)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[]", "is no configuration of mmWave Studio"),
        ("{", "is no configuration of mmWave Studio"),
        (json.dumps(STUDIO).replace("numLoops", "loops"), "rlFrameCfg_t: has no numLoops"),
        (json.dumps(STUDIO).replace('"0x4"', '"all"'), r"rlChirps\[1\]: txEnable is 'all'"),
    ],
)
def test_a_bad_studio_file_is_refused(files, content, said):
    (files / "b.json").write_text(content)
    with pytest.raises(BoardFileError, match=said):
        read_board(files / "b.json")
