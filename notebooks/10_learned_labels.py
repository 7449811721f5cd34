# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Learning from labelled cells
# A data set keeps the truth of every range-Doppler cell as a mask: noise, the city, or a UAV. A
# small network in NumPy learns to name a cell from its surroundings and its directions, and is
# tested in streets that it has not seen. A minute on two idle cores, most of it for the data set.

# %% [markdown]
# ## The data set
# One radar with an L of five receive antennas and five targets among 4 x 4 blocks. Each of 16 cells
# of the ground belongs to the training or to the test. Only spectra and labels are kept, so that no
# receiver runs.

# %%
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import numpy as np

import isac_rt as irt

names = [f"U{k}" for k in range(1, 6)]
targets = "".join(
    f"  {name}: {{role: target, position_m: [0, {4 * k}, 9]}}\n" for k, name in enumerate(names)
)
drawn = "".join(
    f"  swarm.{name}.position_m: {{uniform: [[-6, -18, 7], [6, 20, 13]]}}\n"
    f"  swarm.{name}.velocity_mps: {{uniform: [[-2, -8, -1], [2, 8, 1]]}}\n"
    for name in names
)
folder = Path(mkdtemp())
(folder / "blocks.yaml").write_text(f"""
frames: 2
frame_interval_s: 0.4
city: {{source: blocks, blocks_x: 4, blocks_y: 4, block_size_m: 40, street_width_m: 24,
       building_height_m: 16, height_spread_m: 5}}
array: {{tx_x: 1, tx_z: 1, rx_x: 4, rx_z: 2}}
radio: {{mode: fmcw, scheme: simo, samples_per_chirp: 128, bandwidth_hz: 160.0e+6,
        chirps_per_frame: 96}}
propagation: {{model: ray_traced, max_bounces: 1, rays: 5000}}
clutter: {{model: field}}
noise: {{model: link_budget, tx_power_dbm: 35}}
receiver_preset: plain
swarm:
  radar: {{role: active, position_m: [0, -30, 9], velocity_mps: [0, 7, 0]}}
{targets}""")
(folder / "cells.yaml").write_text(f"""
scenario: blocks.yaml
scenes: 40
seed: 3
place: {{east_m: [-128, 128], north_m: [-128, 128], cell_m: 64, up_m: [-2, 14]}}
draw:
  swarm.radar.velocity_mps: {{uniform: [[-1, 3, 0], [1, 9, 0]]}}
{drawn}splits: {{train: 0.6, test: 0.4}}
keep: [cube, mask, boxes]
""")
card = irt.run_dataset(irt.load_dataset(folder / "cells.yaml"), folder / "set")
{split: sum(shards.values()) for split, shards in card["splits"].items()}

# %% [markdown]
# All samples of a split in one batch, and one of them: the power that a range-Doppler cell receives
# from all directions, and the truth of the cells.

# %%
splits = {}
for split in ("train", "test"):
    samples = irt.Samples(folder / "set", split)
    splits[split] = irt.collate([samples[k] for k in range(len(samples))])
test = splits["test"]
number = np.argmax((test["mask"] > 1).sum(axis=(1, 2)))
level = 10 * np.log10(test["cube"][number].mean(axis=-1))
level -= np.median(level)
axes = test["map_velocity"][number], test["map_range"][number]
figure, ax = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
ax[0].pcolormesh(*axes, level, vmin=0, vmax=40, shading="nearest")
ax[1].pcolormesh(*axes, np.minimum(test["mask"][number], 2), shading="nearest", cmap="viridis")
for one, title in zip(ax, ("power [dB over the median]", "0 noise, 1 city, 2 UAV"), strict=True):
    one.set(title=title, xlim=(-17, 17), ylim=(0, 75), xlabel="velocity [m/s]")
ax[0].set_ylabel("range [m]")
figure.tight_layout()

# %% [markdown]
# ## What the network sees
# Of each cell the power by direction, the power of the 7 x 7 cells around it, its range, and its
# velocity over the radar's own speed. No map of the city.

# %%
AROUND = 3


