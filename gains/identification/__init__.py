"""Healthy recordings to plants: motors, surfaces, drives, sensors, free parameters of a model."""
