"""A learned policy for other programs and machines: NumPy, C, ONNX, fuzzy tools."""
