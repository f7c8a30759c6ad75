"""Material bindings, and the diffuse, emissive and opacity part of shading networks."""
