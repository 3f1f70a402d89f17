"""What a cart is: its parameters and its hardware."""
