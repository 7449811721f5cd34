# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # From paths to the IF signal, term by term
# After mixing with the reference chirp, a path of delay $\tau(t)$ has the phase $f_c\tau +
# \alpha\tau(u-\tau/2)$ in cycles, with $u$ the time since the chirp began. The paper keeps two
# terms of it. The cells below add the others one by one, until an error below 1e-4 is left.

# %%
import matplotlib.pyplot as plt
import numpy as np

import isac_rt as irt

scenario = irt.load(
    "../scenes/paper_swarm_consistent.yaml",
    [
        "accuracy.preset=everything",
        "propagation.leakage.enabled=false",
        "radio.groups=1",
        "modulation.pilot_every_frames=null",
    ],
    frames=4,
)
setup = irt.prepare(scenario)
frame = setup.frame(0)
path = frame.paths["AT", "PT1"].select(np.array([0]))
path

# %% [markdown]
# Samples of the path in the first receive antenna, by the exact model: the chirps of transmit
# antenna 0, without data.

# %%
w = setup.waveform
sent = frame.sent["AT"]
start = setup.timetable.start_time(0, "AT")
receiver = irt.ReceiveArray(frame.poses["PT1"], setup.antennas)
reference = irt.Reference(start)
cube = irt.if_signal(w, [(sent, path)], receiver, reference, irt.Exact())
chirps = np.flatnonzero(cube.schedule[0] == 0)
signal = cube.samples[0, 0, chirps]
signal = signal / np.abs(signal).mean()

# %% [markdown]
# The paper's separable model has a beat frequency for the delay at mid-frame and a Doppler phase
# from chirp to chirp. Each further term is a phase over (chirp, sample). The number is the
# relative RMS error after the best complex factor.

# %%
p = chirps[:, None]
u = w.fast_time  # since the start of the reference chirp
middle = w.frame_duration / 2
slot = p * w.slot_duration
tau, rate = path.delay[0], path.delay_rate[0]
beat, doppler = w.slope * tau * u, w.carrier_frequency * rate * slot
# delay of the two elements against the arrays' middles: they delay the whole chirp, not only its
# carrier
elements = [
    (frame.poses["AT"], setup.antennas.tx_positions[0], path.departure[0]),
    (frame.poses["PT1"], setup.antennas.rx_positions[0], path.arrival[0]),
]
element = -sum(pose.to_world(at) @ direction for pose, at, direction in elements) / 299792458.0
terms = {
    "paper: beat and Doppler": beat + doppler,
    "+ Doppler within the chirp": w.carrier_frequency * rate * u + 0 * slot,
    "+ migration through range": w.slope * rate * (slot - middle) * u,
    "+ square of fast time": w.slope * rate * u**2 + 0 * slot,
    "+ elements delay the whole chirp": w.slope * element * u + 0 * slot,
    "+ residual video phase in motion": -w.slope * tau * rate * (slot + u),
    "+ acceleration": w.carrier_frequency * path.delay_accel[0] / 2 * (slot + u - middle) ** 2,
}
model, left = 0.0, {}
for name, cycles in terms.items():
    model = model + cycles
    turned = signal * np.exp(-2j * np.pi * model)
    left[name] = np.sqrt(np.mean(np.abs(turned - turned.mean()) ** 2))
for name, value in left.items():
    print(f"{name:35s} {value:.2e}")

# %%
figure, ax = plt.subplots(figsize=(8, 3))
ax.barh(list(left), list(left.values()))
ax.set(xscale="log", xlabel="relative RMS that is left")
ax.invert_yaxis()

# %% [markdown]
# The fast methods against the exact one. The error of `Gridded` is the curvature of the line-of-
# sight wavefront over both arrays at once; the default, `Auto`, gives lines of sight to `Direct`.

# %%
links = [(sent, frame.paths["AT", "PT1"])]
exact = irt.if_signal(w, links, receiver, reference, irt.Exact()).samples
for method in (irt.Direct(), irt.Gridded()):
    fast = irt.if_signal(w, links, receiver, reference, method).samples
    print(method.name, f"{np.linalg.norm(fast - exact) / np.linalg.norm(exact):.1e}")
