"""Scenes that a simulation moves, and many views of many worlds of them."""
