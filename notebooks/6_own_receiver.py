# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A custom receiver
# A terminal is a class with a method `receive`, from samples and public knowledge to a
# `Reception`. Replacing it leaves tracking, scoring and figures as they are.

# %% [markdown]
# This active terminal keeps only detections with an SNR above 14 dB, of those that a CFAR with
# many false alarms finds:

# %%
from dataclasses import replace
from tempfile import TemporaryDirectory

import isac_rt as irt


class Cautious(irt.ActiveTerminal):
    """Drops detections under 14 dB."""

    def receive(self, cube, payload, clutter, maps):
        found = super().receive(cube, payload, clutter, maps)
        strong = found.detections.snr > 25
        return replace(found, detections=found.detections.select(strong))


def terminal(setup, link):
    """The standard receiver for passive terminals, the cautious one for active ones."""
    if link[0] != link[1]:
        return irt.standard_terminal(setup, link)
    s = setup.scenario
    return Cautious(setup.waveform, setup.antennas, s.receivers, s.tracking)


scenario = irt.load(
    "../scenes/street_canyon.yaml",
    [
        "clutter.model=none",
        "modulation.acquisition_frames=1",
        "receiver_preset=plain",
        "receivers.false_alarm_rate=1e-3",
    ],
    frames=4,
)
for name, receiver in (("standard", irt.standard_terminal), ("cautious", terminal)):
    own = irt.run(scenario, terminal=receiver).summary["terminals"]["AT"]
    print(
        f"{name}: hit rate {own['hit_rate']:.2f}, false detections per frame "
        f"{own['false_per_frame']:.1f}"
    )

# %% [markdown]
# Samples can be saved for other receivers, as NetCDF here, or by `irt.write_sigmf`:

# %%
setup = irt.prepare(scenario)
frame = setup.frame(2)
cube = frame.samples(("AT", "PT1"))
with TemporaryDirectory() as folder:
    irt.save_cube(cube, f"{folder}/frame2.nc")
    print(irt.load_cube(f"{folder}/frame2.nc"))
