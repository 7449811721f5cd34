"""isac_rt: ray-traced integrated sensing and communication with UAV swarms over cities at 77 GHz.

    import isac_rt as irt
    scenario = irt.load("scenes/street_canyon.yaml")
    results = irt.run(scenario)

Every stage is callable by itself: `trace`, `if_signal`, `receive_active`, `receive_passive`. Names are imported on first use, so that
`import isac_rt` starts neither Sionna nor the JIT.
"""

from __future__ import annotations

from importlib import import_module

_HOME = {
    "load": "scenario_file",
    "to_yaml": "scenario_file",
    "Scenario": "scenario",
    "prepare": "simulate",
    "run": "simulate",
    "trace": "simulate",
    "if_signal": "ifsignal",
    "range_profiles": "ifsignal",
    "add_noise": "ifsignal",
    "Transmission": "ifsignal",
    "IFCube": "ifsignal",
    "receive_active": "receive",
    "receive_passive": "receive",
    "Reception": "receive",
    "Detections": "receive",
    "Prediction": "receive",
    "ActiveTerminal": "terminal",
    "PassiveTerminal": "terminal",
    "standard_terminal": "simulate",
    "city_of": "surroundings",
    "scene_3d": "interactive",
    "animate": "animate",
    "write_animation": "animate",
    "save_cube": "interchange",
    "load_cube": "interchange",
    "write_sigmf": "interchange",
    "read_sigmf": "interchange",
    "from_sionna": "interchange",
    "stonesoup_detections": "interchange",
    "PathSet": "propagation.pathset",
    "PathKind": "propagation.pathset",
    "Results": "results",
    "save": "results",
    "open_results": "results",
    "load_sweep": "sweep",
    "run_sweep": "sweep",
    "open_sweep": "sweep",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'isac_rt' has no attribute {name!r}")
    home = import_module(f"isac_rt.{_HOME[name]}")
    return getattr(home, "load" if name == "open_results" else name)


def __dir__() -> list[str]:
    return __all__
