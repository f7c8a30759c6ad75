"""UsdLux lights, and gprims that are lights."""
