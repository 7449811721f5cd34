"""What a scenario may say of hardware, and what it refuses."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from isac_rt.document import ScenarioError
from isac_rt.frame.front_end import FrontEnd, Oscillator
from isac_rt.scenario.file import load, to_yaml
from isac_rt.scenario.tree import Scenario

SWARM = {
    "AT": {"role": "active", "position_m": [0, 0, 30], "boresight": [0, 1, 0]},
    "PT": {"role": "passive", "position_m": [0, 30, 30], "boresight": [0, -1, 0]},
}


@pytest.mark.parametrize(
    ("oscillator", "said"),
    [
        ({"mask_dbc_hz": [[1e4, -80], [1e5, -79]]}, "mask_dbc_hz.1: the mask rises"),
        ({"mask_dbc_hz": [[1e5, -80], [1e5, -90]]}, "does not follow 100000 Hz"),
        ({"mask_dbc_hz": [[1e5, -80]], "locked": False}, "needs two points or more"),
        ({"mask_dbc_hz": [[1e5, float("nan")]]}, "finite number"),
        ({"mask_dbc_hz": [[0.0, -80]]}, "greater than or equal to 0.001"),
    ],
)
def test_masks_that_are_none_are_refused(oscillator, said):
    """Planted bug: `after[1] < before[1]`."""
    with pytest.raises(ValidationError, match=said):
        Oscillator(**oscillator)


def test_a_terminal_s_own_front_end_goes_before_that_of_all():
    """Planted bug: `self.radio.front_end or ...`."""
    noisy = {"oscillator": {"mask_dbc_hz": [[1e5, -80.0]]}}
    swarm = SWARM | {"PT": SWARM["PT"] | {"front_end": {}}}
    scenario = Scenario(swarm=swarm, radio={"front_end": noisy})
    assert not scenario.front_end_of("AT").ideal
    assert scenario.front_end_of("PT").ideal
    assert FrontEnd().ideal


@pytest.mark.parametrize(
    ("rx", "count"),
    [
        ({"shape": "linear", "columns": 4}, 4),
        ({"shape": "planar", "columns": 3, "rows": 2}, 6),
        ({"shape": "ti_cascade"}, 16),
        ({"positions": [[0, 0], [1, 0], [2, 0.5]]}, 3),
    ],
)
def test_elements_are_those_of_the_array_that_is_stated(rx, count):
    """Not the 15 of the default L."""
    array = {"rx": rx}
    stated = {"front_end": {"receive": {"gain_db": [0.5] * count}}}
    front_end = Scenario(swarm=SWARM, array=array, radio=stated).front_end_of("AT")
    assert len(front_end.receive.gain_db) == count
    stated["front_end"]["receive"]["gain_db"] = [0.5] * 15
    with pytest.raises(ValidationError, match=f"15 values for {count} receive elements"):
        Scenario(swarm=SWARM, array=array, radio=stated)


def test_targets_have_no_front_end():
    """Planted bug: `problems` of a UAV without those of its hardware."""
    with pytest.raises(ValidationError, match="no meaning for what neither"):
        Scenario(swarm=SWARM | {"U": {"role": "target", "position_m": [9, 9, 9], "front_end": {}}})


@pytest.mark.parametrize(
    ("radio", "said"),
    [
        ({"front_end": {"preset": "awr1443"}}, "antennas that send at once have one response"),
        ({"calibration": "board.cal"}, "gains of antennas that send at once cannot be told"),
    ],
)
def test_what_cannot_be_told_of_antennas_that_send_at_once_is_refused(radio, said):
    """A response of its own at each, and a board's calibration by transmitter, hold where antennas
    take turns."""
    alone = {"AT": SWARM["AT"]}
    for scheme in ("ddm", "bpm"):
        with pytest.raises(ValidationError, match=said):
            Scenario(swarm=alone, radio={"mode": "fmcw", "scheme": scheme, **radio})
    Scenario(swarm=alone, radio={"mode": "fmcw", **radio})


@pytest.mark.parametrize(
    ("elements", "said"),
    [
        ({"transmit": {"gain_db": [1, 2]}}, "gain_db: 2 values for 3 transmit elements"),
        ({"receive": {"delay_ps": [0, 1]}}, "2 values for 15 receive elements"),
        ({"receive": {"gain_std_db": -1}}, "greater than or equal to 0"),
        ({"receive": {"delay_ps": [float("inf")]}}, "finite number"),
    ],
)
def test_elements_that_do_not_match_the_array_are_refused(elements, said):
    """At all terminals and at one. Planted bug: transmit held against the receive
    elements."""
    with pytest.raises(ValidationError, match=said):
        Scenario(swarm=SWARM, radio={"front_end": elements})
    with pytest.raises(ValidationError, match=said):
        Scenario(swarm=SWARM | {"PT": SWARM["PT"] | {"front_end": elements}})


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"transmit_response": {"table_db": [1]}}, "one value is no table"),
        ({"receive_response": {"table_deg": [0, float("nan")]}}, "finite number"),
        ({"transmit": {"gain_db": [400]}}, "less than or equal to 120"),
        ({"transmit": {"gain_std_db": 30}}, "less than or equal to 20"),
        ({"converter": {"compression_dbm": -400}}, "greater than or equal to -200"),
        ({"shifter": {"errors_deg": [1, 2]}}, "of steps of which there are none"),
        ({"shifter": {"errors_std_deg": 2}}, "of steps of which there are none"),
        ({"shifter": {"bits": 2, "errors_deg": [1, 2, 3]}}, "3 values for the 4 steps of 2 bits"),
        ({"converter": {"bits": 0}}, "greater than or equal to 1"),
        ({"converter": {"full_scale_dbm": -10}}, "converters without bits"),
        ({"converter": {"iq_phase_deg": 60}}, "less than or equal to 45"),
    ],
)
def test_sweeps_and_converters_that_are_none_are_refused(stated, said):
    """Planted bug: a table of one value accepted."""
    with pytest.raises(ValidationError, match=said):
        FrontEnd(**stated)


@pytest.mark.parametrize("stated", [{"converter": {"dc_dbm": -60}}, {"saturation_dbm": 10}])
def test_powers_need_a_link_budget(stated):
    """Planted bug: `noise.model == "link_budget"`."""
    Scenario(swarm=SWARM, radio={"front_end": stated})
    with pytest.raises(ValidationError, match=r"which noise\.model snr does not know"):
        Scenario(swarm=SWARM, radio={"front_end": stated}, noise={"model": "snr"})


def test_presets_give_way_to_what_is_stated(tmp_path):
    """Key by key; what is written holds both and reads back. Planted bug: a part that is stated
    replaces the preset's whole."""
    one = FrontEnd(preset="awr1443", transmit={"gain_std_db": 0.2})
    assert one.transmit.gain_std_db == 0.2
    assert one.transmit.delay_ps == (228,)
    assert one.oscillator.mask_dbc_hz[0] == (3e5, -85.0)
    scenario = Scenario(swarm=SWARM, radio={"front_end": {"preset": "pll_poor"}})
    (tmp_path / "s.yaml").write_text(to_yaml(scenario))
    assert load(tmp_path / "s.yaml").radio.front_end == scenario.radio.front_end
    assert FrontEnd(preset="ideal").ideal
    with pytest.raises(ValidationError, match="Input should be 'ideal'"):
        FrontEnd(preset="perfect")


