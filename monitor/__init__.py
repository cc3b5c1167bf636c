"""The running monitor: observer -> estimates -> alarms -> Zenoh, MCAP, Rerun."""
