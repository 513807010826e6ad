"""The figures of Rozumnyi et al., "Tracking by 3D Model Estimation of Unknown Objects in Videos", ICCV 2023.

IoU and average recall are in [0, 1], gains in percent as the paper prints them.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """One row of a table in the paper."""

    value: float  # IoU, or average recall in Table 5
    gain: float | None = None  # gain over the initial masks, in percent, if printed


CDTB = {
    "CSR-DCF": Published(0.498),
    "CSR-DCF + ours": Published(0.512, 2.8),
    "D3S": Published(0.732),
    "D3S + ours": Published(0.765, 4.5),
    "OSTrack": Published(0.758),
    "OSTrack + ours": Published(0.788, 4.0),
}
"""Table 1: mean IoU on CDTB, 80 sequences."""

IN_HAND = {
    "OSVOS": Published(0.8797),
    "OSTrack": Published(0.9326),
    "OSTrack + ours": Published(0.9405),
    "BackFlow (RGB-D)": Published(0.9352),
}
"""Table 2: IoU on the in-hand object manipulation dataset."""

COIN = {
    "Coin tracking": Published(0.704),
    "RGB": Published(0.718, 2.0),
    "RGB, flat prior": Published(0.731, 3.8),
    "S2DNet": Published(0.740, 5.1),
    "S2DNet, flat prior": Published(0.764, 8.5),
}
"""Table 3: IoU on the Coin Tracking dataset."""

ABLATION = {
    "initial masks (OSTrack)": Published(0.703),
    "RGB": Published(0.717, 2.0),
    "S2DNet": Published(0.740, 5.3),
    "no L_F": Published(0.727, 3.4),
    "no L_M": Published(0.689, -2.0),
    "no L_L": Published(0.692, -1.6),
    "no L_T": Published(0.734, 4.4),
}
"""Table 4: IoU on 16 random sequences of CDTB; the rows without a loss use S2DNet features."""

TUD_L = {
    "CosyPose-ECCV20-Synt+Real": Published(0.823),
    "CDPNv2 BOP20-RGB": Published(0.772),
    "CDPN BOP19-RGB": Published(0.769),
    "Zhigang-CDPN-ICCV19": Published(0.757),
    "Leaping from 2D to 6D-ECCVW20": Published(0.751),
    "CosyPose-ECCV20-PBR": Published(0.685),
    "CDPNv2 BOP20-PBR": Published(0.588),
    "EPOS-BOP20-PBR": Published(0.558),
    "ours": Published(0.545),
    "Pix2Pose-BOP20-ICCV19": Published(0.420),
    "Sundermeyer-IJCV19": Published(0.401),
    "Pix2Pose-BOP19-ICCV19": Published(0.349),
    "SingleMultiPathEncoder-CVPR20": Published(0.334),
    "DPOD (synthetic)": Published(0.242),
}
"""Table 5: average recall on TUD-L; all but ours are given the model and were trained."""

KEYFRAMES = {
    1: Published(0.7034),
    2: Published(0.7303),
    3: Published(0.7313),
    4: Published(0.7338),
    5: Published(0.7344),
    6: Published(0.7404),
    7: Published(0.7377),
    8: Published(0.7429),
    9: Published(0.7362),
    10: Published(0.7423),
}
"""Figure on the number of keyframes: IoU on the sequences of the ablation, S2DNet features."""
