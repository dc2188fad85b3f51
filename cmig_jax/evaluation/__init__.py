"""Evaluation: test pairs, methods, the engine that runs every method on every pair, metrics and tables. Pictures are in `report`."""
