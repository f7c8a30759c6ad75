"""Image files to pixels, and what shading networks make of them."""
