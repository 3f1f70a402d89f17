"""Trained agents for other programs: plain weights, ONNX, C, and a page for the browser."""
