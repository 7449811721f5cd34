# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # The two receivers, step by step
# The active terminal (AT) knows its data and removes them from its echoes. The passive terminal
# (PT) demodulates the data first and then senses with the same chirps. Both are shown on one frame
# of the paper's swarm.

# %%
import matplotlib.pyplot as plt
import numpy as np

import isac_rt as irt
from isac_rt.receive import cfar, spectrum
from isac_rt.receive import maps as doppler
from isac_rt.receive import symbols as demodulate
from isac_rt.receive.known import Known

scenario = irt.load(
    "../scenes/paper_swarm_consistent.yaml", ["propagation.leakage.enabled=false"], frames=200
)
setup = irt.prepare(scenario)
w, frame = setup.waveform, setup.frame(160)
payload = frame.sent["AT"].payload
payload.delay_symbols.shape, payload.modulated

# %% [markdown]
# ## AT: before data removal
# The delay symbol of each chirp moves the echo to another range cell.

# %%
cube = frame.samples(("AT", "AT"))
raw = np.abs(np.fft.fft(cube.samples[0, 0] * np.hanning(w.num_samples), axis=-1)).T
figure, ax = plt.subplots(figsize=(8, 3.2))
ax.imshow(
    20 * np.log10(raw),
    aspect="auto",
    origin="lower",
    cmap="magma",
    vmin=20 * np.log10(raw.max()) - 40,
)
ax.set(xlabel="chirp", ylabel="cell", title="group 0, antenna 0, with data")
# %% [markdown]
# ## AT: data removal, range-Doppler map, CFAR
# `clean_spectrum` removes the delay symbols with their phase terms and the DPSK phases. The groups
# are combined to one uniform slow time.

# %%
r, sent_by_me = scenario.receivers, Known.of(cube, payload, setup.antennas, passes=2)
spectra = spectrum.clean_spectrum(cube, sent_by_me)
power = doppler.power_map(spectra, sent_by_me)
above, level = cfar.CfarRule.of(r, sent_by_me.channels).detect(power)
velocity = doppler.doppler_bins(w) * w.velocity_cell(2)
figure, ax = plt.subplots(figsize=(8, 3.6))
far = 120
shown = ax.imshow(
    10 * np.log10(power[:far] / np.median(power)),
    aspect="auto",
    origin="lower",
    cmap="magma",
    vmin=-3,
    vmax=30,
    extent=(velocity[0], velocity[-1], 0, far * w.range_cell(2)),
)
rows, columns = np.nonzero(above[:far])
ax.plot(velocity[columns], rows * w.range_cell(2), "wo", mfc="none")
figure.colorbar(shown, label="over the median [dB]")
ax.set(xlabel="radial velocity [m/s]", ylabel="range [m]")
# %% [markdown]
# The detections: peaks are interpolated between the cells, and directions come from the L-shaped
# virtual array.

# %%
irt.receive_active(cube, payload, setup.antennas, r).detections

# %% [markdown]
# ## PT: demodulation, then sensing
# The passive terminal derotates each chirp by the predicted beat frequency of its line of sight
# and picks the strongest of N/2 cells.

# %%
received = frame.samples(("AT", "PT1"))
sight = frame.paths["AT", "PT1"].select(np.array([0]))
c = 299792458.0
known = irt.Prediction(
    range=c * sight.delay + 0.03,  # a prediction is never perfect
    velocity=c * sight.delay_rate,
    direction=np.zeros((1, 2)),
    range_std=np.array([0.03]),
    velocity_std=np.array([0.1]),
    weight=np.ones(1),
)
symbols = demodulate.demodulate(received, known, scenario.modulation.dpsk_order)
print(
    "wrong delay symbols:",
    int((symbols.delay != payload.delay_symbols).sum()),
    "of",
    symbols.delay.size,
)
print(
    "wrong transitions:  ",
    int((symbols.transitions != payload.transitions).sum()),
    "of",
    symbols.transitions.size,
)

# %%
figure, ax = plt.subplots(figsize=(8, 2.6))
ax.plot(10 * np.log10(symbols.delay_confidence[0]), ".")
ax.set(xlabel="chirp", ylabel="confidence [dB]", title="peak over the mean of the other cells")
# %%
irt.receive_passive(received, setup.antennas, r, scenario.modulation.dpsk_order, known, True)
