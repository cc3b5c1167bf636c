"""Reconstructions of earlier observers and a Kalman filter, to compare with."""
