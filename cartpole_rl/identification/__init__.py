"""Identification: what a recording says about the cart that it was made on."""
