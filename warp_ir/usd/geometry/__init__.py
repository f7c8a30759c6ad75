"""Geometry prims to triangles: meshes, implicit shapes, subdivision, skinning, instancing, velocities."""
