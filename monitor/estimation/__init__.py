"""From (u, y) samples to estimates and evidence: observers, one by one or over whole stretches, banks, edges."""
