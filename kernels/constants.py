"""Constants that several kernels and their callers share; this file loads neither torch nor an engine."""

NEAR = 0.05  # metres: points nearer to a camera are neither measured nor drawn
