"""What the rest reads with: checked values of attributes, primvars, triangles, and the report of what was skipped."""
