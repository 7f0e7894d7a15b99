"""Prints the names and shapes of a snapshot's tensors as JSON, read by the safetensors package."""

import json
import sys

import numpy as np
from safetensors.numpy import load_file

tensors = load_file(sys.argv[1])
for name, tensor in tensors.items():
    assert tensor.dtype == np.float32, (name, tensor.dtype)
    assert np.isfinite(tensor).all(), name
print(json.dumps({name: list(tensor.shape) for name, tensor in tensors.items()}))
