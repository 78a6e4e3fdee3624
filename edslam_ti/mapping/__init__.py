"""Builds the Gaussian map from events, depth and poses (Sec. III-C to III-E)."""
