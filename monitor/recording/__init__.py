"""Storage: MCAP files within a budget, clips around alarms, the journal of alarm events."""
