"""Virtual point lights: emission along light paths, arrangement into sets, and gathering at a point."""
