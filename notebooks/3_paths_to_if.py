# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # From paths to the IF signal, term by term
# One target, one chirp after the other. A path of delay $\tau(t)$ gives, after mixing with the
# reference chirp,
# $f_c\tau + \alpha\tau(u-\tau/2)$ cycles, $u$ the time since the chirp began. The paper keeps a
# part of this; here the terms
# are added one by one until nothing is left.

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
# Its samples in the first receive antenna, by the exact model. The chirps of transmit antenna 0
# alone, without data:

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
# The paper's separable model: a beat frequency for the delay at the frame's middle, a Doppler phase
# from chirp to chirp.
# Each further term is a phase over (chirp, sample); what is left is the relative RMS after the best
# complex factor.

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
element = (
    -sum(pose.to_world(place) @ direction for pose, place, direction in elements) / 299792458.0
)
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
# The fast methods against the exact one. What `Gridded` leaves here is the curvature of the line of
# sight's wavefront over both arrays at
# once; the default, `Auto`, gives lines of sight to `Direct`.

# %%
links = [(sent, frame.paths["AT", "PT1"])]
exact = irt.if_signal(w, links, receiver, reference, irt.Exact()).samples
for method in (irt.Direct(), irt.Gridded()):
    fast = irt.if_signal(w, links, receiver, reference, method).samples
    print(method.name, f"{np.linalg.norm(fast - exact) / np.linalg.norm(exact):.1e}")
