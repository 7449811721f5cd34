# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A sweep and its figures
# A sweep is a scenario, axes and repetitions. It runs on all cores, stores each finished point,
# and resumes where it was interrupted.

# %% [markdown]
# Four SNRs and two DPSK orders, five frames each:

# %%
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt

import isac_rt as irt
from isac_rt.views import figures

folder = Path(mkdtemp())
base = Path("../scenes/paper_swarm_consistent.yaml").resolve()
(folder / "sweep.yaml").write_text(f"""
name: snr
scenario: {base}
set: {{frames: 5, receivers.active_every_frames: 5, modulation.pilot_every_frames: null,
       radio.samples_per_chirp: 256, radio.bandwidth_hz: 320e6}}
axes:
  snr_db: {{key: noise.snr_db, values: [-25, -20, -10, 0]}}
  order: {{key: modulation.dpsk_order, values: [4, 16]}}
repetitions: 1
seed: 1
""")
plan = irt.load_sweep(folder / "sweep.yaml")
irt.run_sweep(plan, folder / "out", workers=1)
dataset = irt.open_sweep(folder / "out")
dataset.sizes

# %% [markdown]
# The result is one labelled dataset: axes are coordinates, error rates have confidence intervals.

# %%
dataset.ser_dpsk_pooled.sel(link="AT->PT1").to_pandas()

# %%
figure, ax = plt.subplots(figsize=(7, 4))
figures.sweep_curves(ax, dataset.sel(link=["AT->PT1"]), "ser_dpsk", "snr_db", "order")
