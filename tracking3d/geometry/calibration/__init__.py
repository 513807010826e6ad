"""Camera calibration: camera files, calibration boards, and the estimation."""
