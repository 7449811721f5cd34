# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Paths in a city
# The 3-D scene of a run. Drag to rotate it; click a kind of path in the legend to hide or show it.

# %%
import matplotlib.pyplot as plt
import numpy as np

import isac_rt as irt

scenario = irt.load(
    "../scenes/street_canyon.yaml", ["clutter.model=field", "accuracy.preset=everything"]
)
setup = irt.prepare(scenario)
setup.city

# %%
epoch = setup.timetable.epoch(0)
times = np.linspace(0, setup.timetable.epoch(scenario.frames - 1), 40)
paths = irt.trace(scenario, 0, setup=setup)
irt.scene_3d(setup.city, setup.swarm, times, epoch, paths)

# %% [markdown]
# Each link has its paths as flat arrays: gains without the carrier phase, delays and delay rates
# in float64, directions of departure and arrival, kinds.

# %%
paths

# %% [markdown]
# Delay and Doppler shift of the paths to the passive terminal, by kind. The scatterers of the
# walls form the ridge.

# %%
received = paths["AT", "PT1"]
figure, ax = plt.subplots(figsize=(8, 4))
for kind in irt.PathKind:
    one = received.select(received.kind == kind)
    if len(one):
        size = 4 if len(one) > 100 else 40
        ax.scatter(
            1e9 * one.delay,
            -scenario.radio.carrier_hz * one.delay_rate,
            s=size,
            label=f"{kind.name.lower()} ({len(one)})",
        )
ax.set(xlabel="delay [ns]", ylabel="Doppler shift [Hz]")
ax.legend()
# %% [markdown]
# A delay in the next frame follows from its rate and acceleration in this one: the line of sight
# changes by $\dot\tau\,\Delta t + \ddot\tau\,\Delta t^2/2$.

# %%
later = irt.trace(scenario, 1, setup=setup)["AT", "PT1"]
dt = setup.timetable.epoch(1) - epoch
rate, accel = received.delay_rate[0], received.delay_accel[0]
print(
    f"moved {1e12 * (later.delay[0] - received.delay[0]):.4f} ps, predicted "
    f"{1e12 * (rate * dt + accel * dt**2 / 2):.4f} ps"
)
