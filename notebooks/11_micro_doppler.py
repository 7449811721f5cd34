# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Micro-Doppler
# Blades and limbs move against the body that carries them, and spread its echo in Doppler. A
# spectrogram over slow time shows how; a car, rain and a foreign radar follow.

# %%
import matplotlib.pyplot as plt
import numpy as np

import isac_rt as irt
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.audit import make_plan

plt.rcParams["figure.dpi"] = 60


def spectrogram(signal, length, step):
    """Power [dB] of windowed pieces of slow time (Doppler, piece)."""
    starts = np.arange(0, signal.size - length, step)
    pieces = signal[starts[:, None] + np.arange(length)] * np.hanning(length)
    return 20 * np.log10(np.abs(np.fft.fftshift(np.fft.fft(pieces, axis=1), axes=1)).T + 1e-30)


def show(ax, power, slot, step, title):
    """Draw a spectrogram; closing is positive."""
    edge = 0.5e-3 / slot
    extent = (0, power.shape[1] * step * slot * 1e3, -edge, edge)  # the IF has -f_D, upwards
    ax.imshow(power, aspect="auto", extent=extent, vmin=power.max() - 50, cmap="viridis")
    ax.set(xlabel="time [ms]", ylabel="Doppler [kHz]", title=title)


def slow_time(setup, frames=1):
    """Range cell of the strongest echo over all chirps of some frames, first antenna."""
    cubes = [setup.frame(f).samples(("radar", "radar")).samples[0, 0] for f in range(frames)]
    window = np.hanning(cubes[0].shape[1])
    profiles = np.fft.fft(np.concatenate(cubes) * window, axis=1)
    return profiles[:, np.abs(profiles).sum(axis=0).argmax()]


# %% [markdown]
# ## Rotors
# One transmitter and slots of 40 us show Doppler shifts up to 12.5 kHz. At 1500 revolutions a
# minute the tips reach 9.7 kHz; at 6000 they reach 38.7 kHz, and fold. A rotor of two blades
# flashes twice in a turn. Strong blades show the pattern over the noise.

# %%
one_transmitter = ["radio.scheme=simo", "array.tx.shape=linear", "array.tx.columns=1"]
scene = "../scenes/quadcopter.yaml"
fig, axes = plt.subplots(1, 2, figsize=(11, 4))
for ax, speed in zip(axes, (1500, 6000), strict=True):
    strong = [f"swarm.Q.rotors.rev_per_min={speed}", "swarm.Q.rotors.blade_dbsm=-5"]
    fewer = ["swarm.Q.rotors.number=1", "swarm.Q.rotors.arm_m=0", "radio.chirps_per_frame=1200"]
    setup = irt.prepare(irt.load(scene, [*one_transmitter, *strong, *fewer]))
    signal, slot = slow_time(setup), setup.waveform.slot_duration
    show(ax, spectrogram(signal, 32, 4), slot, 4, f"{speed} revolutions a minute")
fig.tight_layout()

# %% [markdown]
# Blades flash as vertical lines, and the body is the horizontal one. The tips' sinusoid between the
# flashes stays under the noise. What `isac-rt plan` says of the whole quadcopter:

# %%
plan = make_plan(irt.prepare(irt.load(scene)))
[item["modelled"] for item in plan["items"] if item["what"].startswith("moving parts")]

# %% [markdown]
# ## A pedestrian
# Frames follow each other without a pause here, and the echo stays coherent from one to the next.
# The trunk keeps the walking speed, the feet swing to and fro about it.

# %%
person = {"role": "target", "position_m": [0.5, 9.0, 1.0], "velocity_mps": [0, -1.3, 0]}
slow = {"slope_mhz_per_us": 15.0, "idle_us": 247.0, "adc_start_us": 6.0, "ramp_end_us": 33.0}
setup = irt.prepare(
    Scenario.model_validate(
        {
            "frames": 6,
            "sensor": "awr1843",
            "radio": {"scheme": "simo", "chirp": slow, "chirps_per_frame": 860},
            "array": {"tx": {"shape": "linear", "columns": 1}},
            "receiver_preset": "plain",
            "swarm": {
                "radar": {"role": "active", "position_m": [0, 0, 1], "boresight": [0, 1, 0]},
                "person": {**person, "extent": {"kind": "pedestrian"}},
            },
        }
    )
)
cubes = [setup.frame(f).samples(("radar", "radar")).samples[0, 0] for f in range(6)]
profiles = np.fft.fft(np.concatenate(cubes) * np.hanning(cubes[0].shape[1]), axis=1)
cell = np.abs(profiles).sum(axis=0).argmax()
cells = range(cell - 4, cell + 5)  # the pedestrian crosses several
power = sum(10 ** (spectrogram(profiles[:, c], 96, 12) / 10) for c in cells)
fig, ax = plt.subplots(figsize=(8, 4))
slot = setup.waveform.slot_duration
show(ax, 10 * np.log10(power), slot, 12, "a pedestrian who comes nearer at 1.3 m/s")

