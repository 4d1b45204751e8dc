"""A policy file as something that flies without Python: an ONNX graph, a C99 header."""
