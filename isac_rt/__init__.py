"""isac_rt: ray-traced integrated sensing and communication with UAV swarms over cities at 77 GHz.

    import isac_rt as irt
    scenario = irt.load("scenes/street_canyon.yaml")
    results = irt.run(scenario)

Every stage is callable by itself: `trace`, `if_signal`, `receive_active`, `receive_passive`. Names
are imported on first use, so that `import isac_rt` starts neither Sionna nor the JIT. Editors and
type checkers read the imports; at run time `_NAMES` says the same.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "1.0.0"

if TYPE_CHECKING:
    from isac_rt.extensions.hardware.calibrate import Calibration as Calibration
    from isac_rt.extensions.hardware.calibrate import calibrate as calibrate
    from isac_rt.extensions.hardware.readers import import_file as import_file
    from isac_rt.extensions.hardware.readers import read_sigmf as read_sigmf
    from isac_rt.extensions.hardware.store import load_capture as load_capture
    from isac_rt.extensions.hardware.store import load_cube as load_cube
    from isac_rt.extensions.hardware.store import save_capture as save_capture
    from isac_rt.extensions.hardware.store import save_cube as save_cube
    from isac_rt.extensions.hardware.types import Capture as Capture
    from isac_rt.frame.cube import IFCube as IFCube
    from isac_rt.frame.cube import ReceiveArray as ReceiveArray
    from isac_rt.frame.cube import Reference as Reference
    from isac_rt.frame.cube import Transmission as Transmission
    from isac_rt.frame.waveform import Waveform as Waveform
    from isac_rt.propagation.pathset import PathKind as PathKind
    from isac_rt.propagation.pathset import PathSet as PathSet
    from isac_rt.receive.active import receive_active as receive_active
    from isac_rt.receive.passive import receive_passive as receive_passive
    from isac_rt.receive.types import Detections as Detections
    from isac_rt.receive.types import Prediction as Prediction
    from isac_rt.receive.types import Reception as Reception
    from isac_rt.results.files import open_results as open_results
    from isac_rt.results.files import save as save
    from isac_rt.results.recorder import Results as Results
    from isac_rt.scenario.file import load as load
    from isac_rt.scenario.file import to_yaml as to_yaml
    from isac_rt.scenario.tree import Scenario as Scenario
    from isac_rt.signal.if_signal import add_noise as add_noise
    from isac_rt.signal.if_signal import if_signal as if_signal
    from isac_rt.signal.methods import Auto as Auto
    from isac_rt.signal.methods import Direct as Direct
    from isac_rt.signal.methods import Exact as Exact
    from isac_rt.signal.methods import Gridded as Gridded
    from isac_rt.signal.methods import Separable as Separable
    from isac_rt.simulation.setup import Frame as Frame
    from isac_rt.simulation.setup import Setup as Setup
    from isac_rt.simulation.setup import city_of as city_of
    from isac_rt.simulation.setup import prepare as prepare
    from isac_rt.simulation.setup import trace as trace
    from isac_rt.simulation.simulate import run as run
    from isac_rt.simulation.stations import standard_terminal as standard_terminal
    from isac_rt.sweep import Samples as Samples
    from isac_rt.sweep import collate as collate
    from isac_rt.sweep import load_dataset as load_dataset
    from isac_rt.sweep import load_sweep as load_sweep
    from isac_rt.sweep import open_sweep as open_sweep
    from isac_rt.sweep import run_dataset as run_dataset
    from isac_rt.sweep import run_sweep as run_sweep
    from isac_rt.track.terminal import ActiveTerminal as ActiveTerminal
    from isac_rt.track.terminal import PassiveTerminal as PassiveTerminal
    from isac_rt.views.animate import animate as animate
    from isac_rt.views.animate import write_animation as write_animation
    from isac_rt.views.interchange import from_sionna as from_sionna
    from isac_rt.views.interchange import stonesoup_detections as stonesoup_detections
    from isac_rt.views.interchange import write_sigmf as write_sigmf
    from isac_rt.views.plots import Plots as Plots
    from isac_rt.views.scene import scene_3d as scene_3d

_NAMES = {
    "extensions.hardware.calibrate": "Calibration calibrate",
    "extensions.hardware.readers": "import_file read_sigmf",
    "extensions.hardware.store": "load_capture load_cube save_capture save_cube",
    "extensions.hardware.types": "Capture",
    "frame.cube": "IFCube ReceiveArray Reference Transmission",
    "frame.waveform": "Waveform",
    "propagation.pathset": "PathKind PathSet",
    "receive.active": "receive_active",
    "receive.passive": "receive_passive",
    "receive.types": "Detections Prediction Reception",
    "results.files": "open_results save",
    "results.recorder": "Results",
    "scenario.file": "load to_yaml",
    "scenario.tree": "Scenario",
    "signal.if_signal": "add_noise if_signal",
    "signal.methods": "Auto Direct Exact Gridded Separable",
    "simulation.setup": "Frame Setup city_of prepare trace",
    "simulation.simulate": "run",
    "simulation.stations": "standard_terminal",
    "sweep": "Samples collate load_dataset load_sweep open_sweep run_dataset run_sweep",
    "track.terminal": "ActiveTerminal PassiveTerminal",
    "views.animate": "animate write_animation",
    "views.scene": "scene_3d",
    "views.interchange": "from_sionna stonesoup_detections write_sigmf",
    "views.plots": "Plots",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted([*_HOME, "__version__"])


if not TYPE_CHECKING:  # a type checker would take every misspelt name for an object

    def __getattr__(name: str):
        if name not in _HOME:
            raise AttributeError(f"module 'isac_rt' has no attribute {name!r}")
        home = import_module(f"isac_rt.{_HOME[name]}")
        return getattr(home, name)


def __dir__() -> list[str]:
    return __all__
