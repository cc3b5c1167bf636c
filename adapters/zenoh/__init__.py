"""Zenoh: sessions, and telemetry from them."""
