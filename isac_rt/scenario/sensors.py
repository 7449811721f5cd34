"""Common FMCW sensors: what a scenario's `sensor` says of `radio`, `array` and `noise`.

docs/sensors.md names the source of each number, and says which are assumed and which chirps are our
choice. Arrays and antenna gains are those of the makers'
evaluation boards.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from isac_rt.frame.boards import TI_TX

Sensor = Literal[
    "awr1642",
    "awr1843",
    "awr2243",
    "awr2243_cascade",
    "awr2944",
    "bgt24mtr12",
    "iwr1443",
    "iwr6843",
]
BoardFile = Annotated[str, Field(pattern=r"\.(cfg|json)$")]

_TI_BOARD = {
    "tx": {"shape": "positions", "positions": [list(place) for place in TI_TX]},
    "rx": {"shape": "linear", "columns": 4},
}
"""TI's AWR1843BOOST and IWR6843ISK: four receivers half a wavelength apart, two transmitters two
wavelengths apart and a third between them half a wavelength higher."""

_OUR_RAMP = {"slope_mhz_per_us": 15.0, "idle_us": 7.0, "adc_start_us": 6.0, "ramp_end_us": 33.0}

SENSORS: dict[str, dict[str, dict[str, Any]]] = {
    # 76 to 81 GHz, 3 TX, 4 RX on AWR1843BOOST; our chirp
    "awr1843": {
        "radio": {
            "mode": "fmcw",
            "scheme": "tdm",
            "carrier_hz": 77e9,
            "chirps_per_frame": 192,
            "samples_per_chirp": 256,
            "sampling_rate_hz": 10e6,
            "chirp": _OUR_RAMP,
        },
        "array": {**_TI_BOARD, "element_gain_dbi": 8.0},
        "noise": {"tx_power_dbm": 12.0, "noise_figure_db": 15.0},
    },
    # 76 to 81 GHz, 4 TX with phase shifters, 4 RX on AWR2944EVM, real converters; our chirp, DDMA
    # with two empty bands and the raised antenna last, as in TI's demonstration
    "awr2944": {
        "radio": {
            "mode": "fmcw",
            "scheme": "ddm",
            "sub_bands": 6,
            "carrier_hz": 76e9,
            "chirps_per_frame": 192,
            "samples_per_chirp": 384,
            "sampling_rate_hz": 15e6,
            "chirp": _OUR_RAMP,
        },
        "array": {
            "tx": {
                "shape": "positions",
                "positions": [[0.0, 0.0], [2.0, 0.0], [4.0, 0.0], [1.0, 0.8]],
            },
            "rx": {"shape": "linear", "columns": 4},
            "element_gain_dbi": 12.0,
        },
        "noise": {"tx_power_dbm": 13.5, "noise_figure_db": 12.0},
    },
    # 60 to 64 GHz, 3 TX, 4 RX on IWR6843ISK; the chirp of TI's profile_iwr6843_ods_3d.cfg
    "iwr6843": {
        "radio": {
            "mode": "fmcw",
            "scheme": "tdm",
            "carrier_hz": 60.25e9,
            "chirps_per_frame": 96,
            "samples_per_chirp": 256,
            "sampling_rate_hz": 12.5e6,
            "chirp": {
                "slope_mhz_per_us": 156.0,
                "idle_us": 7.0,
                "adc_start_us": 3.0,
                "ramp_end_us": 24.0,
            },
        },
        "array": {**_TI_BOARD, "element_gain_dbi": 7.0},
        "noise": {"tx_power_dbm": 12.0, "noise_figure_db": 12.0},
    },
    # 24.025 to 24.225 GHz, 1 TX, 2 RX in a row on Infineon's Position2Go, with the chirp of its
    # firmware: 64 samples over a ramp of 300 us; 0.9 us of it are left to the echoes on their way
    "bgt24mtr12": {
        "radio": {
            "mode": "fmcw",
            "scheme": "simo",
            "carrier_hz": 24.025e9,
            "chirps_per_frame": 64,
            "samples_per_chirp": 64,
            "sampling_rate_hz": 0.214e6,
            "chirp": {
                "slope_mhz_per_us": 0.6667,
                "idle_us": 200.0,
                "adc_start_us": 0.9,
                "ramp_end_us": 300.0,
            },
        },
        "array": {
            "tx": {"shape": "linear", "columns": 1},
            "rx": {"shape": "linear", "columns": 2},
            "element_gain_dbi": 12.0,
        },
        "noise": {"tx_power_dbm": 11.0, "noise_figure_db": 12.0},
    },
}


def _like_awr1843(
    chirps: int, noise: tuple[float, float], gain_dbi: float, array: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """A sensor with the chirp of the AWR1843 here: chirps in a frame, transmit power [dBm] and
    noise figure [dB], gain of an element, and its array."""
    power, figure = noise
    return {
        "radio": {**SENSORS["awr1843"]["radio"], "chirps_per_frame": chirps},
        "array": {**array, "element_gain_dbi": gain_dbi},
        "noise": {"tx_power_dbm": power, "noise_figure_db": figure},
    }


_IN_A_ROW = {
    "tx": {"shape": "positions", "positions": [[0.0, 0.0], [2.0, 0.0]]},
    "rx": _TI_BOARD["rx"],
}
_CASCADE = {"tx": {"shape": "ti_cascade"}, "rx": {"shape": "ti_cascade"}}
SENSORS |= {
    # 2 TX two wavelengths apart, 4 RX on AWR1642BOOST
    "awr1642": _like_awr1843(128, (12.5, 15.0), 8.0, _IN_A_ROW),
    # 3 TX, 4 RX on IWR1443BOOST and AWR2243BOOST
    "iwr1443": _like_awr1843(192, (12.0, 15.0), 8.0, _TI_BOARD),
    "awr2243": _like_awr1843(192, (13.0, 13.0), 8.0, _TI_BOARD),
    # four AWR2243 on MMWCAS-RF-EVM: 12 TX in turn, 16 RX
    "awr2243_cascade": _like_awr1843(192, (13.0, 13.0), 8.0, _CASCADE),
}


def with_sensor(stated: dict[str, Any]) -> dict[str, Any]:
    """Return a file's settings, completed by its `sensor`. Malformed parts stay as they are, for
    the validation."""
    name, out = stated.get("sensor"), dict(stated)
    if not isinstance(name, str) or name.lower() not in SENSORS:
        return out
    out["sensor"] = name.lower()
    return completed(out, SENSORS[name.lower()])


def completed(stated: dict[str, Any], defaults: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return settings with what a sensor says under the keys that are stated."""
    out = dict(stated)
    for key, values in defaults.items():
        given = stated.get(key, {})
        if isinstance(given, dict):
            out[key] = {**values, **given}
            if isinstance(chirp := given.get("chirp"), dict):
                out[key]["chirp"] = {**values.get("chirp", {}), **chirp}
    return out
