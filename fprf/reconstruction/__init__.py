"""Images or a video without poses to a scene folder: choose, match, reconstruct. COLMAP runs in processes of
its own.
"""
