"""Basic readers of USD values: type-checked attributes, colour spaces, primvars, triangles, and the warning report."""
