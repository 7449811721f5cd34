# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A first run
# A street canyon, traced at 77 GHz: one active terminal, one passive terminal that decodes, one target. `irt.run` does all
# of it; the cells after it take one frame apart by hand.

# %%
import numpy as np

import isac_rt as irt

scenario = irt.load("../scenes/street_canyon.yaml", frames=5)
results = irt.run(scenario)
results.summary["links"]["AT->PT1"]

# %% [markdown]
# Everything is in one labelled dataset. The path counts by kind, summed over the frames:

# %%
results.dataset.path_count.sum("frame").to_pandas()

# %% [markdown]
# ## One frame by hand
# Poses and paths of frame 3, the strongest paths to the passive terminal:

# %%
setup = irt.prepare(scenario)
poses, paths = setup.trace(3)
heard = paths["AT", "PT1"]
strongest = np.argsort(-heard.power)[:5]
[(irt.PathKind(k).name, f"{p:.1f} dB", f"{1e9 * t:.3f} ns") for k, p, t in zip(
    heard.kind[strongest], 10 * np.log10(heard.power[strongest]), heard.delay[strongest], strict=True)]

# %% [markdown]
# Its IF samples, and what the active terminal makes of its own:

# %%
sent = setup.transmission(3, poses["AT"])
cube = setup.receive_samples(3, sent, paths["AT", "AT"], poses)
reception = irt.receive_active(cube, sent.payload, setup.antennas, scenario.receivers)
print(cube.samples.shape, len(reception.detections), "detections")
