"""Plants: simulated carts, and one cart on a serial port, under one contract (`specs.py`)."""
