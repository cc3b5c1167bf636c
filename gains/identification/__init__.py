"""Plants from healthy recordings: motors, surfaces, drives, sensors, free parameters of a model."""