# %% [markdown]
# ## Flat blades
# Seen from nearly below, wires turn across the view: nothing comes nearer, and their echo is at the
# body's Doppler. With a chord a blade is a plate, and flashes when its tilted normal passes the
# radar, once a turn for each of two blades.

# %%
hover = "{role: target, position_m: [0.3, 0.5, 6], rotors: {number: 1, rev_per_min: 1500"
fig, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True)
for ax, chord in zip(axes, ("null", 0.015), strict=True):
    above = [f"swarm.Q={hover}, chord_m: {chord}}}}}", "swarm.radar.boresight=[0,0.1,1]"]
    longer = "radio.chirps_per_frame=1200"
    setup = irt.prepare(irt.load(scene, [*one_transmitter, *above, longer]))
    signal, slot = slow_time(setup), setup.waveform.slot_duration
    show(ax, spectrogram(signal, 32, 4), slot, 4, "wires" if chord == "null" else "plates")
fig.tight_layout()

# %% [markdown]
# ## A car in the street
# Power by range in 20 frames: the car goes by at 5.5 m, its side a flash when the radar is across
# from it, and hides the pedestrian at 13 m behind it for as long.

# %%
setup = irt.prepare(irt.load("../scenes/street_traffic.yaml"))
cubes = [setup.frame(f).samples(("radar", "radar")).samples[0] for f in range(20)]
moving = [cube - cube.mean(axis=1, keepdims=True) for cube in cubes]  # what stands still is out
window = np.hanning(cubes[0].shape[-1])
profiles = [(np.abs(np.fft.fft(cube * window)) ** 2).mean(axis=(0, 1)) for cube in moving]
w = setup.waveform
shown = 10 * np.log10(np.transpose(profiles))[: int(20 / w.range_cell(2))]
fig, ax = plt.subplots(figsize=(8, 4))
ax.imshow(shown, aspect="auto", origin="lower", extent=(0, 20, 0, 20), vmin=np.median(shown))
_ = ax.set(xlabel="frame", ylabel="range [m]", title="a car before a pedestrian")

# %% [markdown]
# ## Rain, and a foreign radar
# Rain is an echo at all ranges, with the Doppler of falling drops and of the wind. A foreign radar
# with a repetition of 50 us crosses our band in every fifth chirp of 40 us, here as it begins.

# %%
weather = ["weather.rain_mm_per_h=50", "weather.wind_mps=[0, -3, 0]", "swarm.Q.rotors=null"]
car = "position_m: [3, 20, 1], boresight: [0, -1, 0], start_hz: 76.9e9, slope_mhz_per_us: 17"
foreign = [f"emitters.car={{{car}, ramp_us: 40, idle_us: 10}}", "swarm.Q.rotors=null"]
fig, axes = plt.subplots(1, 2, figsize=(11, 4))
rain, crossed = (
    irt.prepare(irt.load(scene, [*one_transmitter, *more])) for more in (weather, foreign)
)
cube = rain.frame(0).samples(("radar", "radar")).samples[0]
window = np.outer(np.hanning(cube.shape[1]), np.hanning(cube.shape[2]))
map_ = (np.abs(np.fft.fftshift(np.fft.fft2(cube * window), axes=1)) ** 2).mean(axis=0)
edge = rain.waveform.wavelength / (4 * rain.waveform.slot_duration)
cells = int(30 / rain.waveform.range_cell(2))
power = 10 * np.log10(map_[::-1, :cells].T)  # the IF has -f_D: closing is positive
extent = (-edge, edge, 0, 30)
axes[0].imshow(power, aspect="auto", origin="lower", extent=extent, vmin=np.median(power))
axes[0].set(xlabel="closing velocity [m/s]", ylabel="range [m]", title="rain of 50 mm/h")
cube = crossed.frame(0).samples(("radar", "radar")).samples[0, 0]
level = 20 * np.log10(np.abs(cube))
axes[1].imshow(level, aspect="auto", origin="lower", vmin=np.median(level))
axes[1].set(xlabel="sample", ylabel="chirp", title="a foreign radar")
fig.tight_layout()
