# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Calibration of a measured cube
# The antennas of a radar board differ in gain, phase and delay. One strong reflector calibrates
# them, and the calibration holds for later captures of the same board.

# %% [markdown]
# The cell below reads TI's capture of a corner reflector if `ISAC_RT_MEASURED` or
# `../shared/measured` has it. Otherwise it simulates a board with gain errors of 1 dB, random
# phases, delay errors of 10 ps and a gain slope over the sweep, and saves it as a capture.

# %%
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import numpy as np

import isac_rt as irt
from isac_rt.extensions.hardware.calibrate import apply
from isac_rt.extensions.hardware.description import Description
from isac_rt.extensions.hardware.explain import STEPS, simulated, unexplained_by
from isac_rt.extensions.hardware.sense import range_azimuth
from isac_rt.extensions.hardware.types import measured_folder
from isac_rt.views.measured import picture

file = measured_folder() / "phaseMismatchCalibration.mat"
print(file.name if file.is_file() else "no measured samples here: a made-up board")

# %%
if not file.is_file():
    rng = np.random.default_rng(1)
    chirp = {"slope_mhz_per_us": 79, "sampling_rate_hz": 8e6, "samples_per_chirp": 256}
    said = Description(receivers=16, chirps=tuple(range(12)), elements="ti_cascade", **chirp)
    file = Path(mkdtemp()) / "board.npy"
    np.save(file, np.zeros((12, 16, 256), np.complex64))
    blank = irt.import_file(file, said)
    ideal = simulated(blank.cube, blank.antennas, 4.7).samples[0]  # (receiver, chirp, sample)
    level = 10 ** (rng.normal(0, 0.05, (16, 12))[:, :1] + rng.normal(0, 0.05, (1, 12)))
    phase = rng.uniform(0, 2 * np.pi, (16, 1)) + rng.uniform(0, 2 * np.pi, (1, 12))
    x = np.linspace(-1, 1, 256)
    late = rng.normal(0, 1e-11, (16, 1)) + rng.normal(0, 1e-11, (1, 12))
    bent = np.exp(1j * phase)[..., None] * np.exp(2j * np.pi * late[..., None] * 1.26e9 * x)
    board = 1000 * ideal * level[..., None] * bent * (1 - 0.4 * x)
    noise = rng.normal(size=board.shape) + 1j * rng.normal(size=board.shape)
    np.save(file, (board + 5 * noise).transpose(1, 0, 2))
    capture = irt.import_file(file, said)
else:
    capture = irt.import_file(file)
capture.cube

# %% [markdown]
# ## Calibrate
# The amplitudes of one point reflector over all transmit and receive antennas form a matrix of
# rank one, whatever the gains of the antennas are. The rest is coupling, noise and other echoes.

# %%
found = irt.calibrate(capture)
print(f"reflector at {found.range_m:.4f} m, {found.snr_db:.0f} dB over the median cell")
print(f"rank-one share {found.rank_one_share:.4f}")
print(f"left of it {found.residual_db:.2f} dB and {found.residual_deg:.2f} degrees")
print(f"gains scatter by {found.gain_spread_rx_db:.2f} (RX), {found.gain_spread_tx_db:.2f} dB (TX)")

# %% [markdown]
# Power of the residual after subtracting the simulated echo, relative to the echo, as more of the
# calibration enters the simulation:

# %%
for step, left in zip(STEPS, unexplained_by(capture, found, list(STEPS.values())), strict=True):
    print(f"{step:32s}{left:7.1f} dB")

# %% [markdown]
# ## Range-azimuth maps
# All 192 virtual channels, added in phase for each direction. Without calibration the reflector is
# smeared over many directions; with it, it is a point at boresight.

# %%
azimuth = np.deg2rad(np.linspace(-60, 60, 241))
fig, ax = plt.subplots(figsize=(7, 4))
picture(ax, range_azimuth(capture, azimuth, 8.0), lowest=25)
fig.tight_layout()

# %%
fig, ax = plt.subplots(figsize=(7, 4))
picture(ax, range_azimuth(apply(found, capture), azimuth, 8.0), lowest=25)
fig.tight_layout()
