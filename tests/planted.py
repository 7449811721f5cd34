"""Bugs that `python tests/mutation.py` plants to see whether anything notices."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Bug:
    """In `file` of the package `old` becomes `new`."""

    file: str
    old: str
    new: str


OF_CASES = {
    "delay of the line of sight": Bug(
        "propagation/segments/geometry.py",
        "span = points - start.position",
        "span = points - 1.0001 * start.position",
    ),
    "delay over the ground": Bug(
        "propagation/segments/geometry.py",
        "mirror_image(image, n, offsets[:, b])",
        "mirror_image(image, 0.9997 * n, offsets[:, b])",
    ),
    "delay over a slanting wall": Bug(
        "propagation/segments/geometry.py",
        "mirror_image(image, n, offsets[:, b])",
        "mirror_image(image, n, -offsets[:, b])",
    ),
    "delay over two planes": Bug(
        "propagation/segments/geometry.py",
        "mirror_image(image, n, offsets[:, b])",
        "mirror_image(image, n, offsets[:, 0])",
    ),
    "delay over three planes": Bug(
        "propagation/segments/geometry.py",
        "mirror_image(image, n, offsets[:, b])",
        "mirror_image(image, n, offsets[:, min(b, 1)])",
    ),
    "corner of three right angles": Bug(
        "propagation/segments/geometry.py",
        """n = normals[:, b]
        image""",
        """n = normals[:, 0]
        image""",
    ),
    "city 100 km from the origin": Bug(
        "world/city/mesh.py",
        "local = index.reshape(-1)[faces], world - centre",
        "local = index.reshape(-1)[faces], (world - centre).astype(np.float32).astype(float)",
    ),
    "doppler of a moving transmitter": Bug(
        "propagation/segments/geometry.py",
        "w, a = velocity - start.velocity, acceleration - start.acceleration",
        "w, a = velocity - 0 * start.velocity, acceleration - start.acceleration",
    ),
    "doppler of a moving receiver": Bug(
        "propagation/segments/geometry.py",
        "w, a = velocity - start.velocity",
        "w, a = -velocity - start.velocity",
    ),
    "doppler of a moving reflector": Bug(
        "propagation/segments/geometry.py",
        "mirror_image(velocity, n)",
        "mirror_image(velocity, 0.7 * n)",
    ),
    "doppler of a moving target": Bug(
        "propagation/scatter_paths.py", "there.rate + back.rate", "there.rate + 0 * back.rate"
    ),
    "doppler of a scatterer": Bug(
        "propagation/segments/geometry.py",
        """rate = (e * w).sum(1)
    accel = ((w * w).sum(-1) - rate**2) / length + (e * a).sum(1)
    return Segments(length, rate, accel, e, -e""",
        """rate = -(e * w).sum(1)
    accel = ((w * w).sum(-1) - rate**2) / length + (e * a).sum(1)
    return Segments(length, rate, accel, e, -e""",
    ),
    "doppler of everything at once": Bug(
        "propagation/segments/geometry.py",
        "velocity = np.broadcast_to(start.velocity, (count, 3)).copy()",
        "velocity = np.zeros((count, 3))",
    ),
    "acceleration of a folded path": Bug(
        "propagation/segments/geometry.py",
        "mirror_image(acceleration, n)",
        "mirror_image(acceleration, 0.7 * n)",
    ),
    "acceleration of an echo": Bug(
        "propagation/scatter_paths.py", "there.accel + back.accel", "there.accel - back.accel"
    ),
    "mirror points obey fermat": Bug(
        "propagation/segments/geometry.py",
        """points[:, b] = target
""",
        """points[:, depth - 1 - b] = target
""",
    ),
    "reciprocity of folded paths": Bug(
        "propagation/segments/geometry.py",
        "departure = first - start.position",
        "departure = first - 1.01 * start.position",
    ),
    "every path of a box": Bug(
        "propagation/segments/images.py", "pick[:, 2 : 2 + count]", "pick[:, 1 + count : 1 : -1]"
    ),
    "a wall 10 km off reflects once": Bug(
        "propagation/segments/geometry.py", "return which[first]", "return which"
    ),
    "velocity along waypoints": Bug(
        "world/swarm.py",
        "self._motion(inside).reshape(3, 3)",
        "self._motion(inside).reshape(3, 3) * [[1.0], [1.001], [1.0]]",
    ),
    "longitude and latitude to metres": Bug(
        "world/city/georeference.py", "+ellps=WGS84", "+ellps=sphere"
    ),
    "buildings are closed and face outward": Bug(
        "world/city/prism.py",
        "Surface(vertices, cap[:, ::-1], finish.floor)",
        "Surface(vertices, cap, finish.floor)",
    ),
    "friis": Bug(
        "propagation/free_space.py",
        "return wavelength / (4 * np.pi * distance)",
        "return wavelength / (2 * np.pi * distance)",
    ),
    "radar equation": Bug("propagation/free_space.py", "(4 * np.pi) ** 3", "(4 * np.pi) ** 2"),
    "two rays across the breakpoint": Bug(
        "propagation/raytrace.py",
        "traced.amplitude * state.elements",
        "np.abs(traced.amplitude) * state.elements",
    ),
    "conducting plate": Bug(
        "propagation/scatter_paths.py",
        "return cls(segment.length, segment.rate",
        "return cls(segment.length / 2, segment.rate",
    ),
    "conducting corner": Bug(
        "propagation/segments/images.py",
        "keep = one_of_each_chain(owned, part.faces, good)",
        "keep = np.flatnonzero(good)",
    ),
    "reflection of a slab": Bug(
        "propagation/segments/reflection.py",
        "root = np.sqrt(eta - (1 - cosine**2))",
        "root = np.sqrt(eta.real - (1 - cosine**2))",
    ),
    "ghosts over a conducting wall": Bug(
        "propagation/raytrace.py",
        "np.concatenate(sections)) / self._free.wavelength",
        "np.concatenate(sections))",
    ),
    "lambertian wall": Bug(
        "kernels/propagation_field.py", "power *= abs(back) / np.pi", "power *= 1 / np.pi"
    ),
    "lambertian wall by way of the ground": Bug(
        "extensions/two_bounces/two_bounces.py",
        """start = mirror.image(state.start)
        else:
            end = mirror.image(state.end)""",
        """pass""",
    ),
    "reflectivity of scatterers": Bug(
        "propagation/segments/reflection.py",
        "np.exp(-4j * np.pi * material.thickness",
        "np.exp(-2j * np.pi * material.thickness",
    ),
    "lobes radiate their power": Bug(
        "propagation/clutter/field.py", "* comb(2 * n, n) / 4.0**n", "* comb(2 * n, n) / 2.0**n"
    ),
    "materials at 77 ghz": Bug(
        "world/city/materials.py",
        "return self.a * frequency_ghz**self.b, self.c * frequency_ghz**self.d",
        "return self.a * frequency_ghz**self.b, self.c * frequency_ghz",
    ),
    "water": Bug("world/city/materials.py", "77.66 + 103.3 * theta", "77.66 - 103.3 * theta"),
    "cross section of a small uav": Bug(
        "propagation/rcs.py",
        "SMALL_MEAN_DBSM - 3 * np.sin(half_bistatic)",
        "SMALL_MEAN_DBSM - 3 * np.sin(2 * half_bistatic)",
    ),
    "cross section of a large uav": Bug(
        "propagation/rcs.py",
        "12 * (off / lobe.azimuth_width) ** 2",
        "12 * (2 * off / lobe.azimuth_width) ** 2",
    ),
    "fluctuation of a cross section": Bug(
        "propagation/rcs.py",
        "_WAVE = np.sqrt(2 / NUM_WAVES)",
        "_WAVE = np.sqrt(1 / NUM_WAVES)",
    ),
    "elements radiate their power": Bug(
        "frame/antennas.py",
        "exponent = max(self.gain / 2 - 1, 0.0)",
        "exponent = max(self.gain - 1, 0.0)",
    ),
    "thermal noise": Bug(
        "frame/level.py",
        "return BOLTZMANN * TEMPERATURE_K",
        "return 2 * BOLTZMANN * TEMPERATURE_K",
    ),
    "phase of scatterers in flight": Bug(
        "kernels/propagation_field.py",
        "length[row], rate[row], accel[row] = r1 + r2, v1 + v2, a1 + a2",
        "length[row], rate[row], accel[row] = np.float32(r1 + r2), v1 + v2, a1 + a2",
    ),
    "coherence of the clutter field": Bug(
        "kernels/propagation_field.py",
        "length[row], rate[row], accel[row] = r1 + r2, v1 + v2, a1 + a2",
        "length[row], rate[row], accel[row] = 1.00001 * (r1 + r2), v1 + v2, a1 + a2",
    ),
    "sight alone changes no range cell at once": Bug(
        "propagation/clutter/visibility.py",
        "penumbra((q - near.where) / near.width)",
        "1.0 * (q > near.where)",
    ),
    "speckle of range doppler cells": Bug(
        "propagation/clutter/cells.py",
        "np.sqrt(-np.log(uniform[0])) *",
        "np.ones_like(uniform[0]) *",
    ),
    "doppler of range cells": Bug(
        "kernels/propagation_field.py",
        "length[row], rate[row], accel[row] = r1 + r2, v1 + v2, a1 + a2",
        "length[row], rate[row], accel[row] = 1.5 * (r1 + r2), v1 + v2, a1 + a2",
    ),
    "noise and merged clutter": Bug(
        "propagation/clutter/merging.py",
        "most = factor * error**2 * (1 + clutter)",
        "most = factor * error * (1 + clutter)",
    ),
    "mean power of a street": Bug(
        "kernels/propagation_field.py",
        "power *= abs(back) / np.pi",
        "power *= 1.03 * abs(back) / np.pi",
    ),
    "numbers of the frame": Bug(
        "frame/settings.py",
        "sampling_rate * sampled / (bandwidth - 2 * sampling_rate)",
        "sampling_rate * sampled / bandwidth",
    ),
    "antenna schedule": Bug(
        "frame/schedule.py",
        "out[:, c] = rng.permutation(num_tx)[square][:num_groups]",
        "out[:, c] = square[rng.integers(0, num_tx, num_groups)]",
    ),
    "bits on symbols": Bug(
        "frame/payload.py", "return symbols ^ (symbols >> 1)", "return symbols ^ (symbols >> 2)"
    ),
    "differential phases": Bug(
        "frame/payload.py",
        "np.cumsum(transitions, axis=2)]",
        "np.cumsum(transitions, axis=2)[..., ::-1]]",
    ),
    "exact model at rest": Bug(
        "frame/waveform.py",
        "(self.slope * tau * (time - tau / 2)) % 1.0",
        "(self.slope * tau * (time - tau)) % 1.0",
    ),
    "exact model in motion": Bug(
        "signal/exact.py", "t.delay[k] + t.rate[k] * time", "t.delay[k] - t.rate[k] * time"
    ),
    "direct method": Bug(
        "kernels/signal_direct.py",
        "quadratic = (f_c + slope * (u - tau)) * a + slope * b * (ts - b / 2)",
        "quadratic = (f_c + slope * (u - tau)) * a",
    ),
    "gridded method": Bug(
        "kernels/signal_gridded.py",
        "cycles = element * (carrier - splat(slope / 2) * element)",
        "cycles = element * (carrier - splat(slope) * element)",
    ),
    "automatic choice": Bug(
        "signal/methods.py",
        "strong, rest = tones.select(alone), tones.select(~alone)",
        "strong, rest = tones.select(alone[::-1]), tones.select(~alone)",
    ),
    "mesh to if at rest": Bug(
        "propagation/scatter_paths.py",
        "there.length + back.length",
        "2 * there.length",
    ),
    "mesh to if in motion": Bug(
        "propagation/scatter_paths.py",
        "there.rate + back.rate",
        "there.rate",
    ),
    "mesh to if two rays in motion": Bug(
        "propagation/segments/geometry.py",
        "mirror_image(velocity, n)",
        "mirror_image(velocity, 0.97 * n)",
    ),
    "signs": Bug(
        "signal/tones.py",
        '"rate": s.delay_rate + s.delay_accel * later + t.clock_drift',
        '"rate": -s.delay_rate + s.delay_accel * later + t.clock_drift',
    ),
    "filter skirts": Bug(
        "kernels/signal_direct.py",
        "outside = max(-beat, beat - w.rate) / w.transition",
        "outside = max(-beat, beat - w.rate) / (2 * w.transition)",
    ),
    "spherical waves": Bug(
        "signal/tones.py",
        "square - 2 * far * along[chunk]",
        "0 * square - 2 * far * along[chunk]",
    ),
    "clock errors": Bug("signal/tones.py", "moved + t.clock_offset", "moved - t.clock_offset"),
    "births and deaths": Bug(
        "kernels/signal_direct.py", "or time >= t.end[k]", "or time >= t.end[k] + 1e9"
    ),
    "data are removed": Bug(
        "receive/spectrum.py",
        "tones(shift[m] / num_samples, num_rows).T",
        "tones(-shift[m] / num_samples, num_rows).T",
    ),
    "resource blocks": Bug(
        "signal/tones.py",
        "(t.first_block - first_block) * w.group_spacing",
        "(first_block - t.first_block) * w.group_spacing",
    ),
    "counter based random numbers": Bug(
        "kernels/signal_noise.py", "a, b = _mix(a, b, 15)", "a, b = _mix(a, b, 16)"
    ),
    "white noise": Bug(
        "kernels/signal_noise.py", "c = _COS[0] + q * (", "c = _COS[0] + np.float32(0.9) * q * ("
    ),
    "noise does not know the order of work": Bug(
        "kernels/signal_noise.py", "a = uint32(low + uint32(i))", "a = uint32(i)"
    ),
    "doppler edge of a rotor": Bug(
        "extensions/street/centres.py",
        '"delay_rate": there.rate + back.rate',
        '"delay_rate": 2 * there.rate',
    ),
    "lines of a circling point": Bug(
        "extensions/street/centres.py",
        "longer = np.vecdot(rho, rho - 2 * q)",
        "longer = np.vecdot(rho, rho - 2.0001 * q)",
    ),
    "blade of points": Bug(
        "extensions/street/rotors.py",
        "LEFT_OUT) + 1) // 2",
        "LEFT_OUT) + 1) // 3",
    ),
    "flat blade of points": Bug(
        "extensions/street/rotors.py",
        "np.exp(-1j * at * self.nodes)",
        "np.exp(-1.05j * at * self.nodes)",
    ),
    "what opaque blades take": Bug(
        "extensions/street/screening.py",
        "(outer - inner) / (-1j * np.pi * u)",
        "outer / (-1j * np.pi * u)",
    ),
    "cross section of a vehicle and an agv": Bug(
        "extensions/street/extent.py",
        "Lobe(180.0, 36.32, 79.65, 36.73, 14.56, 7.50)",
        "Lobe(180.0, 36.32, 79.65, 36.73, 15.46, 8.40)",
    ),
    "dpsk symbol errors": Bug(
        "receive/symbols.py",
        "product = chains[..., 1:] * chains[..., :-1].conj()",
        "product = chains[..., 1:] * chains[:, :, :1, :-1].conj()",
    ),
    "delay symbol errors": Bug(
        "receive/symbols.py",
        "derotation = tones(-beats[m] / w.num_samples, w.num_samples)",
        "derotation = tones(-np.floor(beats[m]) / w.num_samples, w.num_samples)",
    ),
    "data at the ends of the velocity": Bug(
        "receive/symbols.py",
        "w.data_phase(raw) - (w.slope * w.delay_step * raw) * delay",
        "w.data_phase(raw)",
    ),
    "union of the groups": Bug(
        "receive/maps.py",
        "resample = np.linalg.solve(np.sinc(band - times), np.sinc(band - grid)).T",
        "resample = np.eye(len(times))",
    ),
    "orthogonal matching pursuit": Bug(
        "kernels/receive_omp.py",
        "re, im = re - a * c - b * d, im - b * c + a * d",
        "re, im = re - a * c + b * d, im - b * c - a * d",
    ),
    "false alarm factor": Bug(
        "receive/cfar.py",
        "cumulative = np.prod([special.gammainc(shape, shape * z) for shape in sides], axis=0)",
        "cumulative = np.mean([special.gammainc(shape, shape * z) for shape in sides], axis=0)",
    ),
    "false alarms along range": Bug(
        "receive/cfar.py",
        "greatest_of_factor(self.rate, float(self.looks), before, behind)",
        "greatest_of_factor(self.rate, 1.0, before, behind)",
    ),
    "detection probability": Bug(
        "receive/cfar.py",
        """return power > factor[:, None] * level
""",
        """return power > 1.1 * factor[:, None] * level
""",
    ),
    "false alarms of the whole chain": Bug(
        "receive/cfar.py",
        "return count**2 / (count + 2 * pairs) if count else 0.0",
        "return count / 9 if count else 0.0",
    ),
    "bias of an echo": Bug(
        "kernels/receive_estimate.py",
        "near = (slope * tau + delay_rate * (carrier + slope * (middle - tau))) * duration",
        "near = (slope * tau - delay_rate * (carrier + slope * (middle - tau))) * duration",
    ),
    "scatter of range and velocity": Bug(
        "receive/estimate.py",
        "rate = 1.0 / (w.frame_duration * w.effective_carrier)",
        "rate = 30.0 / (w.frame_duration * w.effective_carrier)",
    ),
    "scatter of directions": Bug(
        "receive/directions.py",
        "        phases = wavenumber * places\n",
        "        phases, wavenumber = 1.02 * wavenumber * places, 1.02 * wavenumber\n",
    ),
    "processing gain": Bug("frame/level.py", "- 2 * 10 * np.log10(1.5)", "- 10 * np.log10(1.5)"),
    "standing clutter is removed": Bug(
        "receive/clutter_filter.py", "sent = schedule[m] == tx", "sent = schedule[m] >= tx"
    ),
    "rayleigh clutter": Bug(
        "propagation/clutter/rayleigh.py",
        "rng.standard_normal((count, 2)) @ np.array([1, 1j]) / np.sqrt(2)",
        "rng.standard_normal((count, 2)) @ np.array([1, 1j])",
    ),
    "jacobians of the tracker": Bug(
        "track/filter.py",
        "turn = (np.eye(3) - e[..., :, None] * e[..., None, :]) / r[..., None, None]",
        "turn = np.eye(3) - e[..., :, None] * e[..., None, :]",
    ),
    "bistatic range": Bug(
        "track/filter.py",
        "(2 * (length - ahead))",
        "(2 * (length + ahead))",
    ),
    "covariance of an unknown acceleration": Bug(
        "track/filter.py",
        "density = 2 * acceleration_std**2",
        "density = acceleration_std**2",
    ),
    "consistency of states": Bug(
        "track/filter.py",
        "density = 2 * acceleration_std**2",
        "density = 0.02 * acceleration_std**2",
    ),
    "consistency of innovations": Bug(
        "track/filter.py",
        "P = A @ P @ np.swapaxes(A, -1, -2) + K @ R @ np.swapaxes(K, -1, -2)",
        "P = A @ P @ np.swapaxes(A, -1, -2) / 4",
    ),
    "consistency in manoeuvres": Bug(
        "track/filter.py",
        "density * interval**5 *",
        "density * interval**6 *",
    ),
    "gospa metric": Bug(
        "results/metrics.py", "(len(x) - pairs) * cutoff**2 / 2", "(len(x) - pairs) * cutoff**2"
    ),
    "binomial intervals": Bug(
        "results/metrics.py",
        "betaincinv(successes, trials - successes + 1, tail)",
        "betaincinv(successes + 1, trials - successes + 1, tail)",
    ),
    "boards before a corner reflector": Bug(
        "extensions/hardware/calibrate.py",
        "still = y * ti_window(size) * np.exp(",
        "still = y * np.exp(",
    ),
    "measured echo explained by the simulated": Bug(
        "extensions/hardware/calibrate.py",
        "delay = delay + one.rx_delay[:, None] + one.tx_delay",
        "delay = delay - one.rx_delay[:, None] + one.tx_delay",
    ),
    "each part of a board counts": Bug(
        "extensions/hardware/calibrate.py",
        "out = out * phasor * (1 + one.response_slope * relative)",
        "out = out * phasor * (1 + 0 * one.response_slope * relative)",
    ),
    "people in a measured frame": Bug(
        "extensions/hardware/readers.py",
        "np.where(values >= 32768, values - 65536.0, values)",
        "np.where(values >= 65536, values - 65536.0, values)",
    ),
    "channels of a measured mover in line": Bug(
        "extensions/hardware/types.py",
        "np.sin(np.pi * (np.arange(size) + 1) / (size + 1)) ** 2",
        "np.sin(np.pi * (np.arange(size) + 1) / (size + 1)) ** 9",
    ),
    "phase shifters of a cascade": Bug(
        "frame/front_end.py", '"errors_std_deg": 2.2}', '"errors_std_deg": 3.2}'
    ),
    "small uav as published": Bug(
        "propagation/rcs.py", '{"small": 3.74, "large": 2.50}', '{"small": 3.47, "large": 2.50}'
    ),
    "paths of a canyon against sionna": Bug(
        "propagation/segments/reflection.py",
        "return (field * vertical(segments.arrival)).sum(1)",
        "return np.abs((field * vertical(segments.arrival)).sum(1))",
    ),
    "paths missed in a city": Bug(
        "propagation/segments/chains.py", "- RAY_OFFSET_M * side", "+ RAY_OFFSET_M * side"
    ),
    "echoes against sionna": Bug(
        "propagation/raytrace.py",
        "on.bounces[j] <= most",
        "on.bounces[j] < most",
    ),
    "cube against mmwrt": Bug(
        "kernels/signal_direct.py",
        "phase = f_c * tau + slope * tau * (u - tau / 2)",
        "phase = f_c * tau + slope * tau * (u + tau / 2)",
    ),
    "cfar against mmwrt": Bug(
        "receive/cfar.py",
        "x = looks * factor * z",
        "x = looks * factor * z / 1.1",
    ),
    "gospa against stone soup": Bug(
        "results/metrics.py",
        "return Gospa(float(np.sqrt(square + missed + false))",
        "return Gospa(float(np.sqrt(square + missed))",
    ),
    "attenuation by gas": Bug(
        "extensions/street/air.py",
        "(a5 + a6 * theta) * (p + e) * theta**0.8",
        "(a5 + a6 * theta) * (p + e) * theta**0.7",
    ),
    "attenuation by rain": Bug("extensions/street/air.py", "np.cos(2 * tilt)", "np.cos(tilt)"),
    "echoes of rain": Bug(
        "extensions/street/weather.py", "weight = 8 * np.pi", "weight = 4 * np.pi"
    ),
    "foreign chirps": Bug(
        "extensions/street/emitters.py",
        "slope=w.slope - train.slope * speed**2",
        "slope=w.slope + train.slope * speed**2",
    ),
    "moving walls": Bug(
        "extensions/street/faces.py", "rise = turn @ place + ", "rise = 0 * turn @ place + "
    ),
    "uavs in moving walls": Bug(
        "extensions/street/faces.py",
        "velocity=end.velocity - 2 * (rise * normal + height * turn)",
        "velocity=end.velocity - 2 * rise * normal",
    ),
    "sliding shadows": Bug(
        "extensions/street/shadows.py",
        "places = stops.places + stops.velocities * time",
        "places = stops.places",
    ),
}
"""For each case of `isac-rt validate` one bug with which it fails (``--planted``)."""

OF_TESTS = (
    (
        "test_hard_geometry::test_grazing_rays",
        Bug(
            "propagation/segments/geometry.py",
            "mirror_image(image, n, offsets[:, b])",
            "mirror_image(image, 0.9997 * n, offsets[:, b])",
        ),
    ),
    (
        "test_hard_geometry::test_a_transmitter_close_to_a_wall_or_on_it",
        Bug(
            "propagation/segments/clearance.py",
            "offsets[:, None]) < most",
            "offsets[:, None]) < 0",
        ),
    ),
    (
        "test_hard_geometry::test_a_transmitter_close_to_a_wall_or_on_it",
        Bug(
            "propagation/segments/clearance.py",
            "float(distance_to_triangles(city.corners[near], positions[name]).min())",
            "float(np.abs(city.normals @ positions[name] - city.plane_offsets).min())",
        ),
    ),
    (
        "test_hard_geometry::test_a_wall_seen_edge_on_and_slivers",
        Bug("world/city/mesh.py", "1e-9 * longest**2", "1e-14 * longest"),
    ),
    (
        "test_hard_geometry::test_two_bodies_at_one_point_are_refused_before_the_run",
        Bug("simulation/preflight.py", "range(0, timetable.frames, step)", "[0]"),
    ),
    (
        "test_hard_geometry::test_a_vertical_link_with_vertical_polarisation",
        Bug(
            "propagation/segments/direct.py",
            "friis = wavelength / (4 * np.pi * direct.length)",
            "friis = wavelength / (4 * np.pi * direct.length) * (-1 if abs(direct.departure[0, 2]) > 0.999999999 else 1)",
        ),
    ),
    (
        "test_hard_geometry::test_a_target_inside_the_radars_own_body",
        Bug(
            "propagation/segments/direct.py",
            """> 1e-9
    ]""",
            "> 1e-1]",
        ),
    ),
    (
        "test_hard_geometry::test_reflections_are_born_and_die_between_traces",
        Bug(
            "simulation/setup.py",
            """self.propagation.trace(
            poses, epoch,""",
            "self.propagation.trace(self.swarm.poses(self.timetable.epoch(max(frame - 1, 0))), epoch,",
        ),
    ),
    (
        "test_hard_signal::test_whole_and_half_cells",
        Bug(
            "receive/estimate.py",
            "np.where(after >= before, offset, -offset)",
            "np.where(after >= before, -offset, offset)",
        ),
    ),
    (
        "test_hard_signal::test_velocities_beyond_the_limit_are_aliases_of_a_known_span",
        Bug(
            "receive/estimate.py",
            "column - num_bins // 2 + _hann_ratio(across)",
            "column + _hann_ratio(across)",
        ),
    ),
    (
        "test_hard_signal::test_one_path_80_db_above_another",
        Bug("signal/methods.py", "(strong & top) | tones.is_los", "(strong & top & tones.is_los)"),
    ),
    (
        "test_hard_signal::test_a_million_paths",
        Bug(
            "kernels/signal_gridded.py",
            "k, lag = path[index], offset[index]",
            "k, lag = path[index.astype(np.int16)], offset[index.astype(np.int16)]",
        ),
    ),
    (
        "test_hard_signal::test_ten_thousand_paths_at_one_delay",
        Bug(
            "kernels/signal_gridded.py",
            "path, offset = path[order], offset[order]",
            "path, offset = (a[order][np.r_[True, np.diff(t.delay[path[order]]) != 0]] for a in (path, offset))",
        ),
    ),
    (
        "test_fuzz::test_what_cannot_run_is_refused_before_it_starts",
        Bug("simulation/preflight.py", "if free is not None and needed > free:", "if False:"),
    ),
    (
        "test_scenario::test_units_wrong_by_a_thousand_are_doubted",
        Bug("scenario/doubts.py", '(1e9, 1e12, "hertz")', '(1e3, 1e15, "hertz")'),
    ),
    (
        "test_killed::test_a_full_disk_is_one_message_and_leaves_nothing",
        Bug(
            "storage.py",
            "            with suppress(OSError):\n                temporary.unlink(missing_ok=True)\n            _in_work",
            "            _in_work",
        ),
    ),
    (
        "test_killed::test_reruns_are_equal_bit_by_bit_whatever_the_threads",
        Bug(
            "simulation/setup.py",
            'words = seed_sequence(seed, "noise", *link, self.number).generate_state(2)',
            'words = vars(np).setdefault("_shared", np.random.default_rng(seed)).integers(2**32, size=2, dtype=np.uint32)',
        ),
    ),
    (
        "test_killed::test_versions_stand_in_the_results",
        Bug("storage.py", "return dict(_versions())", 'return {"numpy": "1"}'),
    ),
    (
        "test_association::test_the_association_is_the_likeliest_of_all",
        Bug("track/filter.py", "d2 + log_det, np.inf)", "d2, np.inf)"),
    ),
    (
        "test_handover::test_a_prediction_is_what_its_samples_measure",
        Bug("track/tracker.py", "velocity_std=report.std[:, 1]", "velocity_std=report.std[:, 0]"),
    ),
    (
        "test_ghost_images::test_reflections_are_the_images_that_each_end_sees",
        Bug(
            "extensions/city_receivers/ghosts.py",
            "_images(state + here, start, walls, reach)",
            "_images(state + here, here, walls, reach)",
        ),
    ),
    (
        "test_ghosts::test_what_others_report_is_a_target",
        Bug(
            "extensions/city_receivers/ghosts.py",
            "self.whose == of.row[:, None]",
            "np.ones((of.row.size, len(self.told)), bool)",
        ),
    ),
    (
        "test_cooperation::test_what_may_be_before_a_wall_may_be_lit",
        Bug(
            "extensions/cooperation/swarm.py",
            "P, cell = uav.state.covariance[:3, :3],",
            "P, cell = 0 * uav.state.covariance[:3, :3],",
        ),
    ),
    (
        "test_randomness::test_no_two_receptions_share_their_noise",
        Bug("simulation/setup.py", '"noise", *link, self.number', '"noise", link.rx, self.number'),
    ),
    (
        "test_view::test_a_body_is_in_view_of_both_ends",
        Bug("results/metrics.py", "ends.append((tx, uav))", "pass"),
    ),
    (
        "test_access_stages::test_the_timetable_on_paper",
        Bug("extensions/access/protocol.py", "0.0 if data else n.hold", "n.hold"),
    ),
    (
        "test_keys::test_stored_paths_hold_the_instant_the_links_and_every_pose",
        Bug(
            "propagation/store.py",
            "json.dumps([self._content, epoch, links, where])",
            "json.dumps([self._content, epoch, where])",
        ),
    ),
    (
        "test_keys::test_keys_hold_every_value_of_a_scenario",
        Bug("results/provenance.py", '    "compare",\n', '    "compare",\n    "swarm",\n'),
    ),
    (
        "test_keys::test_keys_hold_every_value_of_a_scenario",
        Bug(
            "results/provenance.py",
            "if key not in UNSEEN_BY_PATHS}",
            'if key not in UNSEEN_BY_PATHS}; seen["swarm"] = {uav: {k: v for k, v in one.items() if k != "rcs"} for uav, one in tree["swarm"].items()}',
        ),
    ),
    (
        "test_keys::test_keys_hold_the_version_of_every_package",
        Bug("sweep/definition.py", '"versions": json.dumps(versions()),', '"versions": "",'),
    ),
    (
        "test_resume::test_everything_that_is_carried_over_is_taken_up",
        Bug(
            "plain.py",
            "{f.name: plain(getattr(value, f.name)) for f in fields(value) if f.init}",
            '{f.name: 0 if f.name == "status" else plain(getattr(value, f.name)) for f in fields(value) if f.init}',
        ),
    ),
    (
        "test_resume::test_everything_that_is_carried_over_is_taken_up",
        Bug(
            "simulation/stations.py",
            """            "feedback": self.feedback,
            "seconds\"""",
            """            "feedback": {"answers": 0, "corrections": 0},
            "seconds\"""",
        ),
    ),
    (
        "test_trouble::test_of_points_that_share_paths_one_goes_first",
        Bug(
            "sweep/execute.py",
            "or point.paths_key in self._traced:",
            "or point.paths_key not in self._traced:",
        ),
    ),
    (
        "test_trouble::test_a_scheduler_that_is_killed_is_one_message",
        Bug(
            "sweep/workers.py",
            "logger.setLevel(logging.CRITICAL)",
            "logger.setLevel(logging.ERROR)",
        ),
    ),
    (
        "test_losses::test_whitened_channels_of_a_cell",
        Bug("results/losses.py", "paths.departure[rows]", "paths.arrival[rows]"),
    ),
    (
        "test_metrics::test_targets_are_scored_among_all_uavs",
        Bug("results/metrics.py", "beside[track] = not scored[uav]", "other[track] = False"),
    ),
    (
        "test_scoring::test_an_alias_or_a_drifted_track_does_not_stand_for_a_uav",
        Bug(
            "results/scoring.py",
            "near = (distance < GOSPA_CUTOFF_M) |",
            "near = (distance < np.inf) |",
        ),
    ),
    (
        "test_swarm_scores::test_tracked_is_within_three_resolutions_of_a_link_that_sees_it",
        Bug("results/swarm.py", "velocity=s[3:])", "velocity=0 * s[3:])"),
    ),
    (
        "test_scoring::test_gospa_is_of_confirmed_tracks_and_targets_in_view",
        Bug("results/scoring.py", "get(track, [-1, -1, -1])", "get(track, [0, 0, 0])"),
    ),
    (
        "test_dataset::test_the_truth_of_a_sample_tells_who_is_occluded",
        Bug("sweep/shards.py", 'd["occluded"][f, o, u]', 'd["in_view"][f, o, u]'),
    ),
    (
        "test_import::test_numbers_that_lost_their_sign_get_it_back",
        Bug(
            "extensions/hardware/readers.py",
            "np.where(values >= 32768,",
            "np.where(values > 32768,",
        ),
    ),
    (
        "test_over_the_chirp::test_tables_are_decibels_and_degrees",
        Bug(
            "extensions/hardware/sweep.py",
            "np.interp(x, np.linspace(-1, 1, len(table)), table)",
            "np.interp(x, np.linspace(-1, 1, len(table)), table, left=0.0, right=0.0)",
        ),
    ),
    (
        "test_city::test_triangles_of_a_strip_and_of_a_fan_face_one_way",
        Bug("world/city/meshfiles.py", "i + 1 + i % 2, i + 2 - i % 2", "i + 1, i + 2"),
    ),
    (
        "test_tables::test_a_city_costs_what_noise_alone_would_find_besides",
        Bug("views/tables.py", "round(noise_only - hits, 3)", "round(hits - noise_only, 3)"),
    ),
    (
        "test_interchange::test_the_ledger_has_positive_doppler_of_what_comes_nearer",
        Bug(
            "views/interchange.py",
            "lambda p: -carrier_frequency[p.tx] * p.delay_rate",
            "lambda p: carrier_frequency[p.tx] * p.delay_rate",
        ),
    ),
    (
        "test_channels::test_draws_scatter_as_stated_and_differ_by_terminal",
        Bug(
            "extensions/hardware/channels.py",
            "rng.normal(size=size) * spread",
            "np.full(size, rng.normal()) * spread",
        ),
    ),
    (
        "test_receive_data::test_a_frame_read_with_an_honest_prediction_is_not_erased",
        Bug(
            "receive/symbols.py",
            "else min(least, symbols.phase_spread)",
            "else symbols.phase_spread",
        ),
    ),
    (
        "test_leakage::test_every_pair_couples_by_a_path_of_its_own",
        Bug(
            "receive/joint/leakage.py",
            "return (1j * phi[..., None])",
            "return (0j * phi[..., None])",
        ),
    ),
    (
        "test_interference::test_radars_that_do_not_receive_each_other_are_not",
        Bug(
            "simulation/preflight.py",
            "sent = float(sending.element_gain(tx.to_body(polyline / distance)))",
            "sent = sending.gain",
        ),
    ),
    (
        "test_extent::test_a_car_near_the_radar_is_the_sum_over_its_faces",
        Bug(
            "extensions/street/centres.py",
            "amplitudes(towards, seen, path",
            "amplitudes(base.sent.towards, base.received.towards, path",
        ),
    ),
    (
        "test_extent::test_a_car_between_two_terminals_has_each_faces_own_directions",
        Bug(
            "extensions/street/centres.py",
            "self._pattern(getattr(path, end), poses",
            "self._pattern(path.tx, poses",
        ),
    ),
    (
        "test_rotors::test_samples_of_flat_blades_are_the_integral_at_every_sample",
        Bug(
            "extensions/street/rotors.py",
            "u.reshape(shape)[:, :, self.nodes.size // 2]",
            "u.reshape(shape).mean(axis=(1, 2, 3))[:, None, None]",
        ),
    ),
    (
        "test_boxes::test_a_mirror_that_turns_away_lives_no_longer",
        Bug(
            "extensions/street/faces.py",
            "np.minimum(np.min(heights, axis=0), beside.min(axis=2))",
            "beside.min(axis=2)",
        ),
    ),
)
"""(file::name of a test of a hard case, a bug with which it fails) (``--hard``)."""
