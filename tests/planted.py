"""Bugs that tests of hard cases are written against; `python tests/mutation.py --hard` plants each
and runs its test, which must fail."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Bug:
    """In `file` of the package `old` becomes `new`; `test` (file::name) is to fail then."""

    test: str
    file: str
    old: str
    new: str


BUGS = (
    Bug(
        "test_hard_geometry::test_grazing_rays",
        "propagation/legs/geometry.py",
        "image = image - 2 * ((n * image)",
        "image = image - 1.999 * ((n * image)",
    ),
    Bug(
        "test_hard_geometry::test_a_transmitter_close_to_a_wall_or_on_it",
        "propagation/legs/clearance.py",
        "if near.size and",
        "if False and",
    ),
    Bug(
        "test_hard_geometry::test_a_transmitter_close_to_a_wall_or_on_it",
        "propagation/legs/clearance.py",
        "float(distance_to_triangles(city.corners[near], place).min())",
        "float(np.abs(city.normals @ place - city.plane_offsets).min())",
    ),
    Bug(
        "test_hard_geometry::test_a_wall_seen_edge_on_and_slivers",
        "world/city/mesh.py",
        "1e-9 * longest**2",
        "1e-14 * longest",
    ),
    Bug(
        "test_hard_geometry::test_two_bodies_at_one_point_are_refused_before_the_run",
        "simulation/preflight.py",
        "range(0, scenario.frames, step)",
        "[0]",
    ),
    Bug(
        "test_hard_geometry::test_a_vertical_link_with_vertical_polarisation",
        "propagation/legs/direct.py",
        "friis = wavelength / (4 * np.pi * direct.length)",
        "friis = wavelength / (4 * np.pi * direct.length) * (-1 if abs(direct.departure[0, 2]) > "
        "0.999999999 else 1)",
    ),
    Bug(
        "test_hard_geometry::test_a_target_inside_the_radars_own_body",
        "propagation/legs/direct.py",
        "> 1e-9]",
        "> 1e-1]",
    ),
    Bug(
        "test_hard_geometry::test_reflections_are_born_and_die_between_traces",
        "simulation/simulate.py",
        "self.propagation.paths(poses, epoch,",
        "self.propagation.paths(self.swarm.poses(self.timetable.epoch(max(frame - 1, 0))), epoch,",
    ),
    Bug(
        "test_hard_signal::test_whole_and_half_cells",
        "receive/estimate.py",
        "return float(offset if after >= before else -offset)",
        "return float(-offset if after >= before else offset)",
    ),
    Bug(
        "test_hard_signal::test_beyond_the_filter_there_is_nothing",
        "signal/direct.py",
        "np.maximum(-beat, beat - sampling_rate) / transition",
        "np.maximum(-beat, beat - sampling_rate) / (2 * transition)",
    ),
    Bug(
        "test_hard_signal::test_velocities_beyond_the_limit_are_aliases_of_a_known_span",
        "receive/estimate.py",
        "column - num_bins // 2 + _hann_ratio(across)",
        "column + _hann_ratio(across)",
    ),
    Bug(
        "test_hard_signal::test_a_target_at_half_a_metre",
        "signal/if_signal.py",
        "near = np.flatnonzero(np.isfinite(radius))",
        "near = np.flatnonzero(np.zeros_like(radius, bool))",
    ),
    Bug(
        "test_hard_signal::test_one_path_80_db_above_another",
        "signal/choice.py",
        "(strong & top) | sight",
        "(strong & top & sight)",
    ),
    Bug(
        "test_hard_signal::test_a_million_paths",
        "signal/gridded.py",
        "k, lag = path[index], offset[index]",
        "k, lag = path[index.astype(np.int16)], offset[index.astype(np.int16)]",
    ),
    Bug(
        "test_hard_signal::test_ten_thousand_paths_at_one_delay",
        "signal/gridded.py",
        "path, offset = path[order], offset[order]",
        "path, offset = (a[order][np.r_[True, np.diff(t.delay[path[order]]) != 0]] for a in (path, "
        "offset))",
    ),
    Bug(
        "test_fuzz::test_what_cannot_run_is_refused_before_it_starts",
        "simulation/preflight.py",
        "if free is not None and needed > free:",
        "if False:",
    ),
    Bug(
        "test_fuzz::test_units_wrong_by_a_thousand_are_warned_of",
        "scenario/doubts.py",
        '(1e9, 1e12, "hertz")',
        '(1e3, 1e15, "hertz")',
    ),
    Bug(
        "test_killed::test_a_full_disk_is_one_message_and_leaves_nothing",
        "results/files.py",
        "temporary.unlink(missing_ok=True)",
        "pass",
    ),
    Bug(
        "test_killed::test_reruns_are_equal_bit_by_bit_whatever_the_threads",
        "simulation/simulate.py",
        'words = seed_sequence(self.scenario.seed, "noise", tx, rx, frame).generate_state(2)',
        'words = vars(np).setdefault("_shared", '
        "np.random.default_rng(self.scenario.seed)).integers(2**32, size=2, dtype=np.uint32)",
    ),
    Bug(
        "test_killed::test_versions_stand_in_the_results",
        "results/provenance.py",
        "return dict(_versions())",
        'return {"numpy": "1"}',
    ),
)
