# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Geometric against Rayleigh clutter
# The paper models 40 to 50 range cells of Rayleigh clutter at zero Doppler. A mesh gives
# scatterers on walls and ground: their Doppler follows from the terminal's own velocity, and their
# power falls with range.

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import isac_rt as irt

frames = {}
for model in ("rayleigh", "field"):
    scenario = irt.load(
        "../scenes/street_canyon.yaml",
        [f"clutter.model={model}", "modulation.acquisition_frames=1", "receiver_preset=plain"],
        frames=2,
    )
    setup = irt.prepare(scenario)
    frame = setup.frame(1)
    cube = frame.samples(("AT", "AT"))
    got = irt.receive_active(
        cube, frame.sent["AT"].payload, setup.antennas, scenario.receivers, maps=True
    )
    frames[model] = frame.paths["AT", "AT"], got
    print(model, frame.paths["AT", "AT"])

# %% [markdown]
# Range-Doppler maps of the active terminal:

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True)
for ax, (model, (_, got)) in zip(axes, frames.items(), strict=True):
    m = got.maps
    level = 10 * np.log10(m.range_doppler / np.median(m.range_doppler))
    ax.imshow(
        level,
        aspect="auto",
        origin="lower",
        cmap="magma",
        vmin=-3,
        vmax=45,
        extent=(m.velocity_axis[0], m.velocity_axis[-1], m.range_axis[0], m.range_axis[-1]),
    )
    ax.set(title=model, xlabel="radial velocity [m/s]", ylim=(0, 90))
axes[0].set_ylabel("range [m]")

# %% [markdown]
# ## Frame-to-frame correlation
# The scatterers of a mesh are fixed in the world. Moved back by their delay rates, they correlate
# between frames; clutter that is drawn anew in each frame does not.


# %%
def profile(paths, waveform):
    """Complex range profile of the diffuse paths, one value per range cell of a pass there and
    back."""
    p = paths.select(paths.kind == irt.PathKind.DIFFUSE)
    cell = np.round(p.delay / waveform.delay_step).astype(int)
    turned = p.gain * np.exp(-2j * np.pi * waveform.carrier_frequency * p.delay)
    return np.bincount(cell, turned.real, waveform.num_samples) + 1j * np.bincount(
        cell, turned.imag, waveform.num_samples
    )


for model in ("rayleigh", "field"):
    scenario = irt.load(
        "../scenes/street_canyon.yaml",
        [f"clutter.model={model}", "frame_interval_s=0.008", "receiver_preset=plain"],
        frames=4,
    )
    setup = irt.prepare(scenario)
    a, b = (setup.frame(k).paths["AT", "AT"] for k in (0, 1))
    # the same instant seen from both frames: the second one's scatterers taken back by their rates
    dt = a.epoch - b.epoch
    delay = b.delay + b.delay_rate * dt + b.delay_accel * dt**2 / 2
    back = replace(b, delay=delay, epoch=a.epoch)
    x, y = profile(a, setup.waveform), profile(back, setup.waveform)
    print(
        f"{model:8s} correlation from frame to frame "
        f"{abs(np.vdot(x, y)) / np.linalg.norm(x) / np.linalg.norm(y):.3f}"
    )
