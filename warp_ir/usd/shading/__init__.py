"""Materials: which is bound, and the diffuse, emissive and opacity part of its shader network."""
