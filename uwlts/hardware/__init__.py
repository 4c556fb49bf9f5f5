"""Cameras, stages and lasers: what moves, lights and looks at the tank."""
