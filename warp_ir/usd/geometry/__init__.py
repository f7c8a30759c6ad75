"""Geometry prims as triangles: meshes, implicit shapes, subdivision, skinning, instancing, velocities."""
