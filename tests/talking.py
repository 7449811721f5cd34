"""A small swarm in open space whose terminals tell each other what they see."""

from __future__ import annotations

from isac_rt.frame.settings import Array, Modulation, Noise
from isac_rt.propagation.settings import Propagation
from isac_rt.receive.settings import Receivers
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario


def uav(role, position, velocity, boresight, rcs=0.0):
    return Uav(
        role=role,
        position_m=position,
        velocity_mps=velocity,
        boresight=boresight,
        rcs={"model": "constant", "value_dbsm": rcs},
    )


def scenario(**change) -> Scenario:
    """An AT that looks north, a PT that looks south, a target between them that both see."""
    base = {
        "name": "talk",
        "seed": 3,
        "frames": 9,
        "frame_interval_s": 0.02,
        "radio": Radio(samples_per_chirp=256, bandwidth_hz=320e6, chirps_per_frame=60),
        "array": Array(rx_x=6, rx_z=6),
        "modulation": Modulation(acquisition_frames=2, pilot_every_frames=None),
        "swarm": {
            "AT": uav("active", (0.3, 0.2, 50), (0.7, 3.1, 0.0), (0, 1, 0)),
            "PT": uav("passive", (-3.9, 27.3, 50.7), (0.2, -1.9, 0.1), (0, -1, 0)),
            "U": uav("target", (9.1, 12.7, 51.3), (-0.9, 1.2, 0.3), (0, 1, 0), rcs=20.0),
        },
        "propagation": Propagation(model="free_space"),
        "noise": Noise(model="snr", snr_db=10),
        "receivers": Receivers(),
        "cooperation": "tracks",
    }
    return Scenario(**base | change)


def small(**change) -> Scenario:
    """The same with few small frames, that say nothing to each other: for what a run does around
    its frames."""
    base = {
        "frames": 3,
        "radio": Radio(samples_per_chirp=64, bandwidth_hz=320e6, chirps_per_frame=24),
        "array": Array(rx_x=2, rx_z=2),
        "cooperation": "none",
    }
    return scenario(**base | change)
