"""DCA-SPE: the active terminal removes its data from its echoes and detects targets."""

from __future__ import annotations

from dataclasses import dataclass, replace

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload
from isac_rt.frame.schedule import codes_of
from isac_rt.receive.chain import Refiner, detector_of, excised, filter_of, refiner_of
from isac_rt.receive.clutter_filter import ClutterFilter
from isac_rt.receive.joint.leakage import without_leakage
from isac_rt.receive.joint.moments import Moments
from isac_rt.receive.known import Known
from isac_rt.receive.sense import Detector, make_maps, measure_channels
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import cleaned
from isac_rt.receive.types import NO_HINTS, ExpectedClutter, Hints, Reception


@dataclass(frozen=True)
class ActiveReceiver:
    """Processing of the active terminal: data removal, clutter filter, detection, estimation,
    refinement."""

    antennas: Antennas
    settings: Receivers
    clutter_filter: ClutterFilter | None
    detector: Detector
    refiner: Refiner | None

    @classmethod
    def of(cls, antennas: Antennas, settings: Receivers) -> ActiveReceiver:
        """Build the receiver of the settings."""
        chain = filter_of(settings), detector_of(settings), refiner_of(settings)
        return cls(antennas, settings, *chain)

    def receive(
        self,
        cube: IFCube,
        payload: Payload,
        hints: Hints = NO_HINTS,
        *,
        maps: bool = False,
    ) -> Reception:
        """See `receive_active`."""
        known = Known.of(cube, payload, self.antennas, 2)
        spectra, known = cleaned(cube, known)
        if self.clutter_filter is not None:
            spectra = spectra.copy()
            self.clutter_filter.clean(spectra, cube.schedule, codes_of(cube.waveform))
        spectra, known = known.decoded(spectra)
        sensed = self.detector.sense(spectra, known, hints)
        detections = sensed.detections
        if self.refiner is not None:
            moments = Moments(cube.samples, known)
            least = self.settings.min_range_m
            alone = without_leakage(cube.samples, known, moments.noise, least)
            if alone is not cube.samples:
                moments = Moments(alone, known)
            detections = self.refiner(moments, detections)[0]
        kept_maps = make_maps(sensed.power, cube, self.settings, 2) if maps else None
        out = Reception.undecoded(
            cube.waveform, detections, kept_maps, sensed.sparse, sensed.correction
        )
        if self.settings.self_calibration == "none":
            return out
        measured = measure_channels(spectra, known, sensed.estimates, sensed.detections.snr)
        return replace(out, path_channels=measured)


def receive_active(
    cube: IFCube,
    payload: Payload,
    antennas: Antennas,
    settings: Receivers,
    *,
    clutter: ExpectedClutter | None = None,
    maps: bool = False,
) -> Reception:
    """Estimate range, velocity and direction of the echoes of the terminal's own transmission.

    Parameters
    ----------
    cube : IFCube, received by the terminal that sent `payload`
    payload : transmitted data
    antennas : of both ends
    settings : Receivers
    clutter : expected clutter of the city, for `clutter_detector: angle_doppler`
    maps : also return range-Doppler maps

    Returns
    -------
    Reception with detections only: range one way, velocity receding positive, direction cosines
    from the virtual L

    Examples
    --------
    An echo 5 m away that recedes at 4 m/s, straight ahead:

    >>> import numpy as np
    >>> from isac_rt.frame.payload import unmodulated
    >>> from isac_rt.frame.schedule import conventional_schedule
    >>> from isac_rt.frame.waveform import Waveform
    >>> w = Waveform(num_samples=64, num_chirps=24)
    >>> antennas = Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5 * w.wavelength)
    >>> t = w.chirp_time[:, :, None] + w.fast_time - w.frame_duration / 2
    >>> tau = (2 * 5 + 2 * 4 * t) / 299792458
    >>> samples = np.exp(2j * np.pi * w.phase(tau, w.fast_time))[:, None].repeat(3, axis=1)
    >>> cube = IFCube(
    ...     samples=samples.astype(np.complex64),
    ...     waveform=w,
    ...     schedule=conventional_schedule(3, 24, 3),
    ...     start_time=0.0,
    ... )
    >>> found = receive_active(cube, unmodulated(w), antennas, Receivers())
    >>> found
    <Reception 1 detections, no data decoded>
    >>> found.detections.range.round(2), found.detections.velocity.round(1)
    (array([5.]), array([4.]))
    """
    chain = ActiveReceiver.of(antennas, settings)
    return chain.receive(excised(cube, settings), payload, Hints(clutter), maps=maps)
