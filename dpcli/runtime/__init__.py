"""This room holds how work runs: device, seeds, progress, signals, processes. Nothing here knows about point clouds."""
