"""Weighted moments that merge exactly: float64, centred (Chan), any order and partition gives the same within 1e-12."""
