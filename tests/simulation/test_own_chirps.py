"""Plain radars with boards of their own: each is as it would be alone."""

from __future__ import annotations

import copy
import warnings

import numpy as np
import pytest
import yaml
from oracles import mixed_chirps

import isac_rt as irt
from isac_rt.document import ScenarioError
from isac_rt.frame.link import Link
from isac_rt.results.provenance import run_content
from isac_rt.scenario.file import folded_tree, to_yaml
from isac_rt.settings import plain_tree
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Exact
from isac_rt.sweep.definition import ground_of

CHIRP = {"slope_mhz_per_us": 31.0, "idle_us": 5.0, "adc_start_us": 4.0, "ramp_end_us": 14.0}
TREE = {
    "frames": 6,
    "seed": 17,
    "frame_interval_s": 0.04,
    "radio": {
        "mode": "fmcw",
        "carrier_hz": 76.2e9,
        "chirps_per_frame": 24,
        "samples_per_chirp": 64,
        "sampling_rate_hz": 8e6,
        "chirp": CHIRP,
    },
    "array": {
        "tx": {"shape": "positions", "positions": [[0, 0], [2, 0], [1, 0.5]]},
        "rx": {"shape": "linear", "columns": 4},
    },
    "swarm": {
        "A": {"role": "active", "position_m": [0, 0, 30], "boresight": [0.1, 1, 0]},
        "B": {
            "role": "active",
            "position_m": [4, 1, 30.5],
            "velocity_mps": [0.3, 1.1, 0],
            "boresight": [-0.2, 1, 0.05],
            "sensor": "bgt24mtr12",
            "radio": {"chirps_per_frame": 32},
        },
        "U": {
            "role": "target",
            "position_m": [1, 15, 31],
            "velocity_mps": [1.5, -0.9, 0.2],
            "rcs": {"model": "constant"},
        },
    },
}
pytestmark = pytest.mark.filterwarnings("ignore::isac_rt.scenario.file.ScenarioWarning")
OF_BOTH = [Link("A", "A"), Link("B", "B")]


@pytest.fixture(scope="module")
def setup():
    return irt.prepare(irt.load(TREE))


def changed(name, **keys):
    tree = copy.deepcopy(TREE)
    tree["swarm"][name] |= keys
    return tree


def test_each_radar_has_its_board(setup):
    """Numbers of the data sheet, by hand. Bugs: the common chirp for all; the spacing of half a
    wavelength at the common carrier; one resource block after the other's."""
    a, b = (setup.of(name) for name in "AB")
    assert (a.waveform.num_samples, b.waveform.num_samples) == (64, 64)
    assert (a.waveform.num_chirps, b.waveform.num_chirps) == (24, 32)
    assert b.waveform.slot_duration == pytest.approx(500e-6)
    assert b.waveform.slope == pytest.approx(0.6667e12)
    half = 299_792_458 / 24.025e9 / 2
    assert np.ptp(setup.arrays.of("B").rx_positions[:, 0]) == pytest.approx(half, rel=1e-9)
    assert (a.waveform.num_tx, b.waveform.num_tx) == (3, 1)
    table = setup.timetable
    assert table.links(3) == OF_BOTH
    assert [table.start_time(3, name) for name in "AB"] == [0.12, 0.12]
    assert table.epoch(3, "B") == pytest.approx(0.12 + 16 * 500e-6)
    assert table.epoch(3, "A") == pytest.approx(0.12 + 12 * 19e-6)


def test_samples_are_the_exact_model(setup):
    """Echoes of both radars against chirps mixed in long double, each at its own middle of the
    frame. Bugs: paths or poses of the common middle; the common carrier in their phase."""
    frame = setup.frame(4)
    for link in OF_BOTH:
        part = setup.of(link.tx)
        of_part = part.frame(4)
        sent, paths = of_part.sent[link.tx], frame.paths[link]
        receiver, reference = of_part._listening(link)
        made = if_signal(part.waveform, [(sent, paths)], receiver, reference, Exact()).samples
        pose = part.swarm.trajectories[link.tx].pose(setup.timetable.epoch(4, link.tx))
        truth = mixed_chirps(
            part.waveform,
            [(sent, paths)],
            pose,
            setup.arrays.of(link.rx),
            setup.timetable.start_time(4, link.tx),
        )
        assert np.abs(made - truth).max() <= 1e-6 * np.abs(truth).max()
        u = part.swarm.trajectories["U"].pose(setup.timetable.epoch(4, link.tx))
        distance = np.linalg.norm(u.position - pose.position)
        delay = paths.delay[paths.target == paths.target_names.index("U")]
        assert delay == pytest.approx(2 * distance / 299_792_458, rel=1e-12)


