"""Certified observers: the convex design, its proof without the solver, the file that holds it."""
