"""Wire protocols and driver node of a serial hexapod."""