def test_a_radar_beside_another_is_as_alone(setup):
    """Samples and tracks of each to the bit as in a scenario where its board is that of all and the
    other radar a target. Bugs: the other's chirps within its samples; the other's epoch."""
    both = irt.run(irt.load(TREE), setup=setup).dataset
    tree = copy.deepcopy(TREE)
    del tree["swarm"]["B"]["sensor"], tree["swarm"]["B"]["radio"]
    tree["swarm"]["B"]["role"] = "target"
    alone = {"A": copy.deepcopy(tree)}
    del tree["radio"], tree["array"]
    tree |= {"sensor": "bgt24mtr12", "radio": {"chirps_per_frame": 32}}
    tree["swarm"]["B"]["role"], tree["swarm"]["A"]["role"] = "active", "target"
    alone["B"] = tree
    for i, name in enumerate("AB"):
        one = irt.prepare(irt.load(alone[name]))
        link = Link(name, name)
        assert np.array_equal(
            one.frame(4).samples(link).samples, setup.frame(4).samples(link).samples
        )
        single = irt.run(irt.load(alone[name]), setup=one).dataset
        for column in ("range", "velocity", "u_x", "snr"):
            mine = both[f"det_{column}"].values[both.det_observer.values == i]
            assert np.array_equal(mine, single[f"det_{column}"].values, equal_nan=True)
        for of in ("tracked_range", "detected_velocity", "truth_range"):
            assert np.array_equal(both[of].values[:, i], single[of].values[:, 0], equal_nan=True)
        carrier = {"A": 76.2e9, "B": 24.025e9}[name]
        assert float(both.carrier_hz[i]) == single.attrs["carrier_hz"] == carrier


def test_a_stated_common_chirp_changes_no_bit():
    """Two radars that state what all have still take turns, 2 T_d apart, in one run."""
    common = changed("B")
    del common["swarm"]["B"]["sensor"], common["swarm"]["B"]["radio"]
    stated = copy.deepcopy(common)
    for name in "AB":
        stated["swarm"][name] |= {"radio": dict(TREE["radio"]), "array": dict(TREE["array"])}
    one, other = (irt.run(irt.load(tree)).dataset for tree in (common, stated))
    assert one.equals(other)
    assert other.attrs["carrier_hz"] == 76.2e9


def test_the_longest_frame_sets_the_interval():
    """Bug: contiguous frames of the common chirp, into which the other radar's reach."""
    tree = copy.deepcopy(TREE)
    del tree["frame_interval_s"]
    scenario = irt.load(tree)
    assert irt.prepare(scenario).timetable.interval == pytest.approx(32 * 500e-6)
    with pytest.raises(ScenarioError, match=r"shorter than a frame, which lasts 0\.016 s"):
        irt.load(tree | {"frame_interval_s": 0.015})


def test_the_resolved_scenario_is_the_same_one():

    scenario = irt.load(TREE)
    assert irt.load(yaml.safe_load(to_yaml(scenario))).model_dump() == scenario.model_dump()


def test_files_name_each_radars_chirp(tmp_path):
    """Samples of both for other programs, with their own sizes; plan and coverage name both."""
    from isac_rt.simulation.audit import make_plan
    from isac_rt.views.samples import write_samples

    setup = irt.prepare(irt.load(TREE))
    write_samples(setup, [1, 2], OF_BOTH, "npy", tmp_path)
    assert np.load(tmp_path / "A_to_A.npy").shape == (2, 1, 4, 24, 64)
    assert np.load(tmp_path / "B_to_B.npy").shape == (2, 1, 2, 32, 64)
    plan = make_plan(setup)
    assert [of["frame_s"] for of in plan["coverage"]["links"]] == pytest.approx([456e-6, 16e-3])
    assert plan["by_chirp"]["B"]["reach_m"] != plan["reach_m"]
    assert {i["link"] for i in plan["items"]} == {"all", "A", "B", "A->A", "B->B"}


