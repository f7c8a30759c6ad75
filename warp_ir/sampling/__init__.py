"""Where samples come from: a low-discrepancy sequence, and maps from the unit square to what is sampled."""
