"""Trained networks: `load` reads one from a run folder or a weights file, `predictor` runs it. No optimiser is built here."""
