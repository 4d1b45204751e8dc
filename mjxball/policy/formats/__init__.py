"""Exports of a policy file for use without Python: an ONNX graph and a C99 header."""
