"""Telemetry in: bytes from links and recordings -> messages -> (u, y) samples on a fixed-rate grid."""
