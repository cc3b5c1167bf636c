"""Any vehicle with a model of its own."""