def features(batch):
    """Features (K, F) of all cells of a batch from 6 to 75 m, and their classes (K,)."""
    power = np.log10(batch["cube"])
    power -= np.median(power, axis=(1, 2, 3), keepdims=True)
    mean = power.mean(axis=-1)
    wide = np.pad(mean, ((0, 0), (0, 0), (AROUND, AROUND)), mode="wrap")
    wide = np.pad(wide, ((0, 0), (AROUND, AROUND), (0, 0)), mode="edge")
    size = 2 * AROUND + 1
    patch = np.lib.stride_tricks.sliding_window_view(wide, (size, size), axis=(1, 2))
    own = np.linalg.norm(batch["truth"]["uavs"]["radar"]["velocity_mps"], axis=1)
    speed = np.broadcast_to(batch["map_velocity"][:, None] / own[:, None, None], mean.shape)
    far = np.broadcast_to(np.log10(batch["map_range"] + 1)[..., None], mean.shape)
    each = np.concatenate(
        [
            power - mean[..., None],
            patch.reshape(*mean.shape, -1),
            np.stack([speed, np.abs(speed), far], axis=-1),
        ],
        axis=-1,
    )
    near = (batch["map_range"][0] > 6) & (batch["map_range"][0] < 75)
    return each[:, near].reshape(-1, each.shape[-1]), np.minimum(batch["mask"], 2)[:, near].ravel()


x, kind = features(splits["train"])
middle, scale = x.mean(axis=0), x.std(axis=0) + 1e-9
dict(zip(("noise", "city", "UAV"), np.bincount(kind).tolist(), strict=True))

# %% [markdown]
# ## Training
# One hidden layer of 32 and a softmax, Adam, batches of 100 cells of each class.

# %%
CELLS = 100


def train(x, kind, hidden=32, steps=3000, rate=3e-3, decay=1e-3, seed=0):
    """Weights of the network."""
    rng = np.random.default_rng(seed)
    weights = [
        rng.normal(size=(x.shape[1], hidden)) / np.sqrt(x.shape[1]),
        np.zeros(hidden),
        rng.normal(size=(hidden, 3)) / np.sqrt(hidden),
        np.zeros(3),
    ]
    mean, square = ([np.zeros_like(w) for w in weights] for _ in range(2))
    members = [np.flatnonzero(kind == k) for k in range(3)]
    for step in range(1, steps + 1):
        batch = np.concatenate([rng.choice(of, CELLS) for of in members])
        h = np.tanh(x[batch] @ weights[0] + weights[1])
        score = np.exp(h @ weights[2] + weights[3])
        error = (score / score.sum(axis=1, keepdims=True) - np.eye(3)[kind[batch]]) / len(batch)
        back = (error @ weights[2].T) * (1 - h * h)
        slopes = [x[batch].T @ back + decay * weights[0], back.sum(axis=0)]
        slopes += [h.T @ error + decay * weights[2], error.sum(axis=0)]
        for w, m, s, g in zip(weights, mean, square, slopes, strict=True):
            m += 0.1 * (g - m)
            s += 0.001 * (g * g - s)
            w -= rate * (m / (1 - 0.9**step)) / (np.sqrt(s / (1 - 0.999**step)) + 1e-8)
    return weights


weights = train((x - middle) / scale, kind)


def scores(x):
    """Scores (K, 3) of the classes."""
    h = np.tanh((x - middle) / scale @ weights[0] + weights[1])
    return h @ weights[2] + weights[3]


# %% [markdown]
# ## The test
# Rows are the truth of cells in unseen streets, columns what the network takes them for: shares of
# a row.

# %%
x, kind = features(test)
found = scores(x)
named = found.argmax(axis=1)
table = np.array([[np.mean(named[kind == a] == b) for b in range(3)] for a in range(3)])
print("share named    noise  city   UAV")
for name, row in zip(("noise", "city", "UAV"), table, strict=True):
    print(f"{name:14s}", *(f"{share:5.2f} " for share in row))

# %% [markdown]
# A detector that judges by power alone cannot tell a UAV from a wall. The figure holds the share of
# the UAVs' cells that is found against the share of all others that is taken for UAVs.

# %%
by_power = x[:, -4 - (2 * AROUND + 1) ** 2 // 2]  # the middle of the patch
by_network = found[:, 2] - np.logaddexp(found[:, 0], found[:, 1])
false = np.geomspace(1e-4, 1e-1, 20)
figure, ax = plt.subplots(figsize=(5.5, 3.4))
at = {}
for name, score in (("power", by_power), ("learned", by_network)):
    threshold = np.quantile(score[kind < 2], 1 - false)
    hit = [(score[kind == 2] > t).mean() for t in threshold]
    ax.semilogx(false, hit, label=name)
    at[name] = float(np.interp(1e-2, false, hit))
ax.set(xlabel="share of other cells taken for UAVs", ylabel="cells of UAVs found", ylim=(0, 1))
ax.legend()
print({name: round(share, 2) for name, share in at.items()})
assert at["learned"] > at["power"]
