# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A first run
# A street canyon, traced at 77 GHz: one active terminal, one passive terminal that decodes, one
# target. `irt.run` does all
# of it; the cells after it take one frame apart by hand.

# %%
import matplotlib.pyplot as plt

import isac_rt as irt
from isac_rt.views import figures

scenario = irt.load("../scenes/street_canyon.yaml", frames=6)
results = irt.run(scenario)
results

# %% [markdown]
# Everything is in one labelled dataset. Paths by kind, summed over the frames:

# %%
results.dataset.path_count.sum("frame").to_pandas()

# %% [markdown]
# Plots take axes and return them. The swarm from above, and what the passive terminal followed:

# %%
setup = irt.prepare(scenario)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4))
figures.scene_map(left, results.dataset, setup.city)
figures.over_time(right, results.dataset, 1, "range")
# %% [markdown]
# ## One frame by hand
# Poses and paths of frame 4 at its middle:

# %%
frame = setup.frame(4)
frame.paths["AT", "PT1"]

# %% [markdown]
# What the active terminal sends, what it receives of its own chirps, what it makes of them, with
# the clutter that it expects of the city:

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
