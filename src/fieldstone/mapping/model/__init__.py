"""The model while it is made: its points, its refinement, its calibration, how certain it is."""
