"""Presets of receivers and trackers, and the sets of them that are compared."""

from __future__ import annotations

from typing import Any, Literal

from isac_rt.receive.settings import COUNTS_WITH, Receivers
from isac_rt.settings import Node
from isac_rt.track.settings import Tracking

PLAIN: dict[str, dict[str, Any]] = {
    "receivers": {
        "velocity_method": "auto",
        "refinement": "local",
        "symbol_decision": "powers",
        "separate_reference": False,
        "link_acquisition": "pilots",
        "passive_detector": "cfar",
        "clutter_filter": "none",
        "clutter_detector": "cfar",
        "false_alarm_rate": 1e-6,
        "update_false_alarm_rate": None,
    },
    "tracking": {"drop_after_s": None, "initiation": "all"},
}


PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "paper": {
        "receivers": {
            **PLAIN["receivers"],
            "velocity_method": "omp",
            "refinement": "grid",
            "clutter_filter": "runs",
        },
        "tracking": PLAIN["tracking"],
    },
    "plain": PLAIN,
    "city": {
        "receivers": {
            **PLAIN["receivers"],
            "symbol_decision": "beams",
            "separate_reference": True,
            "link_acquisition": "blind",
            "passive_detector": "beams",
            "clutter_detector": "angle_doppler",
            "update_false_alarm_rate": 1e-4,
        },
        "tracking": {"drop_after_s": 0.36, "initiation": "unexplained"},
    },
}
"""What each preset says of `receivers` and `tracking`, all of them of the same keys; of the rest
they say nothing."""


Preset = Literal["paper", "plain", "city"]


class ReceiverSet(Node):
    """Receivers and trackers that receive the same samples as the scenario's own. They listen only:
    nothing that is sent depends on them."""

    preset: Preset | None = None
    """Settings by name, which the keys stated beside it override. null, the default: none; what is
    not stated is as in the scenario's own `receivers` and `tracking`."""
    receivers: Receivers = Receivers()
    """How its terminals detect targets and decode data. What is left out is as the preset says, or
    as by default."""
    tracking: Tracking = Tracking()
    """Its Kalman filters, and when a track begins and ends. What is left out is as the preset says,
    or as by default."""


def with_preset(stated: dict[str, Any], named: Any, own: dict[str, Any]) -> dict[str, Any]:
    """Return a file's settings of a set of receivers, completed by the preset `named` and by `own`
    settings. Malformed parts stay as they are, for the validation."""
    preset = PRESETS.get(named, {}) if isinstance(named, str) else {}
    out = dict(stated)
    for key in ("receivers", "tracking"):
        mine = stated.get(key, {})
        if isinstance(mine, dict):
            parts = [p for p in (own.get(key), preset.get(key)) if isinstance(p, dict)]
            filled = {k: v for part in parts for k, v in part.items()} | mine
            out[key] = filled if key == "tracking" else _without_idle(filled, mine)
    return out


def _without_idle(filled: dict[str, Any], stated: dict[str, Any]) -> dict[str, Any]:
    """Settings of receivers without those that nobody stated and that have no meaning beside what
    was."""
    idle = {
        key
        for key, (needed, values) in COUNTS_WITH.items()
        if needed in stated and stated[needed] not in values
    }
    start, usual = filled.get("false_alarm_rate"), filled.get("update_false_alarm_rate")
    if isinstance(start, int | float) and isinstance(usual, int | float) and usual < start:
        idle.add("update_false_alarm_rate")
    return {k: v for k, v in filled.items() if k in stated or k not in idle}
