"""From (u, y) samples to estimates and evidence: observers, banks, isolation, uncertainty."""