def test_what_is_stated_is_written_and_read_again(tmp_path):
    """Planted bug: a tuple of points written as one list."""
    mask = {"oscillator": {"mask_dbc_hz": [[1e4, -80.0], [1e6, -100.5]], "locked": False}}
    one = Scenario(swarm=SWARM, radio={"front_end": mask})
    (tmp_path / "s.yaml").write_text(to_yaml(one))
    assert load(tmp_path / "s.yaml").radio.front_end == one.radio.front_end


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ({"radio": {"front_end": {"preset": ["ideal"]}}}, "preset"),
        ({"swarm": {"AT": {**SWARM["AT"], "front_end": {"preset": {"a": 1}}}}}, "preset"),
        ({"radio": {"front_end": {"ramp": {"ripple_hz": 1e300}}}}, "no error of a ramp"),
        ({"belief": {"missing_m": [["a", 1, 2, 3]]}}, "four numbers"),
        ({"array": {"rx": {"positions": [[1e308, 0], [-1e308, 0]]}}}, "no place in an array"),
        (
            {
                "swarm": {"AT": SWARM["AT"]},
                "radio": {
                    "mode": "fmcw",
                    "chirp": {
                        "slope_mhz_per_us": 1e308,
                        "adc_start_us": 0,
                        "idle_us": 1,
                    },
                },
            },
            "bandwidth_hz",
        ),
    ],
)
def test_what_is_no_value_is_one_message(part, said):
    """Seen as a TypeError and a ZeroDivisionError."""
    with pytest.raises(ScenarioError, match=said):
        load({"swarm": SWARM} | part)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"radio": {"groups": 2}}, "as many groups as the 3 transmit antennas"),
    ],
)
def test_self_calibration_needs_samples_and_all_groups(changes, words):
    """Also in a set that is compared."""
    wanted = {"self_calibration": "tracks"}
    receivers = {**changes.get("receivers", {}), **wanted}
    radio = changes.get("radio", {})
    with pytest.raises(ValueError, match=words):
        Scenario(swarm=SWARM, radio=radio, receivers=receivers)
    if radio:
        with pytest.raises(ValueError, match=words):
            Scenario(swarm=SWARM, radio=radio, compare={"other": {"receivers": wanted}})


def test_self_calibration_of_a_sensor_is_told_what_helps():
    """`radio.groups` is refused in mode fmcw, so that it is no remedy there."""
    sensor = {"AT": SWARM["AT"]}
    receivers = {"self_calibration": "tracks"}
    with pytest.raises(ValueError, match="needs one transmit antenna in mode fmcw") as told:
        Scenario(swarm=sensor, sensor="awr1843", receivers=receivers)
    assert "change radio.groups" not in str(told.value)
    Scenario(swarm=sensor, sensor="bgt24mtr12", receivers=receivers)
