"""Sensors against each other: strapdown kinematics, for any vehicle."""
