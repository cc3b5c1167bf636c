"""What people see of a vehicle: panels and colours, Rerun files and the live Rerun view."""
