"""What people look at: panels and colours, Rerun files and the live Rerun view."""
