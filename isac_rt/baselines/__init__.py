"""What the paper compares with, at the same parameters: conventional TDM-MIMO FMCW and mmWave-LoRadar, each a receiver of its own."""

from isac_rt.baselines.fmcw import fmcw_frame, receive_fmcw
from isac_rt.baselines.tdm import resolution

__all__ = ["fmcw_frame", "receive_fmcw", "resolution"]
