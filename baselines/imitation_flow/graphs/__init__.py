"""Trained emissions as ONNX graphs."""
