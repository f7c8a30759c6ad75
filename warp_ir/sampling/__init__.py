"""Sampling: a low-discrepancy sequence, maps from the unit square to directions, and tabulated distributions."""
