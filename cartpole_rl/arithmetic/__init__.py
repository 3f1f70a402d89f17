"""Pure functions of tensors as plain arithmetic for one cart: in Python, JavaScript or C."""
