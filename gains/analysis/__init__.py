"""Which faults the sensors allow to estimate, and bounds that no observer beats."""
