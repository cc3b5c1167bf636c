"""Certified observers: the convex design, its proof without the solver, and the file of its gains."""
