"""DCA-SPE: the active terminal takes its own data out of its echoes and senses."""

from __future__ import annotations

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, RangeProfiles
from isac_rt.frame.payload import Payload
from isac_rt.receive.clutter.filter import remove_standing
from isac_rt.receive.clutter.sense import sense_in_clutter
from isac_rt.receive.joint.fit import Frame
from isac_rt.receive.joint.separate import separate
from isac_rt.receive.sense import make_maps, sense
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.types import ExpectedClutter, Reception
from isac_rt.scenario.receivers import Receivers


def receive_active(
    cube: IFCube | RangeProfiles,
    payload: Payload,
    antennas: Antennas,
    settings: Receivers,
    *,
    clutter: ExpectedClutter | None = None,
    maps: bool = False,
) -> Reception:
    """Range, velocity and direction of what the transmitter's own echoes show.

    Parameters
    ----------
    cube : IFCube, received by the terminal that sent `payload`, or its range profiles, with which
        there is no `joint` refinement
    clutter : what the city is expected to return, for the detectors that need it
        (`isac_rt.receive.clutter.detectors`)
    maps : also return pictures

    Returns
    -------
    Reception with detections only: range one way, velocity receding positive, direction cosines
    from the virtual L
    """
    w = cube.waveform
    if isinstance(cube, RangeProfiles):
        spectra = cube.spectra.copy() if settings.clutter_filter != "none" else cube.spectra
    else:
        spectra = clean_spectrum(cube, payload.delay_symbols, payload.phases, w.num_delay_symbols)
    if settings.clutter_filter != "none":
        remove_standing(
            spectra,
            cube.schedule,
            settings.clutter_run_cells if settings.clutter_filter == "runs" else None,
        )
    if settings.clutter_detector == "cfar":
        found = sense(
            spectra, w, cube.schedule, payload.delay_symbols, antennas, settings, passes=2
        )
    else:
        found = sense_in_clutter(
            spectra, w, cube.schedule, payload.delay_symbols, antennas, settings, clutter
        )
    detections = found.detections
    if settings.refinement == "joint" and isinstance(cube, IFCube):
        detections = separate(
            Frame(cube, payload.delay_symbols, payload.phases, antennas, 2), detections
        )[0]
    picture = make_maps(found.power, cube, settings, 2) if maps else None
    return Reception.undecoded(w, detections, picture, found.sparse)
