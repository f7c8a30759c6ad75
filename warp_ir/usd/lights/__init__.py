"""UsdLux lights, and geometry that is a light."""
