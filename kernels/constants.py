"""Numbers that several kernels and their callers share; it loads neither torch nor an engine."""

NEAR = 0.05  # metres: a camera measures and draws nothing nearer
