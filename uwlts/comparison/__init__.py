"""Comparison of a surface with an earlier cloud, a mesh or an ideal shape."""
