"""What the paper compares with, at the same parameters: conventional TDM-MIMO FMCW and
mmWave-LoRadar, each a receiver of its own."""

from reproduce.baselines.fmcw import fmcw_frame, receive_fmcw
from reproduce.baselines.loradar import (
    Echoes,
    LoRadar,
    LoRadarFrame,
    detect_symbols,
    loradar_error_rate,
    loradar_frame,
    loradar_symbol_errors,
    receive_loradar,
    symbol_tones,
)
from reproduce.baselines.tdm import resolution

__all__ = [
    "Echoes",
    "LoRadar",
    "LoRadarFrame",
    "detect_symbols",
    "fmcw_frame",
    "loradar_error_rate",
    "loradar_frame",
    "loradar_symbol_errors",
    "receive_fmcw",
    "receive_loradar",
    "resolution",
    "symbol_tones",
]
