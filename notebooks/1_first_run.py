# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A first run
# A street canyon, ray-traced at 77 GHz, with one active terminal (AT), one passive terminal (PT1)
# that decodes the AT's data, and one target. `irt.run` simulates the whole flight. The cells after
# it compute one frame step by step.

# %%
import matplotlib.pyplot as plt

import isac_rt as irt
from isac_rt.views import figures

scenario = irt.load("../scenes/street_canyon.yaml", frames=6)
results = irt.run(scenario)
results

# %% [markdown]
# All results are in one labelled dataset. Number of paths by kind, summed over the frames:

# %%
results.dataset.path_count.sum("frame").to_pandas()

# %% [markdown]
# Plots take axes and return them. Left: the swarm from above. Right: the ranges that the passive
# terminal measured and tracked:

# %%
setup = irt.prepare(scenario)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4))
figures.scene_map(left, results.dataset, setup.city)
figures.over_time(right, results.dataset, 1, "range")
# %% [markdown]
# ## One frame, step by step
# Poses and paths of frame 4 at its middle:

# %%
frame = setup.frame(4)
frame.paths["AT", "PT1"]

# %% [markdown]
# The active terminal's samples of its own echoes, and the detections that it makes of them. The
# receiver uses the clutter that it expects of the city:

# %%
cube = frame.samples(("AT", "AT"))
cube

# %%
reception = irt.receive_active(
    cube,
    frame.sent["AT"].payload,
    setup.antennas,
    scenario.receivers,
    clutter=frame.expected["AT"],
)
reception.detections
