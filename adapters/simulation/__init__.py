"""The reference plant with exact faults, and senders of simulated or recorded telemetry."""
