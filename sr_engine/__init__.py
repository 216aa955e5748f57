"""Numerics: localize the fiducial, reconstruct, simulate a slice. Only worker.py does I/O."""