def test_different_chirps_in_one_band_of_unknown_power_are_doubted():
    """Said once, and neither where bands are apart nor where powers are stated. Bug: carriers alone
    compared; warned of in a link budget too."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        irt.prepare(irt.load(TREE))
        assert not [one for one in said if "same frequencies" in str(one.message)]
        tree = changed("B", sensor="awr1843", radio={"carrier_hz": 76.5e9})
        irt.prepare(irt.load(tree))
        assert not [one for one in said if "same frequencies" in str(one.message)]
        irt.prepare(irt.load(tree | {"noise": {"model": "snr"}}))
    about = [str(one.message) for one in said if "same frequencies" in str(one.message)]
    assert len(about) == 1 and about[0].startswith("A and B sweep")


@pytest.mark.parametrize(
    ("name", "keys", "said"),
    [
        ("A", {"radio": {"chirps_per_frame": 23}}, "swarm.A.radio.*23 chirps are not a multiple"),
        (
            "A",
            {"radio": {"mode": "isac", "chirp": None}},
            "is isac, and radio.mode of all terminals is fmcw",
        ),
        ("A", {"radio": {"scheme": "simo"}}, "swarm.A.radio.scheme.*simo sends from one antenna"),
        ("U", {"sensor": "awr1843"}, "swarm.U.sensor.*has no meaning for what neither"),
        ("A", {"sensor": "awr9"}, "swarm.A.sensor = awr9: must be awr1642"),
        ("A", {"sensor": "gone.cfg"}, "swarm.A.sensor.*gone.cfg: cannot be read"),
        ("A", {"radio": {"calibration": "gone.nc"}}, "swarm.A.radio.calibration.*no such file"),
    ],
)
def test_bad_boards_are_refused_once(name, keys, said):
    """Bug: the common radio's rules asked of the terminal's."""
    with pytest.raises(ScenarioError, match=said) as problem:
        irt.load(changed(name, **keys))
    assert "\n" not in str(problem.value)


def test_terminals_with_data_share_the_chirp():
    tree = changed("B")
    tree["radio"] = {}
    with pytest.raises(ScenarioError, match="terminals that send data share the chirp") as problem:
        irt.load(tree)
    assert "swarm.B.sensor" in str(problem.value)


def test_a_radar_takes_its_boards_file(tmp_path):
    """TI's configuration of one terminal, relative to the scenario's folder; the common interval
    stays. Bug: the board's period for all."""
    (tmp_path / "b.cfg").write_text(
        "channelCfg 15 1 0\nadcCfg 2 1\nprofileCfg 0 77.5 20 7 40 0 0 30 1 128 5000 0 0 30\n"
        "chirpCfg 0 0 0 0 0 0 0 1\nframeCfg 0 0 32 0 100 1 0\n"
    )
    tree = changed("B", sensor="b.cfg", radio={"samples_per_chirp": 64})
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(tree))
    scenario = irt.load(tmp_path / "s.yaml")
    radio = scenario.swarm["B"].radio
    assert (radio.carrier_hz, radio.samples_per_chirp, radio.chirps_per_frame) == (77.5e9, 64, 32)
    assert scenario.frame_interval_s == TREE["frame_interval_s"]
    assert irt.prepare(scenario).of("B").waveform.slope == pytest.approx(30e12)


def test_what_is_kept_depends_on_each_boards_calibration(tmp_path):
    """One changed byte of one radar's file makes another run and another point of a sweep. Bug: the
    common board's file alone."""
    found = []
    for text in ("one", "two"):
        (tmp_path / "b.nc").write_text(text)
        tree = changed("B", radio={"calibration": "b.nc"})
        (tmp_path / "s.yaml").write_text(yaml.safe_dump(tree))
        scenario = irt.load(tmp_path / "s.yaml")
        found.append((run_content(scenario, 2), ground_of(plain_tree(scenario), tmp_path)))
    assert found[0][0] != found[1][0]
    assert found[0][1] != found[1][1]


def test_sweeps_take_boards_as_values():
    """A board in place of another, of all or of one radar, is as if the file had named it; what the
    file states stays. Bug: the first board's numbers stated beside the second one's name."""
    tree = changed("B", radio={"chirps_per_frame": 24}) | {"sensor": "iwr6843"}
    tree |= {"radio": {"samples_per_chirp": 128}, "array": {"element_gain_dbi": 6.5}}
    base = irt.load(tree)
    for board in ("awr2944", "awr1642"):
        folded = folded_tree(base, ["sensor"]) | {"sensor": board}
        assert irt.load(folded).model_dump() == irt.load(tree | {"sensor": board}).model_dump()
        folded = folded_tree(base, ["swarm.B.sensor"])
        folded["swarm"]["B"]["sensor"] = board
        other = copy.deepcopy(tree)
        other["swarm"]["B"]["sensor"] = board
        assert irt.load(folded).model_dump() == irt.load(other).model_dump()
