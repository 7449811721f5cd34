"""isac_rt: ray-traced integrated sensing and communication with UAV swarms over cities at 77 GHz.

    import isac_rt as irt
    scenario = irt.load("scenes/street_canyon.yaml")
    results = irt.run(scenario)

Every stage is callable by itself: `trace`, `if_signal`, `receive_active`, `receive_passive`. Names
are imported on first use, so that `import isac_rt` starts neither Sionna nor the JIT.
"""

from __future__ import annotations

from importlib import import_module

_HOME = {
    "load": "scenario.file",
    "to_yaml": "scenario.file",
    "Scenario": "scenario.tree",
    "prepare": "simulation.setup",
    "run": "simulation.simulate",
    "trace": "simulation.setup",
    "if_signal": "signal.if_signal",
    "range_profiles": "signal.if_signal",
    "add_noise": "signal.if_signal",
    "Transmission": "frame.cube",
    "IFCube": "frame.cube",
    "receive_active": "receive",
    "receive_passive": "receive",
    "Reception": "receive",
    "Detections": "receive",
    "Prediction": "receive",
    "ActiveTerminal": "terminal.terminal",
    "PassiveTerminal": "terminal.terminal",
    "standard_terminal": "simulation.simulate",
    "city_of": "world.area",
    "scene_3d": "views.interactive",
    "animate": "views.animate",
    "write_animation": "views.animate",
    "save_cube": "views.interchange",
    "load_cube": "views.interchange",
    "write_sigmf": "views.interchange",
    "read_sigmf": "views.interchange",
    "from_sionna": "views.interchange",
    "stonesoup_detections": "views.interchange",
    "PathSet": "propagation.pathset",
    "PathKind": "propagation.pathset",
    "Results": "results.recorder",
    "save": "results.files",
    "open_results": "results.files",
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
