"""Image assets: decoding, caching, environment map layouts, and values of shading networks as images."""
